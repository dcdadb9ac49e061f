"""Files that appear under their names only once they are whole."""

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from gcd_train.errors import RunError


@contextmanager
def whole(path: Path) -> Generator[Path]:
    """Where to write what becomes `path` at the end of the block; after an error nothing is left. Makes its folder."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes, *, lasting: bool = False) -> None:
    """Write a file. lasting: it stays through a power cut, too. Raises RunError if it cannot be written."""
    try:
        with whole(path) as partial, partial.open("wb") as file:
            file.write(content)
            if lasting:
                file.flush()
                os.fsync(file.fileno())
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}; free some space, or choose another --out") from error
