"""The packaged model on scenes it has not seen: ahead of what needs no learning, and no blur."""

from pathlib import Path

import pytest
from headless import needs_egl
from typer.testing import CliRunner

from gcd_model import load_synthesizer
from gcd_train.baselines import BaselineSettings, build, fit_statistics
from gcd_train.cli.main import app
from gcd_train.datasets.paired import PairedClips
from gcd_train.evaluation import Evaluation, PairedSet, SynthesizedViews, evaluate

pytestmark = [needs_egl, pytest.mark.timeout(600)]


def made(folder: Path, first_seed: int, clips: int) -> PairedClips:
    options = ["--out", str(folder), "--first-seed", str(first_seed), "--clips", str(clips)]
    assert CliRunner().invoke(app, ["generate", "driving", *options]).exit_code == 0
    return PairedClips.open(folder)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Evaluation]:
    """The model and what it is compared with on three held-out scenes, by name."""
    folder = tmp_path_factory.mktemp("scenes")
    clips, training = made(folder / "held-out", 1_000_000, 3), made(folder / "train", 0, 2)
    model = SynthesizedViews.of(load_synthesizer("package:driving-small", device="cpu"), clips)
    settings = BaselineSettings(
        frames=clips.frames,
        height=clips.height,
        width=clips.width,
        classes=tuple(clips.classes),
        statistics=fit_statistics(training),
    )
    compared = [build(name, settings) for name in ("depth_reprojection", "majority_map")]
    return {each.name: each for each in evaluate([model, *compared], PairedSet.of(clips))}


def test_it_is_ahead_of_the_exact_depth(found: dict[str, Evaluation]) -> None:
    ahead = found["driving-small"].total.psnr_db - found["depth_reprojection"].total.psnr_db
    assert ahead > 1.0


def test_a_view_is_no_blur(found: dict[str, Evaluation]) -> None:
    assert 0.5 < found["driving-small"].total.gradient_energy < 1.4


def test_the_class_map_is_ahead_of_the_most_frequent_class_of_each_pixel(found: dict[str, Evaluation]) -> None:
    assert found["driving-small"].total.miou > max(0.4, found["majority_map"].total.miou)
