"""What our own writers write, the readers read: the same pictures, depths, labels and poses; and exact pairs of it."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from box_world import STAGE, stage
from headless import needs_egl

from gcd_model.geometry import Intrinsics
from gcd_train.data.encodings import SKY_M
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.paths import DRIVING, MAX90, FrameSampling
from gcd_train.data.pictures import PictureOptions, ViewPairs
from gcd_train.errors import DataError
from gcd_train.evaluation.clips import further_poses
from gcd_train.evaluation.opening import ClipOptions, open_clips
from gcd_train.scenes.description import Scene
from gcd_train.scenes.driving.classes import class_ids
from gcd_train.scenes.driving.world import driving_drive
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.scene_writer import write_scene
from gcd_train.scenes.triangles import freeze
from gcd_train.scenes.worlds import SCENE_WORLDS, SceneFormat, SceneWorld

SEED, FRAMES, WIDTH, HEIGHT = 3, 2, 48, 36
SIZE = (WIDTH, HEIGHT)
CLIP = FrameSampling(clip=2, reach_last=True)

pytestmark = needs_egl


def written(root: Path, world: SceneWorld, *, compact: bool = False) -> Path:
    form = SceneFormat(width=WIDTH, height=HEIGHT, frames=FRAMES, oversample=1, compact=compact)
    write_scene(root, world, form, SEED)
    return root


def drawn(scene: Scene) -> dict[tuple[int, str], Rendering]:
    with Renderer(WIDTH, HEIGHT, oversample=1) as renderer:
        return {(step, name): view for step, name, view in renderer.views(freeze(scene), scene.cameras)}


@pytest.fixture(scope="module")
def stage_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stage in the published layout."""
    return written(tmp_path_factory.mktemp("stage"), STAGE)


@pytest.mark.parametrize("compact", [False, True])
def test_a_kubric_scene_is_read_as_it_was_drawn(stage_root: Path, tmp_path: Path, compact: bool) -> None:
    stage_root = written(tmp_path, STAGE, compact=True) if compact else stage_root
    dataset = Kubric4D(stage_root, instances=True)
    scene = stage(SEED, FRAMES)
    pictures = drawn(scene)
    assert dataset.frames("scn00003") == FRAMES
    assert any(stage_root.rglob("*.webp")) == compact
    for time in range(FRAMES):
        for camera, view in zip(dataset.cameras, dataset.views("scn00003", time), strict=True):
            wanted = pictures[time, camera]
            near = wanted.depth > 0
            assert np.abs(view.rgb.astype(int) - wanted.rgb).mean() <= (6 if compact else 0)
            np.testing.assert_allclose(view.depth[near], wanted.depth[near], rtol=6e-4 if compact else 1e-6)
            assert float(view.depth[~near].min(initial=SKY_M)) > 20_000
            np.testing.assert_array_equal(view.instances, wanted.instances)
            np.testing.assert_allclose(view.world_from_camera, scene.cameras[camera][time], atol=1e-6)
            assert view.lens.fx == pytest.approx(48.0)


def test_an_exact_orbit_looks_like_its_point_cloud(stage_root: Path) -> None:
    dataset, orbit = Kubric4D(stage_root), replace(MAX90, frames=CLIP)
    exact = ViewPairs(dataset, orbit, 4, PictureOptions(size=SIZE, exact=True, visible=True)).sample(2)
    splatted = ViewPairs(dataset, orbit, 4, PictureOptions(size=SIZE, visible=True)).sample(2)
    assert exact.skipped == splatted.skipped == ()
    np.testing.assert_array_equal(exact.source_from_target, splatted.source_from_target)
    np.testing.assert_array_equal(exact.source[0], exact.target[0])
    for one, other in ((exact.source, splatted.source), (exact.target, splatted.target)):
        assert np.abs(one.astype(int) - other).mean() < 12
    assert exact.visible is not None
    assert splatted.visible is not None


def test_a_camera_that_is_drawn_for_an_exact_scene_sees_what_one_there_sees(stage_root: Path) -> None:
    dataset, orbit = Kubric4D(stage_root), replace(MAX90, frames=CLIP)
    pairs = ViewPairs(dataset, orbit, 4, PictureOptions(size=SIZE, exact=True))
    own = [dataset.views("scn00003", time, ["view3", "view9"]) for time in (0, 1)]
    poses = np.stack([view.world_from_camera for view in own[0]])
    for seen, there in zip(pairs.seen_from("scn00003", (0, 1), poses), own, strict=True):
        for one, other in zip(seen, there, strict=True):
            assert np.abs(one.rgb.astype(int) - other.rgb).mean() < 3  # drawn with twice the samples
            np.testing.assert_array_equal(one.world_from_camera, other.world_from_camera)
            near = (one.depth > 0) & (other.depth < SKY_M / 2)
            assert np.median(np.abs(one.depth[near] / other.depth[near] - 1)) < 0.03  # half a pixel apart
    with pytest.raises(DataError, match="--exact"):
        ViewPairs(dataset, orbit, 4, PictureOptions(size=SIZE)).seen_from("scn00003", (0,), poses)


def test_a_method_gets_the_scenes_own_cameras_first_and_drawn_ones_then(stage_root: Path) -> None:
    options = ClipOptions(data=[stage_root], exact=True, trajectories=1, frame_start=0, frame_skip=1)
    clips, _ = open_clips(options, size=(1, HEIGHT, WIDTH))
    assert clips.cameras == 16 + 48
    seen = clips.clip(clips.keys[0]).seen
    assert seen.others is not None
    poses = [views[0].world_from_camera for views in seen.others(18)]
    np.testing.assert_array_equal(poses[:15], [views[0].world_from_camera for views in seen.others(15)])
    np.testing.assert_allclose(poses[15:], further_poses()[:3])
    apart = np.linalg.norm(np.array(poses)[:, None, :3, 3] - np.array(poses)[:, :3, 3], axis=-1)
    assert apart[~np.eye(18, dtype=bool)].min() > 0.5
    with pytest.raises(DataError, match="63 cameras beside the source"):
        seen.others(64)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive in the published layout."""
    return written(tmp_path_factory.mktemp("driving"), SCENE_WORLDS["driving"])


@pytest.mark.parametrize("compact", [False, True])
def test_a_driving_scene_is_read_as_it_was_drawn(root: Path, tmp_path: Path, compact: bool) -> None:
    root = written(tmp_path, SCENE_WORLDS["driving"], compact=True) if compact else root
    pictures = drawn(driving_drive(SEED, frames=FRAMES))
    dataset = ParallelDomain4D(root, instances=True)
    (scene,) = dataset.scenes
    assert any((root / scene / "rgb").rglob("*.webp")) == compact
    vehicle_from_camera = SCENE_WORLDS["driving"].vehicle_from_camera
    assert vehicle_from_camera is not None
    for time in range(FRAMES):
        for camera, view in zip(dataset.cameras, dataset.views(scene, time), strict=True):
            wanted = pictures[time, camera]
            depth = np.where(wanted.depth > 0, wanted.depth, np.float32(SKY_M))
            if compact:
                np.testing.assert_array_less(np.abs(1 / view.depth - 1 / depth), 0.0013 * (1 / depth + 1 / 20))
                assert np.abs(view.rgb.astype(int) - wanted.rgb).mean() < 12
            else:
                np.testing.assert_array_equal(view.depth, depth)
                np.testing.assert_array_equal(view.rgb, wanted.rgb)
            np.testing.assert_array_equal(view.classes, class_ids(wanted.classes))
            np.testing.assert_array_equal(view.instances, wanted.instances)
            np.testing.assert_allclose(view.world_from_camera, vehicle_from_camera()[camera], atol=1e-6)
            assert view.lens == Intrinsics.from_hfov(85.0, WIDTH, HEIGHT)


def test_exact_pairs_start_with_the_same_picture(root: Path) -> None:
    dataset = ParallelDomain4D(root)
    sampling = replace(DRIVING, frames=CLIP)
    pairs = ViewPairs(dataset, sampling, 0, PictureOptions(size=(WIDTH, 24), exact=True, visible=True, class_ids=True))
    sample = pairs.sample(0)
    assert sample.skipped == ()
    np.testing.assert_array_equal(sample.source[0], sample.target[0])
    assert np.abs(sample.source[1].astype(int) - sample.target[1]).mean() > 5
    assert sample.visible is not None
    assert sample.target_classes is not None
    known = sample.target_classes[0] != 29  # the sky has no depth
    assert sample.visible[0][known].mean() > 0.98
    assert sample.visible[1].mean() < sample.visible[0].mean()
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(pairs)).sample(0).target, sample.target)
    splatted = ViewPairs(dataset, sampling, 0, PictureOptions(size=(WIDTH, 24), class_ids=True)).sample(0)
    assert np.abs(splatted.target.astype(int) - sample.target).mean() < 25
    assert splatted.target_classes is not None
    assert np.mean(splatted.target_classes == sample.target_classes) > 0.6


def test_exact_pairs_of_a_damaged_geometry_are_left_out_by_name(root: Path, tmp_path: Path) -> None:
    dataset = ParallelDomain4D(root)
    geometry = dataset.folder(dataset.scenes[0]) / "geometry.npz"
    content = geometry.read_bytes()
    try:
        geometry.write_bytes(content[:1000])
        pairs = ViewPairs(dataset, replace(DRIVING, frames=CLIP), 0, PictureOptions(size=(WIDTH, 24), exact=True))
        with pytest.raises(DataError, match=r"geometry\.npz is no drawable scene"):
            pairs.sample(0)
    finally:
        geometry.write_bytes(content)
