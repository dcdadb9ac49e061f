"""Cameras on a sphere about one point, which is how the network is told where to go, and paths of cameras.

A path has one pose per frame, seen from the source camera, which stands still.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor

from gcd_model.errors import OptionError, PoseError, ShapeError
from gcd_model.geometry.pose import CameraMount, Intrinsics, look_at, pose_from_axes, relative_pose, require_rigid

Interpolation = Literal["linear", "sine"]

LOOK_AT = (0.0, 0.0, 1.0)
"""The world point in the middle of the sphere, which every camera on it looks at, metres (Kubric-4D)."""

_COINCIDENT_M, _POLE_SINE, _SAME_POSE = 1e-6, 1e-9, 1e-9
_AXES = ("azimuth_deg", "elevation_deg", "radius_m")


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
        _require_finite(self)


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
        _require_finite(self)
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
        return Spherical(**{axis: getattr(self, axis) + getattr(delta, axis) for axis in _AXES})

    def __sub__(self, source: "Spherical") -> SphericalDelta:
        """The change that leads from `source` to this camera, not wrapped."""
        return SphericalDelta(**{axis: getattr(self, axis) - getattr(source, axis) for axis in _AXES})


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
    return sphere_poses(_numbers(view))


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


def nearest_delta(source_from_target: Tensor, source: Spherical) -> tuple[SphericalDelta, float]:
    """The spherical change that brings the camera closest to a freely chosen pose.

    The sphere has three degrees of freedom: the position is met, the orientation is what remains.

    Args:
        source_from_target: [4, 4] rigid, metres: the asked camera as the source camera sees it.
        source: where the source camera stands; a rigid change alone does not fix a spherical one.
    Returns:
        The change, of equivalent azimuths the one nearest 0, in [-180, 180]; and the angle from the asked to the fitted
        orientation, in [0, 180] degrees.
    Raises:
        PoseError: not one rigid pose, or the asked camera stands at LOOK_AT.
    """
    asked = to_pose(source) @ require_rigid(source_from_target, "source_from_target")
    fitted = from_pose(asked)
    delta, rest = fitted - source, relative_pose(to_pose(fitted), asked)
    turn = torch.linalg.vector_norm(rotation_matrix_to_axis_angle(rest[:3, :3]))
    return replace(delta, azimuth_deg=math.remainder(delta.azimuth_deg, 360.0)), math.degrees(float(turn))


def _numbers(view: Spherical | SphericalDelta) -> Tensor:
    return torch.tensor([getattr(view, axis) for axis in _AXES], dtype=torch.float64)


def _require_finite(view: Spherical | SphericalDelta) -> None:
    if not bool(_numbers(view).isfinite().all()):
        raise PoseError(f"azimuth, elevation and radius must be finite numbers, got {view}")


# --- paths ------------------------------------------------------------------------------------------------------------


DRIVING_SOURCE_POSITION = (1.6, 0.0, 1.55)
"""ParallelDomain-4D: the forward camera in the vehicle's frame (x ahead, y left, z up), metres."""
DRIVING_SOURCE_TARGET = (6.6, 0.0, 1.55)
"""What it looks at."""
DRIVING_GOAL_POSITION = (-8.0, 0.0, 8.0)
"""ParallelDomain-4D: the virtual camera above and behind the vehicle."""
DRIVING_GOAL_TARGET = (5.6, 0.0, 1.55)
"""What it looks at."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Trajectory:
    """Where the camera of a view is in each of T frames.

    source_from_target: float64 [T, 4, 4], metres; the last pose is the goal.
    delta: float64 [T, 3], the same as azimuth and elevation in degrees and radius in metres, destination minus source;
        None for a path that is not on the sphere.
    source: where the source camera stands, if that is known or assumed.
    lens: of the view, which the live model can give another than the source's; None: the source's.
    Raises ShapeError where sizes disagree, PoseError where a pose is not rigid.
    """

    source_from_target: Tensor
    delta: Tensor | None = None
    source: Spherical | None = None
    lens: Intrinsics | None = None

    def __post_init__(self) -> None:
        poses, delta = self.source_from_target, self.delta
        if poses.ndim != 3 or not len(poses) or poses.dtype != torch.float64:
            found = f"{poses.dtype} {list(poses.shape)}"
            raise ShapeError(f"source_from_target must be float64 [T, 4, 4], one pose per frame, got {found}")
        require_rigid(poses, "source_from_target")
        if delta is not None and (
            delta.shape != (self.frames, 3) or delta.dtype != torch.float64 or not bool(delta.isfinite().all())
        ):
            found = f"{delta.dtype} {list(delta.shape)}"
            raise ShapeError(f"delta must be float64 [{self.frames}, 3] and finite, got {found}")

    @property
    def frames(self) -> int:
        """T."""
        return self.source_from_target.shape[0]

    @property
    def at_goal(self) -> tuple[bool, ...]:
        """Whether the camera stands at its goal pose, T flags; one that is asked to stay does from the first frame."""
        apart = (self.source_from_target - self.source_from_target[-1]).abs().amax(dim=(-2, -1))
        return tuple((apart <= _SAME_POSE).tolist())

    @property
    def goal_delta(self) -> SphericalDelta | None:
        """The whole change, from the source camera to the last frame's; None for a path that is not on the sphere."""
        return None if self.delta is None else SphericalDelta(**dict(zip(_AXES, self.delta[-1].tolist(), strict=True)))


def path_progress(frames: int, move_time: int, interpolation: Interpolation = "linear") -> Tensor:
    """The share `a` of the way from source to goal that is done in frame t.

        linear: a = t / move_time        sine: a = (1 - cos(pi t / move_time)) / 2        t >= move_time: a = 1

    Args:
        frames: T.
        move_time: the frame in which the goal is reached; T - 1 is gradual, 0 is direct.
    Returns:
        float64 [T] in [0, 1].
    Raises:
        OptionError: no frames, or a goal that T frames cannot reach.
    Source: Van Hoorick et al. 2024 (GCD), section 3; in the sine as printed pi stands in the wrong place.
    """
    if not 0 <= move_time < frames:
        raise OptionError(
            f"move_time must lie between 0 (direct) and {max(frames - 1, 0)} (gradual) for {frames} frames, "
            f"got {move_time}"
        )
    moving = torch.arange(move_time, dtype=torch.float64) / max(move_time, 1)  # [move_time]
    share = moving if interpolation == "linear" else torch.sin(moving * (math.pi / 2)) ** 2  # = (1 - cos(pi a)) / 2
    return torch.cat([share, share.new_ones(frames - move_time)])


def spherical_trajectory(
    source: Spherical,
    delta: SphericalDelta,
    *,
    frames: int,
    move_time: int,
    interpolation: Interpolation = "linear",
) -> Trajectory:
    """A path over the sphere, interpolated in azimuth, elevation and radius.

    Args:
        source: where the source camera stands.
        delta: the whole change.
        frames, move_time, interpolation: see path_progress().
    Raises:
        OptionError: see path_progress().
        PoseError: no camera can stand at the goal (over the top, or no distance left).
    Source: Generative Camera Dolly, Kubric-4D; linear, gradual or direct.
    """
    _ = source + delta  # a goal where no camera can stand is an error before any step towards it
    return _trajectory_on_sphere(source, path_progress(frames, move_time, interpolation)[:, None] * _numbers(delta))


def driving_trajectory(*, frames: int, move_time: int, mount: CameraMount | None = None) -> Trajectory:
    """ParallelDomain-4D's one path: from the forward camera to one above and behind the vehicle.

    Position and looked-at point move separately, each straight and at a sine pace.

    Args:
        frames, move_time: see path_progress().
        mount: where the source camera really is, None for the data set's. The path stays where it is in the vehicle's
            frame; only the poses seen from the source camera change.
    Source: Generative Camera Dolly, ParallelDomain-4D, as released; other mounts are ours.
    """
    done = path_progress(frames, move_time, "sine")[:, None]
    points = (DRIVING_SOURCE_POSITION, DRIVING_GOAL_POSITION, DRIVING_SOURCE_TARGET, DRIVING_GOAL_TARGET)
    start, goal, from_target, to_target = (torch.tensor(point, dtype=torch.float64) for point in points)
    position, target = torch.lerp(start, goal, done), torch.lerp(from_target, to_target, done)  # [T, 3] each
    return pose_trajectory(relative_pose((mount or CameraMount()).vehicle_from_camera, look_at(position, target)))


def pose_trajectory(source_from_target: Tensor) -> Trajectory:
    """A free path: [T, 4, 4] rigid, metres. Raises as `Trajectory`."""
    return Trajectory(source_from_target=source_from_target.to("cpu", torch.float64))


def fitted_trajectory(source_from_target: Tensor, source: Spherical) -> tuple[Trajectory, float]:
    """The path over the sphere nearest to a free path, for a network that is told spherical changes only.

    Args:
        source_from_target: [T, 4, 4] rigid, metres: the asked path.
        source: where the source camera stands.
    Returns:
        The fitted path (its poses are the fitted, not the asked ones) and the largest angle that an orientation is left
        turned by, degrees. The azimuth starts from the value nearest 0 and does not jump: full turns are kept.
    Raises:
        ShapeError, PoseError: not a list of rigid poses, or one of them stands at the look-at point.
    """
    rows, turned_deg, azimuth_deg = list[Tensor](), 0.0, 0.0
    for pose in pose_trajectory(source_from_target).source_from_target:
        delta, turn_deg = nearest_delta(pose, source)
        azimuth_deg += math.remainder(delta.azimuth_deg - azimuth_deg, 360.0)
        rows.append(_numbers(replace(delta, azimuth_deg=azimuth_deg)))
        turned_deg = max(turned_deg, turn_deg)
    return _trajectory_on_sphere(source, torch.stack(rows)), turned_deg


def motion_bucket(delta: SphericalDelta, *, max_azimuth_deg: float, max_elevation_deg: float) -> int:
    """The number that tells the network how far the camera moves.

        round(255 * |(d_azimuth, d_elevation)| / |(max_azimuth, max_elevation)|), not clamped beyond 255

    Args:
        delta: the whole change; the radius does not count.
        max_azimuth_deg, max_elevation_deg: the largest change the checkpoint was trained for.
    Raises:
        OptionError: both limits are 0.
    Source: Generative Camera Dolly, Kubric-4D, as released.
    """
    largest_deg = math.hypot(max_azimuth_deg, max_elevation_deg)
    if not largest_deg > 0.0:
        raise OptionError("the motion number needs a largest angle above 0; give the motion number itself instead")
    return round(255.0 * (math.hypot(delta.azimuth_deg, delta.elevation_deg) / largest_deg))


def _trajectory_on_sphere(source: Spherical, deltas: Tensor) -> Trajectory:
    poses = relative_pose(to_pose(source), sphere_poses(_numbers(source) + deltas))  # [T, 4, 4]
    return Trajectory(source_from_target=poses, delta=deltas, source=source)


# --- a destination that swings to and fro ----------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class Orbit:
    """A swing in azimuth about the source camera, between -amplitude and +amplitude.

    rate_deg_s: speed along `direction`; negative swings the other way.
    amplitude_deg: where it turns round, 0 or more.
    azimuth_deg: where it is now, within the amplitude.
    direction: 1 or -1, flips at each turn.
    Raises OptionError outside these.
    """

    rate_deg_s: float
    amplitude_deg: float
    azimuth_deg: float = 0.0
    direction: int = 1

    def __post_init__(self) -> None:
        if not all(math.isfinite(number) for number in (self.rate_deg_s, self.amplitude_deg, self.azimuth_deg)):
            raise OptionError(f"an orbit needs finite numbers, got {self}")
        if self.amplitude_deg < 0.0 or abs(self.azimuth_deg) > self.amplitude_deg:
            raise OptionError(
                f"an orbit's azimuth must lie within its amplitude, a number from 0 up: "
                f"got {self.azimuth_deg:g} and {self.amplitude_deg:g} degrees"
            )
        if self.direction not in (1, -1):
            raise OptionError(f"an orbit's direction must be 1 or -1, got {self.direction}")

    @property
    def delta(self) -> SphericalDelta:
        """The destination now, as a change from the source camera."""
        return SphericalDelta(azimuth_deg=self.azimuth_deg)

    def advanced(self, seconds: float) -> "Orbit":
        """The orbit some time later (earlier, if negative), reflected as often as the time asks for.

        Advancing by a and then by b is advancing by a + b, so windows may come in any rhythm.

        Raises:
            OptionError: the time is not finite.
        """
        if not math.isfinite(seconds):
            raise OptionError(f"an orbit advances by a finite time, got {seconds} s")
        if self.rate_deg_s == 0.0 or self.amplitude_deg == 0.0:
            return self
        amplitude = self.amplitude_deg
        rising = self.direction if self.rate_deg_s > 0.0 else -self.direction
        # Travelled since the last turn at -amplitude: up 2 amplitudes, then down 2.
        done = self.azimuth_deg + amplitude if rising > 0 else 2.0 * amplitude + (amplitude - self.azimuth_deg)
        phase = (done + abs(self.rate_deg_s) * seconds) % (4.0 * amplitude)
        if phase < 2.0 * amplitude:
            return replace(self, azimuth_deg=phase - amplitude, direction=self.direction * rising)
        # In this order each step rounds towards the limit, never beyond it.
        return replace(self, azimuth_deg=amplitude - (phase - 2.0 * amplitude), direction=-self.direction * rising)
