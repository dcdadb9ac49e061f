"""Warps by known planes, against pictures of a painted world that are traced ray by ray here."""

import math

import pytest
import torch
import torch.nn.functional as F
from small_models import draw
from torch import Tensor
from torch.testing import assert_close

from gcd_model.config import PlaneWarpConfig, warp_channels
from gcd_model.errors import ShapeError
from gcd_model.geometry import CameraMount, Intrinsics, Trajectory, driving_trajectory, invert_rigid
from gcd_model.plane_warp import PathWarpCache, PathWarps, PlaneWarps, plane_warp, trained_mount, warp

CONFIG = PlaneWarpConfig()
GROUND, INFINITY, FIRST_SIDE, FIRST_FRONT = 0, 1, 2, 6
HEIGHT, WIDTH = 64, 96
LAST = 13
MOUNTS = [CameraMount(), CameraMount(height_m=1.1, forward_m=0.4, left_m=0.3, tilt_deg=8.0, hfov_deg=70.0)]


def path(mount: CameraMount | None = None) -> Trajectory:
    return driving_trajectory(frames=14, move_time=LAST, mount=mount)


def warps(mount: CameraMount | None = None, height: int = HEIGHT, width: int = WIDTH) -> PlaneWarps:
    mount = mount or CameraMount()
    return plane_warp(CONFIG, mount, path(mount).source_from_target, height, width)


def pixel(camera: Intrinsics, camera_from_vehicle: Tensor, point: Tensor) -> Tensor:
    """Where a point of the vehicle's frame is seen, in pixels [2]."""
    seen = camera.matrix @ (camera_from_vehicle @ torch.cat([point, point.new_ones(1)]))[:3]
    return seen[:2] / seen[2]


def identity_grid(height: int, width: int) -> Tensor:
    return F.affine_grid(torch.eye(2, 3)[None], [1, 1, height, width], align_corners=False)[0]


# --- where points go -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize(
    ("layer", "point"),
    [
        (GROUND, (9.0, 1.0, 0.0)),
        (GROUND, (14.0, -4.0, 0.0)),
        (FIRST_SIDE, (14.0, 5.5, 1.0)),
        (FIRST_SIDE, (14.0, -5.5, 1.0)),
        (FIRST_SIDE + 3, (30.0, 15.0, 4.0)),
        (FIRST_FRONT, (8.0, 1.0, 2.0)),
        (FIRST_FRONT + 4, (45.0, -9.0, 6.0)),
    ],
)
def test_a_point_on_a_plane_is_fetched_from_where_the_source_sees_it(
    mount: CameraMount, layer: int, point: tuple[float, float, float]
) -> None:
    where, size = torch.tensor(point, dtype=torch.float64), torch.tensor([WIDTH, HEIGHT])
    made = warps(mount)
    for t in (0, 7, LAST):
        vehicle_from_target = mount.vehicle_from_camera @ path(mount).source_from_target[t]
        at = pixel(Intrinsics.from_hfov(CONFIG.hfov_deg, WIDTH, HEIGHT), invert_rigid(vehicle_from_target), where)
        source = Intrinsics.from_hfov(mount.hfov_deg, WIDTH, HEIGHT)
        expected = pixel(source, invert_rigid(mount.vehicle_from_camera), where)
        place = (at / size * 2 - 1).float().reshape(1, 1, 1, 2)
        found = F.grid_sample(made.grid[t, layer].permute(2, 0, 1)[None], place, align_corners=False).flatten()
        assert_close((found.double() + 1) / 2 * size, expected, rtol=0, atol=0.03)
        assert made.valid[t, layer, int(at[1]), int(at[0])]


@pytest.mark.parametrize("mount", MOUNTS[:1])
def test_at_the_start_of_the_path_every_layer_shows_the_source_itself(mount: CameraMount) -> None:
    made = warps(mount)
    own = identity_grid(HEIGHT, WIDTH).expand(CONFIG.layers, -1, -1, -1)
    here = made.valid[0]
    assert_close(made.grid[0][here], own[here], rtol=0, atol=1e-5)
    assert here[INFINITY].all()
    assert here[GROUND, HEIGHT // 2 :].all()
    assert not here[GROUND, : HEIGHT // 2].any()  # a level camera sees no ground above the middle


# --- what arrives ----------------------------------------------------------------------------------------------------


def paint(points: Tensor) -> Tensor:
    """A smooth colour for every point of the world: [H, W, 3] metres -> [3, H, W] in [-1, 1]."""
    x, y, z = points.unbind(-1)
    return torch.stack([torch.sin(x / 4 + y / 9), torch.sin(y / 3), torch.cos(z / 2 + x / 7)])


def traced(vehicle_from_camera: Tensor, camera: Intrinsics, wall_x: float | None) -> tuple[Tensor, Tensor]:
    """Picture [3, H, W] of painted ground and, if any, a painted wall across; distance of what is seen [H, W]."""
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).double()
    rays = pixels @ torch.linalg.inv(camera.matrix).T @ vehicle_from_camera[:3, :3].T
    rays = rays / rays.norm(dim=-1, keepdim=True)
    start = vehicle_from_camera[:3, 3]
    reach = torch.where(rays[..., 2] < 0, -start[2] / rays[..., 2], torch.inf)
    if wall_x is not None:
        wall = torch.where(rays[..., 0] > 0, (wall_x - start[0]) / rays[..., 0], torch.inf)
        reach = torch.minimum(reach, wall)
    return paint(start + rays * reach.clamp(max=1e4)[..., None]).float(), reach


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize(("layer", "wall_x"), [(GROUND, None), (FIRST_FRONT + 1, 12.0)])
def test_a_world_of_planes_arrives_in_its_own_colours(mount: CameraMount, layer: int, wall_x: float | None) -> None:
    source, _ = traced(mount.vehicle_from_camera, Intrinsics.from_hfov(mount.hfov_deg, WIDTH, HEIGHT), wall_x)
    made = warps(mount)
    for t in (5, LAST):
        vehicle_from_target = mount.vehicle_from_camera @ path(mount).source_from_target[t]
        target = Intrinsics.from_hfov(CONFIG.hfov_deg, WIDTH, HEIGHT)
        expected, reach = traced(vehicle_from_target, target, wall_x)
        found = warp(source[None], made.grid[t : t + 1], made.valid[t : t + 1])[0, layer]
        near = made.valid[t, layer] & (reach < 25.0)
        assert near.float().mean() > 0.05
        error = (found - expected).abs().mean(dim=0)[near]
        assert error.mean() < 0.01
        assert (source - expected).abs().mean(dim=0)[near].mean() > 0.1  # so something had to be done


def test_what_is_not_valid_is_mid_grey() -> None:
    made = warps()
    picture = warp(torch.ones(14, 3, HEIGHT, WIDTH), made.grid, made.valid)
    assert_close(picture, made.valid[:, :, None].float().expand_as(picture))
    assert not made.valid[LAST, GROUND, -1, WIDTH // 2]  # below the goal camera lies ground the source never saw


# --- the layers ------------------------------------------------------------------------------------------------------


def test_the_ground_hides_what_lies_below_it_and_walls_hide_the_ground_behind() -> None:
    made, ground = warps(), warps().grid[:, GROUND]
    for wall in range(FIRST_FRONT, CONFIG.layers):
        both = made.valid[LAST, wall] & made.valid[LAST, GROUND]
        same = (made.grid[LAST, wall] - ground[LAST]).abs().amax(dim=-1) < 1e-6
        assert (same & both).any(), "no ground in front of the wall"
        first_behind = torch.nonzero((both & ~same)[:, WIDTH // 2])[:, 0]
        first_before = torch.nonzero((both & same)[:, WIDTH // 2])[:, 0]
        assert first_behind.max() < first_before.min()  # higher in the picture is farther away


def test_farther_front_walls_show_more_ground() -> None:
    made = warps()
    ground = made.grid[LAST, GROUND]
    shown = [
        int(((made.grid[LAST, wall] - ground).abs().amax(dim=-1) < 1e-6).sum())
        for wall in range(FIRST_FRONT, CONFIG.layers)
    ]
    assert shown == sorted(shown)
    assert len(set(shown)) == len(shown)


def test_infinity_does_not_care_where_the_camera_stands() -> None:
    here, there = CameraMount(), CameraMount(height_m=3.0, forward_m=0.0, left_m=2.0)
    sky = warps(here).rays[LAST, 2] > 1e-3
    assert sky.any()
    assert_close(warps(here).grid[LAST, INFINITY][sky], warps(there).grid[LAST, INFINITY][sky], rtol=0, atol=1e-3)
    assert_close(warps(here).grid[LAST, INFINITY][~sky], warps(here).grid[LAST, GROUND][~sky], rtol=0, atol=1e-5)


def test_the_warps_of_a_mirrored_source_are_mirrored_warps() -> None:
    made, source = warps(), draw(14, 3, HEIGHT, WIDTH)
    plain, mirrored = warp(source, made.grid, made.valid), warp(source.flip(-1), made.grid, made.valid)
    assert torch.equal(made.valid, made.valid.flip(-1))
    assert_close(mirrored, plain.flip(-1), rtol=0, atol=1e-3)


def test_rays_are_of_unit_length_and_tell_the_distance_to_the_ground() -> None:
    rays = warps().rays
    assert_close(rays[:, :3].norm(dim=1), torch.ones(14, HEIGHT, WIDTH))
    centre = rays[LAST, :, HEIGHT // 2 - 1 : HEIGHT // 2 + 1, WIDTH // 2 - 1 : WIDTH // 2 + 1].mean(dim=(1, 2))
    assert_close(centre[:3], torch.tensor([13.6, 0.0, -6.45]) / math.hypot(13.6, 6.45), rtol=0, atol=1e-3)
    distance = 8.0 * math.hypot(13.6, 6.45) / 6.45  # 8 m above the ground, along that slope
    assert centre[3].item() == pytest.approx(math.log10(distance / 10.0), abs=1e-2)
    assert (rays[0, 3, : HEIGHT // 2] == 1.0).all()


def test_the_road_is_the_one_that_shipped_weights_were_trained_on() -> None:
    """Recorded when driving-small was trained: what is warped otherwise is another model."""
    made = warps()
    seen = [int(made.valid[:, layer].sum()) for layer in range(CONFIG.layers)]
    assert seen == [31524, 53892, 41248, 45250, 47938, 49840, 36562, 44756, 49842, 51764, 53180]
    below = [made.grid[:, layer, ..., 1][made.valid[:, layer]].double().mean().item() for layer in range(CONFIG.layers)]
    recorded = [0.289251, 0.037116, -0.031451, -0.029689, -0.0212, -0.008839]
    assert below[:FIRST_FRONT] == pytest.approx(recorded, abs=2e-6)
    assert below[FIRST_FRONT:] == pytest.approx([-0.080715, -0.110688, -0.087312, -0.042192, -0.008162], abs=2e-6)
    rays = made.rays.double().mean(dim=(0, 2, 3)).tolist()
    assert rays == pytest.approx([0.812637, 0.0, -0.231275, 0.405205], abs=2e-6)


# --- along a path ----------------------------------------------------------------------------------------------------


def test_the_trained_mount_is_the_configs() -> None:
    assert trained_mount(CONFIG) == CameraMount()
    other = PlaneWarpConfig(hfov_deg=70.0, position=(1.0, 0.5, 2.0))
    assert trained_mount(other) == CameraMount(height_m=2.0, forward_m=1.0, left_m=0.5, hfov_deg=70.0)


def test_condition_channels_are_source_ground_distant_layers_and_rays_in_that_order() -> None:
    source, numbers = draw(3, 3, HEIGHT, WIDTH).clamp(-1, 1), torch.tensor([LAST, 0, 4])
    channels = PathWarps(CONFIG, CameraMount(), path(), HEIGHT, WIDTH).channels(source, numbers)
    assert channels.shape == (3, warp_channels(CONFIG, 8), HEIGHT // 8, WIDTH // 8)
    assert warp_channels(CONFIG, 8) == 48 + 48 + 5 * 12 + 4 == 160
    half, quarter = F.avg_pool2d(source, 2), F.avg_pool2d(source, 4)
    assert_close(F.pixel_shuffle(channels[:, :48], 4), half)
    at_half, at_quarter = warps(height=HEIGHT // 2, width=WIDTH // 2), warps(height=HEIGHT // 4, width=WIDTH // 4)
    ground = warp(half, at_half.grid[numbers], at_half.valid[numbers])[:, GROUND]
    assert_close(F.pixel_shuffle(channels[:, 48:96], 4), ground)
    distant = warp(quarter, at_quarter.grid[numbers], at_quarter.valid[numbers])[:, INFINITY:FIRST_FRONT]
    assert_close(F.pixel_shuffle(channels[:, 96:156], 2), distant.flatten(1, 2))
    assert torch.equal(channels[:, 156:], warps(height=HEIGHT // 8, width=WIDTH // 8).rays[numbers])


def test_rows_are_frames_of_any_clips() -> None:
    made = PathWarps(CONFIG, CameraMount(), path(), HEIGHT, WIDTH)
    source, numbers = draw(4, 3, HEIGHT, WIDTH), torch.tensor([3, LAST, 3, 0])
    warped, valid = made.layers(source, numbers)
    assert warped.shape == (4, CONFIG.layers, 3, HEIGHT, WIDTH)
    assert valid.dtype == torch.bool
    for row in range(4):
        alone, own = made.layers(source[row : row + 1], numbers[row : row + 1])
        assert_close(warped[row], alone[0])
        assert torch.equal(valid[row], own[0])
        assert_close(made.channels(source, numbers)[row], made.channels(source[row:][:1], numbers[row:][:1])[0])


def test_a_size_that_is_no_multiple_of_the_latent_grid_is_refused() -> None:
    with pytest.raises(ShapeError, match="multiples of 8, got 60x96"):
        PathWarps(CONFIG, CameraMount(), path(), 60, WIDTH)


def test_the_same_path_is_computed_once_and_old_ones_are_forgotten() -> None:
    cache, device = PathWarpCache(CONFIG, 8, kept=2), torch.device("cpu")
    first = cache.warps(MOUNTS[0], path(), 16, 24, device)
    assert cache.warps(MOUNTS[0], path(), 16, 24, device) is first
    assert cache.warps(MOUNTS[1], path(), 16, 24, device) is not first
    assert cache.warps(MOUNTS[0], path(), 16, 24, device) is first
    cache.warps(MOUNTS[0], path(MOUNTS[1]), 16, 24, device)
    assert cache.warps(MOUNTS[0], path(), 16, 24, device) is first  # used last, kept longest
    cache.warps(MOUNTS[0], path(), 24, 16, device)
    cache.warps(MOUNTS[0], path(), 24, 24, device)
    assert cache.warps(MOUNTS[0], path(), 16, 24, device) is not first
