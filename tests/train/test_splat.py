"""Points drawn as another camera sees them, and the pictures that training sees of them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from ball_room import BALL, RIG, meet, photograph, rig_poses
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.data.splat import Doubles, Splatted, ray_lengths, splat
from gcd_train.data.visibility import depth_visibility, fill_holes, published_tensor, quantised, render_lens, visibility

SOURCE = Intrinsics.from_hfov(53.13, 72, 48)
TARGET = Intrinsics.from_hfov(53.13, 52, 35)
HERE = np.eye(4)


# the published point renderer written down again, slowly: float64, loops over pixels and taps, weights as they are
# printed and not relative to anything: what the fast one is held against


def plain_splat(
    views: Sequence[SceneView], world_from_camera: Doubles, lens: Intrinsics, *, radius: int, published: bool = False
) -> tuple[Doubles, Doubles]:
    """Colour float64 [H, W, 3] in 0..1 and the sum of weights [H, W]."""
    half = 0.0 if published else 0.5
    points = np.concatenate([plain_points(view, half) for view in views])
    rgb = np.concatenate([view.rgb.reshape(-1, 3) for view in views]) / 255.0
    in_camera = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    depth = in_camera[:, 2]
    with np.errstate(all="ignore"):
        u = lens.fx * in_camera[:, 0] / depth + lens.cx
        v = lens.fy * in_camera[:, 1] / depth + lens.cy
    known = np.isfinite(points).all(-1) & (depth > 0.1)
    place = np.stack([u, v], -1)
    place = np.trunc(place[known] + 0.5) if published else np.floor(place[known])
    inside = (place >= 0).all(-1) & (place[:, 0] < lens.width) & (place[:, 1] < lens.height)
    column, row = place[inside].astype(int).T
    depth, rgb = depth[known][inside], rgb[known][inside]
    summed, total = np.zeros((lens.height, lens.width, 3)), np.zeros((lens.height, lens.width))
    if len(depth):
        weights = _weights(depth)
        for down in range(-(radius // 2), (radius + 1) // 2 + 1):
            for right in range(-(radius // 2), (radius + 1) // 2 + 1):
                share = weights * (1.0 if (down, right) == (0, 0) else 0.02)
                y, x = row + down, column + right
                fits = (y >= 0) & (x >= 0) & (y < lens.height) & (x < lens.width)
                np.add.at(total, (y[fits], x[fits]), share[fits])
                np.add.at(summed, (y[fits], x[fits]), share[fits, None] * rgb[fits])
    return np.where(total[..., None] > 0, summed / np.where(total > 0, total, 1.0)[..., None], 0.0), total


def plain_points(view: SceneView, half: float) -> Doubles:
    """World points of a view, one pixel after another, NaN where the depth is none."""
    height, width = view.depth.shape
    points = np.full((height, width, 3), np.nan)
    for row in range(height):
        for column in range(width):
            z = float(view.depth[row, column])
            if 0.0 < z <= 30_000.0:
                x = (column + half - view.lens.cx) / view.lens.fx * z
                y = (row + half - view.lens.cy) / view.lens.fy * z
                points[row, column] = view.world_from_camera[:3, :3] @ [x, y, z] + view.world_from_camera[:3, 3]
    return points.reshape(-1, 3)


def _weights(depth: Doubles) -> Doubles:
    d_max = depth.max()
    if d_max < 64.0:
        return np.exp(-512.0 * (2.0 * depth / d_max - 1.0))
    d = np.minimum(np.sqrt(depth), 32.0)
    return np.exp(-256.0 * (2.0 * d / d.max() - 1.0))


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
    made = splat(views, HERE, TARGET, radius=radius, published=published)
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
    made = splat(views, HERE, TARGET, radius=radius, published=True)
    np.testing.assert_array_equal(made.lit[..., 0].numpy(), wanted.sum(-1) > 0)
    assert 0.1 < made.lit.float().mean() < 0.9
    assert splat(views, HERE, TARGET).lit.shape == (TARGET.height, TARGET.width, 0)


@pytest.mark.parametrize("published", [False, True])
def test_a_camera_sees_its_own_picture_again(room: list[SceneView], published: bool) -> None:
    view = room[0]
    made = splat([view], view.world_from_camera, view.lens, radius=0, published=published)
    assert bool(made.covered.all())
    np.testing.assert_array_equal((made.colour * 255).round().to(torch.uint8).numpy(), view.rgb)
    np.testing.assert_allclose(made.depth.numpy(), view.depth, rtol=1e-5)


def test_depth_and_colour_of_a_room_are_those_of_a_camera_that_stands_there(room: list[SceneView]) -> None:
    pose = rig_poses([(30.0, 20.0)])[0]
    truth = photograph(pose, TARGET)
    made = splat(room, pose, TARGET, radius=0)
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
    made = splat([view], HERE, SOURCE, radius=radius)
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


@pytest.mark.parametrize("what", ["no view", "behind the camera", "absurd depth"])
def test_where_there_is_no_point_it_is_black_and_nothing_is_covered(what: str) -> None:
    depth = np.full((SOURCE.height, SOURCE.width), np.nan, np.float32)
    views = {"no view": [], "absurd depth": [replace(wall(1.0, 9), depth=depth)]}.get(what, [wall(5.0, 200)])
    made = splat(views, np.diag([-1.0, 1.0, -1.0, 1.0]) if what == "behind the camera" else HERE, TARGET)
    assert made.colour.shape == (TARGET.height, TARGET.width, 3)
    assert not made.covered.any()
    assert not made.colour.any()
    assert not made.depth.any()


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
        covered = splat(views, pose, TARGET, radius=0).covered.numpy()
        assert (covered != (total > 0)).sum() <= 1  # a point on a pixel's border may fall either way


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_draws_the_same(room: list[SceneView]) -> None:
    pose = rig_poses([(40.0, 20.0)])[0]
    made, wanted = (splat(room, pose, TARGET, device=device) for device in ("cuda", "cpu"))
    assert psnr_db(replace(made, colour=made.colour.cpu()), wanted.colour.double().numpy()) >= 50.0
    assert (made.covered.cpu() == wanted.covered).float().mean() > 0.999


def test_distance_becomes_depth_exactly(room: list[SceneView]) -> None:
    points = plain_points(room[0], 0.5).reshape(*room[0].depth.shape, 3) - room[0].world_from_camera[:3, 3]
    planar = np.linalg.norm(points, axis=-1).astype(np.float32) / ray_lengths(SOURCE)
    assert planar.dtype == np.float32
    np.testing.assert_allclose(planar, room[0].depth, rtol=1e-5)


def test_the_published_depth_is_off_by_up_to_half_a_percent() -> None:
    """Of rays from edge to edge: exact in the corners and in the middle, 0.48 % at most between."""
    lens = Intrinsics.from_hfov(2 * np.degrees(np.arctan(0.5)), 577, 385)
    far = np.full((385, 577), 15.0, np.float32)
    right, down = np.linspace(-0.5, 0.5, 577), np.linspace(-0.5 * 385 / 577, 0.5 * 385 / 577, 385)
    exact = 15.0 / np.sqrt(1 + right[None] ** 2 + down[:, None] ** 2)
    off = np.abs(far / ray_lengths(lens, published=True) / exact - 1)
    assert off[[0, 0, -1, -1, 192], [0, -1, 0, -1, 288]].max() < 1e-6
    assert 0.004 < off.max() < 0.005


def test_filling_is_the_normalised_blur_of_opencv_too(room: list[SceneView]) -> None:
    made = splat(room, rig_poses([(40.0, 20.0)])[0], SOURCE, radius=0)
    colour, held = made.colour.numpy().astype(np.float64), made.covered.numpy().astype(np.float64)
    assert 0.2 < held.mean() < 0.999
    total = cv2.GaussianBlur(held, (21, 21), 5.25)[..., None]
    blurred = cv2.GaussianBlur(colour, (21, 21), 5.25) / np.maximum(total, 1e-7)
    wanted = cv2.GaussianBlur(np.where(held[..., None] > 0, colour, blurred), (3, 3), 0.6)
    np.testing.assert_allclose(fill_holes(made.colour, made.covered).numpy(), wanted, atol=1e-5)


def test_the_published_picture_is_within_50_db_of_plain_float64(room: list[SceneView]) -> None:
    pose = rig_poses([(40.0, 20.0)])[0]
    colour, total = plain_splat(room, pose, SOURCE.resized(66, 44), radius=1)
    wanted = fill_holes(torch.from_numpy(colour), torch.from_numpy(total > 0)).permute(2, 0, 1)[None]
    wanted = torch.nn.functional.interpolate(wanted, size=(40, 60), mode="bilinear")[0].permute(1, 2, 0)
    made = published_tensor(room, pose, SOURCE, (60, 40))
    assert -10 * np.log10(((made - wanted) ** 2).mean().item()) >= 50.0
    assert np.abs(quantised(made) / 255 - made.numpy()).max() < 0.5 / 255 + 1e-6


@pytest.mark.parametrize(("width", "height", "crop"), [(90, 60, (0, 24, 640, 427)), (60, 60, (80, 0, 480, 480))])
def test_another_shape_is_a_crop_in_the_centre(width: int, height: int, crop: tuple[int, int, int, int]) -> None:
    lens = Intrinsics.from_hfov(85.0, 640, 480)
    made, cropped = render_lens(lens, width, height), lens.cropped(*crop).resized(width, height)
    assert made.fx == pytest.approx(cropped.fx, rel=1e-3)
    assert made.fy == pytest.approx(cropped.fy, rel=1e-3)
    assert (made.cx, made.cy) == (width / 2, height / 2)


@pytest.mark.parametrize(("grey", "published"), [(0, False), (1, False), (0, True), (1, True)])
def test_black_is_a_hole_in_published_pictures_only(grey: int, published: bool) -> None:
    depth = np.full((48, 72), 5.0, np.float32)
    rgb = np.full((48, 72, 3), 200, np.uint8)
    rgb[18:28, 30:42] = grey
    made = published_tensor([flat_view(depth, rgb)], HERE, SOURCE, (66, 44), published=published)
    middle = quantised(made, published=published)[19:24, 31:36]
    if grey == 0 and published:
        assert middle.min() > 165  # filled from what is around it; its edges are nearly black
    else:
        assert (middle == grey).all()


def test_a_view_drawn_from_where_it_was_taken_is_visible_everywhere(room: list[SceneView]) -> None:
    view = room[0]
    assert visibility(view, view.world_from_camera, SOURCE, (64, 43)).all()
    assert depth_visibility(view, view.depth, view.world_from_camera, SOURCE).all()


def test_what_the_source_could_not_see_is_not_visible(room: list[SceneView]) -> None:
    source, pose = room[2], rig_poses([(RIG[8][0] + 60.0, 10.0)])[0]
    target = photograph(pose, SOURCE)
    seen = depth_visibility(source, target.depth, pose, SOURCE)
    assert 0.1 < seen.mean() < 0.9
    assert (seen == _seen_by_rays(source, target)).mean() > 0.96  # the rest lies along outlines
    rule = visibility(source, pose, SOURCE, (72, 48))
    assert 0.1 < rule.mean() < 0.9
    assert (seen & rule).sum() > 0.5 * seen.sum()
    assert (rule & ~seen).any()  # the rule does not ask whether the target shows the same thing


def _seen_by_rays(source: SceneView, target: SceneView) -> np.ndarray:
    """Whether the way from the source camera to each target point is free, and within its picture."""
    points, eye = plain_points(target, 0.5).reshape(*target.depth.shape, 3), source.world_from_camera[:3, 3]
    x, y, z = np.moveaxis((points - eye) @ source.world_from_camera[:3, :3], -1, 0)
    u, v = source.lens.fx * x / z + source.lens.cx, source.lens.fy * y / z + source.lens.cy
    inside = (z > 0.1) & (u >= 0) & (u < source.lens.width) & (v >= 0) & (v < source.lens.height)
    return inside & (meet(eye, points - eye)[0] > 0.98)


def test_digits_are_cut_off_in_published_pictures_only() -> None:
    rgb = np.full((48, 72, 3), 100, np.uint8)
    rgb[::2] = 101
    depth = np.full((48, 72), 5.0, np.float32)
    for published in (False, True):
        made = published_tensor([flat_view(depth, rgb)], HERE, SOURCE, (64, 43), published=published)
        exact = np.floor(made.numpy() * 255 + (0.0 if published else 0.5)).astype(np.uint8)
        np.testing.assert_array_equal(quantised(made, published=published), exact)
