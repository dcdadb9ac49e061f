"""Cameras on a sphere about one point, which is how the network is told where to go."""

import math
from dataclasses import dataclass, replace

import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor

from gcd_model.errors import PoseError
from gcd_model.geometry.pose import pose_from_axes, relative_pose, require_rigid

LOOK_AT = (0.0, 0.0, 1.0)
"""The world point in the middle of the sphere, which every camera on it looks at, metres (Kubric-4D)."""

_COINCIDENT_M = 1e-6
_POLE_SINE = 1e-9


@dataclass(frozen=True, kw_only=True, slots=True)
class SphericalDelta:
    """Destination minus source, on the sphere. Never wrapped: 360 degrees is a full turn, not a standstill.

    azimuth_deg: positive moves the camera to its own right. elevation_deg: positive moves it up.
    radius_m: negative moves it closer.
    """

    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    radius_m: float = 0.0

    def __post_init__(self) -> None:
        _require_finite(self.azimuth_deg, self.elevation_deg, self.radius_m)


@dataclass(frozen=True, kw_only=True, slots=True)
class Spherical:
    """A camera on a sphere about LOOK_AT that looks at its middle with a level right axis.

    azimuth_deg: counter-clockwise seen from above, 0 along world x; any number, not wrapped.
    elevation_deg: above the level of LOOK_AT, in [-90, 90]. At the ends the azimuth still says which way is right.
    radius_m: distance to LOOK_AT, positive.
    Raises PoseError outside these.
    """

    azimuth_deg: float
    elevation_deg: float
    radius_m: float

    def __post_init__(self) -> None:
        _require_finite(self.azimuth_deg, self.elevation_deg, self.radius_m)
        if not -90.0 <= self.elevation_deg <= 90.0:
            raise PoseError(
                f"a camera's elevation must lie within -90..90 degrees, got {self.elevation_deg:g}: "
                "choose source and change so that it does not pass over the top"
            )
        if not self.radius_m > 0.0:
            raise PoseError(
                f"a camera's radius must be positive, got {self.radius_m:g} m: "
                "choose source and change so that it does not pass the look-at point"
            )

    def __add__(self, delta: SphericalDelta) -> "Spherical":
        """Where the camera stands after the change. Raises PoseError where no camera can stand."""
        return Spherical(
            azimuth_deg=self.azimuth_deg + delta.azimuth_deg,
            elevation_deg=self.elevation_deg + delta.elevation_deg,
            radius_m=self.radius_m + delta.radius_m,
        )

    def __sub__(self, source: "Spherical") -> SphericalDelta:
        """The change that leads from `source` to this camera, not wrapped."""
        return SphericalDelta(
            azimuth_deg=self.azimuth_deg - source.azimuth_deg,
            elevation_deg=self.elevation_deg - source.elevation_deg,
            radius_m=self.radius_m - source.radius_m,
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class DeltaFit:
    """The spherical change nearest to a rigid one, and what it leaves over.

    position_error_m: distance from the asked to the fitted position; the sphere reaches every point, so rounding only.
    rotation_error_deg: angle from the asked to the fitted orientation, in [0, 180].
    """

    delta: SphericalDelta
    position_error_m: float
    rotation_error_deg: float


def sphere_poses(views: Tensor) -> Tensor:
    """Poses of many cameras on the sphere.

        position = LOOK_AT + r (cos e cos a, cos e sin a, sin e)

    Args:
        views: [..., 3] azimuth a and elevation e in degrees, radius r in metres.
    Returns:
        world_from_camera: float64 [..., 4, 4].
    Source: Generative Camera Dolly, Kubric-4D cameras; the radius is measured from the look-at point.
    """
    views = views.to("cpu", torch.float64)
    azimuth, elevation = torch.deg2rad(views[..., :2]).unbind(-1)
    outward = torch.stack([elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()], dim=-1)
    right = torch.stack([-azimuth.sin(), azimuth.cos(), torch.zeros_like(azimuth)], dim=-1)
    position = outward.new_tensor(LOOK_AT) + views[..., 2:] * outward
    return pose_from_axes(right, torch.linalg.cross(right, outward), -outward, position)


def to_pose(view: Spherical) -> Tensor:
    """The camera as a matrix: world_from_camera, float64 [4, 4]. Equals look_at() wherever that is defined."""
    return sphere_poses(torch.tensor([view.azimuth_deg, view.elevation_deg, view.radius_m], dtype=torch.float64))


def from_pose(world_from_camera: Tensor) -> Spherical:
    """The camera on the sphere that stands where this one stands, whatever this one looks at.

    Straight above or below LOOK_AT the position has no azimuth; there the camera's right axis decides it.

    Args:
        world_from_camera: [4, 4].
    Returns:
        Its position on the sphere, azimuth in (-180, 180].
    Raises:
        PoseError: the pose is not rigid, or stands at LOOK_AT, from where no direction leads to it.
    """
    pose = require_rigid(world_from_camera, "world_from_camera")
    if pose.ndim != 2:
        raise PoseError(f"world_from_camera must be one pose [4, 4], got {list(pose.shape)}")
    x, y, z = (pose[:3, 3] - pose.new_tensor(LOOK_AT)).tolist()
    radius_m = math.hypot(x, y, z)
    if radius_m < _COINCIDENT_M:
        raise PoseError(
            f"the camera stands at the look-at point {LOOK_AT}, where it has no azimuth or elevation: move it away, "
            "or say where the source camera stands"
        )
    level_m = math.hypot(x, y)
    elevation_deg = math.degrees(math.atan2(z, level_m))
    if level_m <= _POLE_SINE * radius_m:
        right_x, right_y = pose[:2, 0].tolist()
        x, y = (right_y, -right_x) if math.hypot(right_x, right_y) >= _POLE_SINE else (1.0, 0.0)
    azimuth_deg = math.degrees(math.atan2(y, x))
    azimuth_deg = azimuth_deg if azimuth_deg > -180.0 else 180.0
    return Spherical(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)


def nearest_delta(source_from_target: Tensor, source: Spherical) -> DeltaFit:
    """The spherical change that brings the camera closest to a freely chosen pose.

    The sphere has three degrees of freedom: the position is met, the orientation is what remains.

    Args:
        source_from_target: [4, 4] rigid, metres: the asked camera as the source camera sees it.
        source: where the source camera stands; a rigid change alone does not fix a spherical one.
    Returns:
        The fit; of the equivalent azimuth changes the one nearest 0, in [-180, 180].
    Raises:
        PoseError: not one rigid pose, or the asked camera stands at LOOK_AT.
    """
    asked = to_pose(source) @ require_rigid(source_from_target, "source_from_target")
    fitted = from_pose(asked)
    rest = relative_pose(to_pose(fitted), asked)
    delta = fitted - source
    return DeltaFit(
        delta=replace(delta, azimuth_deg=math.remainder(delta.azimuth_deg, 360.0)),
        position_error_m=float(torch.linalg.vector_norm(rest[:3, 3])),
        rotation_error_deg=math.degrees(float(torch.linalg.vector_norm(rotation_matrix_to_axis_angle(rest[:3, :3])))),
    )


def _require_finite(*numbers: float) -> None:
    if not all(math.isfinite(number) for number in numbers):
        raise PoseError(f"azimuth, elevation and radius must be finite numbers, got {numbers}")
