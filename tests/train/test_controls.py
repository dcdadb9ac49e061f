"""Splits, scene lists and control lists, tiny ones and, where they lie beside the clone, the published ones."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest

from gcd_model.geometry import to_pose
from gcd_train.data.files import Skips
from gcd_train.data.splits import Part, kubric_split, read_controls, read_scene_list, read_split, write_sweep
from gcd_train.errors import DataError

OFFICIAL = Path(__file__).parents[2].parent / "shared" / "spec" / "official"
needs_official = pytest.mark.skipif(
    not OFFICIAL.is_dir(), reason="needs the published lists in ../shared/spec/official beside the clone"
)


def test_every_kubric_scene_is_in_one_part() -> None:
    scenes = [f"scn{number:05d}" for number in range(3000)]
    parts: list[Part] = ["train", "val", "test"]
    split = [kubric_split(scenes, part) for part in parts]
    assert [len(part) for part in split] == [2800, 100, 100]
    assert sorted(scene for part in split for scene in part) == scenes
    assert split[2][0] == "scn02900"


def test_a_split_file_is_read_by_base_name(tmp_path: Path) -> None:
    path = tmp_path / "split.json"
    path.write_text(json.dumps({"seed": 1, "train": ["data/scene_000001"], "val": [], "test": ["scene_000003"]}))
    assert read_split(path, "train") == ("scene_000001",)
    assert read_split(path, "val") == ()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "is no split file"),
        ('{"train": []}', "is no split file"),
        ('{"train": [1], "val": [], "test": []}', "is no split file"),
        ('{"train": ["scene_000001"], "val": ["x/scene_000001"], "test": []}', "1 scenes .* first: scene_000001"),
    ],
)
def test_a_damaged_split_file_and_a_scene_in_two_parts_are_named(tmp_path: Path, content: str, said: str) -> None:
    path = tmp_path / "split.json"
    path.write_text(content)
    with pytest.raises(DataError, match=rf"split\.json.* {said}"):
        read_split(path, "train")
    with pytest.raises(DataError, match=r"gone\.json is no split file"):
        read_split(tmp_path / "gone.json", "train")


def test_a_list_is_stripped_of_comments_and_counts_what_it_leaves_out(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text(
        "\n# a comment, invalid or not\n/data/scene_000048\n  data/test/scene_000072/  # good\n"
        "/d/scene_000452  # invalid\n# /d/scene_000453 # invalid\nREADME\n/d/scene_000048\n# /d/scene_000777\n"
    )
    skips = Skips()
    listed = read_scene_list(path, skips)
    assert listed == ("scene_000048", "scene_000072")
    assert skips.total == 4
    told = "\n".join(skips.lines())
    assert f"scene_000452: {path} line 5: is marked invalid" in told
    assert f"scene_000453: {path} line 6: is marked invalid" in told
    assert f"README: {path} line 7: is no scene name" in told
    assert f"scene_000048: {path} line 8: stands there twice" in told


def test_a_list_of_nothing_is_refused(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("# nothing\n")
    with pytest.raises(DataError, match="lists no scene"):
        read_scene_list(tmp_path / "list.txt", Skips())
    with pytest.raises(DataError, match="is no list of scenes"):
        read_scene_list(tmp_path / "gone.txt", Skips())


def test_kubric_controls_say_cameras_and_driving_ones_do_not(tmp_path: Path) -> None:
    path = tmp_path / "controls.json"
    sample = {"frame_start": 2, "frame_skip": 3, "spherical_start": [15, 5, 15], "spherical_end": [100, 20.5, 14]}
    path.write_text(json.dumps({"test/scn02900": {"sample_01": sample | {"note": 1}, "sample_00": sample}}))
    first, second = read_controls(path)["scn02900"]
    assert (first.name, second.name) == ("sample_00", "sample_01")
    assert first.start is not None
    assert first.goal is not None
    assert (first.start.azimuth_deg, first.goal.elevation_deg, first.goal.radius_m) == (15.0, 20.5, 14.0)
    assert first.frame_numbers(3) == (2, 5, 8)
    assert first.fps(24.0) == 8.0


@pytest.mark.parametrize(
    ("sample", "match"),
    [
        ({"frame_start": -1, "frame_skip": 1}, "a control list has scenes with samples with frame_start"),
        ({"frame_start": 0, "frame_skip": 0}, "a control list has scenes with samples with frame_start"),
        ({"frame_start": 0}, "a control list has scenes with samples with frame_start"),
        ({"frame_start": 0, "frame_skip": 1, "spherical_start": [0, 0, 1]}, "a, s has only one of"),
        (
            {"frame_start": 0, "frame_skip": 1, "spherical_start": [0, 0, 0], "spherical_end": [0, 0, 1]},
            "a, s asks for a camera that cannot be",
        ),
    ],
)
def test_a_damaged_control_list_is_named(tmp_path: Path, sample: dict[str, object], match: str) -> None:
    path = tmp_path / "controls.json"
    path.write_text(json.dumps({"a": {"s": sample}}))
    with pytest.raises(DataError, match=rf"controls\.json.*{match}"):
        read_controls(path)


def test_a_sweep_goes_to_the_right_from_ten_degrees_up_whatever_scenes_there_are(tmp_path: Path) -> None:
    path = tmp_path / "sweep.json"
    assert write_sweep(path, ["scn00007", "scn00009"], step_deg=45.0) == 5
    swept = read_controls(path)
    for controls in swept.values():
        starts = {control.start for control in controls}
        assert [control.goal.azimuth_deg - control.start.azimuth_deg for control in controls] == pytest.approx(
            [0.0, 45.0, 90.0, 135.0, 180.0]
        )
        ((start,), *_) = [starts]
        assert (start.elevation_deg, start.radius_m) == (10.0, 15.0)
        assert {(control.goal.elevation_deg, control.goal.radius_m) for control in controls} == {(10.0, 15.0)}
        to_the_right = to_pose(start).inverse() @ to_pose(controls[1].goal)
        assert to_the_right[0, 3] > 0  # x of the source camera is right
    assert write_sweep(path, ["scn00009"], step_deg=100.0) == 3
    assert read_controls(path)["scn00009"][-1] == replace(swept["scn00009"][-1], name="sample_02")  # 180 always
    write_sweep(path, ["scn00009"], step_deg=45.0)
    assert read_controls(path)["scn00009"] == swept["scn00009"]


def test_skips_are_counted_logged_once_and_merged(caplog: pytest.LogCaptureFixture) -> None:
    skips, other = Skips(), Skips()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            skips.add("scene_a", "a.png", "is missing")
        other.extend([skips.add("scene_b", "b.png", "is damaged")])
    assert (skips.total, other.total) == (4, 1)
    assert [record.getMessage() for record in caplog.records].count("left out scene_a: a.png is missing") == 1
    assert skips.lines(most=1) == ["scene_a: a.png is missing", "and 1 more"]
    caplog.clear()
    assert [str(Skips(logged=False).add("scene_a", "a.png", "is gone")), caplog.text] == ["scene_a: a.png is gone", ""]


@needs_official
def test_the_published_split_has_its_published_sizes() -> None:
    path = OFFICIAL / "pardom_datasplit.json"
    parts: list[Part] = ["train", "val", "test"]
    assert [len(read_split(path, part)) for part in parts] == [1411, 61, 61]


@needs_official
@pytest.mark.parametrize(
    ("name", "scenes", "left_out"),
    [
        ("kubric_test20.txt", 20, 0),
        ("kubric_test50.txt", 50, 0),
        ("kubric_test100.txt", 100, 0),
        ("pardom_test20.txt", 20, 1),
        ("pardom_test61.txt", 60, 1),
    ],
)
def test_the_published_lists_have_their_usable_scenes(name: str, scenes: int, left_out: int) -> None:
    skips = Skips()
    listed = read_scene_list(OFFICIAL / name, skips)
    assert (len(listed), skips.total) == (scenes, left_out)


@needs_official
def test_the_published_controls_fit_the_clips_they_are_for() -> None:
    controls = read_controls(OFFICIAL / "pardom_valtest_controls.json")
    assert len(controls) == 2150
    assert all(len(samples) == 8 for samples in controls.values())
    every = [control for samples in controls.values() for control in samples]
    assert max(control.frame_numbers(14)[-1] for control in every) == 48  # the last frame is never reached
    assert {control.fps(10.0) for control in every} == {5.0, 10.0}
