"""What one training sample is: frames and camera path, drawn as Generative Camera Dolly draws them.

A draw depends on nothing but its random generator, so `generator(seed, index)` gives the same sample in any order and
in any number of workers.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.errors import ModelError
from gcd_model.geometry import (
    DRIVING_SOURCE_POSITION,
    DRIVING_SOURCE_TARGET,
    Spherical,
    SphericalDelta,
    driving_trajectory,
    look_at,
    spherical_trajectory,
    to_pose,
)
from gcd_train.errors import DataError, RecipeError

Range = tuple[float, float]
CLIP = 14
"""Frames of a clip."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Control:
    """One evaluation sample. name: as in the file, `sample_00`. frame_start: first frame number. frame_skip: stride.

    start, goal: where the camera is at first and in the end; None in driving, whose path is fixed.
    """

    name: str
    frame_start: int
    frame_skip: int
    start: Spherical | None = None
    goal: Spherical | None = None

    def frame_numbers(self, clip: int) -> tuple[int, ...]:
        """Of a clip of so many frames."""
        return tuple(self.frame_start + self.frame_skip * step for step in range(clip))

    def fps(self, scene_fps: float) -> float:
        """Frames per second of the clip as the network is told it, rounded as published."""
        return float(round(scene_fps / self.frame_skip))


Controls = Mapping[str, tuple[Control, ...]]
"""By scene name, in the order of the file."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameSampling:
    """Which frames of a scene a clip is.

    clip: T. strides: one of them is drawn, of those for which the scene is long enough. latest_start: largest first
    frame number, None for no such limit. reach_last: let a clip end with the scene's last frame, which an off-by-one in
    the released code keeps out of reach. reverse: probability that the clip runs backwards.
    """

    clip: int = CLIP
    strides: tuple[int, ...] = (1,)
    latest_start: int | None = None
    reach_last: bool = False
    reverse: float = 0.0

    def last_start(self, frames: int, stride: int) -> int:
        """Largest first frame number, below 0 if no clip fits: min(frames - ((T - 1) stride + 1) - 1, latest)."""
        last = frames - ((self.clip - 1) * stride + 1) - (0 if self.reach_last else 1)
        return last if self.latest_start is None else min(last, self.latest_start)

    def draw(self, rng: np.random.Generator, frames: int) -> tuple[tuple[int, ...], int]:
        """Frame numbers, falling where they run backwards, and stride. Raises DataError if no clip fits."""
        fitting = [stride for stride in self.strides if self.last_start(frames, stride) >= 0]
        if not fitting:
            wanted = frames - self.last_start(frames, min(self.strides))
            left_out = "" if self.reach_last else " (the last is left out, as published, unless data.frames.reach_last)"
            raise DataError(
                f"is too short: a clip of {self.clip} at stride {min(self.strides)} wants {wanted} frames{left_out}, "
                f"got {frames}"
            )
        stride = int(rng.choice(fitting))
        start = int(rng.integers(self.last_start(frames, stride) + 1))
        numbers = tuple(range(start, start + self.clip * stride, stride))
        return (numbers[::-1] if rng.random() < self.reverse else numbers), stride

    def controlled(self, control: Control, frames: int) -> tuple[int, ...]:
        """Frame numbers a control asks for. Raises DataError if the scene does not have them."""
        numbers = control.frame_numbers(self.clip)
        if numbers[-1] >= frames:
            raise DataError(f"is too short: {control.name} asks for frame {numbers[-1]} of {frames}")
        return numbers


KUBRIC_FRAMES = FrameSampling(strides=(1, 2, 3, 4), latest_start=6, reverse=0.2)
"""Clips of Kubric-4D, 24, 12, 8 or 6 frames a second."""
DRIVING_FRAMES = FrameSampling(strides=(1, 2))
"""Clips of ParallelDomain-4D, 10 or 5 frames a second."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Draw:
    """One sample of a scene.

    frame_numbers: T numbers of the scene's frames, falling where the clip runs backwards. fps: of the clip.
    world_from_source: f64 [4, 4], it stands still. world_from_target: f64 [T, 4, 4]. The world is the scene's, or the
    vehicle in driving. start: the source on the sphere, deltas: f64 [T, 3] target minus source in azimuth and elevation
    in degrees and radius in metres; None in driving.
    """

    frame_numbers: tuple[int, ...]
    fps: float
    world_from_source: NDArray[np.float64]
    world_from_target: NDArray[np.float64]
    start: Spherical | None = None
    deltas: NDArray[np.float64] | None = None


def generator(seed: int, index: int, attempt: int = 0) -> np.random.Generator:
    """The generator of one sample; of another one for each attempt to replace it."""
    return np.random.default_rng((seed, index, attempt))


@dataclass(frozen=True, kw_only=True, slots=True)
class OrbitSampling:
    """Source and goal on the sphere about the scene (Kubric-4D).

    azimuth_deg, elevation_deg, radius_m: where the source may stand and the goal too (its azimuth may be any). The
    source's elevation is uniform in its sine, so that directions are; the goal's is uniform in degrees.
    max_azimuth_deg, max_elevation_deg, max_radius_m: largest change to the goal.
    move_time: the frame in which the camera is at the goal: the last by default (gradual), or 0 (direct).
    Source: Van Hoorick et al. 2024 (GCD), section 4; bounds of elevation as released (the paper prints 0..90 for
    max180: `elevation_deg=(0, 90)`).
    """

    max_azimuth_deg: float = 90.0
    max_elevation_deg: float = 30.0
    max_radius_m: float = 3.0
    azimuth_deg: Range = (0.0, 360.0)
    elevation_deg: Range = (0.0, 50.0)
    radius_m: Range = (12.0, 18.0)
    move_time: int | None = None
    frames: FrameSampling = KUBRIC_FRAMES

    def __post_init__(self) -> None:
        for name, (low, high) in {
            "azimuth": self.azimuth_deg,
            "elevation": self.elevation_deg,
            "radius": self.radius_m,
        }.items():
            if not low <= high:
                raise RecipeError(f"bounds of the {name} must be low, high, got {low:g}, {high:g}")
        if self.elevation_deg[0] < -90.0 or self.elevation_deg[1] > 90.0 or self.radius_m[0] <= 0.0:
            raise RecipeError(
                f"elevations lie within -90..90 degrees and radii above 0 m, got {self.elevation_deg}, {self.radius_m}"
            )

    def draw(self, rng: np.random.Generator, frames: int, fps: float) -> Draw:
        """A sample. Raises DataError if the scene is too short."""
        numbers, stride = self.frames.draw(rng, frames)
        start = self.source(rng)
        return self._draw(numbers, fps / stride, start, self.change(rng, start))

    def controlled(self, control: Control, frames: int, fps: float) -> Draw:
        """The sample of a control. Raises DataError if the scene is too short or the control has no cameras."""
        numbers = self.frames.controlled(control, frames)
        if control.start is None or control.goal is None:
            raise DataError(f"control {control.name} has no cameras: it is a driving control, give Kubric-4D's")
        return self._draw(numbers, control.fps(fps), control.start, control.goal - control.start)

    def source(self, rng: np.random.Generator) -> Spherical:
        """Where a source camera stands, uniform over the bounds' part of the sphere and in the radius."""
        low, high = (math.sin(math.radians(bound)) for bound in self.elevation_deg)
        return Spherical(
            azimuth_deg=float(rng.uniform(*self.azimuth_deg)),
            elevation_deg=math.degrees(math.asin(rng.uniform(low, high))),
            radius_m=float(rng.uniform(*self.radius_m)),
        )

    def change(self, rng: np.random.Generator, start: Spherical) -> SphericalDelta:
        """The way from a source to a goal."""
        return SphericalDelta(
            azimuth_deg=float(rng.uniform(-self.max_azimuth_deg, self.max_azimuth_deg)),
            elevation_deg=_step(rng, start.elevation_deg, self.max_elevation_deg, self.elevation_deg),
            radius_m=_step(rng, start.radius_m, self.max_radius_m, self.radius_m),
        )

    def _draw(self, numbers: tuple[int, ...], fps: float, start: Spherical, change: SphericalDelta) -> Draw:
        last = len(numbers) - 1
        move_time = last if self.move_time is None else self.move_time
        try:
            path = spherical_trajectory(start, change, frames=len(numbers), move_time=move_time)
        except ModelError as error:
            raise DataError(f"asks for a camera that cannot be: {error}") from error
        world_from_source = to_pose(start).numpy()
        deltas = None if path.delta is None else path.delta.numpy()
        return Draw(
            frame_numbers=numbers,
            fps=fps,
            world_from_source=world_from_source,
            world_from_target=world_from_source @ path.source_from_target.numpy(),
            start=start,
            deltas=deltas,
        )


MAX90 = OrbitSampling()
"""Kubric-4D, up to 90 degrees of azimuth and 30 of elevation, gradual."""
MAX180 = OrbitSampling(max_azimuth_deg=180.0, max_elevation_deg=60.0)
"""Kubric-4D, up to 180 degrees of azimuth and 60 of elevation, gradual."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DrivingSampling:
    """ParallelDomain-4D's one path, from the forward camera up and back, at a sine pace; only the frames are drawn.

    move_time: as in OrbitSampling.
    """

    move_time: int | None = None
    frames: FrameSampling = DRIVING_FRAMES

    def draw(self, rng: np.random.Generator, frames: int, fps: float) -> Draw:
        """A sample. Raises DataError if the scene is too short."""
        numbers, stride = self.frames.draw(rng, frames)
        return self._draw(numbers, fps / stride)

    def controlled(self, control: Control, frames: int, fps: float) -> Draw:
        """The sample of a control. Raises DataError if the scene is too short for it."""
        return self._draw(self.frames.controlled(control, frames), control.fps(fps))

    def _draw(self, numbers: tuple[int, ...], fps: float) -> Draw:
        last = len(numbers) - 1
        move_time = last if self.move_time is None else self.move_time
        path = driving_trajectory(frames=len(numbers), move_time=move_time)
        ends = DRIVING_SOURCE_POSITION, DRIVING_SOURCE_TARGET
        vehicle_from_source = look_at(*(torch.tensor(point, dtype=torch.float64) for point in ends)).numpy()
        return Draw(
            frame_numbers=numbers,
            fps=fps,
            world_from_source=vehicle_from_source,
            world_from_target=vehicle_from_source @ path.source_from_target.numpy(),
        )


DRIVING = DrivingSampling()
"""ParallelDomain-4D, gradual."""


Sampling: TypeAlias = OrbitSampling | DrivingSampling
"""Draws samples."""


def _step(rng: np.random.Generator, at: float, most: float, bounds: Range) -> float:
    """A change that stays within the bounds and is at most `most`; the nearest end for a start outside of them."""
    low, high = max(at - most, bounds[0]), min(at + most, bounds[1])
    return float(np.clip(rng.uniform(low, max(low, high)), *bounds)) - at


def delta_of(text: str, option: str) -> SphericalDelta:
    """`AZIMUTH,ELEVATION,RADIUS` of a command line; elevation and radius may be left out. option: as the message names
    it. Raises RecipeError."""
    try:
        azimuth_deg, elevation_deg, radius_m = (*map(float, text.split(",")), 0.0, 0.0)[:3]
    except ValueError:
        raise RecipeError(f"{option}AZIMUTH,ELEVATION,RADIUS wants numbers such as 30,15,0, got {text!r}") from None
    return SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)
