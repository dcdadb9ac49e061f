"""Which pictures of a scene the fixed driving path ever asks for.

The source picture of a frame depends on its time t alone. The target picture depends on t and on how far along the
path the camera is, the position i = 0..13; stride and start do not matter beyond t = start + i * stride. In a scene of
50 frames (T = 14, strides 1 and 2, the last frame is never reached, as published) that leaves

    sources   49    t = 0..48
    gradual   504   pairs (t, i) with 0 <= t - i <= 35: every pair of stride 2 is also one of stride 1
    direct    49    pairs (t, 13), of which gradual has 36
    both      517

instead of the 2 x 14 x 59 = 1652 pictures of all 59 clips one by one.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, get_args

import msgspec

from gcd_train.errors import RecipeError

PathKind = Literal["gradual", "direct"]


@dataclass(frozen=True, order=True, slots=True)
class ClipPlace:
    """A clip within a scene: frames start, start + stride, ..."""

    start: int
    stride: int


class ClipPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The clips that training takes from a scene.

    clip_frames: T. strides: in frames of the scene. paths: gradual reaches the goal at T - 1, direct stands there.
    Source: Generative Camera Dolly, ParallelDomain-4D, as released.
    """

    clip_frames: int = 14
    strides: tuple[int, ...] = (1, 2)
    paths: tuple[PathKind, ...] = ("gradual", "direct")

    def __post_init__(self) -> None:
        if self.clip_frames < 2 or not self.strides or min(self.strides) < 1:
            raise RecipeError(
                f"a plan needs clips of 2 frames or more and strides of 1 or more, got {self.clip_frames} frames and "
                f"strides {self.strides}"
            )
        if not self.paths or not set(self.paths) <= set(get_args(PathKind)):
            raise RecipeError(f"paths must be some of {', '.join(get_args(PathKind))}, got {self.paths}")

    def times(self, place: ClipPlace) -> range:
        """The frames of a clip."""
        return range(place.start, place.start + self.clip_frames * place.stride, place.stride)

    def position(self, path: PathKind, index: int) -> int:
        """Where on the path the camera of a clip's frame `index` is, 0 (source) .. T - 1 (goal)."""
        return index if path == "gradual" else self.clip_frames - 1

    def clips(self, frames: int, there: Collection[int]) -> list[ClipPlace]:
        """All clips of a scene of `frames` frames, of which those in `there` can be had; ordered by stride, start."""
        places = [
            ClipPlace(start, stride)
            for stride in self.strides
            for start in range(frames - (self.clip_frames - 1) * stride - 1)
        ]
        return [place for place in places if all(time in there for time in self.times(place))]

    def pairs(self, frames: int, there: Collection[int]) -> list[tuple[int, int]]:
        """The (time, position) of every target picture those clips need, each once, in order."""
        return sorted(
            {
                (time, self.position(path, index))
                for place in self.clips(frames, there)
                for index, time in enumerate(self.times(place))
                for path in self.paths
            }
        )
