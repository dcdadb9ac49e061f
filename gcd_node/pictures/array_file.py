"""NumPy files: those of strangers are opened without pickles and checked, ours appear whole or not at all."""

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import OutputError, SourceError

_MOST_BYTES = 2**30  # of all arrays, unfolded


def read_npy(path: Path, wanted: str) -> NDArray[Any]:
    """The array of a .npy file. `wanted` says for the message what it should hold. Raises SourceError."""
    loaded = _load(path, wanted)
    if isinstance(loaded, np.ndarray):
        return loaded
    loaded.close()
    raise SourceError(f"{path} is an archive of arrays; give {wanted}")


def read_npz(path: Path, wanted: str) -> dict[str, NDArray[Any]]:
    """All arrays of an .npz file by name. Raises SourceError."""
    loaded = _load(path, wanted)
    if isinstance(loaded, np.ndarray):
        raise SourceError(f"{path} is a single array; give {wanted}")
    try:
        with loaded:
            return {name: loaded[name] for name in loaded.files}
    except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
        raise _unreadable(path, wanted, error) from error


def write_npy(path: Path, array: NDArray[Any]) -> None:
    """Write one array. Raises OutputError."""
    _write(path, lambda file: np.save(file, array, allow_pickle=False))


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name. Raises OutputError."""
    _write(path, lambda file: np.savez(file, allow_pickle=False, **arrays))


def _write(path: Path, save: Callable[[BinaryIO], None]) -> None:
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("wb") as file:
            save(file)
        part.replace(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; name another file or folder") from error


def _load(path: Path, wanted: str) -> Any:
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        size = path.stat().st_size
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
        if size > _MOST_BYTES:
            raise ValueError(f"it holds more than {_MOST_BYTES} bytes")
        return np.load(path, allow_pickle=False)
    except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
        raise _unreadable(path, wanted, error) from error


def _unreadable(path: Path, wanted: str, error: Exception) -> SourceError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error).split("\n")[0]
    return SourceError(f"cannot read {path}: {reason or type(error).__name__}; give {wanted}")
