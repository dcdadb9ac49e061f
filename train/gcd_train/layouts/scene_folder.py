"""Scene folders that appear whole: built in a hidden folder beside their place, settled on the disk, then renamed.

While a scene is made, `.scn00042.<token>.partial/` holds the folder `scn00042` and a locked file. The lock ends with
its process, however that ends, so what a killed run left behind is told from what another process is making.
"""

import errno
import fcntl
import os
import shutil
import time
import uuid
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from gcd_train.errors import RunError

_LOCK = "lock"
_OLD_S = 24 * 3600.0  # without locks: nobody makes a scene for so long


@contextmanager
def new_scene(root: Path, name: str) -> Generator[Path]:
    """An empty folder called `name` to fill; it appears in `root` at the end of the block, complete, or never.

    If another process finished the same scene meanwhile, that one stays and this one is dropped: they are alike.

    Raises:
        RunError: `root` cannot be written, or something that is no scene folder has the name.
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
        _settle(folder)
        _publish(folder, root / name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        os.close(lock)


def remove_leftovers(root: Path, name: str = "*") -> int:
    """Delete what runs that are no more left of scene `name`, by default of all; how many there were."""
    found = [partial for partial in root.glob(f".{name}.*.partial") if _is_abandoned(partial)]
    for partial in found:
        shutil.rmtree(partial, ignore_errors=True)
    return len(found)


def _claim(root: Path, name: str) -> tuple[Path, int]:
    """A new partial folder, and the descriptor that holds its lock."""
    while True:
        partial = root / f".{name}.{uuid.uuid4().hex[:12]}.partial"
        partial.mkdir()
        try:
            lock = os.open(partial / _LOCK, os.O_CREAT | os.O_RDWR, 0o644)
        except FileNotFoundError:
            continue  # somebody took it for a leftover before it was locked
        _lock(lock)
        if (partial / _LOCK).exists():
            return partial, lock
        os.close(lock)


def _lock(descriptor: int) -> bool | None:
    """True: ours now. False: another process has it. None: this file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return False if error.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    return True


def _is_abandoned(partial: Path) -> bool:
    try:
        lock = os.open(partial / _LOCK, os.O_RDWR)
    except FileNotFoundError:
        return _age_s(partial) > 60.0  # killed between its first two steps, or just about to take the second
    try:
        free = _lock(lock)
        return free or (free is None and _age_s(partial) > _OLD_S)
    finally:
        os.close(lock)


def _age_s(path: Path) -> float:
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _settle(folder: Path) -> None:
    """Bring every file and folder to the disk, so that a power cut after the rename finds them whole."""
    for where, _, names in os.walk(folder, topdown=False):
        for name in names:
            _sync(Path(where, name), os.O_RDONLY)
        _sync(Path(where), os.O_RDONLY | os.O_DIRECTORY)


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
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
    _sync(place.parent, os.O_RDONLY | os.O_DIRECTORY)
