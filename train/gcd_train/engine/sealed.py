"""A digest inside a state file, so that any copy can be checked: SHA-256 as the comment of its zip archive."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

_MARK = b"gcd-train sha256 "
_COMMENT = len(_MARK) + 64
_CHUNK = 1 << 22


class _Hashing:
    """A file that is written front to back, with the digest of all that went in."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.digest = file, hashlib.sha256()

    def write(self, data: Any) -> int:
        self.digest.update(data)
        return self._file.write(data)

    def flush(self) -> None:
        self._file.flush()


def write_sealed(path: Path, write: Callable[[Any], None]) -> None:
    """Write a zip archive with its digest and wait until it is on the disk. write: puts the archive into a file."""
    with path.open("wb") as file:
        hashing = _Hashing(file)
        write(hashing)
        file.seek(-2, os.SEEK_END)  # the length of the comment, zero so far
        file.write(_COMMENT.to_bytes(2, "little") + _MARK + hashing.digest.hexdigest().encode())
        file.flush()
        os.fsync(file.fileno())


def damage(path: Path) -> str | None:
    """What is wrong with a sealed file, or None."""
    if not path.is_file():
        return "it is no regular file"
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - _COMMENT - 2))
        length, comment = file.read(2), file.read()
        if length != _COMMENT.to_bytes(2, "little") or not comment.startswith(_MARK):
            return "it is no state, or only half of one"
        right = comment.removeprefix(_MARK).decode("ascii", "replace") == _digest(file, size - _COMMENT - 2)
        return None if right else "its bytes are not those that were written"


def _digest(file: IO[bytes], size: int) -> str:
    file.seek(0)
    total, left = hashlib.sha256(), size
    while left > 0:
        chunk = file.read(min(left, _CHUNK))
        if not chunk:
            return ""
        total.update(chunk)
        left -= len(chunk)
    total.update(b"\0\0")
    return total.hexdigest()
