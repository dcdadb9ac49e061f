from pathlib import Path

import pytest
import torch

from gcd_train.checkpoint import StageState, load_state, save_state
from gcd_train.errors import RunError


def state(value: float) -> StageState:
    return StageState(
        stage="unet",
        identity="abc",
        updates=7,
        seconds=1.5,
        module={"weight": torch.full((2,), value), "count": torch.tensor(3)},
        optimiser={"state": {0: {"step": torch.tensor(7.0)}}, "param_groups": [{"lr": 0.1, "betas": (0.9, 0.98)}]},
        average={"weight": torch.full((2,), value + 1)},
    )


def test_a_state_survives_the_round_trip(tmp_path: Path) -> None:
    save_state(tmp_path / "unet" / "state.pt", state(1.0))
    loaded = load_state(tmp_path / "unet" / "state.pt", "unet")
    assert (loaded.updates, loaded.seconds, loaded.identity) == (7, 1.5, "abc")
    assert loaded.optimiser["param_groups"] == [{"lr": 0.1, "betas": (0.9, 0.98)}]
    assert torch.equal(loaded.best["weight"], torch.full((2,), 2.0))
    assert torch.equal(loaded.best["count"], torch.tensor(3))


def test_a_failed_write_leaves_the_older_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "state.pt"
    save_state(path, state(1.0))

    def full(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(RunError, match="No space left"):
        save_state(path, state(5.0))
    assert load_state(path, "unet").module["weight"][0] == 1.0


@pytest.mark.parametrize("content", [b"", b"rubbish", b"PK\x03\x04 half a file"])
def test_a_damaged_state_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "state.pt"
    path.write_bytes(content)
    with pytest.raises(RunError, match=r"the state .*state\.pt is damaged: "):
        load_state(path, "unet")


def test_the_state_of_another_stage_is_refused(tmp_path: Path) -> None:
    save_state(tmp_path / "state.pt", state(1.0))
    with pytest.raises(RunError, match="'vae'"):
        load_state(tmp_path / "state.pt", "vae")
