"""Files and folders that appear under their names only once they are whole.

While a folder is made, `.NAME.<token>.partial/` holds it and a locked file. The lock ends with its process, however
that ends, so what a killed run left behind is told from what another process is making.
"""

import errno
import fcntl
import logging
import os
import shutil
import time
import uuid
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from gcd_train.errors import RunError

_log = logging.getLogger(__name__)
_LOCK = "lock"
_UNLOCKED_S = 60.0  # a partial folder is locked sooner, or was killed in between


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


@contextmanager
def new_folder(root: Path, name: str) -> Generator[Path]:
    """An empty folder called `name` to fill; it appears in `root` at the end of the block, on the disk, or never.

    If another process finished the same folder meanwhile, that one stays and this one is dropped: they are alike.

    Raises:
        RunError: `root` cannot be written, or something that is no folder has the name.
        OSError: as raised in the block; nothing is left then.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        remove_leftovers(root, name)
        partial, lock = _claim(root, name)
    except OSError as error:
        raise RunError(f"{root} cannot be written ({error}); choose a folder that can") from error
    try:
        folder = partial / name
        folder.mkdir()
        yield folder
        _sync_all(folder)
        _publish(folder, root / name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        os.close(lock)


def remove_leftovers(root: Path, name: str = "*") -> int:
    """Delete what killed runs left of folder `name`, by default of all; how many there were."""
    found = [partial for partial in root.glob(f".{name}.*.partial") if _is_abandoned(partial)]
    for partial in found:
        shutil.rmtree(partial, ignore_errors=True)
    return len(found)


@contextmanager
def only_writer(folder: Path) -> Generator[None]:
    """Hold a folder for one run. Raises RunError if another run has it, or it cannot be written; a killed one lets go
    by itself, and what it left of files is deleted."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("a")
    except OSError as error:
        raise RunError(f"cannot write in {folder}: {error.strerror}; choose another --out") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(f"another run is at work in {folder}; wait for it, or choose another --out") from error
        except OSError as error:
            _log.warning("%s is on a file system without locks; start no second run in it (%s)", folder, error)
        else:
            for leftover in folder.glob(".*.partial"):
                if leftover.is_file():
                    leftover.unlink(missing_ok=True)
        yield


def _claim(root: Path, name: str) -> tuple[Path, int]:
    """A new partial folder, and the descriptor that holds its lock."""
    while True:
        partial = root / f".{name}.{uuid.uuid4().hex[:12]}.partial"
        partial.mkdir()
        try:
            lock = os.open(partial / _LOCK, os.O_CREAT | os.O_RDWR, 0o644)
        except FileNotFoundError:
            continue  # removed as a leftover before it was locked
        _try_lock(lock)
        if (partial / _LOCK).exists():
            return partial, lock
        os.close(lock)


def _try_lock(descriptor: int) -> bool:
    """False: another process has it, or this file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _is_abandoned(partial: Path) -> bool:
    try:
        lock = os.open(partial / _LOCK, os.O_RDWR)
    except FileNotFoundError:
        try:
            return time.time() - partial.stat().st_mtime > _UNLOCKED_S
        except FileNotFoundError:
            return False
    try:
        return _try_lock(lock)
    finally:
        os.close(lock)


def _sync_all(folder: Path) -> None:
    """So that a power cut after the rename finds every file whole."""
    for where, _, names in os.walk(folder, topdown=False):
        for name in names:
            _sync(Path(where, name))
        _sync(Path(where))


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _publish(folder: Path, place: Path) -> None:
    try:
        folder.rename(place)  # replaces an empty folder, nothing else
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise
        if not place.is_dir():
            raise RunError(f"{place} is in the way: it is no folder; move it and run again") from error
        return
    _sync(place.parent)
