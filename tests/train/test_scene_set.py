"""Clips of whole scenes: which there are, the same in any list, and what methods are shown of them."""

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from fake_model import traits_of
from tiny_scenes4d import draw, kubric_poses, write_driving, write_kubric
from typer.testing import CliRunner

from gcd_model.config import SVD_14
from gcd_model.geometry import Spherical
from gcd_model.weights.card import FamilyName
from gcd_train.cli.main import app
from gcd_train.data.files import MANIFEST, SceneManifest
from gcd_train.data.paths import FrameSampling, OrbitSampling
from gcd_train.data.splits import (
    RELEASED_SOURCE,
    SceneControls,
    public_split,
    public_splits,
    read_controls,
    released_controls,
    write_controls,
)
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.clips import EvaluationSet, SceneSet
from gcd_train.evaluation.opening import ClipOptions, open_clips
from gcd_train.evaluation.store import Run

SCENES = ("scn02900", "scene_000005")
VIEWS = tuple(f"view{number}" for number in range(4))
DRAWN = ClipOptions(data=(), camera=VIEWS)
KUBRIC = replace(DRAWN, frame_start=0, frame_skip=1)
DRIVING = replace(KUBRIC, camera=("camera0", "yaw-0", "yaw-60"))
PAPER = SceneControls(
    seed=3, clips=4, sampling=OrbitSampling(frames=FrameSampling(clip=14, strides=(1, 2), latest_start=6))
)


@pytest.fixture(scope="module")
def kubric(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kubric")
    for number in (2900, 2901):
        write_kubric(root, number, frames=4)
    return root


@pytest.fixture(scope="module")
def driving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("driving")
    write_driving(root, 5, frames=4)
    return root


def opened_and_told(root: Path, options: ClipOptions, **more: object) -> tuple[EvaluationSet, tuple[str, ...]]:
    return open_clips(replace(options, data=(root,), **more), size=(3, 32, 48))


def opened(root: Path, options: ClipOptions, **more: object) -> EvaluationSet:
    return opened_and_told(root, options, **more)[0]


# --- which clips ---------------------------------------------------------------------------------------------------


def test_the_paper_goes_from_one_part_of_a_scene_seen_by_one_low_camera_to_four_goals_in_bounds() -> None:
    sources: set[Spherical] = set()
    for scene in (f"scn{number:05d}" for number in range(2900, 2950)):
        each = [PAPER.control(scene, name, 60) for name in PAPER.names(scene)]
        assert len({(one.start, one.frame_start, one.frame_skip) for one in each}) == 1
        start, goals = each[0].start, [one.goal for one in each if one.goal is not None]
        sources.add(start)
        assert len(set(goals)) == 4
        for change in (goal - start for goal in goals):
            assert abs(change.azimuth_deg) <= 90
            assert -5 <= change.elevation_deg <= 30
            assert abs(change.radius_m) <= 3
        assert each[0].frame_skip in (1, 2)
        assert 0 <= each[0].frame_start <= 6
    assert {source.elevation_deg for source in sources} == {5.0}
    assert {int(source.azimuth_deg // 90) for source in sources} == {0, 1, 2, 3}
    assert min(source.radius_m for source in sources) < 13 < 17 < max(source.radius_m for source in sources)


def test_variants_of_one_table_are_measured_at_the_same_goals(kubric: Path) -> None:
    names: tuple[FamilyName, ...] = ("kubric90", "kubric180")
    options = replace(KUBRIC, data=(kubric,))
    each = [
        open_clips(options, traits_of(SVD_14, name, move_time=move_time))[0] for name in names for move_time in (0, 13)
    ]
    goals = [one.controls.control("scn02901", "sample_02", 60).goal for one in each if isinstance(one, SceneSet)]
    assert goals == [goals[0]] * 4
    assert [one.pairs.sampling.move_time for one in each if isinstance(one, SceneSet)] == [0, None] * 2
    change = goals[0] - each[0].controls.control("scn02901", "sample_02", 60).start
    assert abs(change.azimuth_deg) <= 90


def test_the_released_script_makes_one_clip_of_its_own_angles() -> None:
    listed = released_controls(["scn02900"], orbit=True)
    control = replace(PAPER, listed=listed, clips=1, skip=4).control("scn02900", "sample_00", 60)
    assert control.start == RELEASED_SOURCE
    assert control.goal == Spherical(azimuth_deg=50.0, elevation_deg=25.0, radius_m=15.0)
    assert (control.frame_start, control.frame_skip) == (0, 4)


def controls(folder: Path, scenes: list[str], samples: int = 3) -> Path:
    """From where the tiny scenes' first camera stands."""
    entry = {"frame_start": 1, "frame_skip": 1, "spherical_start": [20, 35, 15], "spherical_end": [50, 40, 14]}
    path = folder / "controls.json"
    path.write_text(json.dumps({scene: {f"sample_{k:02d}": entry for k in range(samples)} for scene in scenes}))
    return path


def test_a_control_list_says_which_clips_there_are_and_who_is_missing_is_told(kubric: Path, tmp_path: Path) -> None:
    listed = controls(tmp_path, ["test/scn02901", "scn02999"])
    clips, notes = opened_and_told(kubric, DRAWN, controls=listed, trajectories=2)
    assert clips.keys == ("scn02901.sample_00", "scn02901.sample_01")
    assert "scn02900" in "".join(notes)
    clip = clips.clip("scn02901.sample_01")
    assert clip.change == pytest.approx((30.0, 5.0, -1.0))
    assert clip.seen.fps == 24.0
    write_controls(tmp_path / "again.json", clips.listed())
    assert read_controls(tmp_path / "again.json")["scn02901"] == read_controls(listed)["scn02901"][:2]
    _, notes = open_clips(replace(DRAWN, data=(kubric,)), size=(3, 64, 96))
    assert "pictures of 48 x 32, measured at 96 x 64" in notes[-1]


def test_a_control_list_that_does_not_fit_is_refused_at_once(kubric: Path, driving: Path, tmp_path: Path) -> None:
    listed = controls(tmp_path, ["scn00001"])
    with pytest.raises(
        DataError, match=r"controls\.json has none of the 2 scenes in .*, first scn02900; give the list"
    ):
        opened(kubric, DRAWN, controls=listed)
    driven = tmp_path / "driven.json"
    driven.write_text(json.dumps({name: {"sample_00": {"frame_start": 0, "frame_skip": 1}} for name in SCENES}))
    with pytest.raises(DataError, match="scn02900, sample_00 has no spherical_start: it is a driving control"):
        opened(kubric, DRAWN, controls=driven)
    assert opened(driving, DRAWN, camera=DRIVING.camera, controls=driven).keys == ("scene_000005.sample_00",)


def test_cameras_that_no_scene_has_are_refused_at_once(kubric: Path, driving: Path) -> None:
    for root, cuts, names in (
        (kubric, KUBRIC, (*VIEWS, "view9")),
        (kubric, KUBRIC, ("nope",)),
        (driving, DRIVING, None),
    ):
        with pytest.raises(
            DataError, match=r"none of \d scenes can be opened with .*; name those there are|are called view0"
        ):
            opened(root, cuts, camera=names or ("yaw-0", "nope"))


def test_bounds_win_over_controls_in_the_released_protocol_only(kubric: Path, tmp_path: Path) -> None:
    listed = controls(tmp_path, ["scn02900"])
    with pytest.raises(RecipeError, match="the paper's protocol takes frames from the controls"):
        opened(kubric, KUBRIC, controls=listed)
    released = opened(kubric, KUBRIC, controls=listed, protocol="release")
    assert released.keys == ("scn02900.sample_00",)


def test_lists_and_splits_choose_scenes(kubric: Path, tmp_path: Path) -> None:
    listed = tmp_path / "test2.txt"
    listed.write_text("# two\ndata/test/scn02901\nkubric/scn02900  # invalid\nscn02950\n")
    clips, notes = opened_and_told(kubric, KUBRIC, listed=listed)
    assert {key.partition(".")[0] for key in clips.keys} == {"scn02901"}
    assert any("invalid" in line for line in notes)
    assert any("scn02950" in line for line in notes)
    assert len(opened(kubric, KUBRIC, split="kubric4d-test20").keys) == 8
    assert len(opened(kubric, KUBRIC, limit=1).keys) == 4
    with pytest.raises(DataError, match="no scene of the list or split"):
        opened(kubric, KUBRIC, split="kubric4d-train")
    with pytest.raises(RecipeError, match="not both"):
        opened(kubric, KUBRIC, split="kubric4d-test", listed=listed)


def test_a_scene_of_ours_is_of_the_world_that_its_manifest_says(tmp_path: Path) -> None:
    write_kubric(tmp_path, 1_000_000, frames=4)
    size = {"frames": 4, "fps": 24.0, "width": 48, "height": 32, "oversample": 1, "hfov_deg": 53.1, "compact": False}
    told = {"layout": "kubric4d", "world": "tabletop", "seed": 1_000_000, "version": "0", "edition": 1}
    manifest = SceneManifest(**told, **size, cameras=VIEWS, files={})
    (tmp_path / "scn1000000" / MANIFEST).write_bytes(msgspec.json.encode(manifest))
    assert len(opened(tmp_path, KUBRIC, split="tabletop-test").keys) == 4
    for split in ("drop-test", "driving-test"):
        with pytest.raises(DataError, match=f"{split} is for .*scn1000000 is of tabletop"):
            opened(tmp_path, KUBRIC, split=split)


def test_the_identity_follows_the_files_and_neither_their_place_nor_their_times(kubric: Path, tmp_path: Path) -> None:
    first, copy = opened(kubric, KUBRIC).identity, tmp_path / "copy"
    shutil.copytree(kubric, copy)  # with times of its own
    assert opened(copy, KUBRIC).identity == first
    (picture,) = copy.glob("scn02900/frames_p0_v0/rgba_00000.png")
    whole = picture.read_bytes()
    picture.write_bytes(whole + b"0")
    assert opened(copy, KUBRIC).identity != first
    picture.write_bytes(whole)
    assert opened(copy, KUBRIC).identity == first
    told = next(copy.glob("scn02900/*.json"))
    told.write_bytes(told.read_bytes().replace(b"0", b"1", 1))  # of the same size
    assert opened(copy, KUBRIC).identity != first


def test_public_splits_of_a_world_share_no_scene() -> None:
    assert {"driving-test", "drop-test", "tabletop-test", "kubric4d-test20"} <= set(public_splits())
    for world in ("driving", "drop", "tabletop", "kubric4d"):
        parts = [public_split(f"{world}-{part}") for part in ("train", "valid", "test")]
        assert all(len(part) > 0 for part in parts)
        runs = [run for part in parts for run in part.runs]
        assert all(a.stop <= b.start or b.stop <= a.start for i, a in enumerate(runs) for b in runs[i + 1 :])
    assert 2900 in public_split("kubric4d-test")
    assert 1_000_039 in public_split("driving-test")
    assert 1_000_040 not in public_split("driving-test")


# --- what is shown -------------------------------------------------------------------------------------------------


def test_a_clip_of_an_orbit_shows_what_its_cameras_see(kubric: Path) -> None:
    clips = pickle.loads(pickle.dumps(opened(kubric, KUBRIC, limit=1)))  # as another process gets it
    assert (clips.kind, clips.camera, len(clips.classes)) == ("kubric", "spherical", 0)
    clip = clips.clip("scn02900.sample_02")
    cameras = clip.seen.cameras
    true = draw(cameras.ground_from_source.numpy(), cameras.source)
    near = (true.depth < 40) & (clip.seen.source_depth[0] > 0)
    assert near.mean() > 0.3
    assert np.median(np.abs(clip.seen.source_depth[0] / true.depth - 1)[near]) < 0.05  # of points, few and coarse
    assert clip.visible.shape == (3, 32, 48)
    assert clip.seen.points == ()  # no camera of the scene stands at the source
    assert clip.change == pytest.approx(
        (
            cameras.trajectory.goal_delta.azimuth_deg,
            cameras.trajectory.goal_delta.elevation_deg,
            cameras.trajectory.goal_delta.radius_m,
        )
    )


def test_further_cameras_are_given_at_the_clips_size_and_times(kubric: Path) -> None:
    clip = opened(kubric, KUBRIC, limit=1).clip("scn02900.sample_00")
    views = clip.seen.others(2)
    assert [len(each) for each in views] == [3, 3]
    assert all((view.lens.width, view.lens.height) == (48, 32) for each in views for view in each)
    poses = [each[0].world_from_camera for each in views]
    assert all(any(np.allclose(pose, known, atol=1e-5) for known in kubric_poses()) for pose in poses)
    assert views[0][0].rgb.tobytes() != views[0][2].rgb.tobytes()
    with pytest.raises(DataError, match="3 cameras beside the source"):
        clip.seen.others(4)


def test_a_driving_clip_has_the_forward_cameras_own_depth_and_classes(driving: Path) -> None:
    clips = opened(driving, DRIVING, modality="semantic")
    clip = clips.clip("scene_000005.sample_00")
    assert (clips.kind, clips.camera, clip.change) == ("driving", "none", None)
    names = [each.name for each in clips.classes]
    assert names == ["Car", "Road", "Sky", "Void"]
    pose, lens = clip.seen.cameras.ground_from_source.numpy(), clip.seen.cameras.source
    true = draw(pose, lens, box_x=9.0)
    ids = np.array([names.index({5: "Car", 24: "Road", 29: "Sky"}[k]) for k in true.ids.ravel()]).reshape(32, 48)
    assert (clip.seen.source_classes[0] == ids).mean() > 0.9
    ratio = clip.seen.source_depth[0] / true.depth
    assert np.median(np.abs(ratio - 1)) < 0.1
    assert set(np.unique(clip.target_classes)) <= set(range(4))
    assert clip.visible[0].mean() > 0.95
    assert [view.rgb.shape for view in clip.seen.points] == [(36, 48, 3)] * 3


@pytest.mark.slow
@pytest.mark.timeout(300)  # points at the published size
def test_the_command_measures_whole_scenes(tmp_path: Path) -> None:
    write_kubric(tmp_path / "data", 2900, frames=15)
    folders = ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "run"), "--split", "kubric4d-test20"]
    cut = ["--trajectories", "1", "--frame-start", "0", "--frame-skip", "1", "--views", "none"]
    cameras = [word for view in VIEWS for word in ("--camera", view)]
    result = CliRunner().invoke(app, ["evaluate", *folders, *cut, *cameras, "--methods", "copy_source"])
    assert result.exit_code == 0, result.output
    run = Run.read(tmp_path / "run")
    told, (record,) = run.note, run.records
    assert (told.kind, told.protocol, told.frames, told.width) == ("kubric", "paper", 14, 384)
    assert (record.key, record.scene, len(record.regions)) == ("scn02900.sample_00", "scn02900", 3)
    (control,) = read_controls(tmp_path / "run" / "controls.json")["scn02900"]
    assert control.frame_start == 0
    assert control.goal.azimuth_deg - control.start.azimuth_deg == pytest.approx(record.change[0])
