"""How a camera is fixed to a vehicle that stands on the ground.

The vehicle's frame has x ahead, y to the left and z up; the ground is z = 0, below the vehicle's reference point.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.errors import OptionError
from gcd_model.geometry.pose import pose_from_axes


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraMount:
    """A forward-looking camera without roll or yaw. The defaults are ParallelDomain-4D's forward camera.

    height_m, forward_m, left_m: where it stands in the vehicle's frame, metres; height above the ground.
    tilt_deg: how far it looks down from the horizon; negative looks up.
    hfov_deg: angle from the left to the right edge of its picture, square pixels.
    Raises OptionError for numbers that no such camera has.
    """

    height_m: float = 1.55
    forward_m: float = 1.6
    left_m: float = 0.0
    tilt_deg: float = 0.0
    hfov_deg: float = 85.0

    def __post_init__(self) -> None:
        numbers = (self.height_m, self.forward_m, self.left_m, self.tilt_deg, self.hfov_deg)
        if not all(map(math.isfinite, numbers)):
            raise OptionError(f"a camera mount must have finite numbers, got {self}")
        if self.height_m <= 0.0:
            raise OptionError(f"a camera must stand above the ground, got a height of {self.height_m:g} m")
        if not -90.0 < self.tilt_deg < 90.0:
            raise OptionError(f"a tilt must lie between -90 and 90 degrees, got {self.tilt_deg:g}")
        if not 0.0 < self.hfov_deg < 180.0:
            raise OptionError(f"a horizontal field of view must lie between 0 and 180 degrees, got {self.hfov_deg:g}")

    @property
    def vehicle_from_camera(self) -> Tensor:
        """The camera's pose in the vehicle's frame, float64 [4, 4], metres."""
        tilt = math.radians(self.tilt_deg)
        right, down, ahead, position = torch.tensor(
            [
                [0.0, -1.0, 0.0],
                [-math.sin(tilt), 0.0, -math.cos(tilt)],
                [math.cos(tilt), 0.0, -math.sin(tilt)],
                [self.forward_m, self.left_m, self.height_m],
            ],
            dtype=torch.float64,
        )
        return pose_from_axes(right, down, ahead, position)
