import csv
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from driving_plane import PlaneClips
from typer.testing import CliRunner

from gcd_model.config import PLAIN_SMALL
from gcd_model.geometry import SphericalDelta
from gcd_model.networks import random_networks
from gcd_model.weights.card import Card
from gcd_model.weights.load import save_weights
from gcd_train.cli.generate import app
from gcd_train.evaluation.clips import PairedSet
from gcd_train.evaluation.galleries import has_views, write_views
from gcd_train.evaluation.predictors import CopySource


def figures(out: Path) -> dict[str, float]:
    """PSNR of each method, frames 2 to the last."""
    with (out / "tables" / "figures.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if (row["frames"], row["pixels"]) == ("2-last", "all")]
    return {row["method"]: float(row["value"]) for row in rows if row["figure"] == "psnr_db"}


def test_kept_views_are_those_of_the_last_prediction_alone(tmp_path: Path) -> None:
    clip = PairedSet.of(PlaneClips.make(1), "plane").clip("plane-00000000")
    (draw,) = CopySource().predict(clip.seen).draws
    for draws in ((draw, draw), (draw,)):
        write_views(tmp_path, clip, replace(draws[0], more=draws[1:]), "last", ())
        assert has_views(tmp_path, "last", len(clip.target))
        assert len(list(tmp_path.glob("sample_*"))) == len(draws)


def run(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["evaluate", *(str(each) for each in arguments)])
    return done.exit_code, done.output


def test_weights_are_evaluated_from_the_command_line(tmp_path: Path) -> None:
    config = msgspec.structs.replace(
        PLAIN_SMALL, frames=4, height=32, width=64, sampling=msgspec.structs.replace(PLAIN_SMALL.sampling, steps=1)
    )
    card = Card(name="untrained", config=config, family="driving", move_time=3, trained=False)
    save_weights(random_networks(config, seed=0), tmp_path / "untrained.safetensors", card)
    held_out = PlaneClips.make(1, width=64).write(tmp_path / "a")
    given = ("--weights", tmp_path / "untrained.safetensors", "--no-baselines")
    given = (*given, "--steps", 1, "--steps", 2, "--views", "none")  # one step is what ships
    code, output = run("--data", held_out, "--out", tmp_path / "out", *given)
    assert code == 0, output
    found = figures(tmp_path / "out")
    assert list(found) == ["untrained", "untrained (2 steps)"]
    assert 0 < found["untrained"] < 30
    assert "### untrained against the others" in output


def test_an_orbit_is_evaluated_from_the_command_line(tmp_path: Path) -> None:
    changes = [SphericalDelta(azimuth_deg=azimuth) for azimuth in (40.0, -30.0, 10.0)]
    held_out = PlaneClips.orbits(changes).write(tmp_path / "a", 3000)
    out = tmp_path / "out"
    code, output = run("--data", held_out, "--out", out)
    assert code == 0, output
    found = figures(out)
    assert "reproject_semd" not in found
    assert found["ground_homography"] < found["copy_source"]  # black where it sees nothing
    with (out / "tables" / "clips.csv").open() as file:
        turned = [float(row["azimuth"]) for row in csv.DictReader(file) if row["method"] == "copy_source"]
    assert turned == pytest.approx([40.0, -30.0, 10.0])
    assert (out / "gallery" / "sheet.png").is_file()
