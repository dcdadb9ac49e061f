"""How a camera sits on its vehicle."""

import math

import pytest
import torch
from torch.testing import assert_close

from gcd_model.errors import OptionError
from gcd_model.geometry import DRIVING_SOURCE_POSITION, DRIVING_SOURCE_TARGET, CameraMount, look_at, require_rigid

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
