"""Where the source camera goes: by odometry, or by the pictures of a textured room rendered from known poses."""

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from gcd_model.geometry import Intrinsics
from gcd_model.live.ego_motion import EgoMotion, Motion

LENS = Intrinsics.from_hfov(80.0, 192, 128)
HERE = torch.eye(4, dtype=torch.float64)
STATIC = torch.ones(LENS.height, LENS.width, dtype=torch.bool)
HOUSE = {"wall": ((0.0, 0.0, 1.0), 8.0), "floor": ((0.0, 1.0, 0.0), 1.5), "side": ((1.0, 0.0, 0.0), 3.0)}


def pose(right: float = 0.0, ahead: float = 0.0, yaw_deg: float = 0.0) -> Tensor:
    yaw = math.radians(yaw_deg)
    world_from_camera = HERE.clone()
    world_from_camera[0, 0] = world_from_camera[2, 2] = math.cos(yaw)
    world_from_camera[0, 2], world_from_camera[2, 0] = math.sin(yaw), -math.sin(yaw)
    world_from_camera[0, 3], world_from_camera[2, 3] = right, ahead
    return world_from_camera


def filmed(world_from_camera: Tensor) -> tuple[Tensor, Tensor]:
    """A wall, a floor and a side wall, each painted with smooth noise: picture [3, H, W] and exact depth [H, W]."""
    x, y = LENS.rays().double()
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ world_from_camera[:3, :3].T
    eye = world_from_camera[:3, 3]
    depth = torch.full((LENS.height, LENS.width), math.inf, dtype=torch.float64)
    grey = torch.zeros_like(depth)
    for number, (normal, distance) in enumerate(HOUSE.values()):
        axis = torch.tensor(normal, dtype=torch.float64)
        z = (distance - eye @ axis) / (rays @ axis)
        z = torch.where(z > 0, z, math.inf)
        point = eye + rays * torch.where(z < 1e3, z, 1e3)[..., None]
        nearer = z < depth
        depth, grey = torch.where(nearer, z, depth), torch.where(nearer, texture(point, axis, number), grey)
    return grey.float().expand(3, -1, -1), depth.float()


def texture(point: Tensor, normal: Tensor, seed: int) -> Tensor:
    """Bilinear noise over a plane, one value each 20 cm: [H, W] in [-1, 1]."""
    noise = torch.rand(1, 1, 200, 200, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1
    across = [axis for axis in range(3) if normal[axis] == 0]
    place = point[..., across] / 0.2 / 100
    return torch.nn.functional.grid_sample(noise, place[None], padding_mode="reflection", align_corners=False)[0, 0]


def step(ego: EgoMotion, picture: Tensor, depth: Tensor, static: Tensor, odometry: Tensor | None = None) -> Motion:
    motion = ego.follow(picture, LENS, odometry)
    ego.settle(depth, static)
    return motion


def drive(poses: list[Tensor], odometry: list[Tensor | None] | None = None) -> list[Motion]:
    ego = EgoMotion()
    given = odometry or [None] * len(poses)
    return [step(ego, *filmed(each), STATIC, known) for each, known in zip(poses, given, strict=True)]


@pytest.mark.parametrize(("right", "ahead", "yaw_deg"), [(0.0, 0.25, 0.0), (0.15, 0.0, 0.0), (0.0, 0.1, 1.5)])
def test_a_steady_motion_is_recovered(right: float, ahead: float, yaw_deg: float) -> None:
    poses = [pose(right * n, ahead * n, yaw_deg * n) for n in range(6)]
    motions = drive(poses)
    assert not any(motion.lost for motion in motions)
    found = motions[-1].world_from_camera
    assert float((found[:3, 3] - poses[-1][:3, 3]).norm()) < 0.02 * 5 * max(right, ahead)
    assert_close(found[:3, :3], poses[-1][:3, :3], atol=math.radians(0.15), rtol=0)


def test_the_world_begins_at_the_first_frame() -> None:
    motions = drive([pose(yaw_deg=30.0, ahead=1.0), pose(yaw_deg=30.0, ahead=1.0)])
    assert all(torch.equal(motion.world_from_camera, HERE) for motion in motions)


def test_a_camera_that_stands_does_not_drift_in_noise() -> None:
    ego, random = EgoMotion(), torch.Generator().manual_seed(0)
    picture, depth = filmed(HERE)
    for _ in range(8):
        noisy = picture + 0.02 * torch.randn(picture.shape, generator=random)
        wrong = depth * torch.exp(0.04 * torch.randn(depth.shape, generator=random))
        motion = step(ego, noisy.clamp(-1, 1), wrong, STATIC)
        assert torch.equal(motion.world_from_camera, HERE)
        assert not motion.lost


def test_things_in_motion_do_not_move_a_camera_that_stands() -> None:
    ego = EgoMotion()
    picture, depth = filmed(HERE)
    static = STATIC.clone()
    static[40:100, 60:150] = False
    for n in range(6):
        passing = picture.clone()
        passing[:, 40:100, 60:150] = picture[:, 40:100, 60:150].roll(3 * n, dims=2)
        assert torch.equal(step(ego, passing, depth, static).world_from_camera, HERE)


def test_depth_of_another_scale_scales_the_motion() -> None:
    ego = EgoMotion()
    for n in range(5):
        picture, depth = filmed(pose(ahead=0.2 * n))
        motion = step(ego, picture, depth * 1.1, STATIC)
    assert float(motion.world_from_camera[2, 3]) == pytest.approx(0.88, rel=0.02)


def test_points_of_unsure_depth_count_less() -> None:
    """One half of the picture is 40 % too far away; where the spread says so, the way is right."""
    step, last = 0.2, 4
    wrong = torch.arange(LENS.width) < LENS.width // 2
    spread = torch.where(wrong, 0.3, 0.005).expand(LENS.height, LENS.width)

    def way(told: Tensor | None) -> float:
        ego = EgoMotion()
        motions: list[Motion] = []
        for n in range(last + 1):
            picture, depth = filmed(pose(right=step * n))
            motions.append(ego.follow(picture, LENS, None))
            ego.settle(torch.where(wrong, 1.4 * depth, depth), STATIC, told)
        return float(motions[-1].world_from_camera[0, 3])

    assert abs(way(spread) - step * last) < 0.1 * step * last
    assert abs(way(None) - step * last) > 2 * abs(way(spread) - step * last)


def test_of_odometry_only_the_differences_count() -> None:
    elsewhere = pose(right=100.0, yaw_deg=70.0)
    steps = [pose(ahead=0.7 * n, yaw_deg=3.0 * n) for n in range(4)]
    motions = drive([HERE] * 4, [elsewhere @ step for step in steps])
    for motion, step in zip(motions, steps, strict=True):
        assert_close(motion.world_from_camera, step)


def test_without_odometry_in_between_the_pictures_carry_on() -> None:
    poses = [pose(ahead=0.2 * n) for n in range(5)]
    motions = drive(poses, [poses[0], poses[1], None, poses[3], poses[4]])
    assert not any(motion.lost for motion in motions)
    assert_close(motions[-1].world_from_camera, poses[-1], atol=0.02, rtol=0)


@pytest.mark.parametrize("jump", [pose(ahead=30.0), pose(yaw_deg=120.0), torch.full((4, 4), math.nan)])
def test_odometry_that_is_no_motion_is_refused(jump: Tensor) -> None:
    motions = drive([HERE] * 2, [HERE, jump.double()])
    assert motions[1].lost
    assert torch.equal(motions[1].world_from_camera, HERE)


def test_a_black_frame_is_lost_and_the_world_begins_anew() -> None:
    ego = EgoMotion()
    frames = [filmed(pose(ahead=0.2 * n)) for n in range(5)]
    black = (torch.full_like(frames[0][0], -1.0), frames[0][1])
    motions = [step(ego, *frame, STATIC) for frame in (*frames[:2], black, *frames[2:])]
    assert [motion.lost is not None for motion in motions] == [False, False, True, True, False, False]
    assert torch.equal(motions[3].world_from_camera, HERE)
    assert_close(motions[5].world_from_camera, pose(ahead=0.4), atol=0.02, rtol=0)


def test_without_any_depth_the_motion_is_unknown() -> None:
    ego = EgoMotion()
    picture, depth = filmed(HERE)
    holes = torch.where(torch.arange(LENS.width) % 2 == 0, 0.0, math.nan).expand_as(depth)
    step(ego, picture, holes, STATIC)
    assert step(ego, picture, holes, STATIC).lost
