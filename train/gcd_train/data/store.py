"""Folders of what encoders made of clips or scenes: shards that appear whole, and an index that names them.

index.json      how everything was made and, of every shard, size, SHA-256 and arrays; replaced as a whole
*.safetensors   a shard
"""

import fcntl
import hashlib
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from safetensors import SafetensorError
from safetensors.torch import load, load_file, save
from torch import Tensor

from gcd_model.errors import FileError
from gcd_model.small_files import read_json
from gcd_train.errors import DataError, RunError
from gcd_train.files import write_whole

FORMAT = 2
_INDEX, _MOST_INDEX = "index.json", 1 << 26


class Shard(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One file. file: in the folder. arrays: shape by name."""

    file: str
    sha256: str
    bytes: int
    arrays: dict[str, tuple[int, ...]]


class Index(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What `index.json` says. format: of index and shards."""

    format: int = FORMAT


Kind = TypeVar("Kind", bound=Index)


def read_index(folder: Path, kind: type[Kind]) -> Kind | None:
    """The index of a folder, None where there is none yet. Raises RunError if it cannot be read."""
    path = folder / _INDEX
    if not path.exists():
        return None
    try:
        index = read_json(path, kind, _MOST_INDEX)
    except FileError as error:
        raise RunError(f"{path} {error}; delete {folder} and encode again") from error
    if index.format != FORMAT:
        raise RunError(f"{path} has format {index.format}, this version reads {FORMAT}; delete {folder}, encode again")
    return index


def write_index(folder: Path, index: Index) -> None:
    """Replace the index; a reader sees the old one or the new one. Raises RunError if it cannot be written."""
    write_whole(folder / _INDEX, msgspec.json.format(msgspec.json.encode(index)), lasting=True)


def write_shard(folder: Path, name: str, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """Write a shard; returns the fields of its `Shard`. Raises RunError if it cannot be written."""
    content, file = save(tensors), f"{name}.safetensors"
    write_whole(folder / file, content, lasting=True)
    arrays = {name: tuple(values.shape) for name, values in sorted(tensors.items())}
    return {"file": file, "sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content), "arrays": arrays}


def fault(folder: Path, shard: Shard) -> str | None:
    """What is wrong with a shard: missing, cut, changed; None if it is as it was written."""
    path = folder / shard.file
    try:
        if not path.is_file() or path.stat().st_size != shard.bytes:
            return f"{path} is missing or not of the {shard.bytes} bytes that were written"
        content = path.read_bytes()
    except OSError as error:
        return f"{path}: {error.strerror}"
    same = hashlib.sha256(content).hexdigest() == shard.sha256
    return None if same else f"{path} is damaged: its SHA-256 is not the one it was written with"


def read_shard(folder: Path, shard: Shard) -> dict[str, Tensor]:
    """The arrays of a shard, in memory. Raises DataError if it is missing or not as it was written."""
    wrong = fault(folder, shard)
    try:
        if wrong is None:
            return load((folder / shard.file).read_bytes())
    except (OSError, SafetensorError) as error:
        wrong = f"{folder / shard.file} cannot be read ({error})"
    raise DataError(f"{wrong}; run the same `gcd-train cache` again, it makes this scene anew")


def map_shard(folder: Path, shard: Shard) -> dict[str, Tensor]:
    """The arrays of a shard, mapped: read where they are used. Raises RunError if it is missing or cut."""
    path = folder / shard.file
    try:
        if not path.is_file() or path.stat().st_size != shard.bytes:
            raise RunError(f"{path} is missing or not of the {shard.bytes} bytes that were written; delete {folder}")
        return load_file(path)
    except (OSError, SafetensorError) as error:
        raise RunError(f"{path} cannot be read ({error}); delete {folder} and encode the clips again") from error


@contextmanager
def only_writer(folder: Path) -> Generator[None]:
    """Hold a folder for one run. Raises RunError if another run has it; a killed one lets go by itself."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunError(f"another run is writing to {folder}; wait for it, or stop it") from error
        for leftover in folder.glob(".*.partial"):
            leftover.unlink(missing_ok=True)
        yield
