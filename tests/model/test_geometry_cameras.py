import math
from collections.abc import Callable
from itertools import accumulate, product
from typing import Any

import pytest
import torch
from kornia.geometry.camera import project_points
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.testing import assert_close

from gcd_model.errors import OptionError, PoseError, ShapeError
from gcd_model.geometry import (
    DRIVING_SOURCE_POSITION,
    DRIVING_SOURCE_TARGET,
    CameraMount,
    Intrinsics,
    Orbit,
    center_crop_box,
    invert_rigid,
    look_at,
    relative_pose,
    require_rigid,
)
from gcd_model.geometry.pose import RIGID_TOLERANCE

IDENTITY = torch.eye(4, dtype=torch.float64)


def random_poses(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    poses = IDENTITY.repeat(count, 1, 1)
    poses[:, :3, :3] = axis_angle_to_rotation_matrix(torch.randn(count, 3, generator=generator, dtype=torch.float64))
    poses[:, :3, 3] = 10 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return poses


def point(x: float, y: float, z: float) -> Tensor:
    return torch.tensor([x, y, z], dtype=torch.float64)


def test_poses_invert_and_compose() -> None:
    a, b, c = random_poses(3, seed=3)
    for product_ in (invert_rigid(a) @ a, a @ invert_rigid(a)):
        assert_close(product_, IDENTITY, rtol=0, atol=1e-12)
    assert_close(relative_pose(a, b) @ relative_pose(b, c), relative_pose(a, c), rtol=0, atol=1e-12)
    assert_close(a @ relative_pose(a, b), b, rtol=0, atol=1e-12)


@pytest.mark.parametrize("azimuth_deg", [0.0, 40.0, 179.0])
@pytest.mark.parametrize("height", [-6.0, 2.5])
def test_look_at_is_rigid_upright_and_centred_on_its_target(azimuth_deg: float, height: float) -> None:
    azimuth = math.radians(azimuth_deg)
    position, target = point(5 * math.cos(azimuth), 5 * math.sin(azimuth), height), point(0.3, -0.2, 0.7)
    world_from_camera = require_rigid(look_at(position, target), "look_at")
    right, down = world_from_camera[:3, 0], world_from_camera[:3, 1]
    target_in_camera = (invert_rigid(world_from_camera) @ torch.cat([target, target.new_ones(1)]))[:3]

    assert_close(world_from_camera[:3, :3].mT @ world_from_camera[:3, :3], IDENTITY[:3, :3], rtol=0, atol=1e-12)
    assert_close(world_from_camera[:3, 3], position)
    assert right[2].item() == pytest.approx(0.0, abs=1e-12)
    assert down[2].item() < 0.0
    assert_close(target_in_camera, point(0, 0, (target - position).norm().item()), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "position", [point(1, 2, 4), point(1, 2, -4), point(1, 2, 0), torch.zeros(2), torch.tensor([math.nan, 0.0, 0.0])]
)
def test_look_at_refuses_to_look_straight_up_or_down_at_itself_or_from_no_point(position: Tensor) -> None:
    with pytest.raises(PoseError):
        look_at(position, point(1, 2, 0))


def test_require_rigid_forgives_rounding_but_not_scale() -> None:
    pose = IDENTITY.clone()
    pose[0, 0] += 0.4 * RIGID_TOLERANCE
    assert require_rigid(pose, "pose")[0, 0].item() == pose[0, 0].item()
    pose[0, 0] += 0.4 * RIGID_TOLERANCE
    with pytest.raises(PoseError):
        require_rigid(pose, "pose")


def broken(row: int, column: int, value: float) -> Tensor:
    pose = IDENTITY.clone()
    pose[row, column] = value
    return pose


@pytest.mark.parametrize(
    "pose",
    [
        torch.eye(3),
        torch.zeros(0, 4, 4),
        broken(0, 3, math.nan),
        broken(1, 1, math.inf),
        broken(0, 1, 0.1),
        broken(2, 2, -1.0),
        broken(3, 0, 5.0),
        broken(3, 3, 0.0),
    ],
)
def test_what_is_not_rigid_is_refused_by_its_name(pose: Tensor) -> None:
    with pytest.raises(PoseError) as caught:
        require_rigid(pose, "asked pose")
    assert str(caught.value).startswith("asked pose")


LEVEL = look_at(
    torch.tensor(DRIVING_SOURCE_POSITION, dtype=torch.float64), torch.tensor(DRIVING_SOURCE_TARGET, dtype=torch.float64)
)


def test_the_default_mount_is_the_data_sets_forward_camera() -> None:
    assert_close(CameraMount().vehicle_from_camera, LEVEL, rtol=0, atol=0)


@pytest.mark.parametrize("tilt_deg", [-30.0, 12.0, 89.0])
def test_a_mount_is_a_rigid_pose_that_looks_down_by_its_tilt(tilt_deg: float) -> None:
    mount = CameraMount(height_m=2.0, forward_m=-1.0, left_m=0.25, tilt_deg=tilt_deg)
    pose = require_rigid(mount.vehicle_from_camera, "mount")
    assert pose[:3, 3].tolist() == [-1.0, 0.25, 2.0]
    assert pose[2, 2].item() == pytest.approx(-math.sin(math.radians(tilt_deg)))
    assert pose[:3, 0].tolist() == [0.0, -1.0, 0.0]  # no roll, no yaw
    assert pose[2, 1].item() < 0  # upright


@pytest.mark.parametrize("changes", [{"height_m": 0.0}, {"tilt_deg": 90.0}, {"hfov_deg": 180.0}, {"left_m": math.nan}])
def test_a_mount_no_camera_has_is_refused(changes: dict[str, float]) -> None:
    with pytest.raises(OptionError):
        CameraMount(**changes)


CAMERA = Intrinsics(fx=400.0, fy=390.0, cx=310.0, cy=250.0, width=640, height=480)
POINTS = torch.tensor([[0.0, 0.0, 1.0], [0.7, -0.2, 2.0], [-1.5, 1.0, 4.0], [3.0, 2.0, 9.0]], dtype=torch.float64)


def pixels(camera: Intrinsics) -> Tensor:
    return project_points(POINTS, camera.matrix.expand(len(POINTS), 3, 3))


def test_a_resized_or_cropped_camera_sees_the_resized_or_cropped_picture() -> None:
    scale = torch.tensor([384 / 640, 256 / 480], dtype=torch.float64)
    assert_close(pixels(CAMERA.resized(384, 256)), pixels(CAMERA) * scale)
    corner = torch.tensor([30.0, 17.0], dtype=torch.float64)
    assert_close(pixels(CAMERA.cropped(30, 17, 500, 400)), pixels(CAMERA) - corner)


@pytest.mark.parametrize("hfov_deg", [20.0, 53.13, 85.0, 150.0])
def test_a_field_of_view_survives_the_round_trip(hfov_deg: float) -> None:
    camera = Intrinsics.from_hfov(hfov_deg, 384, 256)
    assert camera.hfov_deg == pytest.approx(hfov_deg)
    assert camera.fx == camera.fy
    assert (camera.cx, camera.cy) == (192.0, 128.0)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: CAMERA.cropped(-1, 0, 10, 10), ShapeError),
        (lambda: CAMERA.cropped(0, 471, 10, 10), ShapeError),
        (lambda: CAMERA.cropped(0, 0, 0, 10), ShapeError),
        (lambda: CAMERA.resized(10, 0), ShapeError),
        (lambda: Intrinsics(fx=0.0, fy=1.0, cx=1.0, cy=1.0, width=2, height=2), OptionError),
        (lambda: Intrinsics(fx=1.0, fy=math.inf, cx=1.0, cy=1.0, width=2, height=2), OptionError),
        (lambda: Intrinsics.from_hfov(180.0, 384, 256), OptionError),
        (lambda: Intrinsics.from_hfov(math.nan, 384, 256), OptionError),
        (lambda: Intrinsics.from_hfov(50.0, 0, 256), ShapeError),
        (lambda: center_crop_box(640, 480, -1.5), OptionError),
        (lambda: center_crop_box(640, 480, math.nan), OptionError),
    ],
)
def test_what_no_pinhole_camera_is_is_refused(make: Callable[[], object], error: type[Exception]) -> None:
    with pytest.raises(error):
        make()


# The crop to the trained shape


@pytest.mark.parametrize("aspect", [0.75, 1.0, 1.5, 16 / 9])
@pytest.mark.parametrize(("width", "height"), [(640, 480), (333, 777), (37, 11)])
def test_the_crop_is_the_largest_centred_part_of_that_shape(width: int, height: int, aspect: float) -> None:
    left, top, kept_width, kept_height = center_crop_box(width, height, aspect, tolerance=0.0)
    assert kept_width == width or kept_height == height
    assert abs(kept_width - min(width, height * aspect)) < 1
    assert abs(kept_height - min(height, width / aspect)) < 1
    assert abs((width - kept_width) - 2 * left) <= 1
    assert abs((height - kept_height) - 2 * top) <= 1


@pytest.mark.parametrize(
    ("width", "height", "box"),
    [
        (640, 480, (0, 27, 640, 426)),  # ParallelDomain-4D, 4:3
        (576, 384, (0, 0, 576, 384)),  # Kubric-4D, already 3:2
        (1920, 1080, (150, 0, 1620, 1080)),
        (1080, 1920, (0, 600, 1080, 720)),
    ],
)
def test_recorded_crops_to_three_by_two(width: int, height: int, box: tuple[int, int, int, int]) -> None:
    assert center_crop_box(width, height, 1.5) == box


ORBITS = [
    Orbit(rate_deg_s=rate, amplitude_deg=amplitude, azimuth_deg=share * amplitude, direction=direction)
    for rate, amplitude, share, direction in product([25.0, -7.3], [45.0, 0.1], [-0.9, 0.35], [1, -1])
]


def ends_together(one: Orbit, other: Orbit) -> bool:
    """The same motion up to rounding: same place, and same way unless both are at a turn."""
    near = math.isclose(one.azimuth_deg, other.azimuth_deg, abs_tol=1e-6)
    at_turn = math.isclose(abs(one.azimuth_deg), one.amplitude_deg, abs_tol=1e-6)
    return near and (at_turn or one.direction == other.direction)


@pytest.mark.parametrize("orbit", ORBITS)
def test_an_orbit_stays_within_its_amplitude_its_times_add_up_and_a_whole_swing_leads_back(orbit: Orbit) -> None:
    steps = [0.0, 0.01, 0.5, 0.583333, 3.0, 100.0, 12345.678]
    visited = list(accumulate(steps * 5, lambda place, step: place.advanced(step), initial=orbit))
    assert all(abs(place.azimuth_deg) <= orbit.amplitude_deg for place in visited)
    assert {place.amplitude_deg for place in visited} == {orbit.amplitude_deg}
    for first_s, second_s in [(0.13, 0.4), (2.0, 9.1), (3.3, -1.2)]:
        assert ends_together(orbit.advanced(first_s).advanced(second_s), orbit.advanced(first_s + second_s))
    swing_s = 4 * orbit.amplitude_deg / abs(orbit.rate_deg_s)
    half = orbit.advanced(swing_s / 2)
    assert ends_together(orbit.advanced(swing_s), orbit)
    assert half.azimuth_deg == pytest.approx(-orbit.azimuth_deg, abs=1e-9)
    assert half.direction == -orbit.direction


@pytest.mark.parametrize(
    "orbit", [Orbit(rate_deg_s=0.0, amplitude_deg=20.0, azimuth_deg=5.0), Orbit(rate_deg_s=9.0, amplitude_deg=0.0)]
)
def test_an_orbit_without_rate_or_amplitude_stays(orbit: Orbit) -> None:
    assert orbit.advanced(17.0) == orbit


@pytest.mark.parametrize(
    "changes",
    [
        {"amplitude_deg": -1.0},
        {"azimuth_deg": 10.1},
        {"direction": 0},
        {"rate_deg_s": math.nan},
        {"amplitude_deg": math.inf},
    ],
)
def test_an_impossible_orbit_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        Orbit(**{"rate_deg_s": 1.0, "amplitude_deg": 10.0, **changes})
