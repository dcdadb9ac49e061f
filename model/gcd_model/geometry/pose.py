"""Rigid camera poses and the conventions that everything else follows.

World: right-handed, z up. Camera: x right, y down, z ahead, as OpenCV has them.
`a_from_b` takes coordinates in b to coordinates in a, so `a_from_b @ b_from_c` reads as `a_from_c`; the columns of
`world_from_camera` are the camera's right, down and ahead axes and its position, in the world.
A pose is a float64 CPU tensor [4, 4] or [..., 4, 4] with the last row (0, 0, 0, 1). Public types speak degrees and
metres; a metre is a scene unit where the video has no scale of its own.
"""

import math
from dataclasses import dataclass

import torch
from kornia.geometry.linalg import inverse_transformation
from torch import Tensor

from gcd_model.errors import OptionError, PoseError

RIGID_TOLERANCE = 1e-3
"""How far a rotation may be from orthonormal, per entry of R^T R, and the last row from (0, 0, 0, 1)."""

_COINCIDENT_M = 1e-9
_VERTICAL_SINE = 1e-9


def invert_rigid(a_from_b: Tensor) -> Tensor:
    """The same relation seen from the other side.

    Args:
        a_from_b: [..., 4, 4] rigid; taken as such, see require_rigid().
    Returns:
        b_from_a: [..., 4, 4].
    """
    flat = inverse_transformation(a_from_b.reshape(-1, 4, 4))
    return flat.reshape(a_from_b.shape)


def relative_pose(world_from_source: Tensor, world_from_target: Tensor) -> Tensor:
    """Target camera as seen from the source camera.

    Args:
        world_from_source, world_from_target: [..., 4, 4] rigid, metres; leading sizes broadcast.
    Returns:
        source_from_target: [..., 4, 4].
    Source: Generative Camera Dolly, section 3, the relative extrinsics between input and output viewpoint.
    """
    return invert_rigid(world_from_source) @ world_from_target


def look_at(position: Tensor, target: Tensor) -> Tensor:
    """Pose of an upright camera at `position` with `target` in the middle of its image.

    Args:
        position, target: [..., 3] world points, metres; leading sizes broadcast.
    Returns:
        world_from_camera: float64 [..., 4, 4]; the right axis is level.
    Raises:
        PoseError: a number is not finite, the points coincide, or the camera would look straight up or down,
            where no direction is its right.
    """
    position, target = torch.broadcast_tensors(_points(position, "position"), _points(target, "target"))
    reach = torch.linalg.vector_norm(target - position, dim=-1, keepdim=True)
    if bool((reach < _COINCIDENT_M).any()):
        raise PoseError("a camera cannot look at the point it stands on: move the position or the target")
    ahead = (target - position) / reach
    across = torch.linalg.cross(ahead.new_tensor([0.0, 0.0, -1.0]).expand_as(ahead), ahead)
    level = torch.linalg.vector_norm(across, dim=-1, keepdim=True)
    if bool((level < _VERTICAL_SINE).any()):
        raise PoseError(
            "a camera that looks straight up or down has no upright pose: "
            "move the position or the target sideways, or give the pose as a matrix"
        )
    right = across / level
    return pose_from_axes(right, torch.linalg.cross(ahead, right), ahead, position)


def pose_from_axes(right: Tensor, down: Tensor, ahead: Tensor, position: Tensor) -> Tensor:
    """Pose with the given camera axes (orthonormal) and position, all [..., 3] in the world: [..., 4, 4]."""
    top = torch.stack([right, down, ahead, position], dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def require_rigid(pose: Tensor, name: str) -> Tensor:
    """The pose as float64 on the CPU, once it is known to be one.

    Args:
        pose: [..., 4, 4], any dtype, at least one.
        name: what the message calls it.
    Raises:
        PoseError: wrong shape, a number that is not finite, a last row other than (0, 0, 0, 1), a rotation that is
            scaled or sheared by more than RIGID_TOLERANCE, or one that mirrors.
    """
    if pose.ndim < 2 or pose.shape[-2:] != (4, 4) or pose.numel() == 0:
        raise PoseError(f"{name} must be [..., 4, 4], got {list(pose.shape)}")
    pose = pose.to("cpu", torch.float64)
    if not bool(pose.isfinite().all()):
        raise PoseError(f"{name} holds NaN or infinite numbers; a pose must be finite")
    last_row = pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    if bool(((pose[..., 3, :] - last_row).abs() > RIGID_TOLERANCE).any()):
        raise PoseError(f"{name} must have the last row (0, 0, 0, 1); is it transposed?")
    rotation = pose[..., :3, :3]
    skew = float((rotation.mT @ rotation - torch.eye(3, dtype=torch.float64)).abs().max())
    if skew > RIGID_TOLERANCE:
        raise PoseError(f"{name} must be rigid: its rotation is {skew:.2g} from orthonormal, at most {RIGID_TOLERANCE}")
    if bool((torch.linalg.det(rotation) < 0).any()):
        raise PoseError(f"{name} mirrors (determinant -1): flip one camera axis so that x is right, y down, z ahead")
    return pose


def _points(points: Tensor, name: str) -> Tensor:
    if points.ndim < 1 or points.shape[-1] != 3:
        raise PoseError(f"{name} must be [..., 3], got {list(points.shape)}")
    points = points.to("cpu", torch.float64)
    if not bool(points.isfinite().all()):
        raise PoseError(f"{name} holds NaN or infinite numbers; a point must be finite")
    return points


# --- a camera on a vehicle -------------------------------------------------------------------------------------------


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
