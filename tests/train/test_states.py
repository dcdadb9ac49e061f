"""States on disk: what is kept, what is refused, and that a killed run goes on to the same bits."""

import os
import pickle
import shutil
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from tiny_world import Slope, loop_options, saved
from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageWriter

from gcd_train.errors import RunError
from gcd_train.recipe import EmaRecipe
from gcd_train.recipe_data import Budget, LogRecipe
from gcd_train.training.checkpoint import DamagedStateError, StateNote, close_folder, newest_weights, read_weights
from gcd_train.training.loop import Loop
from gcd_train.training.monitor import RunFolder

LOG = LogRecipe(log_s=1e6, save_s=1e6, measure_s=1e6, keep=3, keep_every=1)

EMA = EmaRecipe(limit=0.9)


def run(path: Path, updates: int, log: LogRecipe = LOG, identity: str = "slope", ema: EmaRecipe | None = EMA) -> Slope:
    task = Slope()
    Loop(task, RunFolder(path), loop_options(Budget(updates=updates), ema, log=log, identity=identity)).run()
    return task


def states(path: Path) -> list[str]:
    return sorted(file.name for file in (path / "unet" / "states").iterdir())


@pytest.mark.parametrize(
    ("keep_every", "kept"), [(4, ["0000004", "0000008", "0000009"]), (None, ["0000008", "0000009"])]
)
def test_the_newest_states_are_kept_and_those_of_every_so_many_updates(
    tmp_path: Path, keep_every: int | None, kept: list[str]
) -> None:
    for updates in (8, 9) if keep_every is None else (9,):
        run(tmp_path, updates, msgspec.structs.replace(LOG, keep=2, keep_every=keep_every))
    assert states(tmp_path) == kept


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-700])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def tensors(state: Path) -> Path:
    """The file that a state of one process has its tensors in."""
    (file,) = state.glob("*.safetensors")
    return file


def extra(path: Path) -> None:
    (path.parent / "extra.safetensors").write_bytes(path.read_bytes())


def pipe(path: Path) -> None:
    os.mkfifo(path.parent / "pipe.safetensors")  # whoever opens it waits for ever


HARMS = [
    *(("tensors", harm) for harm in (truncate, flip, Path.unlink, extra, pipe)),
    *(("note", harm) for harm in (truncate, flip, Path.unlink)),
]


@pytest.mark.parametrize(("which", "harm"), HARMS)
def test_a_damaged_state_is_put_aside_and_the_one_before_it_is_used(
    tmp_path: Path, which: str, harm: Callable[[Path], None]
) -> None:
    whole = run(tmp_path / "whole", 6)
    run(tmp_path / "harmed", 4)
    newest = tmp_path / "harmed" / "unet" / "states" / "0000004"
    harm(newest / "state.json" if which == "note" else tensors(newest))
    with pytest.raises(RunError):  # weights are not exchanged for less trained ones
        newest_weights(tmp_path / "harmed" / "unet", "unet")
    resumed = run(tmp_path / "harmed", 6)
    assert resumed.losses == {update: whole.losses[update] for update in (3, 4, 5)}  # the fourth update once more
    assert newest.with_suffix(".damaged").exists()


def test_a_run_whose_states_are_all_damaged_does_not_start_anew_by_itself(tmp_path: Path) -> None:
    run(tmp_path, 3)
    for path in (tmp_path / "unet").rglob("*.safetensors"):
        flip(path)
    with pytest.raises(RunError):
        run(tmp_path, 6)
    assert not list((tmp_path / "unet").rglob("*.damaged"))


@pytest.mark.parametrize("first", [-1, 1 << 50, 1 << 62])
def test_a_state_whose_tensors_are_not_whole_is_damaged(tmp_path: Path, first: int) -> None:
    """What nobody wrote would be read as zeros, or asks for more memory than there is."""
    run(tmp_path, 1)
    state = tmp_path / "unet" / "states" / "0000001"
    note, file = read_weights(state, "unet").note, tensors(state)
    content = file.read_bytes()
    (size,) = struct.unpack("<Q", content[:8])
    header = content[8 : 8 + size].replace(rb'"saved_offsets\": [0', rb'"saved_offsets\": [%d' % first)
    file.write_bytes(struct.pack("<Q", len(header)) + header + content[8 + size :])
    sealed(state, note)
    with pytest.raises(DamagedStateError):
        read_weights(state, "unet")


def sealed(state: Path, note: StateNote) -> None:
    """Digests that match what is in it."""
    unfinished = state.rename(state.with_suffix(".part"))
    (unfinished / "state.json").unlink()
    close_folder(unfinished, note)


def test_the_state_of_another_stage_or_model_is_refused(tmp_path: Path) -> None:
    run(tmp_path, 1)
    shutil.copytree(tmp_path / "unet", tmp_path / "vae")
    with pytest.raises(RunError):
        newest_weights(tmp_path / "vae", "vae")
    with pytest.raises(RunError):
        run(tmp_path, 2, identity="another")
    with pytest.raises(RunError):
        run(tmp_path, 2, ema=None)


def test_a_full_disk_leaves_the_older_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(tmp_path, 1)

    def full(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    for owner, name in ((os, "fsync"), (HuggingFaceStorageWriter, "write_data")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, full)
            with pytest.raises(RunError, match=r"^[^\n]*No space left on device[^\n]*$"):
                run(tmp_path, 2)
        assert saved(tmp_path / "unet", "unet").note.updates == 1


class Killed(BaseException):
    """Stands in for SIGKILL: nothing catches it."""


class Assassin:
    """Ends the process at the n-th thing it does to the disk; what tensors are written is cut in half."""

    def __init__(self, at: int, patch: pytest.MonkeyPatch) -> None:
        self._left = at
        for owner, name in ((Path, "rename"), (Path, "mkdir"), (os, "fsync"), (shutil, "rmtree")):
            patch.setattr(owner, name, self._watched(getattr(owner, name)))
        patch.setattr(HuggingFaceStorageWriter, "write_data", self._cut(HuggingFaceStorageWriter.write_data))

    @property
    def struck(self) -> bool:
        return self._left <= 0

    def _strike(self) -> None:
        self._left -= 1
        if self.struck:
            raise Killed

    def _watched(self, done: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*args: Any, **named: Any) -> Any:
            self._strike()
            return done(*args, **named)

        return watched

    def _cut(self, write: Callable[..., Any]) -> Callable[..., Any]:
        def cut(writer: Any, *args: Any) -> Any:
            made = write(writer, *args)
            if self._left == 1:
                truncate(tensors(Path(writer.path)))
            self._strike()
            return made

        return cut


def test_a_run_killed_at_any_write_goes_on_to_the_same_losses(tmp_path: Path) -> None:
    whole, kills = run(tmp_path / "whole", 4), 0
    while True:
        path = tmp_path / f"{kills}"
        with pytest.MonkeyPatch.context() as patch:
            assassin = Assassin(1 + kills, patch)
            with suppress(Killed, RunError):  # torch passes on what ends its writer as an error of its own
                run(path, 4, msgspec.structs.replace(LOG, keep=2, keep_every=None, save_s=1e-9))
        if not assassin.struck:
            break
        kills += 1
        resumed = run(path, 4)
        assert resumed.losses == {update: whole.losses[update] for update in resumed.losses}
        assert torch.equal(resumed.module.weight, whole.module.weight)
        assert saved(path / "unet", "unet").note.updates == 4
        assert {name.partition(".")[2] for name in states(path)} == {""}  # nothing half written is left
    assert kills > 10


class Hostile:
    """Whoever unpickles it leaves a file."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.mark,)


@pytest.mark.parametrize("name", ["tensors", "state.json", ".metadata", "__0_0.distcp", "0000005.pt", "state.pt"])
def test_a_run_folder_that_somebody_else_made_runs_nothing(tmp_path: Path, name: str) -> None:
    """Every file of it a pickle, and digests that match."""
    run(tmp_path, 1)
    state, mark = tmp_path / "unet" / "states" / "0000001", tmp_path / "ran"
    note = read_weights(state, "unet").note
    pickled = pickle.dumps(Hostile(mark))
    place = {"tensors": tensors(state), "0000005.pt": state.parent / name, "state.pt": state.parent.parent / name}
    place.get(name, state / name).write_bytes(pickled)
    if name != "state.json":
        sealed(state, note)
    for attempt in (lambda: read_weights(state, "unet"), lambda: run(tmp_path, 2)):
        with suppress(RunError):
            attempt()
        assert not mark.exists()
    if name in ("tensors", "state.json"):
        with pytest.raises(DamagedStateError):
            read_weights(next((tmp_path / "unet" / "states").glob("0000001*")), "unet")
