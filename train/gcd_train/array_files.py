"""Archives of strangers, numpy's and zip's: nothing is unpickled, and nothing unfolds without limit."""

import io
import zipfile
import zlib
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError

ARRAY_FAULTS = (
    OSError, ValueError, EOFError, OverflowError, MemoryError, RecursionError, SyntaxError, TypeError, TokenError,
)  # fmt: skip
"""What numpy raises for a damaged or hostile file."""
ZIP_FAULTS = (OSError, KeyError, ValueError, NotImplementedError, EOFError, zlib.error, zipfile.BadZipFile)
"""What zipfile raises for one, and `read_member`."""
_MOST_ARRAYS, _MOST_MEMBER = 1 << 30, 1 << 28


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an npz by name. Raises DataError if it is damaged, no regular file, or unfolds to over a GiB."""
    try:
        _require_regular(path)
        with path.open("rb") as file:
            content = io.BytesIO(file.read(_MOST_ARRAYS))
        if not content.getbuffer().nbytes:
            raise ValueError("it is empty")
        with zipfile.ZipFile(content) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MOST_ARRAYS:
                raise ValueError(f"it unfolds to more than {_MOST_ARRAYS} bytes")
        with np.load(content, allow_pickle=False) as arrays:
            return dict(arrays)
    except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
        raise DataError(f"{path} is damaged ({error}); make or download it again") from error


def map_npy(path: Path) -> NDArray[Any]:
    """An npy file's array, mapped; what is written to it stays in memory. Raises one of ARRAY_FAULTS."""
    _require_regular(path)
    return np.load(path, mmap_mode="c", allow_pickle=False)


def read_member(archive: zipfile.ZipFile, name: str) -> bytes:
    """One file of an archive. Raises one of ZIP_FAULTS; ValueError for one that unfolds to over 256 MiB."""
    if archive.getinfo(name).file_size > _MOST_MEMBER:
        raise ValueError(f"{name} unfolds to more than {_MOST_MEMBER} bytes")
    return archive.read(name)


def _require_regular(path: Path) -> None:
    if path.exists() and not path.is_file():
        raise ValueError("it is no regular file")
