"""The states of a stage on disk: the newest and some before it; a damaged one is passed over for the one before.

    STAGE/state.pt                 the newest one of a single process
    STAGE/states/0001250.pt        older ones, by the number of updates
    STAGE/states/0001250/          those of several processes: a folder of torch.distributed.checkpoint and digest.json

`state.pt` is newer than all in `states`; it moves there before anything newer appears. Files and folders appear and
go by being renamed, so whatever has its final name is complete.
"""

import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar

from gcd_train.checkpoint import DamagedStateError, StageState, load_state
from gcd_train.engine.sharded import read_weights
from gcd_train.engine.trained import Mark
from gcd_train.errors import RunError
from gcd_train.recipe import LogRecipe

_log = logging.getLogger(__name__)
Read = TypeVar("Read")


class StateKeeper(Protocol):
    """Saves a stage's states and finds the newest good one."""

    def save(self, mark: Mark) -> None:
        """Write a state. Raises RunError if it cannot be written."""
        ...

    def restore(self) -> Mark | None:
        """Put the newest good state into what is trained; None if there is none. Raises RunError if it does not fit."""
        ...

    def finish(self) -> None:
        """Wait until all is written. Raises RunError if it cannot be."""
        ...


class StateFolder:
    """The names of a stage's states. stage_folder: the folder of the stage."""

    def __init__(self, stage_folder: Path, log: LogRecipe) -> None:
        self.newest = stage_folder / "state.pt"
        self.older = stage_folder / "states"
        self._keep, self._keep_every = log.keep, log.keep_every

    def listed(self) -> list[Path]:
        """All states, newest first."""
        older = [path for path in self.older.glob("[0-9]*") if path.stem.isdigit() and path.suffix in ("", ".pt")]
        older.sort(key=lambda path: int(path.stem), reverse=True)
        return [self.newest, *older] if self.newest.exists() else older

    def place(self, updates: int) -> Path:
        """Where a folder of so many updates goes; with the suffix .pt, a file."""
        return self.older / f"{updates:07d}"

    def make_way(self, updates: int) -> None:
        """Give `state.pt`, of so many updates, its name among the older ones."""
        if self.newest.exists():
            self.older.mkdir(exist_ok=True)
            self.newest.replace(self.place(updates).with_suffix(".pt"))

    def put_aside(self, path: Path) -> None:
        """Take a damaged state out of the way; its bytes stay, for whoever wants to look at them."""
        if path.exists():
            aside = path.with_name(path.name + ".damaged")
            _remove(aside)
            path.rename(aside)

    def thin_out(self) -> None:
        """Delete all but the newest ones and those that are kept for ever."""
        for path in self.listed()[self._keep :]:
            if not self._keep_every or int(path.stem) % self._keep_every:
                going = path.with_name(path.name + ".going")
                path.rename(going)
                _remove(going)


def newest_good(states: list[Path], read: Callable[[Path], Read]) -> tuple[Path, Read] | None:
    """The first that can be read, newest first, and what was read; None if there is no state at all.

    Raises RunError if there are states and all of them are damaged.
    """
    for path in states:
        try:
            return path, read(path)
        except DamagedStateError as error:
            before = "no state is left" if path == states[-1] else "going on from the state before it"
            _log.warning("%s; %s", error, before)
    if states:
        raise RunError(
            f"all {len(states)} states of the stage are damaged, see above; delete {states[0]} and what else there is "
            "to start the stage anew"
        )
    return None


def newest_weights(stage_folder: Path, stage: str) -> tuple[Path, StageState] | None:
    """The newest state of a stage, for its weights; None if there is none.

    Raises RunError if it is damaged: the one before it is less trained, so running the stage again has to choose it.
    """
    states = StateFolder(stage_folder, LogRecipe()).listed()
    if not states:
        return None
    read = read_weights if states[0].is_dir() else load_state
    try:
        return states[0], read(states[0], stage)
    except DamagedStateError as error:
        raise RunError(f"{error}; run the stage {stage!r} again, it goes on from the state before") from error


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
