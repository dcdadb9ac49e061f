"""A torch zip read by a pickle reader that can rebuild tensors and nothing else.

A checkpoint of somebody else may name any function of any module and ask to have it called. Here only tensors are
real, and made by our own code; every other name becomes an inert placeholder, which takes whatever the file does to it
and keeps none of it. So foreign classes (a trainer's callbacks, an option container) do not stop us, and nothing runs.
"""

import functools
import io
import pickle
import struct
import zipfile
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

import torch
from torch import UntypedStorage

from gcd_model.errors import CheckpointError

_LARGEST_PICKLE = 16 * 2**20
"""Of a torch zip, in bytes; the pickle of a full-size training with its optimizer has two million."""
SAVE_AGAIN = "load it where it was made and write it again with torch.save (torch 1.6 or newer)"
_STORAGES = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "BoolStorage": torch.bool,
    "ComplexFloatStorage": torch.complex64,
    "ComplexDoubleStorage": torch.complex128,
}
"""What torch's typed storages hold; bytes for all others."""


class Placeholder:
    """Stands for an object of a class or function we do not call.

    It takes every step of the pickle protocol (construction, state, items) and forgets it.
    """

    __slots__ = ()
    origin = "an unknown class"

    def __new__(cls, *_args: object, **_options: object) -> "Placeholder":
        """Any arguments."""
        return object.__new__(cls)

    def __init__(self, *_args: object, **_options: object) -> None:
        """Keeps nothing."""

    def __call__(self, *_args: object, **_options: object) -> "Placeholder":
        """A placeholder used as a function gives itself."""
        return self

    def forget(self, *_args: object) -> None:
        """What state, items and elements of a foreign object come to."""

    __setstate__ = __setitem__ = append = extend = add = forget


@functools.lru_cache(maxsize=4096)
def _placeholder_class(origin: str) -> type[Placeholder]:
    return type("Placeholder", (Placeholder,), {"__slots__": (), "origin": origin})


@dataclass(frozen=True, slots=True)
class _Storage:
    content: UntypedStorage
    dtype: torch.dtype


class _Rebuild:
    """What the names of torch's rebuilding stand for; without attributes, so that a pickle can call but not change it.

    Called with a storage and its tensor's place, shape and strides it gives the tensor; with a tensor, that tensor.
    """

    __slots__ = ()

    def __call__(
        self, held: object, start: int = 0, shape: tuple[int, ...] = (), strides: tuple[int, ...] = (), *more: object
    ) -> object:
        if not isinstance(held, _Storage):
            return held  # a parameter counts as its tensor
        dtype = next((each for each in more if isinstance(each, torch.dtype)), held.dtype)
        return torch.empty(0, dtype=dtype).set_(held.content, start, shape, strides)


class _Reader(pickle.Unpickler):
    """Reads the pickle of an open torch zip; storages are views of one private mapping of the file."""

    def __init__(self, path: Path, file: BinaryIO, archive: zipfile.ZipFile, folder: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{folder}data.pkl")))
        self._file, self._archive, self._folder = file, archive, folder
        self._bytes = UntypedStorage.from_file(str(path), shared=False, nbytes=path.stat().st_size)
        self._storages: dict[str, UntypedStorage] = {}

    def find_class(self, module_name: str, global_name: str, /) -> object:
        """What a name of the file stands for; nothing is looked up but torch's dtypes, for which storages stand too."""
        if (module_name, global_name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module_name == "torch._utils" and global_name in _REBUILDING:
            return _Rebuild()
        if module_name in ("torch", "torch.storage") and global_name.endswith("Storage"):
            return _STORAGES.get(global_name, torch.uint8)
        dtype = vars(torch).get(global_name) if module_name == "torch" else None
        return dtype if isinstance(dtype, torch.dtype) else _placeholder_class(f"{module_name}.{global_name}")

    def persistent_load(self, pid: object) -> object:
        """A storage, by (kind, type, key, device, number of elements)."""
        match pid:
            case ("storage", torch.dtype() as dtype, str(key), _, int(count)):
                return _Storage(self._mapped(key, dtype.itemsize * count), dtype)
            case _:
                raise CheckpointError("its pickle refers to what is no tensor: refused")

    def _mapped(self, key: str, claimed: int) -> UntypedStorage:
        """The record's bytes. A short one would be read past its end."""
        if key not in self._storages:
            entry = self._archive.getinfo(f"{self._folder}data/{key}")
            self._file.seek(entry.header_offset)
            name, extra = struct.unpack("<26x2H", self._file.read(30))
            start = entry.header_offset + 30 + name + extra
            self._storages[key] = cast(UntypedStorage, self._bytes[start : start + entry.file_size])
        there = self._storages[key].nbytes()
        if not 0 <= claimed <= there:
            raise CheckpointError(
                f"tensor record {key} should hold {claimed} bytes and holds {there}: damaged, refused"
            )
        return self._storages[key]


_REBUILDING = (
    "_rebuild_tensor_v2",
    "_rebuild_tensor_v3",
    "_rebuild_parameter",
    "_rebuild_parameter_with_state",
)


def read_pickle(path: Path, file: BinaryIO) -> object:
    """What stands at the root of a torch zip, which is open.

    Raises: CheckpointError if it is no checkpoint that can be mapped; whatever a damaged zip or pickle raises.
    """
    with zipfile.ZipFile(file) as archive:
        entries = {entry.filename: entry for entry in archive.infolist()}
        if any(name.endswith("constants.pkl") for name in entries):
            raise CheckpointError("is a TorchScript program, which would be executed; wanted are weights only")
        pickled = next((name for name in entries if name.partition("/")[2] == "data.pkl"), None)
        if pickled is None:
            raise CheckpointError("is a zip without data.pkl, not a torch checkpoint; unpack it if it only wraps one")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries.values()):
            raise CheckpointError(f"is a zip whose tensors are compressed and cannot be mapped; {SAVE_AGAIN}")
        if entries[pickled].file_size > _LARGEST_PICKLE:
            raise CheckpointError(f"its pickle has {entries[pickled].file_size} bytes, more than {_LARGEST_PICKLE}")
        folder = pickled.removesuffix("data.pkl")
        if f"{folder}byteorder" in entries and archive.read(f"{folder}byteorder") != b"little":
            raise CheckpointError(f"holds numbers with the large end first; {SAVE_AGAIN}")
        return _Reader(path, file, archive, folder).load()
