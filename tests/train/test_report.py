import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from driving_plane import PlaneClips, evaluated, without_learning
from typer.testing import CliRunner

from gcd_model.config import PLAIN_SMALL
from gcd_model.geometry import SphericalDelta
from gcd_model.networks import random_networks
from gcd_model.weights.card import Card
from gcd_model.weights.load import save_weights
from gcd_train.cli.main import app
from gcd_train.errors import RunError
from gcd_train.evaluation.clips import PairedSet
from gcd_train.evaluation.galleries import (
    Strip,
    contact_rows,
    has_rows,
    has_views,
    write_rows,
    write_sheet,
    write_views,
)
from gcd_train.evaluation.measure import predicted_and_measured
from gcd_train.evaluation.predictors import CopySource
from gcd_train.evaluation.summary import Conditions, MountNumbers, Shot, Summary, to_markdown, write_summary


def conditions(weights: str | None = None) -> Conditions:
    return Conditions(
        data=("held-out",),
        weights=weights,
        sha256_12=None,
        steps=None if weights is None else 4,
        shots=(Shot(world="driving", scene=7, clip="00000007"), Shot(world="driving", scene=8, clip="00000025")),
        frames=4,
        size=(32, 48),
        grid=(16, 24),
        camera="none",
        true_mount=MountNumbers(height_m=1.55, tilt_deg=0.0),
        declared_mount=MountNumbers(height_m=1.8, tilt_deg=2.0),
        train=("training",),
        train_clips=2,
    )


@pytest.fixture(scope="module")
def report() -> Summary:
    clips = PlaneClips.make(2)
    found = evaluated(without_learning(clips), clips)
    names = tuple(each.name for each in clips.classes)
    return Summary(conditions=conditions(), classes=names, model=(), baselines=tuple(found))


def test_the_table_has_a_row_for_each_predictor_and_class(report: Summary) -> None:
    text = to_markdown(report)
    for name in ("copy_source", "mean_target", "majority_map", "ground_homography", "depth_reprojection *"):
        assert f"| {name} |" in text
    assert "2 clips of 2 scenes in `held-out`, frames 2-4" in text
    assert "LPIPS: no weights given" in text
    assert "declared: 1.8 m, 2 deg down" in text
    road = next(line for line in text.splitlines() if line.startswith("| road |"))
    assert road.count("|") == 2 + len(report.evaluations) - 1  # the mean target has no classes
    assert "nan" not in text


def test_a_models_clips_are_named_and_its_steps_compared(report: Summary) -> None:
    shipped = report.baselines[3]
    rows = replace(shipped, name="w"), replace(report.baselines[0], name="w (1 step)")
    text = to_markdown(replace(report, conditions=conditions("w"), model=rows))
    assert "`w` as it ships: 4 steps of its sampler" in text
    ahead = shipped.value("psnr_db") - report.baselines[0].value("psnr_db")
    assert f"- over w (1 step): PSNR dB {ahead:+.2f}" in text
    first, second = (line for line in text.splitlines() if line.startswith("| driving "))
    assert first.startswith(f"| driving 7 | {shipped.clips.figure('psnr_db')[0]:.2f} |")
    assert second.startswith("| driving 8 (00000025) |")


def test_json_holds_every_figure_and_null_for_none(report: Summary, tmp_path: Path) -> None:
    write_summary(report, "text", tmp_path)
    read = json.loads((tmp_path / "evaluation.json").read_text())
    majority = next(each for each in read["baselines"] if each["name"] == "majority_map")
    assert (majority["total"]["psnr_db"], majority["error"]["psnr_db"]) == (None, None)
    assert majority["total"]["miou"] == pytest.approx(report.baselines[2].value("miou"))
    assert len(majority["clips"]) == 2
    assert len(majority["error"]["class_iou"]) == len(majority["clips"][0]["class_iou_full"]) == len(report.classes)
    assert read["conditions"]["declared_mount"] == {"height_m": 1.8, "tilt_deg": 2.0}
    assert [shot["scene"] for shot in read["conditions"]["shots"]] == [7, 8]
    assert (tmp_path / "evaluation.md").read_text() == "text"
    with pytest.raises(RunError):
        write_summary(report, "", tmp_path / "evaluation.md")


def test_a_contact_sheet_stacks_source_views_and_target(tmp_path: Path) -> None:
    clips = PlaneClips.make(2)
    pairs, sheet = PairedSet(clips=clips, identity="plane"), list[tuple[str, Sequence[Strip]]]()
    for key in pairs.keys:
        clip = pairs.clip(key)
        prediction, record = predicted_and_measured(CopySource(), clip, classes=clips.classes)
        write_rows(tmp_path / key, prediction, clips.classes)
        assert has_rows(tmp_path / key, record)
        sheet.append((key, contact_rows(clip, [("copy", tmp_path / key)], clips.classes)))
    write_sheet(sheet, tmp_path / "sheet.png")
    shown = cv2.imread(str(tmp_path / "sheet.png"))
    assert shown is not None
    height = 3 * 14 + 4  # as these pictures are lower than three lines of a label
    assert shown.shape == (2 * 5 * height, 140 + 4 * (48 + 4), 3)
    assert np.array_equal(shown[:32, 140:188, ::-1], clips[0].source[0])
    assert np.array_equal(shown[height : height + 32, 296:344, ::-1], clips[0].source[3])
    assert np.array_equal(shown[4 * height : 4 * height + 32, 296:344, ::-1], clips[0].target[3])
    (tmp_path / f"{key}.png").unlink()  # killed in between
    assert not has_rows(tmp_path / key, record)


def test_kept_views_are_those_of_the_last_prediction_alone(tmp_path: Path) -> None:
    clip = PairedSet(clips=PlaneClips.make(1), identity="plane").clip("plane-00000000")
    (draw,) = CopySource().predict(clip.seen).draws
    for draws in ((draw, draw), (draw,)):
        write_views(tmp_path, clip, replace(draws[0], more=draws[1:]), "last", ())
        assert has_views(tmp_path, "last", len(clip.target))
        assert len(list(tmp_path.glob("sample_*"))) == len(draws)


def run(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["evaluate", *(str(each) for each in arguments)])
    return done.exit_code, done.output


def test_weights_are_evaluated_from_the_command_line_with_a_declared_mount(tmp_path: Path) -> None:
    config = msgspec.structs.replace(
        PLAIN_SMALL, frames=4, height=32, width=64, sampling=msgspec.structs.replace(PLAIN_SMALL.sampling, steps=1)
    )
    card = Card(name="untrained", config=config, family="driving", move_time=3, trained=False)
    save_weights(random_networks(config, seed=0), tmp_path / "untrained.safetensors", card)
    held_out = PlaneClips.make(1, width=64).write(tmp_path / "a")
    given = ("--weights", tmp_path / "untrained.safetensors", "--declared-height", 1.8, "--no-baselines")
    given = (*given, "--steps", 1, "--steps", 2, "--sheet-clips", 0)  # one step is what ships
    code, output = run("--data", held_out, "--out", tmp_path / "out", *given)
    assert code == 0, output
    read = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    found, more = read["model"]
    assert (found["name"], more["name"]) == ("untrained", "untrained (2 steps)")
    assert 0 < found["total"]["psnr_db"] < 30
    assert read["conditions"]["declared_mount"]["height_m"] == 1.8
    assert read["conditions"]["true_mount"]["height_m"] == 1.55


def test_an_orbit_is_evaluated_from_the_command_line(tmp_path: Path) -> None:
    changes = [SphericalDelta(azimuth_deg=azimuth) for azimuth in (40.0, -30.0, 10.0)]
    held_out = PlaneClips.orbits(changes).write(tmp_path / "a", 3000)
    training = PlaneClips.orbits(changes).write(tmp_path / "b")
    out = tmp_path / "out"
    code, output = run("--data", held_out, "--train", training, "--out", out, "--declared-tilt", 1)
    assert code == 78
    assert "no vehicle" in output
    code, output = run("--data", held_out, "--train", training, "--out", out)
    assert code == 0, output
    read = json.loads((out / "evaluation.json").read_text())
    found = {each["name"]: each["total"]["psnr_db"] for each in read["baselines"]}
    assert "majority_map" not in found
    assert found["ground_homography"] > found["copy_source"]
    assert [shot["change"][0] for shot in read["conditions"]["shots"]] == pytest.approx([40.0, -30.0, 10.0])
    assert (out / "contact_sheet.png").is_file()
