"""What a run says of itself."""

import json
from pathlib import Path

import pytest
import torch

from gcd_train.errors import RunError, TrainError
from gcd_train.training.monitor import FiniteGuard, RunFolder, TensorBoard, write_sheet


def test_a_loss_that_is_no_number_names_update_and_clips(tmp_path: Path) -> None:
    guard = FiniteGuard("unet", tmp_path / "unet" / "not_finite.json")
    guard.saw(4, "loss", torch.tensor(0.5), ("seed 1",))
    with pytest.raises(TrainError, match=r"the loss of unet is nan at update 5, on clips seed 2, seed 3 \(see"):
        guard.saw(5, "loss", torch.tensor(torch.nan), ("seed 2", "seed 3"))
    told = json.loads((tmp_path / "unet" / "not_finite.json").read_text())
    assert (told["update"], told["clips"]) == (5, ["seed 2", "seed 3"])


def test_looked_at_late_the_first_wrong_value_counts_with_the_clips_of_its_update(tmp_path: Path) -> None:
    guard = FiniteGuard("unet", tmp_path / "note.json", at_once=False)
    guard.saw(7, "loss", torch.tensor(1.0), ("a",))
    guard.saw(7, "loss", torch.tensor(2.0), ("b",))
    guard.saw(7, "gradient", torch.tensor(torch.inf))
    guard.saw(8, "loss", torch.tensor(torch.nan), ("c",))
    with pytest.raises(TrainError, match="the gradient of unet is inf at update 7, on clips a, b"):
        guard.check()


def test_a_note_is_not_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "note.json").symlink_to(tmp_path / "mine.txt")
    with pytest.raises(TrainError):
        FiniteGuard("unet", tmp_path / "note.json").saw(5, "loss", torch.tensor(torch.nan))
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_a_note_that_cannot_be_written_does_not_hide_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "unet").write_text("a file where a folder should be")
    with pytest.raises(TrainError, match="the loss of unet is nan at update 5"):
        FiniteGuard("unet", tmp_path / "unet" / "not_finite.json").saw(5, "loss", torch.tensor(torch.nan))


def test_a_folder_that_tensorboard_cannot_write_is_named(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="needs tensorboard (extra `train`)")
    (tmp_path / "tensorboard").write_text("a file where a folder should be")
    with pytest.raises(RunError, match=r"cannot write in .*tensorboard"):
        TensorBoard(tmp_path / "tensorboard")


def test_figures_and_pictures_reach_tensorboard(tmp_path: Path) -> None:
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator", reason="needs tensorboard (extra `train`)"
    )
    board = TensorBoard(tmp_path / "tensorboard")
    folder = RunFolder(tmp_path, board)
    picture = folder.sample("unet", 3)
    write_sheet(picture, [[torch.zeros(3, 8, 8)]])
    folder.record("unet", "loss", {"updates": 3, "loss": 0.25})
    folder.record("unet", "measured", {"updates": 3, "psnr": 20.0}, picture)
    board.close()
    events = accumulator.EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    (loss,) = events.Scalars("unet/loss/loss")
    assert (loss.step, loss.value) == (3, 0.25)
    assert events.Scalars("unet/measured/psnr")[0].value == 20.0
    assert events.Images("unet/samples")[0].step == 3
