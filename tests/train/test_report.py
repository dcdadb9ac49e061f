import json
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from driving_plane import PlaneClips
from typer.testing import CliRunner

from gcd_model.checkpoints import save_weights
from gcd_model.config import DRIVING_SMALL
from gcd_model.geometry import CameraMount
from gcd_model.networks import random_networks
from gcd_model.own_format import Card
from gcd_train.baselines import CopySource, MajorityMap, driving_baselines, fit_statistics
from gcd_train.cli.main import app
from gcd_train.errors import RunError
from gcd_train.evaluation import evaluate
from gcd_train.report import (
    Conditions,
    MountNumbers,
    Report,
    against_bar,
    psnr_lead,
    to_markdown,
    write_contact_sheet,
    write_report,
)


def conditions(weights: str | None = None) -> Conditions:
    mount = MountNumbers(height_m=1.55, tilt_deg=0.0)
    return Conditions(
        data="held-out",
        weights=weights,
        sha256_12=None,
        clips=2,
        first_seed=7,
        last_seed=8,
        frames=4,
        size=(32, 48),
        grid=(16, 24),
        true_mount=mount,
        declared_mount=MountNumbers(height_m=1.8, tilt_deg=2.0),
        train="training",
        train_clips=2,
    )


@pytest.fixture(scope="module")
def report() -> Report:
    clips = PlaneClips.make(2)
    baselines = driving_baselines(fit_statistics(clips), CameraMount(), len(clips.classes))
    found = evaluate(baselines, clips)
    return Report(conditions=conditions(), classes=tuple(c.name for c in clips.classes), evaluations=found)


def test_the_table_has_a_row_for_each_predictor_and_class(report: Report) -> None:
    text = to_markdown(report)
    for name in ("copy_source", "mean_target", "majority_map", "ground_homography", "depth_reprojection *"):
        assert f"| {name} |" in text
    assert "declared: 1.8 m, 2 deg down" in text
    road = next(line for line in text.splitlines() if line.startswith("| road |"))
    assert road.count("|") == 2 + len(report.evaluations)
    assert "nan" not in text


def test_what_a_predictor_lacks_is_a_dash(report: Report) -> None:
    line = next(line for line in to_markdown(report).splitlines() if line.startswith("| majority_map |"))
    assert line.split("|")[2].strip() == "-"


def test_json_holds_every_figure_and_null_for_none(report: Report, tmp_path: Path) -> None:
    write_report(report, tmp_path)
    read = json.loads((tmp_path / "evaluation.json").read_text())
    majority = next(each for each in read["evaluations"] if each["name"] == "majority_map")
    assert majority["total"]["psnr_db"] is None
    assert majority["total"]["miou"] == pytest.approx(report.evaluations[2].total.miou)
    assert len(majority["clips"]) == 2
    assert read["conditions"]["declared_mount"] == {"height_m": 1.8, "tilt_deg": 2.0}


def test_a_lead_is_paired_over_clips(report: Report) -> None:
    first, other = report.evaluations[3], report.evaluations[0]
    lead, error = psnr_lead(first, other)
    assert lead == pytest.approx(first.total.psnr_db - other.total.psnr_db)
    assert error >= 0
    assert psnr_lead(first, first) == (0.0, 0.0)


def test_the_bar_is_told_for_weights_only(report: Report) -> None:
    assert against_bar(report) == []
    lines = against_bar(Report(conditions=conditions("w"), classes=report.classes, evaluations=report.evaluations))
    assert len(lines) == 4
    assert "missed" in lines[0]
    assert "reached" in lines[1]


def test_a_contact_sheet_stacks_five_rows_for_each_clip(tmp_path: Path) -> None:
    clips = PlaneClips.make(2)
    write_contact_sheet(tmp_path / "sheet.png", CopySource(), clips, [0, 1])
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet.shape == (2 * 5 * 32 + 4, 84 + 2 * (48 + 4), 3)  # frames 1 and 4
    assert np.array_equal(sheet[4 * 32 : 5 * 32, 136 : 136 + 48, ::-1], clips[0].target[3])


def test_rows_a_predictor_does_not_have_are_left_out(tmp_path: Path) -> None:
    clips = PlaneClips.make(1)
    write_contact_sheet(tmp_path / "sheet.png", MajorityMap(statistics=fit_statistics(clips)), clips, [0])
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet.shape[0] == 4 * 32


def test_a_place_that_cannot_be_written_is_our_error(report: Report, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="--out"):
        write_report(report, tmp_path / "file")


def run(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["evaluate", *(str(each) for each in arguments)])
    return done.exit_code, done.output


def test_baselines_are_evaluated_from_the_command_line(tmp_path: Path) -> None:
    held_out, training = PlaneClips.make(2).write(tmp_path / "a", 1000), PlaneClips.make(3).write(tmp_path / "b")
    code, output = run("--data", held_out, "--train", training, "--out", tmp_path / "out", "--limit", 1)
    assert code == 0, output
    assert "depth_reprojection" in output
    read = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert (read["conditions"]["clips"], read["conditions"]["train_clips"]) == (1, 3)
    assert (tmp_path / "out" / "contact_sheet.png").is_file()


def test_clips_from_a_folder_measure_as_they_do_in_memory(tmp_path: Path) -> None:
    clips = PlaneClips.make(2)
    held_out, training = clips.write(tmp_path / "a", 1000), clips.write(tmp_path / "b")
    code, output = run("--data", held_out, "--train", training, "--out", tmp_path / "out")
    assert code == 0, output
    read = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    baselines = driving_baselines(fit_statistics(clips), CameraMount(), len(clips.classes))
    expected = [each.total.psnr_db for each in evaluate(baselines, clips)]
    found = [each["total"]["psnr_db"] or np.nan for each in read["evaluations"]]
    assert found == pytest.approx(expected, abs=0.02, nan_ok=True)  # depth is stored in 1/256 m


def test_weights_are_evaluated_from_the_command_line_with_a_declared_mount(tmp_path: Path) -> None:
    config = msgspec.structs.replace(DRIVING_SMALL, frames=4, height=32, width=64)
    card = Card(name="untrained", config=config, family="driving", move_time=3, trained=False)
    save_weights(random_networks(config, seed=0), tmp_path / "untrained.safetensors", card)
    held_out = PlaneClips.make(1, width=64).write(tmp_path / "a")
    given = ("--weights", tmp_path / "untrained.safetensors", "--declared-height", 1.8, "--no-baselines")
    code, output = run("--data", held_out, "--out", tmp_path / "out", *given)
    assert code == 0, output
    read = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    (found,) = read["evaluations"]
    assert found["name"] == "untrained"
    assert 0 < found["total"]["psnr_db"] < 30
    assert 0 <= found["total"]["miou"] < 0.5
    assert read["conditions"]["declared_mount"]["height_m"] == 1.8
    assert read["conditions"]["true_mount"]["height_m"] == 1.55


@pytest.mark.parametrize(
    ("arguments", "code", "hint"),
    [((), 78, "--train"), (("--no-baselines",), 78, "--weights"), (("--train", "nowhere"), 66, "nowhere")],
)
def test_what_is_missing_is_said(tmp_path: Path, arguments: tuple[str, ...], code: int, hint: str) -> None:
    held_out = PlaneClips.make(1).write(tmp_path / "a")
    found, output = run("--data", held_out, "--out", tmp_path / "out", *arguments)
    assert found == code
    assert hint in output
