import math

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.testing import assert_close

from gcd_model.errors import OptionError, PoseError
from gcd_model.geometry import (
    DRIVING_SOURCE_POSITION,
    DRIVING_SOURCE_TARGET,
    CameraMount,
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


def test_inverse_undoes_a_pose_from_both_sides() -> None:
    poses = random_poses(8, seed=1)
    assert_close(invert_rigid(poses) @ poses, IDENTITY.expand(8, 4, 4), rtol=0, atol=1e-12)
    assert_close(poses @ invert_rigid(poses), IDENTITY.expand(8, 4, 4), rtol=0, atol=1e-12)


def test_relative_poses_compose() -> None:
    a, b, c = random_poses(3, seed=3)
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
