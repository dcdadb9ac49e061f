"""`gcd-train show`: what is on the sheet is what is in the files, and a broken file is named."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from box_world import STAGE, box_scene
from headless import needs_egl
from tiny_scenes4d import write_driving, write_kubric
from tiny_world import ran

from gcd_train.data.files import GEOMETRY, FileFault
from gcd_train.errors import DataError, RecipeError
from gcd_train.look.sheet import SKY_M, UNSEEN, Footage
from gcd_train.look.show import ShowOptions, open_scene
from gcd_train.scenes.scene_writer import write_scene
from gcd_train.scenes.triangles import freeze
from gcd_train.scenes.worlds import DEPTH_UNIT_M, SceneFormat, World

FRAMES = 4


@pytest.fixture(scope="module")
def orbit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_kubric(tmp_path_factory.mktemp("orbit"), 7, views=5, frames=FRAMES)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_driving(tmp_path_factory.mktemp("drive"), 7, frames=FRAMES)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pairs")
    write_pairs(folder)
    return folder


def write_pairs(folder: Path, height: int = 32, width: int = 48) -> None:
    """One shard with one clip of three frames: a wall 10 m ahead; the target stands where the source does."""
    world = World(
        name="driving", width=width, height=height, frames=3, fps=10.0, hfov_deg=85.0, oversample=1, clips_per_shard=1
    )
    (folder / "world.json").write_bytes(msgspec.json.encode(world))
    depth = np.full((3 * height, width), round(10 / DEPTH_UNIT_M), np.uint16)
    ids = np.ones((3 * height, width), np.uint8)
    colour = np.full((3 * height, width, 3), 90, np.uint8)
    poses = {camera: [np.eye(4).tolist()] * 3 for camera in ("source", "target")}
    with zipfile.ZipFile(folder / "shard-00000005-1.zip", "w") as archive:
        archive.writestr("00000005/scene.json", json.dumps({"facts": {"hfov_deg": 85.0}, "world_from_camera": poses}))
        for camera in poses:
            for kind, strip in {"rgb": colour, "depth": depth, "classes": ids, "instances": ids}.items():
                archive.writestr(f"00000005/{camera}.{kind}.png", cv2.imencode(".png", strip)[1].tobytes())


def opened(path: Path, **options: object) -> Footage:
    return open_scene(path, ShowOptions(**options))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("layout", ["orbit", "drive", "pairs"])
def test_every_layout_gives_a_clip_whose_path_begins_at_the_source(layout: str, request: pytest.FixtureRequest) -> None:
    footage = opened(request.getfixturevalue(layout))
    t, h, w = footage.depth.shape
    assert footage.source.shape == footage.sample.target.shape == footage.splat.shape == (t, h, w, 3)
    assert footage.visible.shape == footage.surface.shape == (t, h, w)
    assert footage.labels is not None
    assert footage.labels.shape == (t, h, w)
    assert len(footage.sample.frame_numbers) == t
    np.testing.assert_allclose(footage.poses[0], footage.views[0].world_from_camera, atol=1e-3)
    assert footage.seen_shares[0] > 0.97  # from where the source stands, everything was seen by it
    assert np.abs(footage.splat[0].astype(int) - footage.source[0])[footage.depth[0] < SKY_M].mean() < 12


def test_only_surfaces_that_were_not_seen_turn_orange(pairs: Path) -> None:
    footage = opened(pairs)
    assert footage.sample.target_depth is not None
    visible, depth = footage.visible.copy(), footage.sample.target_depth.copy()
    visible[:, :, :8] = False
    depth[:, :, :4] = 0.0  # sky
    footage = replace(footage, sample=replace(footage.sample, visible=visible, target_depth=depth))
    painted = footage.seen()
    assert np.array_equal(painted[:, :, 8:], footage.sample.target[:, :, 8:])
    assert np.array_equal(painted[:, :, :4], footage.sample.target[:, :, :4])
    assert np.abs(painted[:, :, 4:8].astype(int) - UNSEEN).max() < 100
    assert footage.seen_shares[0] == pytest.approx(40 / 44)


def test_a_scene_that_is_too_short_is_shown_whole(drive: Path) -> None:
    footage = opened(drive)
    assert footage.sample.frame_numbers == tuple(range(FRAMES))
    assert footage.scene == "4 frames at 10 fps, 3 cameras"
    assert footage.ontology is not None


# what goes wrong


@pytest.mark.parametrize(
    "file",
    [
        "frames_p0_v4/rgba_00002.png",
        "frames_p0_v4/depth_00001.tiff",
        "frames_p0_v4/segmentation_00003.png",
        "scn00007_p0_v4.json",
        "scn00007_p0_v2.json",
    ],
)
def test_a_broken_file_is_named_and_there_is_no_traceback(tmp_path: Path, file: str) -> None:
    path = write_kubric(tmp_path, 7, views=5, frames=FRAMES) / file
    path.write_bytes(path.read_bytes()[:60])
    if path.suffix == ".tiff":
        path.unlink()
    code, told = ran("show", path.parents[len(Path(file).parts) - 1], "--out", tmp_path / "out")
    assert code == DataError.exit_code
    assert path.name in told
    assert not (tmp_path / "out").exists()


def test_what_is_no_scene_is_refused_with_what_to_give_instead(orbit: Path, tmp_path: Path) -> None:
    assert f"show one, such as {orbit}" in ran("show", orbit.parent)[1]
    assert "neither scnNNNNN" in ran("show", tmp_path)[1]
    assert "is no folder" in ran("show", tmp_path / "scn00001")[1]


def test_pair_shards_name_an_unknown_clip_and_a_damaged_shard(pairs: Path, tmp_path: Path) -> None:
    code, told = ran("show", pairs, "--seed", 9)
    assert (code, "no clip of seed 9" in told) == (RecipeError.exit_code, True)
    write_pairs(tmp_path)
    shard = tmp_path / "shard-00000005-1.zip"
    shard.write_bytes(shard.read_bytes()[:-40])
    code, told = ran("show", tmp_path)
    assert (code, shard.name in told) == (DataError.exit_code, True)


# the whole command


def test_the_command_writes_sheet_path_and_video_and_tells_facts_with_units(drive: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="figures need the extra `train`")
    code, told = ran("show", drive, "--out", tmp_path)
    assert code == 0
    for words in ("4 frames at 10 fps", "3 cameras", "hfov 85.0°", "m (1st to 99th percentile)", "Car", "Road", "%"):
        assert words in told
    for name in ("sheet.png", "trajectory.png"):
        picture = cv2.imread(str(tmp_path / name))
        assert picture is not None
        assert min(picture.shape[:2]) > 200
        assert picture.std() > 20  # something is drawn on it
    video = cv2.VideoCapture(str(tmp_path / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 2 * (FRAMES + 7)
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)


@needs_egl
@pytest.mark.parametrize("compact", [True, False])
def test_a_scene_of_ours_is_wholly_seen_from_where_its_source_stands(compact: bool, tmp_path: Path) -> None:
    """Fails where what the writer means by depth is not what the reader takes it for."""
    form = SceneFormat(width=96, height=64, frames=2, oversample=1, compact=compact)
    write_scene(tmp_path, STAGE, form, 0)
    footage = opened(tmp_path / "scn00000")
    assert footage.target_is.startswith("rendered")
    assert footage.seen_shares[0] > 0.9
    points = opened(tmp_path / "scn00000", points=True)
    assert points.sample.target_depth is None
    assert np.abs(points.sample.target[0].astype(int) - footage.sample.target[0]).mean() < 8


def test_geometry_of_too_few_frames_is_named(tmp_path: Path) -> None:
    scene = write_kubric(tmp_path, 7, views=5, frames=FRAMES)
    with (scene / GEOMETRY).open("wb") as file:
        freeze(box_scene(0, 1)).save(file)
    with pytest.raises(FileFault, match=GEOMETRY):
        opened(scene)
