"""Saving and finding a stage's states, in one process or in several."""

import logging
import shutil
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from torch.distributed.checkpoint.filesystem import FileSystemWriter
from torch.distributed.checkpoint.state_dict_saver import async_save, save

from gcd_train.checkpoint import load_state, require_identity, save_state
from gcd_train.engine.processes import Processes
from gcd_train.engine.sharded import FolderNote, admit_moments, checked_note, close_folder, load_folder, names_in
from gcd_train.engine.states import StateFolder, newest_good
from gcd_train.engine.trained import Mark, Trained
from gcd_train.errors import RunError

_log = logging.getLogger(__name__)


class FileStates:
    """The states of one process: one file each. See StateKeeper."""

    def __init__(self, folder: StateFolder, trained: Trained, stage: str, identity: str) -> None:
        self._folder, self._trained, self._stage, self._identity = folder, trained, stage, identity
        self._newest: int | None = None  # updates of state.pt

    def save(self, mark: Mark) -> None:
        """See StateKeeper."""
        newest = self._folder.newest
        ready = newest.with_name("state.pt.new")
        save_state(ready, self._trained.state(self._stage, self._identity, mark))
        try:
            if self._newest is not None and self._newest != mark.updates:
                self._folder.make_way(self._newest)
            ready.replace(newest)
            self._newest = mark.updates
            self._folder.thin_out()
        except OSError as error:
            raise RunError(f"cannot write in {newest.parent}: {error}; see to the disk, or choose --out") from error

    def restore(self) -> Mark | None:
        """See StateKeeper. Also goes on from what several processes left."""
        states = self._folder.listed()
        found = newest_good(states, self._read)
        if found is None:
            return None
        path, mark = found
        for damaged in states[: states.index(path)]:
            self._folder.put_aside(damaged)
        self._newest = mark.updates if path == self._folder.newest else None
        return mark

    def finish(self) -> None:
        """See StateKeeper; nothing is under way."""

    def _read(self, path: Path) -> Mark:
        if path.is_dir():
            note = checked_note(path, self._stage)
            require_identity(path, note.identity, self._identity)
            return _read_folder(path, note, self._trained, None)
        state = load_state(path, self._stage)
        require_identity(path, state.identity, self._identity)
        self._trained.restore(state)
        return Mark(state.updates, state.seconds)


class FolderStates:
    """The states of several processes: a folder each, to which every process writes its part. See StateKeeper.

    beside: write while training goes on, from a copy in the host's memory.
    """

    def __init__(
        self,
        folder: StateFolder,
        trained: Trained,
        stage: str,
        identity: str,
        processes: Processes,
        *,
        beside: bool,
    ) -> None:
        self._folder, self._trained, self._stage, self._identity = folder, trained, stage, identity
        self._processes, self._beside = processes, beside
        self._closing: Future[None] | None = None
        self._closer = ThreadPoolExecutor(1, thread_name_prefix="state")
        self._single: int | None = None  # updates of a state.pt, before it made way

    def save(self, mark: Mark) -> None:
        """See StateKeeper."""
        self._wait()
        folder = self._folder.place(mark.updates)
        unfinished = folder.with_name(folder.name + ".part")
        if self._processes.first:
            self._clear(unfinished)
        self._processes.told(None)
        writer, group = FileSystemWriter(unfinished), self._processes.saving
        flat = dict(self._trained.flat())
        with self._processes.others_gone():
            if not self._beside:
                save(flat, storage_writer=writer, process_group=group)
                self._close(None, unfinished, mark)
                self._processes.told(None)
                return
            written = async_save(flat, storage_writer=writer, process_group=group)
        assert isinstance(written, Future), "the thread checkpointer answers with a future"
        self._closing = self._closer.submit(self._close, written, unfinished, mark)

    def restore(self) -> Mark | None:
        """See StateKeeper. Also goes on from what one process left; the first process chooses for all."""
        chosen = self._processes.told(self._choose() if self._processes.first else None)
        if isinstance(chosen, str):
            raise RunError(chosen)
        if chosen is None:
            return None
        assert isinstance(chosen, Path), "a state's path is told"
        if chosen.is_dir():
            note = checked_note(chosen, self._stage) if self._processes.first else None
            note = self._processes.told(note)
            assert isinstance(note, FolderNote), "the first process tells what the folder says"
            return _read_folder(chosen, note, self._trained, self._processes)
        state = load_state(chosen, self._stage)
        self._trained.put(state)
        self._single = state.updates
        return Mark(state.updates, state.seconds)

    def finish(self) -> None:
        """See StateKeeper."""
        self._wait()
        self._processes.told(None)

    def _wait(self) -> None:
        if self._closing is not None:
            self._closing.result()
            self._closing = None

    def _clear(self, unfinished: Path) -> None:
        unfinished.parent.mkdir(parents=True, exist_ok=True)
        if unfinished.exists():
            shutil.rmtree(unfinished)
        if self._single is not None:
            self._folder.make_way(self._single)
            self._single = None

    def _close(self, written: "Future[object] | None", unfinished: Path, mark: Mark) -> None:
        """Once all processes have written, the first one gives the folder its name."""
        if written is not None:
            written.result()
        if not self._processes.first:
            return
        kind = type(self._trained.optimiser)
        note = FolderNote(
            stage=self._stage,
            identity=self._identity,
            updates=mark.updates,
            seconds=mark.seconds,
            moments=f"{kind.__module__}.{kind.__qualname__}",
        )
        close_folder(unfinished, unfinished.with_suffix(""), note)
        self._folder.thin_out()

    def _choose(self) -> Path | str | None:
        """The newest good state; the message where none fits. Damaged ones are put aside."""
        states = self._folder.listed()
        try:
            found = newest_good(states, self._require_good)
        except RunError as error:
            return str(error)
        if found is None:
            return None
        for damaged in states[: states.index(found[0])]:
            self._folder.put_aside(damaged)
        return found[0]

    def _require_good(self, path: Path) -> None:
        kept = checked_note(path, self._stage) if path.is_dir() else load_state(path, self._stage)
        require_identity(path, kept.identity, self._identity)


def _read_folder(path: Path, note: FolderNote, trained: Trained, processes: Processes | None) -> Mark:
    """Put a checked folder into what is trained; None for one process that nobody started as several."""
    admit_moments(note)
    group = None if processes is None else processes.saving
    load_folder(path, dict(trained.ready_for(set(names_in(path)))), group)
    return Mark(note.updates, note.seconds)
