"""From depth to points, and from points to the pictures that training sees."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from ball_room import FLOOR, RIG, meet, photograph, rig_poses
from plain_splat import plain_splat

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError
from gcd_train.pointcloud import (
    SplatOptions,
    depth_visibility,
    fill_holes,
    planar_from_distance,
    published_picture,
    published_tensor,
    render_lens,
    splat,
    unproject,
    visibility,
)

LENS = Intrinsics.from_hfov(53.13, 72, 48)
SMALL = Intrinsics.from_hfov(53.13, 48, 32)


@pytest.fixture(scope="module")
def room() -> list[SceneView]:
    return [photograph(pose, LENS) for pose in rig_poses(RIG[::4])]


def distance_of(view: SceneView) -> np.ndarray:
    away = unproject(view) - view.world_from_camera[:3, 3]
    return np.linalg.norm(away, axis=-1).astype(np.float32)


def test_points_lie_where_the_world_is(room: list[SceneView]) -> None:
    points = unproject(room[0])
    floor = room[0].classes == FLOOR
    assert floor.any()
    np.testing.assert_allclose(points[floor][:, 2], 0.0, atol=1e-4)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf, 1e9])
def test_unknown_depth_is_no_point(room: list[SceneView], bad: float) -> None:
    depth = room[0].depth.copy()
    depth[3, 4] = bad
    points = unproject(replace(room[0], depth=depth))
    assert np.isnan(points[3, 4]).all()
    assert np.isnan(points).sum() == 3


def test_a_lens_of_another_picture_is_refused(room: list[SceneView]) -> None:
    with pytest.raises(DataError, match="48 x 32, got"):
        unproject(replace(room[0], lens=SMALL))


def test_distance_becomes_depth_exactly(room: list[SceneView]) -> None:
    planar = planar_from_distance(distance_of(room[0]), LENS)
    assert planar.dtype == np.float32
    np.testing.assert_allclose(planar, room[0].depth, rtol=1e-5)


def test_the_published_depth_is_off_by_up_to_half_a_percent() -> None:
    """Of rays from edge to edge: exact in the corners and in the middle, 0.48 % at most between."""
    lens = Intrinsics.from_hfov(2 * np.degrees(np.arctan(0.5)), 577, 385)
    far = np.full((385, 577), 15.0, np.float32)
    right, down = np.linspace(-0.5, 0.5, 577), np.linspace(-0.5 * 385 / 577, 0.5 * 385 / 577, 385)
    exact = 15.0 / np.sqrt(1 + right[None] ** 2 + down[:, None] ** 2)
    off = np.abs(planar_from_distance(far, lens, published=True) / exact - 1)
    assert off[[0, 0, -1, -1, 192], [0, -1, 0, -1, 288]].max() < 1e-6
    assert 0.004 < off.max() < 0.005


def test_filling_is_the_normalised_blur_of_opencv_too(room: list[SceneView]) -> None:
    made = splat(room, rig_poses([(40.0, 20.0)])[0], LENS, options=SplatOptions(radius=0))
    colour, held = made.colour.numpy().astype(np.float64), made.covered.numpy().astype(np.float64)
    assert 0.2 < held.mean() < 0.999
    total = cv2.GaussianBlur(held, (21, 21), 5.25)[..., None]
    blurred = cv2.GaussianBlur(colour, (21, 21), 5.25) / np.maximum(total, 1e-7)
    wanted = cv2.GaussianBlur(np.where(held[..., None] > 0, colour, blurred), (3, 3), 0.6)
    np.testing.assert_allclose(fill_holes(made.colour, made.covered).numpy(), wanted, atol=1e-5)


def test_the_published_picture_is_within_50_db_of_plain_float64(room: list[SceneView]) -> None:
    pose = rig_poses([(40.0, 20.0)])[0]
    colour, total = plain_splat(room, pose, LENS.resized(66, 44), radius=1)
    wanted = fill_holes(torch.from_numpy(colour), torch.from_numpy(total > 0)).permute(2, 0, 1)[None]
    wanted = torch.nn.functional.interpolate(wanted, size=(40, 60), mode="bilinear")[0].permute(1, 2, 0)
    made = published_tensor(room, pose, LENS, width=60, height=40)
    assert -10 * np.log10(((made - wanted) ** 2).mean().item()) >= 50.0
    assert (
        np.abs(published_picture(room, pose, LENS, width=60, height=40) / 255 - made.numpy()).max() < 0.5 / 255 + 1e-6
    )


@pytest.mark.parametrize(("width", "height", "crop"), [(90, 60, (0, 24, 640, 427)), (60, 60, (80, 0, 480, 480))])
def test_another_shape_is_a_crop_in_the_centre(width: int, height: int, crop: tuple[int, int, int, int]) -> None:
    lens = Intrinsics.from_hfov(85.0, 640, 480)
    made, cropped = render_lens(lens, width, height), lens.cropped(*crop).resized(width, height)
    assert made.fx == pytest.approx(cropped.fx, rel=1e-3)
    assert made.fy == pytest.approx(cropped.fy, rel=1e-3)
    assert (made.cx, made.cy) == (width / 2, height / 2)


def test_black_is_a_hole_in_published_pictures_only() -> None:
    depth = np.full((48, 72), 5.0, np.float32)
    rgb = np.full((48, 72, 3), 200, np.uint8)
    rgb[20:24, 30:36] = 0
    view = SceneView(rgb=rgb, depth=depth, classes=None, instances=None, world_from_camera=np.eye(4), lens=LENS)
    ours, theirs = (
        published_picture([view], np.eye(4), LENS, width=66, height=44, options=SplatOptions(radius=0, published=each))
        for each in (False, True)
    )
    assert ours.min() < 20
    assert theirs.min() > 190


def test_a_view_drawn_from_where_it_was_taken_is_visible_everywhere(room: list[SceneView]) -> None:
    view = room[0]
    assert visibility(view, view.world_from_camera, LENS, width=64, height=43).all()
    assert depth_visibility(view, view.depth, view.world_from_camera, LENS).all()


def test_what_the_source_could_not_see_is_not_visible(room: list[SceneView]) -> None:
    source, pose = room[2], rig_poses([(RIG[8][0] + 60.0, 10.0)])[0]
    target = photograph(pose, LENS)
    seen = depth_visibility(source, target.depth, pose, LENS)
    assert 0.1 < seen.mean() < 0.9
    assert (seen == _seen_by_rays(source, target)).mean() > 0.96  # the rest lies along outlines
    rule = visibility(source, pose, LENS, width=72, height=48)
    assert 0.1 < rule.mean() < 0.9
    assert (seen & rule).sum() > 0.5 * seen.sum()
    assert (rule & ~seen).any()  # the rule does not ask whether the target shows the same thing


def _seen_by_rays(source: SceneView, target: SceneView) -> np.ndarray:
    """Whether the way from the source camera to each target point is free, and within its picture."""
    points, eye = unproject(target).astype(np.float64), source.world_from_camera[:3, 3]
    x, y, z = np.moveaxis((points - eye) @ source.world_from_camera[:3, :3], -1, 0)
    u, v = source.lens.fx * x / z + source.lens.cx, source.lens.fy * y / z + source.lens.cy
    inside = (z > 0.1) & (u >= 0) & (u < source.lens.width) & (v >= 0) & (v < source.lens.height)
    return inside & (meet(eye, points - eye)[0] > 0.98)


def test_points_of_whole_pixel_numbers_lie_half_a_pixel_up_and_left(room: list[SceneView]) -> None:
    view = replace(room[0], world_from_camera=np.eye(4))
    step = (unproject(view) - unproject(view, published=True)) * [LENS.fx, LENS.fy, 1.0] / view.depth[..., None]
    np.testing.assert_allclose(step, np.broadcast_to([0.5, 0.5, 0.0], step.shape), atol=1e-4)


def test_digits_are_cut_off_in_published_pictures_only() -> None:
    rgb = np.full((48, 72, 3), 100, np.uint8)
    rgb[::2] = 101
    depth = np.full((48, 72), 5.0, np.float32)
    view = SceneView(rgb=rgb, depth=depth, classes=None, instances=None, world_from_camera=np.eye(4), lens=LENS)
    for published in (False, True):
        options = SplatOptions(published=published)
        exact = published_tensor([view], np.eye(4), LENS, width=64, height=43, options=options).numpy() * 255
        made = published_picture([view], np.eye(4), LENS, width=64, height=43, options=options)
        np.testing.assert_array_equal(made, np.floor(exact + (0.0 if published else 0.5)).astype(np.uint8))
