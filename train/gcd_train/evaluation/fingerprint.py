"""What a folder of files is known by again, without reading all of it."""

import hashlib
import os
from pathlib import Path

from gcd_train.errors import DataError

_TOLD_BY = ".json"
_SMALL_BYTES = 4 << 20


def fingerprint(folder: Path) -> bytes:
    """Digest of the names and sizes of all files below, and of what small JSON files say.

    Pictures are not read, and times do not count: a copy has the same fingerprint. What begins with a dot is left out,
    as file browsers leave such things.

    Raises:
        DataError: the folder or a file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        for name, size in sorted(_files(folder)):
            digest.update(f"{name} {size}\n".encode())
            if name.endswith(_TOLD_BY) and size <= _SMALL_BYTES and (folder / name).is_file():
                digest.update(hashlib.sha256((folder / name).read_bytes()).digest())
    except OSError as error:
        raise DataError(f"{folder} cannot be read ({error}); look at the scene, or leave it out with --list") from error
    return digest.digest()


def _files(folder: Path) -> list[tuple[str, int]]:
    """Names below the folder, with slashes, and bytes."""
    found: list[tuple[str, int]] = []
    for place, folders, names in os.walk(folder, onerror=_passed_on, followlinks=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        here = Path(place)
        found += [
            ((here / name).relative_to(folder).as_posix(), (here / name).stat().st_size)
            for name in names
            if not name.startswith(".")
        ]
    return found


def _passed_on(error: OSError) -> None:
    """`os.walk` keeps errors to itself unless it is told not to."""
    raise error
