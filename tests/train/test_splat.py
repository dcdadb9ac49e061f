"""Points drawn as another camera sees them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from ball_room import BALL, RIG, photograph, rig_poses
from numpy.typing import NDArray
from plain_splat import plain_splat

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError
from gcd_train.pointcloud import SplatOptions, Splatted, splat

SOURCE = Intrinsics.from_hfov(53.13, 72, 48)
TARGET = Intrinsics.from_hfov(53.13, 52, 35)
HERE = np.eye(4)


@pytest.fixture(scope="module")
def room() -> list[SceneView]:
    return [photograph(pose, SOURCE) for pose in rig_poses(RIG[::4])]


def random_views(count: int, depths: tuple[float, float], seed: int = 0) -> list[SceneView]:
    """Cameras near the origin that look ahead into noise: no two neighbours alike, in depth or colour."""
    random = np.random.default_rng(seed)
    views: list[SceneView] = []
    for _ in range(count):
        pose = np.eye(4)
        pose[:3, 3] = random.uniform(-0.5, 0.5, 3)
        depth = random.uniform(*depths, (SOURCE.height, SOURCE.width)).astype(np.float32)
        views.append(flat_view(depth, random.integers(0, 256, (*depth.shape, 3), np.uint8), pose))
    return views


def flat_view(
    depth: NDArray[np.float32], rgb: NDArray[np.uint8], pose: NDArray[np.float64] = HERE, lens: Intrinsics = SOURCE
) -> SceneView:
    return SceneView(rgb=rgb, depth=depth, classes=None, instances=None, world_from_camera=pose, lens=lens)


def wall(depth_m: float, colour: int, lens: Intrinsics = SOURCE) -> SceneView:
    shape = (lens.height, lens.width)
    return flat_view(np.full(shape, depth_m, np.float32), np.full((*shape, 3), colour, np.uint8), lens=lens)


def psnr_db(made: Splatted, wanted: NDArray[np.float64]) -> float:
    return float(-10 * np.log10(((made.colour.numpy() - wanted) ** 2).mean() + 1e-20))


@pytest.mark.parametrize("radius", [0, 1, 2])
@pytest.mark.parametrize("depths", [(4.0, 20.0), (10.0, 3000.0)], ids=["near", "far"])
@pytest.mark.parametrize("published", [False, True])
def test_it_agrees_with_the_plain_float64_renderer_on_noise(
    radius: int, depths: tuple[float, float], published: bool
) -> None:
    views = random_views(3, depths)
    wanted, total = plain_splat(views, HERE, TARGET, radius=radius, published=published)
    made = splat(views, HERE, TARGET, options=SplatOptions(radius=radius, published=published))
    assert psnr_db(made, wanted) >= 50.0
    assert (made.covered.numpy() == (total > 0)).mean() > 0.999


@pytest.mark.parametrize("radius", [0, 1, 2])
@pytest.mark.parametrize("scale", [1.0, 4.0], ids=["near", "far"])
def test_it_agrees_with_the_plain_float64_renderer_on_a_room(room: list[SceneView], radius: int, scale: float) -> None:
    views = [larger(view, scale) for view in room]
    pose = rig_poses([(40.0, 20.0)], 14.0 * scale)[0]
    wanted, total = plain_splat(views, pose, TARGET, radius=radius)
    made = splat(views, pose, TARGET, options=SplatOptions(radius=radius))
    assert psnr_db(made, wanted) >= 50.0
    assert (made.covered.numpy() == (total > 0)).mean() > 0.999


@pytest.mark.parametrize("radius", [0, 1])
@pytest.mark.parametrize("behind_m", [4.0, 25.0, 50.0, 300.0])
def test_black_keeps_the_trace_of_what_is_behind_it_where_float64_does(radius: int, behind_m: float) -> None:
    depth, rgb = (
        np.full((SOURCE.height, SOURCE.width), 2.0, np.float32),
        np.zeros((SOURCE.height, SOURCE.width, 3), np.uint8),
    )
    rgb[:, 40:] = 200
    depth[:10] = 0.0
    back = wall(behind_m, 90)
    back.depth[:, :20] = 0.0
    views = [flat_view(depth, rgb), back]
    wanted, _ = plain_splat(views, HERE, TARGET, radius=radius, published=True)
    made = splat(views, HERE, TARGET, options=SplatOptions(radius=radius, published=True))
    np.testing.assert_array_equal(made.lit[..., 0].numpy(), wanted.sum(-1) > 0)
    assert 0.1 < made.lit.float().mean() < 0.9
    assert splat(views, HERE, TARGET).lit.shape == (TARGET.height, TARGET.width, 0)


def larger(view: SceneView, scale: float) -> SceneView:
    pose = view.world_from_camera.copy()
    pose[:3, 3] *= scale
    return replace(view, depth=view.depth * np.float32(scale), world_from_camera=pose)


@pytest.mark.parametrize("published", [False, True])
def test_a_camera_sees_its_own_picture_again(room: list[SceneView], published: bool) -> None:
    view = room[0]
    options = SplatOptions(radius=0, published=published)
    made = splat([view], view.world_from_camera, view.lens, options=options)
    assert bool(made.covered.all())
    np.testing.assert_array_equal((made.colour * 255).round().to(torch.uint8).numpy(), view.rgb)
    np.testing.assert_allclose(made.depth.numpy(), view.depth, rtol=1e-5)


def test_depth_and_colour_of_a_room_are_those_of_a_camera_that_stands_there(room: list[SceneView]) -> None:
    pose = rig_poses([(30.0, 20.0)])[0]
    truth = photograph(pose, TARGET)
    made = splat(room, pose, TARGET, options=SplatOptions(radius=0))
    seen = made.covered.numpy()
    assert seen.mean() > 0.5
    off = np.abs(made.depth.numpy() - truth.depth)[seen] / truth.depth[seen]
    assert np.median(off) < 0.01
    assert np.median(np.abs(made.colour.numpy() - truth.rgb / 255)[seen]) < 0.05


@pytest.mark.parametrize(("radius", "reached"), [(0, 1), (1, 4), (2, 9), (3, 16)])
def test_a_single_point_shows_in_as_many_pixels_as_its_radius_says(radius: int, reached: int) -> None:
    depth = np.zeros((SOURCE.height, SOURCE.width), np.float32)
    depth[20, 30] = 7.0
    view = flat_view(depth, np.full((*depth.shape, 3), 90, np.uint8))
    made = splat([view], HERE, SOURCE, options=SplatOptions(radius=radius))
    assert int(made.covered.sum()) == reached
    assert bool(made.covered[20, 30])
    np.testing.assert_allclose(made.colour[made.covered].numpy(), 90 / 255, atol=1e-6)


def test_a_neighbour_gives_way_to_a_pixels_own_point_unless_that_is_far_behind() -> None:
    depth = np.zeros((SOURCE.height, SOURCE.width), np.float32)
    depth[20, 30], depth[20, 31], depth[20, 32] = 7.0, 7.05, 9.0
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    rgb[20, 30], rgb[20, 31], rgb[20, 32] = 250, 100, 10
    made = splat([flat_view(depth, rgb)], HERE, SOURCE)
    own, behind = made.colour[20, 31, 0].item(), made.colour[20, 32, 0].item()
    assert 100 / 255 < own < 250 / 255
    assert behind == pytest.approx(100 / 255, abs=1e-3)
    assert made.depth[20, 31].item() == pytest.approx(7.0 if own > 175 / 255 else 7.05)


def test_no_views_give_black_and_nothing_covered() -> None:
    made = splat([], HERE, TARGET)
    assert made.colour.shape == (TARGET.height, TARGET.width, 3)
    assert not made.covered.any()
    assert not made.colour.any()
    assert not made.depth.any()


def test_points_behind_the_camera_never_appear() -> None:
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert not splat([wall(5.0, 200)], turned, TARGET).covered.any()


def test_points_nearer_than_ten_centimetres_never_appear() -> None:
    assert not splat([wall(0.09, 200)], HERE, TARGET).covered.any()
    assert splat([wall(0.11, 200)], HERE, TARGET).covered.all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -3.0, 0.0, 1e30, 30_001.0])
def test_absurd_depth_is_left_out_and_changes_nothing_else(room: list[SceneView], bad: float) -> None:
    depth, holes = room[0].depth.copy(), room[0].depth.copy()
    depth[10:20, 5:40], holes[10:20, 5:40] = bad, 0.0
    pose = rig_poses([(40.0, 20.0)])[0]
    made = splat([replace(room[0], depth=depth), *room[1:]], pose, TARGET)
    wanted = splat([replace(room[0], depth=holes), *room[1:]], pose, TARGET)
    assert torch.equal(made.colour, wanted.colour)
    assert torch.equal(made.depth, wanted.depth)


def test_a_view_of_nothing_but_absurd_depth_is_no_view() -> None:
    depth = np.full((SOURCE.height, SOURCE.width), np.nan, np.float32)
    made = splat([replace(wall(1.0, 9), depth=depth)], HERE, TARGET)
    assert not made.covered.any()
    assert bool(made.colour.isfinite().all())


def test_labels_are_those_of_the_heaviest_point_and_never_mixed(room: list[SceneView]) -> None:
    pose = rig_poses([(30.0, 20.0)])[0]
    labels = [np.where(view.classes == BALL, 60_000, 7).astype(np.uint16) for view in room if view.classes is not None]
    made = splat(room, pose, TARGET, labels=labels)
    truth = photograph(pose, TARGET).classes
    seen = made.covered.numpy()
    found = made.labels.numpy()
    assert set(np.unique(found[seen])) == {7, 60_000}
    assert not found[~seen].any()
    assert (found == np.where(truth == BALL, 60_000, 7))[seen].mean() > 0.9


def test_a_view_that_looks_elsewhere_is_not_even_read(room: list[SceneView]) -> None:
    class Untouchable(np.ndarray[Any, np.dtype[np.float32]]):
        def __array_function__(self, *_: object, **__: object) -> Any:
            raise AssertionError("the depth of a view that cannot contribute was looked at")

    away = wall(5.0, 200)
    pose = np.diag([-1.0, 1.0, -1.0, 1.0])
    pose[2, 3] = -1.0
    view = replace(away, depth=away.depth.view(Untouchable), world_from_camera=pose)
    assert not splat([view], HERE, TARGET).covered.any()
    with pytest.raises(AssertionError, match="looked at"):
        splat([replace(view, world_from_camera=HERE)], HERE, TARGET)


@pytest.mark.parametrize("seed", range(4))
def test_no_tile_that_contributes_is_passed_over(seed: int) -> None:
    """Single pixels far apart, cameras anywhere: what the plain renderer finds, the tiles must let through."""
    random = np.random.default_rng(seed)
    depth = np.where(random.random((SOURCE.height, SOURCE.width)) < 0.01, random.uniform(0.2, 40.0), 0.0)
    poses = rig_poses([(float(a), float(e)) for a, e in random.uniform((0, -80), (360, 80), (12, 2))], 6.0)
    rgb = random.integers(1, 256, (*depth.shape, 3), np.uint8)
    views = [flat_view(depth.astype(np.float32), rgb, pose) for pose in poses[:4]]
    for pose in poses[4:]:
        _, total = plain_splat(views, pose, TARGET, radius=0)
        covered = splat(views, pose, TARGET, options=SplatOptions(radius=0)).covered.numpy()
        assert (covered != (total > 0)).sum() <= 1  # a point on a pixel's border may fall either way


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({"rgb": np.zeros((48, 71, 3), np.uint8)}, "view 1 must be 72 x 48"),
        ({"depth": np.zeros((47, 72), np.float32)}, "view 1 must be 72 x 48"),
        ({"rgb": np.zeros((48, 72, 3), np.float32)}, "u8"),
        ({"rgb": np.zeros((48, 72, 4), np.uint8)}, "same C"),
    ],
)
def test_parts_that_do_not_fit_are_named(fault: dict[str, Any], said: str) -> None:
    with pytest.raises(DataError, match=said):
        splat([wall(5.0, 1), replace(wall(5.0, 1), **fault)], HERE, TARGET)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_draws_the_same(room: list[SceneView]) -> None:
    pose = rig_poses([(40.0, 20.0)])[0]
    made, wanted = (splat(room, pose, TARGET, device=device) for device in ("cuda", "cpu"))
    assert psnr_db(replace(made, colour=made.colour.cpu()), wanted.colour.double().numpy()) >= 50.0
    assert (made.covered.cpu() == wanted.covered).float().mean() > 0.999


def test_sizes_may_differ_from_view_to_view(room: list[SceneView]) -> None:
    other = photograph(room[0].world_from_camera, Intrinsics.from_hfov(60.0, 45, 33))
    made = splat([room[0], other], room[0].world_from_camera, TARGET)
    assert bool(made.covered.any())
