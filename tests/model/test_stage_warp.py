"""Warps by the planes of a stage, against a chequered world that is traced ray by ray here."""

import math

import pytest
import torch
import torch.nn.functional as F
from small_models import STAGE, TINY_OBJECTS, draw
from torch import Tensor
from torch.testing import assert_close

from gcd_model.config import DRIVING_SMALL, OBJECTS_SMALL, SMALL, ModelConfig, PlaneWarpConfig, warp_channels
from gcd_model.errors import OptionError, PoseError, ShapeError
from gcd_model.geometry import (
    CameraMount,
    Intrinsics,
    Spherical,
    SphericalDelta,
    Trajectory,
    driving_trajectory,
    invert_rigid,
    pose_trajectory,
    spherical_trajectory,
    to_pose,
)
from gcd_model.plane_warp import PathWarpCache, PathWarps, channels_of, clip_warps, mirrored, plane_warp, source_mount

GROUND, INFINITY, FIRST_UPRIGHT = 0, 1, 2
HEIGHT, WIDTH, LAST = 64, 96, 4
SOURCE = Spherical(azimuth_deg=0.0, elevation_deg=12.0, radius_m=14.0)
LOW = Spherical(azimuth_deg=130.0, elevation_deg=9.0, radius_m=16.0)
GOALS = [SphericalDelta(azimuth_deg=50.0, elevation_deg=20.0, radius_m=-2.0), SphericalDelta(azimuth_deg=-80.0)]


def path(source: Spherical = SOURCE, goal: SphericalDelta = GOALS[0]) -> Trajectory:
    return spherical_trajectory(source, goal, frames=LAST + 1, move_time=LAST)


def warps(trajectory: Trajectory, frames: list[int] | None = None) -> PathWarps:
    return PathWarps(STAGE, None, trajectory, HEIGHT, WIDTH, down_factor=8, frames=frames)


def chequer(points: Tensor) -> Tensor:
    """Soft squares 2 m wide, darker the other way in each direction: [H, W, 3] metres -> [3, H, W] in [-1, 1]."""
    x, y, z = (torch.sin(points * (math.pi / 2))).unbind(-1)
    return torch.stack([x * y, y * z.cos(), (x + z) / 2])


def traced(pose: Tensor, normal: Tensor, offset: float, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Picture [3, H, W] of ground and, in front of it, one plane `normal . p = offset`; distance seen [H, W]."""
    camera = Intrinsics.from_hfov(STAGE.hfov_deg, width, height)
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).double()
    rays = pixels @ torch.linalg.inv(camera.matrix).T @ pose[:3, :3].T
    rays, start, reach = rays / rays.norm(dim=-1, keepdim=True), pose[:3, 3], torch.full((height, width), torch.inf)
    for across, at in ((torch.tensor([0.0, 0.0, 1.0]).double(), 0.0), (normal, offset)):
        multiple = (at - start @ across) / (rays @ across)
        reach = torch.where(multiple > 0, torch.minimum(reach.double(), multiple), reach.double())
    return chequer(start + rays * reach.clamp(max=1e3)[..., None]).float(), reach


# --- what arrives ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("source", "goal"), [(SOURCE, GOALS[0]), (LOW, GOALS[1])])
@pytest.mark.parametrize("layer", [GROUND, FIRST_UPRIGHT, FIRST_UPRIGHT + 1, FIRST_UPRIGHT + 2])
def test_a_world_of_planes_arrives_as_the_target_camera_sees_it(
    source: Spherical, goal: SphericalDelta, layer: int
) -> None:
    made, poses = warps(path(source, goal)), to_pose(source) @ path(source, goal).source_from_target
    for t in (2, LAST):
        bisector = math.radians(source.azimuth_deg + goal.azimuth_deg * t / LAST / 2)
        away = -torch.tensor([math.cos(bisector), math.sin(bisector), 0.0], dtype=torch.float64)
        offset = 1e3 if layer == GROUND else STAGE.offsets_m[layer - FIRST_UPRIGHT]
        seen, _ = traced(to_pose(source), away, offset, 4 * HEIGHT, 4 * WIDTH)
        expected, reach = traced(poses[t], away, offset, HEIGHT, WIDTH)
        warped, valid = made.layers(seen[None], torch.tensor([t]))
        near = valid[0, layer] & (reach < 20.0)
        assert near.float().mean() > 0.2
        other = FIRST_UPRIGHT + (layer - 1) % len(STAGE.offsets_m)
        right, wrong = ((warped[0, each] - expected).abs().mean(dim=0)[near].mean() for each in (layer, other))
        assert right < 0.005
        assert wrong > 3 * right  # so it is not all the same


@pytest.mark.parametrize("goal", [SphericalDelta(azimuth_deg=40.0, radius_m=3.0), *GOALS])
def test_a_point_on_a_plane_is_fetched_from_where_the_source_sees_it(goal: SphericalDelta) -> None:
    trajectory = path(SOURCE, goal)
    grid, camera = plane_grid(trajectory), Intrinsics.from_hfov(STAGE.hfov_deg, WIDTH, HEIGHT)
    size, bisector = torch.tensor([WIDTH, HEIGHT]), math.radians(goal.azimuth_deg / 2)
    away = -torch.tensor([math.cos(bisector), math.sin(bisector)], dtype=torch.float64)
    for layer, offset in enumerate(STAGE.offsets_m, start=FIRST_UPRIGHT):
        point = torch.cat([offset * away + 0.4 * torch.stack([-away[1], away[0]]), away.new_tensor([1.3, 1.0])])
        at, expected = (
            (camera.matrix @ (invert_rigid(pose) @ point)[:3]) for pose in (goal_pose(trajectory), to_pose(SOURCE))
        )
        place = (at[:2] / at[2] / size * 2 - 1).float().reshape(1, 1, 1, 2)
        found = F.grid_sample(grid[layer].permute(2, 0, 1)[None], place, align_corners=False).flatten()
        assert_close((found.double() + 1) / 2 * size, expected[:2] / expected[2], rtol=0, atol=0.03)


def goal_pose(trajectory: Trajectory) -> Tensor:
    return to_pose(SOURCE) @ trajectory.source_from_target[LAST]


def plane_grid(trajectory: Trajectory) -> Tensor:
    """[L, H, W, 2] of the last frame."""
    mount = source_mount(STAGE, trajectory)
    return plane_warp(STAGE, mount, trajectory.source_from_target, HEIGHT, WIDTH).grid[LAST]


def test_at_the_start_of_the_path_every_layer_shows_the_source_itself() -> None:
    source = draw(1, 3, HEIGHT, WIDTH)
    warped, valid = warps(path()).layers(source, torch.zeros(1, dtype=torch.long))
    assert valid[0, INFINITY].all()
    assert valid[0, GROUND, HEIGHT // 2 :].all()
    inner = valid[0, :, None].expand_as(warped[0])
    assert_close(warped[0][inner], source.expand_as(warped[0])[inner], rtol=0, atol=1e-3)


def test_a_mirrored_path_shows_a_mirrored_source_in_the_mirror() -> None:
    source, numbers = draw(LAST + 1, 3, HEIGHT, WIDTH), torch.arange(LAST + 1)
    left, right = (
        SphericalDelta(azimuth_deg=-40.0, elevation_deg=9.0),
        SphericalDelta(azimuth_deg=40.0, elevation_deg=9.0),
    )
    expected = warps(path(goal=left)).pictures(source.flip(-1), numbers)
    found = mirrored(warps(path(goal=right)).pictures(source, numbers))
    for name in ("half", "ground", "distant", "rays"):
        assert_close(getattr(found, name), getattr(expected, name), rtol=0, atol=2e-3)
    assert (found.rays[:, 1] + mirrored(found).rays[:, 1].flip(-1)).abs().max() < 1e-6


def test_rays_are_told_in_the_source_cameras_azimuth_and_know_the_ground() -> None:
    for source in (SOURCE, Spherical(azimuth_deg=77.0, elevation_deg=12.0, radius_m=14.0)):
        rays = warps(path(source)).pictures(draw(1, 3, HEIGHT, WIDTH), torch.tensor([0])).rays[0]
        assert_close(rays[:3].norm(dim=0), torch.ones(HEIGHT // 8, WIDTH // 8))
        centre = rays[:, HEIGHT // 16 - 1 : HEIGHT // 16 + 1, WIDTH // 16 - 1 : WIDTH // 16 + 1].mean(dim=(1, 2))
        tilt = math.radians(12.0)
        assert_close(centre[:3], torch.tensor([math.cos(tilt), 0.0, -math.sin(tilt)]), rtol=0, atol=5e-3)
        assert centre[3].item() == pytest.approx(math.log10((14.0 + 1 / math.sin(tilt)) / 10), abs=0.02)
    assert rays[3, 0].eq(1.0).all()  # above the horizon


def test_a_half_turn_shows_the_same_planes_either_way_round_and_no_nan() -> None:
    for azimuth_deg in (-180.0, 180.0):
        grid = plane_grid(path(goal=SphericalDelta(azimuth_deg=azimuth_deg)))
        assert grid.isfinite().all()
    straight_up = SphericalDelta(elevation_deg=90.0 - SOURCE.elevation_deg)
    warped, valid = warps(path(goal=straight_up)).layers(draw(1, 3, HEIGHT, WIDTH), torch.tensor([LAST]))
    assert warped.isfinite().all()
    assert valid[0, GROUND].any()


# --- where the source camera stands ----------------------------------------------------------------------------------


@pytest.mark.parametrize("source", [SOURCE, LOW])
def test_the_source_camera_stands_where_the_path_says(source: Spherical) -> None:
    turn = math.radians(180.0 - source.azimuth_deg)
    stage_from_world = torch.eye(4, dtype=torch.float64)
    stage_from_world[0, :2] = torch.tensor([math.cos(turn), -math.sin(turn)], dtype=torch.float64)
    stage_from_world[1, :2] = torch.tensor([math.sin(turn), math.cos(turn)], dtype=torch.float64)
    found = source_mount(STAGE, path(source)).vehicle_from_camera
    assert_close(found, stage_from_world @ to_pose(source))
    assert source_mount(STAGE, path(source)).hfov_deg == STAGE.hfov_deg


def test_a_place_no_source_camera_can_have_is_refused() -> None:
    free = pose_trajectory(path().source_from_target)
    with pytest.raises(PoseError, match="plan the path with `plan_view`"):
        warps(free)
    below = Spherical(azimuth_deg=0.0, elevation_deg=-8.0, radius_m=15.0)
    with pytest.raises(OptionError, match="above the ground"):
        warps(path(below))
    above = Spherical(azimuth_deg=0.0, elevation_deg=90.0, radius_m=15.0)
    with pytest.raises(OptionError, match="tilt must lie between"):
        warps(path(above, SphericalDelta(elevation_deg=-30.0)))


def test_on_a_vehicle_the_source_camera_stands_as_trained() -> None:
    assert source_mount(PlaneWarpConfig(), driving_trajectory(frames=2, move_time=1)) == CameraMount()


# --- for one clip ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [TINY_OBJECTS, OBJECTS_SMALL])
def test_channels_are_made_of_the_pictures_of_a_clip(config: ModelConfig) -> None:
    trajectory = spherical_trajectory(SOURCE, GOALS[0], frames=config.frames, move_time=config.frames - 1)
    made, source, factor = (
        clip_warps(config, trajectory),
        F.interpolate(draw(2, 3, 4, 6), size=(config.height, config.width), mode="bilinear"),
        config.vae.down_factor,
    )
    numbers = torch.tensor([1, 2])
    pictures = made.pictures(source, numbers)
    assert config.plane_warp is not None
    assert pictures.half.shape == pictures.ground.shape == (2, 3, config.height // 2, config.width // 2)
    assert pictures.distant.shape == (2, config.plane_warp.distant, 3, config.height // 4, config.width // 4)
    assert pictures.rays.shape == (2, 4, config.height // factor, config.width // factor)
    channels = channels_of(pictures, factor)
    assert channels.shape[1] == warp_channels(config.plane_warp, factor)
    assert config.unet.condition_channels == config.vae.latent_channels + channels.shape[1]
    assert torch.equal(channels, made.channels(source, numbers))
    warped, _ = made.layers(source, numbers)
    assert warped.shape[1] == config.plane_warp.layers
    small = F.avg_pool2d(warped[:, GROUND], 2)
    assert (small - pictures.ground).abs().mean() < 0.15 * small.abs().mean()


def test_some_frames_alone_are_as_among_all() -> None:
    source, numbers = draw(3, 3, HEIGHT, WIDTH), torch.tensor([LAST, 1, LAST])
    few, every = warps(path(), [1, LAST]), warps(path())
    assert_close(few.channels(source, numbers), every.channels(source, numbers))
    for found, expected in zip(few.layers(source, numbers), every.layers(source, numbers), strict=True):
        assert_close(found, expected)
    with pytest.raises(ShapeError, match=r"some frames of the path only, and \[0\] are not"):
        few.channels(source[:1], torch.tensor([0]))


def test_a_road_can_be_warped_frame_by_frame_too() -> None:
    road = driving_trajectory(frames=DRIVING_SMALL.frames, move_time=DRIVING_SMALL.frames - 1)
    source, numbers = draw(1, 3, DRIVING_SMALL.height, DRIVING_SMALL.width), torch.tensor([9])
    few, every = (clip_warps(DRIVING_SMALL, road, frames=frames) for frames in ([9], None))
    assert_close(few.channels(source, numbers), every.channels(source, numbers))


def test_a_model_without_planes_has_no_warps() -> None:
    with pytest.raises(OptionError, match="no plane_warp"):
        clip_warps(SMALL, path())


def test_the_cache_knows_where_the_source_camera_stood() -> None:
    cache, device, goal = PathWarpCache(STAGE, 8, kept=2), torch.device("cpu"), SphericalDelta(azimuth_deg=20.0)
    first = cache.warps(None, path(SOURCE, goal), 16, 24, device)
    assert cache.warps(None, path(SOURCE, goal), 16, 24, device) is first
    farther = Spherical(azimuth_deg=0.0, elevation_deg=12.0, radius_m=15.0)
    assert cache.warps(None, path(farther, goal), 16, 24, device) is not first
    for azimuth_deg in range(5):  # an orbit goes on and on: the cache stays as small
        cache.warps(None, path(SOURCE, SphericalDelta(azimuth_deg=azimuth_deg)), 16, 24, device)
    assert cache.warps(None, path(SOURCE, goal), 16, 24, device) is not first
