"""Which frames of a scene make a clip: start, stride, direction of time."""

from dataclasses import dataclass

import numpy as np

from gcd_train.datasets.controls import Control
from gcd_train.errors import DataError, RecipeError

CLIP = 14
"""Frames of a clip."""


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

    def __post_init__(self) -> None:
        if self.clip < 1 or not self.strides or min(self.strides) < 1:
            raise RecipeError(f"a clip needs frames and strides from 1 up, got {self.clip} and {self.strides}")
        if not 0.0 <= self.reverse <= 1.0 or (self.latest_start is not None and self.latest_start < 0):
            raise RecipeError(
                f"a probability lies within 0..1 and a start from 0 up, got {self.reverse} and {self.latest_start}"
            )

    def last_start(self, frames: int, stride: int) -> int:
        """Largest first frame number, below 0 if no clip fits: min(frames - ((T - 1) stride + 1) - 1, latest)."""
        last = frames - ((self.clip - 1) * stride + 1) - (0 if self.reach_last else 1)
        return last if self.latest_start is None else min(last, self.latest_start)

    def draw(self, rng: np.random.Generator, frames: int) -> tuple[tuple[int, ...], int, bool]:
        """Frame numbers, stride, and whether they run backwards. Raises DataError if no clip fits."""
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
        if rng.random() < self.reverse:
            return numbers[::-1], stride, True
        return numbers, stride, False

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
