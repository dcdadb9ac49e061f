import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from driving_plane import PlaneClips, without_learning
from typer.testing import CliRunner

from gcd_model.config import PLAIN_SMALL
from gcd_model.geometry import SphericalDelta
from gcd_model.networks import random_networks
from gcd_model.weights.card import Card
from gcd_model.weights.load import save_weights
from gcd_train.baselines import CopySource, MajorityMap, fit_statistics
from gcd_train.cli.main import app
from gcd_train.errors import RunError
from gcd_train.evaluation import (
    Conditions,
    MountNumbers,
    PairedSet,
    Report,
    Shot,
    evaluate,
    to_markdown,
    write_contact_sheet,
    write_report,
)


def as_set(clips: PlaneClips) -> PairedSet:
    return PairedSet(clips=clips, identity="plane")


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
def report() -> Report:
    clips = PlaneClips.make(2)
    found = evaluate(without_learning(clips), as_set(clips))
    return Report(conditions=conditions(), classes=tuple(c.name for c in clips.classes), model=(), baselines=found)


def told_of(report: Report) -> Report:
    """The ground homography as if it were a model that ships with 4 steps, and again with 1."""
    homography = report.baselines[3]
    worse = replace(homography.total, psnr_db=homography.total.psnr_db - 0.25)
    rows = replace(homography, name="w"), replace(homography, name="w (1 step)", total=worse)
    return replace(report, conditions=conditions("w"), model=rows)


def test_the_table_has_a_row_for_each_predictor_and_class(report: Report) -> None:
    text = to_markdown(report)
    for name in ("copy_source", "mean_target", "majority_map", "ground_homography", "depth_reprojection *"):
        assert f"| {name} |" in text
    assert "2 clips of 2 scenes in `held-out`, frames 2-4" in text
    assert "LPIPS: no weights given" in text
    assert "declared: 1.8 m, 2 deg down" in text
    road = next(line for line in text.splitlines() if line.startswith("| road |"))
    assert road.count("|") == 2 + len(report.evaluations) - 1  # the mean target has no classes
    assert "nan" not in text


def test_a_class_that_is_too_small_for_the_class_grid_has_a_dash_there(report: Report) -> None:
    first, *others = report.evaluations
    total = replace(
        first.total, class_iou=(math.nan,) * len(report.classes), class_iou_full=(0.25,) * len(report.classes)
    )
    text = to_markdown(replace(report, model=(), baselines=(replace(first, total=total), *others)))
    assert "- (0.25)" in text
    assert "nan" not in text


def test_class_figures_of_who_copies_the_exact_classes_have_a_star(report: Report) -> None:
    lines = {line.split("|")[1].strip(): line for line in to_markdown(report).splitlines() if "|" in line}
    of_classes = [" *" in cell for name in ("copy_source", "majority_map") for cell in lines[name].split("|")[2:]]
    assert sum(of_classes[: len(of_classes) // 2]) == 2  # mIoU and accuracy
    assert sum(of_classes[len(of_classes) // 2 :]) == 0


def test_a_class_that_nobody_saw_or_said_has_no_row_and_without_class_maps_there_is_no_table(report: Report) -> None:
    nothing = (math.nan,) * len(report.classes)
    unseen = tuple(
        replace(each, total=replace(each.total, class_iou=(math.nan, *each.total.class_iou[1:])))
        for each in report.baselines
    )
    unseen = tuple(
        replace(each, total=replace(each.total, class_iou_full=(math.nan, *each.total.class_iou_full[1:])))
        for each in unseen
    )
    assert f"| {report.classes[0]} |" in to_markdown(report)
    assert f"| {report.classes[0]} |" not in to_markdown(replace(report, baselines=unseen))
    bare = replace(report.baselines[0].total, miou=math.nan, class_iou=nothing, class_iou_full=nothing)
    assert "IoU of each class" not in to_markdown(
        replace(report, baselines=(replace(report.baselines[0], total=bare),))
    )


def test_what_a_predictor_lacks_is_a_dash(report: Report) -> None:
    line = next(line for line in to_markdown(report).splitlines() if line.startswith("| majority_map |"))
    assert line.split("|")[2].strip() == "-"


def test_a_models_clips_are_named_and_its_steps_compared(report: Report) -> None:
    text = to_markdown(told_of(report))
    assert "`w` as it ships: 4 steps of its sampler" in text
    assert "- over w (1 step): PSNR dB +0.25" in text
    first, second = (line for line in text.splitlines() if line.startswith("| driving "))
    assert first.startswith("| driving 7 |")
    assert second.startswith("| driving 8 (00000025) |")
    assert f"| {report.baselines[3].clips[0].psnr_db:.2f} |" in first


def test_what_nobody_has_is_left_out() -> None:
    clips = PlaneClips.orbits([SphericalDelta(azimuth_deg=40.0, radius_m=-1.0)])
    found = evaluate(without_learning(clips, named=False), as_set(clips))
    shot = Shot(world="drop", scene=4, clip="00000013", change=(40.0, 0.0, -1.0))
    orbit = msgspec.structs.replace(
        conditions("copy"), camera="spherical", shots=(shot,), true_mount=None, declared_mount=None
    )
    made = Report(conditions=orbit, classes=(), model=found[:1], baselines=found)
    text = to_markdown(made)
    assert "| drop 4 (00000013) az +40 el +0 r -1.0 |" in text
    assert [word for word in ("mIoU", "accuracy", "IoU of", "declared", "Class figures", "nan") if word in text] == []


def test_json_holds_every_figure_and_null_for_none(report: Report, tmp_path: Path) -> None:
    write_report(report, "text", tmp_path)
    read = json.loads((tmp_path / "evaluation.json").read_text())
    majority = next(each for each in read["baselines"] if each["name"] == "majority_map")
    assert majority["total"]["psnr_db"] is None
    assert majority["total"]["miou"] == pytest.approx(report.baselines[2].total.miou)
    assert len(majority["clips"]) == len(majority["without"]) == 2
    assert read["conditions"]["declared_mount"] == {"height_m": 1.8, "tilt_deg": 2.0}
    assert [shot["scene"] for shot in read["conditions"]["shots"]] == [7, 8]
    assert read["model"] == []
    assert (tmp_path / "evaluation.md").read_text() == "text"


def test_a_contact_sheet_stacks_source_view_best_baselines_and_target(tmp_path: Path) -> None:
    clips = PlaneClips.make(2)
    majority = fit_statistics(clips).majority
    assert majority is not None
    predictors = [CopySource(), MajorityMap(majority=majority)]  # two rows, and one
    some = [(key, as_set(clips).clip(key)) for key in as_set(clips).keys]
    write_contact_sheet(tmp_path / "sheet.png", predictors, some, classes=clips.classes)
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet.shape == (2 * 6 * 32 + 4, 132 + 2 * (48 + 4), 3)  # frames 1 and 4
    assert np.array_equal(sheet[:32, 132 : 132 + 48, ::-1], clips[0].source[0])
    assert np.array_equal(sheet[5 * 32 : 6 * 32, 184 : 184 + 48, ::-1], clips[0].target[3])


def test_a_sheet_of_clips_without_classes_has_pictures_alone(tmp_path: Path) -> None:
    clips = PlaneClips.orbits([SphericalDelta(azimuth_deg=40.0)])
    some = as_set(clips)
    write_contact_sheet(tmp_path / "sheet.png", [CopySource()], [("drop 0", some.clip(some.keys[0]))])
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet.shape[0] == 3 * 32


def test_a_place_that_cannot_be_written_is_our_error(report: Report, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="--out"):
        write_report(report, "", tmp_path / "file")


def run(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["evaluate", *(str(each) for each in arguments)])
    return done.exit_code, done.output


def test_baselines_are_evaluated_from_the_command_line(tmp_path: Path) -> None:
    held_out, training = PlaneClips.make(2).write(tmp_path / "a", 1000), PlaneClips.make(3).write(tmp_path / "b")
    code, output = run("--data", held_out, "--train", training, "--out", tmp_path / "out", "--limit", 1)
    assert code == 0, output
    assert "depth_reprojection" in output
    read = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert (len(read["conditions"]["shots"]), read["conditions"]["train_clips"]) == (1, 3)
    assert (tmp_path / "out" / "contact_sheet.png").is_file()


def test_clips_from_a_folder_measure_as_they_do_in_memory(tmp_path: Path) -> None:
    clips = PlaneClips.make(2)
    held_out, training = clips.write(tmp_path / "a", 1000), clips.write(tmp_path / "b")
    code, output = run("--data", held_out, "--train", training, "--out", tmp_path / "out")
    assert code == 0, output
    read = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    expected = [each.total.psnr_db for each in evaluate(without_learning(clips), as_set(clips))]
    found = {each["name"]: each["total"]["psnr_db"] or np.nan for each in read["baselines"]}
    names = [each.name for each in without_learning(clips)]
    assert [found[name] for name in names] == pytest.approx(expected, abs=0.02, nan_ok=True)  # depth in 1/256 m


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


@pytest.mark.parametrize(
    ("arguments", "code", "hint"),
    [((), 78, "--train"), (("--no-baselines",), 78, "--weights"), (("--train", "nowhere"), 66, "nowhere")],
)
def test_what_is_missing_is_said(tmp_path: Path, arguments: tuple[str, ...], code: int, hint: str) -> None:
    held_out = PlaneClips.make(1).write(tmp_path / "a")
    found, output = run("--data", held_out, "--out", tmp_path / "out", *arguments)
    assert found == code
    assert hint in output


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
