"""Rigid camera poses, the pinhole, and the conventions that everything else follows.

World: right-handed, z up. Camera: x right, y down, z ahead, as OpenCV has them.
`a_from_b` takes coordinates in b to coordinates in a, so `a_from_b @ b_from_c` reads as `a_from_c`; the columns of
`world_from_camera` are the camera's right, down and ahead axes and its position, in the world.
A pose is a float64 CPU tensor [4, 4] or [..., 4, 4] with the last row (0, 0, 0, 1). Public types speak degrees and
metres; a metre is a scene unit where the video has no scale of its own.
"""

import math
from dataclasses import dataclass, replace

import torch
from kornia.geometry.linalg import inverse_transformation
from torch import Tensor

from gcd_model.errors import OptionError, PoseError, ShapeError

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


# --- the pinhole camera, and the crop that brings a picture to the trained shape -------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class Intrinsics:
    """A distortion-free camera: u = fx x / z + cx, v = fy y / z + cy, all in pixels.

    u and v count from the top left corner of the picture, so a centred camera has cx = width / 2 and resizing just
    scales. An OpenCV calibration counts from the centre of the first pixel: add 0.5 to its cx and cy.
    Raises OptionError for a focal length that is not positive, ShapeError for an empty picture.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ShapeError(f"a picture must be at least 1 x 1, got {self.width} x {self.height}")
        if not all(math.isfinite(number) for number in (self.fx, self.fy, self.cx, self.cy)):
            raise OptionError(f"intrinsics must be finite, got {self}")
        if self.fx <= 0.0 or self.fy <= 0.0:
            raise OptionError(f"focal lengths must be positive pixels, got fx {self.fx:g}, fy {self.fy:g}")

    @classmethod
    def from_hfov(cls, hfov_deg: float, width: int, height: int) -> "Intrinsics":
        """A centred camera with square pixels that sees `hfov_deg` across its width.

        Raises:
            OptionError: the angle is not within 0..180 degrees.
        """
        if not 0.0 < hfov_deg < 180.0:
            raise OptionError(f"a horizontal field of view must lie between 0 and 180 degrees, got {hfov_deg:g}")
        focal = width / 2 / math.tan(math.radians(hfov_deg) / 2)
        return cls(fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)

    @property
    def matrix(self) -> Tensor:
        """float64 [3, 3], from camera axes to homogeneous pixels."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    def rays(self, device: torch.device | None = None) -> Tensor:
        """x / z and y / z through each pixel's centre: float32 [2, H, W]."""
        x = (torch.arange(self.width, dtype=torch.float32, device=device) + 0.5 - self.cx) / self.fx
        y = (torch.arange(self.height, dtype=torch.float32, device=device) + 0.5 - self.cy) / self.fy
        return torch.stack(torch.meshgrid(x, y, indexing="xy"))

    @property
    def hfov_deg(self) -> float:
        """Angle from the left to the right edge, degrees."""
        return _angle_deg(self.fx, self.cx, self.width)

    @property
    def vfov_deg(self) -> float:
        """Angle from the upper to the lower edge, degrees."""
        return _angle_deg(self.fy, self.cy, self.height)

    def resized(self, width: int, height: int) -> "Intrinsics":
        """The camera of the same picture at another size; the angles stay."""
        across, along = width / self.width, height / self.height
        fx, fy, cx, cy = self.fx * across, self.fy * along, self.cx * across, self.cy * along
        return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)

    def cropped(self, left: int, top: int, width: int, height: int) -> "Intrinsics":
        """The camera of a part of the picture, in pixels; the focal lengths stay.

        Raises:
            ShapeError: the part is empty or reaches over the edge.
        """
        if left < 0 or top < 0 or left + width > self.width or top + height > self.height:
            raise ShapeError(
                f"a crop must stay inside the {self.width} x {self.height} picture, "
                f"got {width} x {height} at ({left}, {top})"
            )
        return replace(self, cx=self.cx - left, cy=self.cy - top, width=width, height=height)


def center_crop_box(width: int, height: int, aspect: float, tolerance: float = 2e-3) -> tuple[int, int, int, int]:
    """The largest centred part of a picture that has a given shape.

    Args:
        width, height: of the picture, pixels.
        aspect: wanted width / height.
        tolerance: a picture whose own width / height is this near is taken whole.
    Returns:
        left, top, width, height of the part, whole pixels, rounded down.
    Raises:
        ShapeError: an empty picture, or a shape that leaves no pixel. OptionError: an aspect that is not positive.
    Source: the preparation of custom videos for Generative Camera Dolly.
    """
    if width < 1 or height < 1:
        raise ShapeError(f"a picture must be at least 1 x 1, got {width} x {height}")
    if not (math.isfinite(aspect) and aspect > 0.0):
        raise OptionError(f"an aspect must be a positive number, width / height, got {aspect}")
    surplus = width / height - aspect
    if abs(surplus) <= tolerance:
        return 0, 0, width, height
    kept_width, kept_height = (int(height * aspect), height) if surplus > 0 else (width, int(width / aspect))
    if kept_width < 1 or kept_height < 1:
        raise ShapeError(f"a picture of {width} x {height} has no part of aspect {aspect:g}; give a larger one")
    return (width - kept_width) // 2, (height - kept_height) // 2, kept_width, kept_height


def _angle_deg(focal: float, centre: float, size: int) -> float:
    return math.degrees(math.atan(centre / focal) + math.atan((size - centre) / focal))
