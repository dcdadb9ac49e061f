"""States on disk: what is kept, what is refused, and that a killed run goes on to the same bits."""

import logging
import os
import pickle
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from tiny_world import Never
from torch import nn
from torch.distributed.checkpoint.filesystem import FileSystemWriter
from torch.distributed.checkpoint.state_dict_saver import save

from gcd_train import checkpoint
from gcd_train.checkpoint import DamagedStateError, load_state
from gcd_train.engine.sharded import FolderNote, checked_note, close_folder, read_weights
from gcd_train.engine.states import newest_weights
from gcd_train.errors import RunError
from gcd_train.loop import Loop, LoopOptions, Progress, StepLoss
from gcd_train.recipe import Budget, EmaRecipe, LogRecipe, OptimiserRecipe
from gcd_train.run_folder import RunFolder
from gcd_train.schedule import ParameterGroup

LOG = LogRecipe(log_s=1e6, save_s=1e6, measure_s=1e6, keep=3, keep_every=1)


class Slope:
    """Four numbers to learn, from inputs that follow from the update; keeps the loss of every update."""

    def __init__(self) -> None:
        self.module = nn.Linear(4, 1)
        nn.init.constant_(self.module.weight, 0.5)
        nn.init.zeros_(self.module.bias)
        self.losses: dict[int, float] = {}

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        return [ParameterGroup(parameters=list(self.module.parameters()))]

    def step_loss(self, progress: Progress) -> StepLoss:
        inputs = torch.randn(8, 4, generator=torch.Generator().manual_seed(progress.updates))
        loss = (self.module(inputs) - inputs.sum(1, keepdim=True)).square().mean()
        self.losses[progress.updates] = loss.item()
        return StepLoss(loss, {"square": loss}, 8)

    def after_update(self, progress: Progress) -> bool:
        return False

    def measure(self, picture: Path) -> dict[str, float]:
        return {"bias": self.module.bias.item()}


def run(path: Path, updates: int, log: LogRecipe = LOG) -> Slope:
    task = Slope()
    options = LoopOptions(
        stage="unet",
        identity="slope",
        budget=Budget(updates=updates),
        optimiser=OptimiserRecipe(rate=0.1),
        ema=EmaRecipe(limit=0.9),
        log=log,
        stop=Never(),
        frames_per_clip=1,
    )
    Loop(task, RunFolder(path), options).run()
    return task


def states(path: Path) -> list[str]:
    return sorted(file.name for file in (path / "unet" / "states").iterdir())


def test_the_newest_states_are_kept_and_those_of_every_so_many_updates(tmp_path: Path) -> None:
    run(tmp_path, 9, msgspec.structs.replace(LOG, keep=2, keep_every=4))
    assert states(tmp_path) == ["0000004.pt", "0000008.pt"]
    assert load_state(tmp_path / "unet" / "state.pt", "unet").updates == 9


def test_without_keep_every_only_the_newest_stay(tmp_path: Path) -> None:
    for updates in range(1, 6):
        run(tmp_path, updates, msgspec.structs.replace(LOG, keep_every=None))
    assert states(tmp_path) == ["0000003.pt", "0000004.pt"]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-700])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


@pytest.mark.parametrize("harm", [truncate, flip, Path.unlink])
def test_a_damaged_state_is_refused_and_the_one_before_it_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, harm: Callable[[Path], None]
) -> None:
    whole = run(tmp_path / "whole", 6)
    run(tmp_path / "harmed", 4)
    harm(tmp_path / "harmed" / "unet" / "state.pt")
    with caplog.at_level(logging.WARNING):
        resumed = run(tmp_path / "harmed", 6)
    assert resumed.losses == {update: whole.losses[update] for update in (3, 4, 5)}  # the fourth update once more
    said = harm is not Path.unlink
    assert ("going on from the state before it" in caplog.text) == said
    assert (tmp_path / "harmed" / "unet" / "state.pt.damaged").exists() == said


def test_a_run_whose_states_are_all_damaged_does_not_start_anew_by_itself(tmp_path: Path) -> None:
    run(tmp_path, 3)
    for path in (tmp_path / "unet").rglob("*.pt"):
        flip(path)
    with pytest.raises(RunError, match="all 3 states of the stage are damaged"):
        run(tmp_path, 6)


def test_damaged_weights_are_not_exchanged_for_less_trained_ones(tmp_path: Path) -> None:
    run(tmp_path, 3)
    flip(tmp_path / "unet" / "state.pt")
    with pytest.raises(RunError, match="not those that were written; run the stage 'unet' again"):
        newest_weights(tmp_path / "unet", "unet")


def test_no_byte_of_a_state_can_change_unnoticed(tmp_path: Path) -> None:
    run(tmp_path, 1)
    path = tmp_path / "unet" / "state.pt"
    data = path.read_bytes()
    for place in (*range(0, len(data), 97), *range(len(data) - 110, len(data))):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        assert checkpoint.damage(path) is not None, place


class Killed(BaseException):
    """Stands in for SIGKILL: nothing catches it."""


class Assassin:
    """Ends the process at the n-th thing it does to the disk; a write is cut in half."""

    def __init__(self, at: int, patch: pytest.MonkeyPatch) -> None:
        self._left = at
        for owner, name in ((Path, "replace"), (Path, "rename"), (Path, "unlink"), (Path, "mkdir"), (os, "fsync")):
            patch.setattr(owner, name, self._watched(getattr(owner, name)))
        write: Any = checkpoint._Hashing.write  # pyright: ignore[reportPrivateUsage]

        def cut(hashing: Any, data: Any) -> int:
            if self._strikes():
                write(hashing, bytes(data)[: len(bytes(data)) // 2])
                hashing._file.flush()
                raise Killed
            self._stay_dead()
            return write(hashing, data)

        patch.setattr(checkpoint._Hashing, "write", cut)  # pyright: ignore[reportPrivateUsage]

    @property
    def struck(self) -> bool:
        return self._left <= 0

    def _strikes(self) -> bool:
        self._left -= 1
        return self._left == 0

    def _stay_dead(self) -> None:
        if self.struck:
            raise Killed

    def _watched(self, done: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*args: Any, **named: Any) -> Any:
            self._strikes()
            self._stay_dead()
            return done(*args, **named)

        return watched


def test_a_run_killed_at_any_write_goes_on_to_the_same_losses(tmp_path: Path) -> None:
    whole, kills = run(tmp_path / "whole", 4), 0
    while True:
        path = tmp_path / f"{kills}"
        with pytest.MonkeyPatch.context() as patch:
            assassin = Assassin(1 + 11 * kills, patch)  # 11: of all the writes of one state, some
            with suppress(Killed, RuntimeError):  # torch closes its archive, and complains that it cannot
                run(path, 4, msgspec.structs.replace(LOG, keep=2, keep_every=None, save_s=1e-9))
        if not assassin.struck:
            break
        kills += 1
        resumed = run(path, 4)
        assert resumed.losses == {update: whole.losses[update] for update in resumed.losses}
        assert torch.equal(resumed.module.weight, whole.module.weight)
        assert 3 in resumed.losses or load_state(path / "unet" / "state.pt", "unet").updates == 4
    assert kills > 10


NOTE = FolderNote(stage="unet", identity="x", updates=1250, seconds=2.0, moments="torch.optim.adam.Adam")


def folder_of(path: Path) -> Path:
    unfinished = path / "0001250.part"
    unfinished.mkdir()
    for number in range(2):
        (unfinished / f"__{number}_0.distcp").write_bytes(bytes([number]) * 1000)
    close_folder(unfinished, path / "0001250", NOTE)
    assert not unfinished.exists()
    return path / "0001250"


def test_a_folder_says_what_it_holds(tmp_path: Path) -> None:
    note = checked_note(folder_of(tmp_path), "unet")
    assert replace_files(note) == NOTE
    assert len(note.files) == 2


def replace_files(note: FolderNote) -> FolderNote:
    return msgspec.structs.replace(note, files={})


@pytest.mark.parametrize(
    ("name", "harm", "words"),
    [
        ("__0_0.distcp", Path.unlink, "is missing"),
        ("__1_0.distcp", truncate, "not those that were written"),
        ("__1_0.distcp", flip, "not those that were written"),
        ("digest.json", Path.unlink, "digest.json cannot be read: No such file"),
        ("digest.json", flip, "not as it was written"),
    ],
)
def test_a_folder_with_a_damaged_file_is_refused(
    tmp_path: Path, name: str, harm: Callable[[Path], None], words: str
) -> None:
    folder = folder_of(tmp_path)
    harm(folder / name)
    with pytest.raises(DamagedStateError, match=words):
        checked_note(folder, "unet")


class Hostile:
    """Whoever unpickles it leaves a file."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.mark,)


def written_state(path: Path, values: dict[str, object]) -> Path:
    unfinished = path / "0001250.part"
    save(values, storage_writer=FileSystemWriter(unfinished), no_dist=True)
    return unfinished


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_folder_that_somebody_else_made_runs_nothing(tmp_path: Path) -> None:
    unfinished, mark = written_state(tmp_path, {"module.weight": torch.ones(2)}), tmp_path / "ran"
    (unfinished / ".metadata").write_bytes(pickle.dumps(Hostile(mark)))
    close_folder(unfinished, tmp_path / "0001250", NOTE)
    with pytest.raises(DamagedStateError):
        read_weights(tmp_path / "0001250", "unet")
    assert not mark.exists()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_folder_holds_tensors_alone(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    unfinished = written_state(tmp_path, {"module.weight": torch.ones(2), "module.note": Hostile(mark)})
    close_folder(unfinished, tmp_path / "0001250", NOTE)
    with pytest.raises(DamagedStateError):
        read_weights(tmp_path / "0001250", "unet")
    assert not mark.exists()
