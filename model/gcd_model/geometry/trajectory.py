"""Camera paths: one pose per frame, seen from the source camera, which stands still."""

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from torch import Tensor

from gcd_model.errors import OptionError, ShapeError
from gcd_model.geometry.pose import CameraMount, look_at, relative_pose, require_rigid
from gcd_model.geometry.spherical import DeltaFit, Spherical, SphericalDelta, nearest_delta, sphere_poses, to_pose

Interpolation = Literal["linear", "sine"]

DRIVING_SOURCE_POSITION = (1.6, 0.0, 1.55)
"""ParallelDomain-4D: the forward camera in the vehicle's frame (x ahead, y left, z up), metres."""
DRIVING_SOURCE_TARGET = (6.6, 0.0, 1.55)
"""What it looks at."""
DRIVING_GOAL_POSITION = (-8.0, 0.0, 8.0)
"""ParallelDomain-4D: the virtual camera above and behind the vehicle."""
DRIVING_GOAL_TARGET = (5.6, 0.0, 1.55)
"""What it looks at."""

_SAME_POSE = 1e-9


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Trajectory:
    """Where the camera of a view is in each of T frames.

    source_from_target: float64 [T, 4, 4], metres.
    delta: float64 [T, 3], the same as azimuth and elevation in degrees and radius in metres, destination minus source;
        None for a path that is not on the sphere.
    at_goal: whether the camera stands at its goal pose, T flags.
    source: where the source camera stands, if that is known or assumed.
    Raises ShapeError where sizes disagree, PoseError where a pose is not rigid.
    """

    source_from_target: Tensor
    delta: Tensor | None
    at_goal: tuple[bool, ...]
    source: Spherical | None

    def __post_init__(self) -> None:
        _require_pose_list(self.source_from_target)
        if self.source_from_target.dtype != torch.float64:
            raise ShapeError(f"source_from_target must be float64, got {self.source_from_target.dtype}")
        if len(self.at_goal) != self.frames:
            raise ShapeError(f"at_goal must have one flag for each of {self.frames} poses, got {len(self.at_goal)}")
        delta = self.delta
        if delta is not None and (delta.shape != (self.frames, 3) or delta.dtype != torch.float64):
            raise ShapeError(f"delta must be float64 [{self.frames}, 3], got {delta.dtype} {list(delta.shape)}")
        if delta is not None and not bool(delta.isfinite().all()):
            raise ShapeError("delta holds NaN or infinite numbers; changes must be finite")

    @property
    def frames(self) -> int:
        """T."""
        return self.source_from_target.shape[0]

    @property
    def goal_delta(self) -> SphericalDelta | None:
        """The whole change, from the source camera to the last frame's; None for a path that is not on the sphere."""
        if self.delta is None:
            return None
        azimuth_deg, elevation_deg, radius_m = self.delta[-1].tolist()
        return SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)


def path_progress(frames: int, move_time: int, interpolation: Interpolation = "linear") -> Tensor:
    """The share `a` of the way from source to goal that is done in frame t.

        linear: a = t / move_time        sine: a = (1 - cos(pi t / move_time)) / 2        t >= move_time: a = 1

    Args:
        frames: T.
        move_time: the frame in which the goal is reached; T - 1 is gradual, 0 is direct.
    Returns:
        float64 [T] in [0, 1].
    Raises:
        OptionError: no frames, an unknown interpolation, or a goal that T frames cannot reach.
    Source: Van Hoorick et al. 2024 (GCD), section 3; in the sine as printed pi stands in the wrong place.
    """
    if interpolation not in get_args(Interpolation):
        raise OptionError(f"interpolation must be one of {get_args(Interpolation)}, got {interpolation!r}")
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
    position = torch.lerp(_point(DRIVING_SOURCE_POSITION), _point(DRIVING_GOAL_POSITION), done)  # [T, 3]
    target = torch.lerp(_point(DRIVING_SOURCE_TARGET), _point(DRIVING_GOAL_TARGET), done)
    return pose_trajectory(relative_pose((mount or CameraMount()).vehicle_from_camera, look_at(position, target)))


def pose_trajectory(source_from_target: Tensor) -> Trajectory:
    """A free path; the last pose is the goal.

    Args:
        source_from_target: [T, 4, 4] rigid, metres.
    Raises:
        ShapeError, PoseError: not a list of rigid poses.
    """
    poses = _require_pose_list(source_from_target)
    return Trajectory(source_from_target=poses, delta=None, at_goal=_at_last_pose(poses), source=None)


def fitted_trajectory(source_from_target: Tensor, source: Spherical) -> tuple[Trajectory, list[DeltaFit]]:
    """The path over the sphere nearest to a free path, for a network that is told spherical changes only.

    Args:
        source_from_target: [T, 4, 4] rigid, metres: the asked path.
        source: where the source camera stands.
    Returns:
        The fitted path (its poses are the fitted, not the asked ones), and for each frame the fit with what it leaves
        over. The azimuth starts from the value nearest 0 and does not jump: full turns are kept.
    Raises:
        ShapeError, PoseError: not a list of rigid poses, or one of them stands at the look-at point.
    """
    asked = _require_pose_list(source_from_target)
    fits: list[DeltaFit] = []
    azimuth_deg = 0.0
    for pose in asked.unbind(0):
        fit = nearest_delta(pose, source)
        azimuth_deg += math.remainder(fit.delta.azimuth_deg - azimuth_deg, 360.0)
        fits.append(replace(fit, delta=replace(fit.delta, azimuth_deg=azimuth_deg)))
    return _trajectory_on_sphere(source, torch.stack([_numbers(fit.delta) for fit in fits])), fits


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
    return Trajectory(source_from_target=poses, delta=deltas, at_goal=_at_last_pose(poses), source=source)


def _at_last_pose(poses: Tensor) -> tuple[bool, ...]:
    # By pose, not by time: a camera that is asked to stay stands at its goal from the first frame on.
    apart = (poses - poses[-1]).abs().amax(dim=(-2, -1))
    return tuple((apart <= _SAME_POSE).tolist())


def _numbers(view: Spherical | SphericalDelta) -> Tensor:
    return torch.tensor([view.azimuth_deg, view.elevation_deg, view.radius_m], dtype=torch.float64)


def _point(xyz: tuple[float, float, float]) -> Tensor:
    return torch.tensor(xyz, dtype=torch.float64)


def _require_pose_list(poses: Tensor) -> Tensor:
    if poses.ndim != 3 or poses.shape[0] < 1:
        raise ShapeError(f"source_from_target must be [T, 4, 4], one pose per frame, got {list(poses.shape)}")
    return require_rigid(poses, "source_from_target")


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
