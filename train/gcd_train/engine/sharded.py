"""States of several processes: a folder of torch.distributed.checkpoint, with the digests of its files."""

import hashlib
import os
import pickle
import shutil
import warnings
from pathlib import Path
from typing import Any

import msgspec
import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed.checkpoint.filesystem import FileSystemReader
from torch.distributed.checkpoint.metadata import Metadata, StorageMeta, TensorStorageMetadata
from torch.distributed.checkpoint.state_dict_loader import load

from gcd_model.errors import FileError
from gcd_model.small_files import decode_json, read_small
from gcd_train.checkpoint import DamagedStateError, StageState
from gcd_train.engine.optimisers import torchao_optimisers
from gcd_train.engine.trained import AVERAGE, MODULE
from gcd_train.errors import RunError

_NOTE = "digest.json"
_FORMAT = 1
_DCP = "torch.distributed.checkpoint"
_MAY_BE_MADE = {
    "collections": {"OrderedDict"},
    "pathlib": {"Path", "PosixPath", "WindowsPath"},
    "torch": {"Size", *(name for name, value in vars(torch).items() if isinstance(value, torch.dtype))},
    "torch.serialization": {"_get_layout"},
    f"{_DCP}.filesystem": {"_StorageInfo"},
    f"{_DCP}.metadata": {
        "ChunkStorageMetadata", "Metadata", "MetadataIndex", "StorageMeta", "TensorProperties", "TensorStorageMetadata",
        "_MEM_FORMAT_ENCODING",
    },
}  # fmt: skip
"""What torch's metadata of tensors consists of, by module; a state that somebody else wrote may name anything."""


class FolderNote(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a folder says of itself. files: SHA-256 of each. moments: the optimiser's class, for its kind of tensors."""

    format: int = _FORMAT
    stage: str
    identity: str
    updates: int
    seconds: float
    moments: str
    files: dict[str, str] = {}


def close_folder(unfinished: Path, folder: Path, note: FolderNote) -> None:
    """Add the digests to a written folder and give it its name. Raises RunError."""
    try:
        found = {path.name: _digest(path) for path in sorted(unfinished.iterdir()) if path.name != _NOTE}
        content = msgspec.json.encode(msgspec.structs.replace(note, files=found))
        with (unfinished / _NOTE).open("wb") as file:
            file.write(content + b"\n" + hashlib.sha256(content).hexdigest().encode())
            file.flush()
            os.fsync(file.fileno())
        if folder.exists():
            shutil.rmtree(folder)
        unfinished.rename(folder)
    except OSError as error:
        raise RunError(f"cannot write the state {folder}: {error}; free some space or choose --out") from error


def checked_note(folder: Path, stage: str) -> FolderNote:
    """What a folder says of itself, when all of it is as it was written.

    Raises DamagedStateError; RunError for another stage.
    """
    try:
        content, _, said = read_small(folder / _NOTE).encode().rpartition(b"\n")
        if hashlib.sha256(content).hexdigest().encode() != said:
            raise _damaged(folder, f"{_NOTE} is not as it was written")
        note = decode_json(content, FolderNote)
        for name, digest in note.files.items():
            if not (folder / name).is_file():
                raise _damaged(folder, f"{name} is missing")
            if _digest(folder / name) != digest:
                raise _damaged(folder, f"the bytes of {name} are not those that were written")
    except FileError as error:
        raise _damaged(folder, f"{_NOTE} {error}") from error
    except OSError as error:
        raise _damaged(folder, f"a file that {_NOTE} names cannot be read: {error}") from error
    if note.stage != stage:
        raise RunError(f"{folder} is no state of the stage {stage!r}; delete it to start anew")
    return note


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if name not in _MAY_BE_MADE.get(module, ()):
            raise pickle.UnpicklingError(f"it names {module}.{name}, which no state of tensors needs")
        return super().find_class(module, name)


class _TensorReader(FileSystemReader):
    """Torch's reader, without its plain pickle: metadata of tensors alone, from which nothing else can be made."""

    def read_metadata(self, *args: Any, **kwargs: Any) -> Metadata:
        """Raises DamagedStateError."""
        _ = args, kwargs
        folder = Path(self.path)
        try:
            with (folder / ".metadata").open("rb") as file:
                metadata = _Unpickler(file).load()
            entries = metadata.state_dict_metadata.values() if isinstance(metadata, Metadata) else [metadata]
            if not all(isinstance(entry, TensorStorageMetadata) for entry in entries):
                raise _damaged(folder, "it holds what is no tensor")
        except FileNotFoundError as error:
            raise _damaged(folder, ".metadata is missing") from error
        except DamagedStateError:
            raise
        except Exception as error:  # a pickle that was cut or made up fails in any way
            raise _damaged(folder, f".metadata cannot be read ({error})") from error
        metadata.storage_meta = metadata.storage_meta or StorageMeta()
        metadata.storage_meta.load_id = self.load_id
        return metadata


def names_in(folder: Path) -> dict[str, TensorStorageMetadata]:
    """The tensors a folder holds, by name. Raises DamagedStateError."""
    return _TensorReader(folder).read_metadata().state_dict_metadata  # pyright: ignore[reportReturnType]


def read_weights(folder: Path, stage: str) -> StageState:
    """Weights and averages of a folder, in one process; the optimiser is left out. Raises as `checked_note`."""
    note = checked_note(folder, stage)
    wanted = {name: value for name, value in names_in(folder).items() if name.startswith((MODULE, AVERAGE))}
    tensors: dict[str, Any] = {
        name: torch.empty(value.size, dtype=value.properties.dtype) for name, value in wanted.items()
    }
    load_folder(folder, tensors, None)
    average = _under(tensors, AVERAGE)
    return StageState(
        stage=stage,
        identity=note.identity,
        updates=note.updates,
        seconds=note.seconds,
        module=_under(tensors, MODULE),
        optimiser={},
        average=average or None,
    )


def load_folder(folder: Path, tensors: dict[str, Any], group: dist.ProcessGroup | None) -> None:
    """Read a folder's values into tensors, each process its share; in one process, without a group, all of them."""
    reader = _TensorReader(folder)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="torch.distributed is disabled")  # as it should be
        load(tensors, storage_reader=reader, process_group=group, no_dist=group is None)


def admit_moments(note: FolderNote) -> None:
    """Let torch read the kind of moments a folder holds. Raises RecipeError if torchao is wanted and missing."""
    if note.moments.startswith("torchao."):
        torchao_optimisers("the state holds 8-bit moments; reading it")


def _under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def _damaged(folder: Path, what: str) -> DamagedStateError:
    return DamagedStateError(f"the state {folder} is damaged: {what}")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
