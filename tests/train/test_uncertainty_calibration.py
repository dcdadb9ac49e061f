"""Intervals of the deviation over samples against truths whose spread is known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from driving_plane import PlaneClips
from tiny_world import ran, write_untrained
from torch import Tensor

from gcd_model import load_synthesizer
from gcd_model.weights.load import inspect_weights
from gcd_train.errors import DataError
from gcd_train.evaluation.calibration import (
    LEVELS,
    Distances,
    best_scale,
    calibrate,
    coverage,
    distances,
    miscoverage,
)
from gcd_train.evaluation.clips import HeldOutClip
from gcd_train.evaluation.predictors import Prediction

T, H, W = 4, 48, 64


def held_out(target: Tensor) -> HeldOutClip:
    """target: [T, 3, H, W] in [0, 1]."""
    pictures = (target * 255).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1).numpy()
    return HeldOutClip(key="a-0", scene="a", seen=None, target=pictures)


def drawn(*videos: Tensor) -> Prediction:
    first, *more = (Prediction(video=video) for video in videos)
    return replace(first, more=tuple(more))


def spread_by(share: float, *, seed: int = 0) -> Distances:
    """A truth that lies so many deviations from the mean, as a standard deviation; the deviation differs by pixel."""
    random = torch.Generator().manual_seed(seed)
    std = 0.02 + 0.03 * torch.rand(T, 1, H, W, generator=random)
    truth = 0.5 + share * std * torch.randn(T, 3, H, W, generator=random)
    std = std.expand(T, 3, H, W)
    return distances(held_out(truth), drawn(0.5 + std, 0.5 - std))


@pytest.mark.parametrize("share", [0.5, 1.0, 2.0])
def test_the_scale_is_the_truths_own_spread(share: float) -> None:
    counts = spread_by(share)["all"]
    assert best_scale(counts) == pytest.approx(share, rel=0.03)
    assert miscoverage(counts, share) < 0.01


def test_the_first_frame_does_not_count() -> None:
    draws = torch.rand(2, T, 3, H, W, generator=torch.Generator().manual_seed(2))
    truth = torch.full((T, 3, H, W), 0.5)
    other = truth.clone()
    other[0] = 0.0
    both = [distances(held_out(each), drawn(*draws))["all"] for each in (truth, other)]
    assert np.array_equal(*both)
    assert both[0].sum() == (T - 1) * 3 * H * W


def test_flat_pixels_are_held_as_often_as_their_rounding_has_it() -> None:
    """Draws that miss a rounded truth by a tenth of a grey level are neither always right nor always wrong."""
    level = 0.1 / 255
    truth = torch.full((T, 3, H, W), 128 / 255)
    counts = distances(held_out(truth), drawn(truth - level, truth + level))["all"]
    half = coverage(counts)[LEVELS.index(0.5)]
    assert half == pytest.approx(2 * 0.674 * 0.1, abs=0.01)  # of one level, what the interval takes


def test_samples_that_do_not_differ_have_no_scale() -> None:
    same = torch.full((T, 3, H, W), 0.3)
    counts = distances(held_out(same + 0.1), drawn(same, same))["all"]
    assert coverage(counts, 1e6)[-1] == 0.0
    with pytest.raises(DataError):
        best_scale(counts)
    with pytest.raises(DataError):
        calibrate([("a", spread_by(1.0)), ("a", spread_by(1.0, seed=1))])  # of one scene


def test_the_scale_of_one_half_is_reported_on_the_other() -> None:
    found = calibrate([(f"s{i}", spread_by(1.0 if i % 2 else 3.0, seed=i)) for i in range(4)])
    assert found.fitted == ("s0", "s2")
    assert found.reported == ("s1", "s3")
    assert found.scale == pytest.approx(3.0, rel=0.03)
    assert found.regions["all"].miscoverage < 0.01  # these need no scale
    assert found.regions["all"].miscoverage_scaled > 0.2
    assert list(found.regions) == ["all"]


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_untrained(tmp_path_factory.mktemp("weights"))


@pytest.mark.slow
def test_the_command_reports_and_stores_a_scale(tmp_path: Path, weights: Path) -> None:
    data = PlaneClips.make(2, width=64).write(tmp_path / "clips", 1)
    stored = tmp_path / "calibrated.safetensors"
    told = ("--data", data, "--weights", weights, "--out", tmp_path / "out", "--samples", 2, "--store", stored)
    code, said = ran("calibrate", *told)
    assert code == 0, said
    note = json.loads((tmp_path / "out" / "calibration.json").read_text())
    scale = note["found"]["scale"]
    assert set(note["found"]["regions"]) == {"all", "visible", "occluded"}
    text = (tmp_path / "out" / "calibration.md").read_text()
    assert f"**Scale {scale:.3g}**, chosen on 1 scene; the table is of the other 1." in text
    assert "Measured on 2 scenes: of fewer than 10 no claim can rest on this scale." in text
    assert "warning: Measured on 2 scenes" in said
    assert f"{stored} holds the scale {scale:.3g}: for 2 samples in" in said
    assert (tmp_path / "out" / "reliability.png").read_bytes().startswith(b"\x89PNG")
    assert inspect_weights(weights).uncertainty_scale is None
    assert inspect_weights(stored).uncertainty_scale == scale
    assert load_synthesizer(stored, device="cpu").traits.uncertainty_scale == scale


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--store", "{weights}"], "--store wants the name of a new .safetensors file"),
        (["--store", "{folder}/new.safetensors", "--steps", "4"], "leave out --steps, or --store"),
    ],
)
def test_a_scale_that_cannot_be_stored_is_refused_before_measuring(
    tmp_path: Path, weights: Path, more: list[str], said: str
) -> None:
    filled = [word.format(weights=weights, folder=tmp_path) for word in more]
    told = ("--data", tmp_path / "none", "--weights", weights, "--out", tmp_path / "out")
    code, shown = ran("calibrate", *told, *filled)
    assert code == 78
    assert said in shown
    assert not (tmp_path / "out").exists()
