"""One loaded checkpoint as its users need to know it: its family, its own facts, and the views it can give."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

import msgspec
import torch
from torch import Tensor

from gcd_model.config import ModelConfig, SemanticClass, SplatDepth
from gcd_model.errors import OptionError, PoseError, ShapeError, ViewFixedError, ViewRangeError
from gcd_model.geometry import (
    CameraMount,
    Spherical,
    SphericalDelta,
    Trajectory,
    driving_trajectory,
    fitted_trajectory,
    look_at,
    motion_bucket,
    pose_trajectory,
    relative_pose,
    spherical_trajectory,
)
from gcd_model.live.config import LiveConfig
from gcd_model.weights.card import KUBRIC90, LIVE_LENS_DEG, Card

_LOG = logging.getLogger(__name__)
_TOLERATED_DEG = 0.05

ASSUMED_SOURCE = Spherical(azimuth_deg=0.0, elevation_deg=5.0, radius_m=15.0)
"""Where the source camera is taken to stand when nobody says: low, looking at the scene's centre."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Traits(Card):
    """One loaded checkpoint as its users need to know it: what it says of itself, and where it runs.

    sha256_12: 12 hex digits that name the weights: of SHA-256 over the file, over samples of it above 512 MiB.
    """

    sha256_12: str
    precision: str
    device: str
    ASSUMED_SOURCE: ClassVar[Spherical] = ASSUMED_SOURCE

    @classmethod
    def of(cls, card: Card, *, sha256_12: str, precision: str, device: str) -> Self:
        """What a card says, and where the model runs."""
        facts = {field.name: getattr(card, field.name) for field in fields(Card)}
        return cls(**facts, sha256_12=sha256_12, precision=precision, device=device)

    @staticmethod
    def assumed_hfov_deg(*, on_sphere: bool) -> float:
        """Field of view that the live model takes a camera to have where nobody states one: of the orbits' training for
        a camera on a sphere, else of the vehicle's."""
        orbits = KUBRIC90.hfov_deg
        return orbits if on_sphere and orbits is not None else CameraMount().hfov_deg

    @property
    def lens_deg(self) -> tuple[float, float] | None:
        """The narrowest and the widest field of view of the training; None where the family does not say."""
        if self.live:
            return LIVE_LENS_DEG
        hfov_deg = None if self.family is None else self.family.hfov_deg
        return None if hfov_deg is None else (hfov_deg, hfov_deg)

    @property
    def ood_threshold(self) -> float | None:
        """`View.ood` above which the source shows another world than the training's; None for models without."""
        return self.config.ood_threshold if isinstance(self.config, LiveConfig) else None

    @property
    def takes_any_pose(self) -> bool:
        """Whether views may stand anywhere and look anywhere."""
        return self.config.camera == "relative_pose" and (self.family is None or self.family.limits is None)

    @property
    def splat(self) -> SplatDepth:
        """See ModelConfig; the live model has its own points."""
        return "none" if isinstance(self.config, LiveConfig) else self.config.splat

    @property
    def fps(self) -> float:
        """The frame rate the network is told when nobody says another."""
        return 12.0 if self.family is None else self.family.fps

    @property
    def rates(self) -> tuple[float, ...]:
        """Trained frame rates; empty if any will do."""
        return () if self.family is None else self.family.rates

    @property
    def knows_camera(self) -> bool:
        """Whether anybody knows where the views' camera stands: not for checkpoints that nobody steers."""
        return self.config.camera != "none" or (self.family is not None and self.family.name.startswith("driving"))

    @property
    def classes(self) -> tuple[SemanticClass, ...]:
        """Ontology of the views' class maps, by id; empty for a model that makes none."""
        if isinstance(self.config, LiveConfig):
            return self.config.classes
        return self.painted_classes

    @property
    def painted_classes(self) -> tuple[SemanticClass, ...]:
        """The classes whose colours the pictures are painted in; empty for a model of photographs."""
        paints = self.family is not None and self.family.output == "semantic"
        return self.config.semantic_classes if paints and isinstance(self.config, ModelConfig) else ()

    def streaming(self) -> "Traits":
        """Of the same model frame by frame: of clips of one frame. Itself for a model that cannot, see
        FrameSynthesizer."""
        return replace(self, config=msgspec.structs.replace(self.config, frames=1)) if self.live else self

    def check_size(self, height: int, width: int) -> None:
        """Raises OptionError if the network cannot take frames of this size."""
        factor = self.config.size_factor
        if height % factor or width % factor or min(height, width) < factor:
            raise OptionError(
                f"height and width must be multiples of {factor} for {self.name}, got {height}x{width}; "
                f"the trained size is {self.config.height}x{self.config.width}"
            )

    def check_lengths(self, frames: int, trajectories: Sequence[Trajectory]) -> None:
        """Raises ShapeError unless there are paths, and they and the features have as many frames as a clip."""
        if not trajectories:
            raise ShapeError("at least one trajectory is wanted, got none")
        for length in (frames, *(path.frames for path in trajectories)):
            if length != self.config.frames:
                raise ShapeError(f"{self.name} works on {self.config.frames} frames, got {length}")

    def motion_bucket(self, trajectory: Trajectory) -> float:
        """The motion number for a camera path. Raises OptionError where only the user can know it.

        Source: Van Hoorick et al. 2024 (GCD), appendix, with the angle ranges of the released configurations.
        """
        if self.family is not None and self.family.motion_bucket is not None:
            return self.family.motion_bucket
        if self.family is None or self.family.limits is None or trajectory.goal_delta is None:
            raise OptionError(
                f"the motion number cannot be worked out for {self.name}: its family or the path's angles are not "
                "known; give --motion-bucket, or name the family with --family"
            )
        limits = self.family.limits
        return motion_bucket(
            trajectory.goal_delta, max_azimuth_deg=limits.azimuth_deg, max_elevation_deg=limits.elevation_deg
        )

    def plan_view(
        self,
        delta: SphericalDelta | None = None,
        *,
        source: Spherical | None = None,
        move_time: int | None = None,
        mount: CameraMount | None = None,
    ) -> Trajectory:
        """The camera path to a goal given as differences of angles and radius.

        Args:
            delta: destination minus source; None for the checkpoint's own fixed view. The live model's is the one above
                and behind the vehicle, unless `source` is given.
            source: where the source camera stands, if known; absolute limits are checked only then.
            move_time: frame in which the goal is reached, instead of the checkpoint's.
            mount: how the source camera sits on its vehicle, for the live model, which orbits about what the camera
                looks at; None as trained. The clip must name the same.
        Raises:
            ViewFixedError: the checkpoint takes no camera command.
            ViewRangeError: the goal lies outside the family's limits.
            OptionError: a mount was given to another model than the live one.
        """
        frames, move_time = self.config.frames, self.move_time if move_time is None else move_time
        if self.live and source is None and delta is None:
            return driving_trajectory(frames=frames, move_time=move_time, mount=mount)
        if self.live:
            source = source or _orbit_of(mount)
        elif mount is not None:
            raise OptionError(f"{self.name} has no use for a camera mount; leave the mount out")
        if self.config.camera == "none":
            return self._fixed_view(delta, move_time)
        delta = SphericalDelta() if delta is None else delta
        self._check_limits(delta, source)
        pace = "linear" if self.family is None else self.family.interpolation
        start = source or ASSUMED_SOURCE
        return spherical_trajectory(start, delta, frames=frames, move_time=move_time, interpolation=pace)

    def plan_placed(
        self, position_m: tuple[float, ...], look_at_m: tuple[float, ...], *, mount: CameraMount | None = None
    ) -> Trajectory:
        """The path of a camera that stands at a point and looks at another, upright, in every frame.

        Args:
            position_m, look_at_m: (x, y, z) in the frame of what the source camera is mounted on: x ahead, y left, z
                up, the ground at z = 0.
            mount: of the source camera; None for CameraMount().
        Raises:
            OptionError: the checkpoint does not take any pose. PoseError: not finite, or it looks straight up or down.
        """
        if not self.takes_any_pose:
            raise OptionError(f"{self.name} takes no position_m and look_at_m; give azimuth, elevation and radius")
        points = (torch.tensor(point, dtype=torch.float64) for point in (position_m, look_at_m))
        pose = relative_pose((mount or CameraMount()).vehicle_from_camera, look_at(*points))
        return self.plan_poses(pose.repeat(self.config.frames, 1, 1))

    def plan_poses(self, source_from_target: Tensor, *, source: Spherical | None = None) -> Trajectory:
        """A camera path given as rigid transforms [T, 4, 4].

        A checkpoint with spherical control gets the nearest angles and radius, frame by frame; one with relative
        poses gets them as they are.
        Raises: ViewFixedError, ViewRangeError, PoseError, OptionError as `plan_view`.
        """
        if self.config.camera == "none":
            raise ViewFixedError(f"{self.name} has one fixed view and takes no poses; leave the poses out")
        if source_from_target.shape[:1] != (self.config.frames,):
            raise PoseError(f"poses must be [{self.config.frames}, 4, 4], got {list(source_from_target.shape)}")
        if self.takes_any_pose:
            return pose_trajectory(source_from_target)
        fitted, turned_deg = fitted_trajectory(source_from_target, source or ASSUMED_SOURCE)
        assert fitted.delta is not None
        for azimuth, elevation, radius in fitted.delta.tolist():
            self._check_limits(SphericalDelta(azimuth_deg=azimuth, elevation_deg=elevation, radius_m=radius), source)
        if self.config.camera != "spherical":
            return replace(fitted, source_from_target=pose_trajectory(source_from_target).source_from_target)
        if turned_deg > _TOLERATED_DEG:
            _LOG.warning(
                "the network is steered by angles and radius: the nearest path turns the asked poses by up to %.3g "
                "degrees",
                turned_deg,
            )
        return fitted

    def _fixed_view(self, delta: SphericalDelta | None, move_time: int) -> Trajectory:
        if delta is not None and delta != SphericalDelta():
            raise ViewFixedError(
                f"{self.name} has one fixed view and takes no camera command; leave azimuth, elevation and radius out"
            )
        if self.knows_camera:
            return driving_trajectory(frames=self.config.frames, move_time=move_time)
        return pose_trajectory(torch.eye(4, dtype=torch.float64).repeat(self.config.frames, 1, 1))

    def _check_limits(self, delta: SphericalDelta, source: Spherical | None) -> None:
        if self.family is None or self.family.limits is None:
            return
        allowed, slack = self.family.limits.allowed(source), 1e-6
        for axis, (low, high) in allowed.items():
            value = getattr(delta, axis)
            if low > high + slack:
                raise ViewRangeError(
                    f"{axis} {getattr(source, axis):g} of the source camera is so far from where {self.family.name} "
                    "was trained that no view can be reached; correct it (a radius is in units of the trained scenes)",
                    allowed,
                )
            if not low - slack <= value <= high + slack:
                raise ViewRangeError(
                    f"{axis} {value:g} is outside [{low:g}, {high:g}], the limits of {self.family.name}; "
                    "choose a view inside, or another checkpoint",
                    allowed,
                )


def _orbit_of(mount: CameraMount | None) -> Spherical:
    """The sphere that a camera on a vehicle orbits on: about the point of the ground that it looks at, at most as far
    away as ASSUMED_SOURCE's; that one without a mount."""
    if mount is None:
        return ASSUMED_SOURCE
    falling = math.sin(math.radians(mount.tilt_deg))
    reach_m = ASSUMED_SOURCE.radius_m
    radius_m = min(reach_m, mount.height_m / falling) if falling > 0 else reach_m
    return Spherical(azimuth_deg=0.0, elevation_deg=mount.tilt_deg, radius_m=radius_m)
