"""Videos without a camera's way: what a network learns from that continues a picture, before it learns of views.

Each side of a pair is a video; its first frame, repeated, is the condition, the video itself the target.
Source: Blattmann et al. 2023 (SVD), image-to-video, which Van Hoorick et al. 2024 (GCD) start from.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.config import CameraControl, SemanticClass
from gcd_model.geometry import CameraMount, Trajectory, pose_trajectory
from gcd_train.datasets.clip_source import ClipSource
from gcd_train.datasets.dataset4d import PairSample
from gcd_train.datasets.skips import Skips
from gcd_train.sample_loader import Samples

Bytes = NDArray[np.uint8]
_PART_SEEDS = 10**15
"""Names of the second set's clips count from here: no clip's own number is as large."""


class VideoClips:
    """A `ClipSource` of both sides of all pairs of some sets, which take turns."""

    def __init__(self, parts: Sequence[ClipSource]) -> None:
        self._parts = tuple(parts)
        longest = max(map(len, self._parts))
        self._places = [
            (part, clip, side)
            for clip in range(longest)
            for part, clips in enumerate(self._parts)
            if clip < len(clips)
            for side in (0, 1)
        ]

    def __len__(self) -> int:
        return len(self._places)

    @property
    def classes(self) -> tuple[SemanticClass, ...]:
        """None: the source's classes are not known everywhere."""
        return ()

    @property
    def fps(self) -> float:
        """Frames per second of the first set."""
        return self._parts[0].fps

    @property
    def camera(self) -> CameraControl:
        """Nobody steers a video."""
        return "none"

    @property
    def mount(self) -> CameraMount | None:
        """None: a video's camera is its own."""
        return None

    @property
    def origin(self) -> str:
        """Names the sets and their options."""
        return "-".join(("videos", *(part.origin for part in self._parts)))

    def seed(self, number: int, /) -> int:
        """Twice the pair's own number, one more for the target's side."""
        part, clip, side = self._places[number]
        return part * _PART_SEEDS + 2 * self._parts[part].seed(clip) + side

    def trajectory(self, number: int, /) -> Trajectory:
        """The camera of the view is the video's own. Raises DataError if the pair cannot be read."""
        part, clip, _ = self._places[number]
        return pose_trajectory(
            torch.eye(4, dtype=torch.float64).repeat(self._parts[part].trajectory(clip).frames, 1, 1)
        )

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """The first frame, repeated, and the video, uint8 [T, H, W, 3] each. Raises DataError."""
        part, clip, side = self._places[number]
        video = self._parts[part].rgb(clip)[side]
        return first_frame(video), video

    def target_classes(self, number: int, /) -> Bytes:
        """Zeros: there are no classes here. uint8 [T, H, W]."""
        return np.zeros(self.rgb(number)[1].shape[:3], np.uint8)


class VideoSamples:
    """Samples of a data set as videos: sample 2n is what the source camera saw of its sample n, 2n + 1 the target."""

    skips: Skips

    def __init__(self, samples: Samples) -> None:
        self._samples, self.skips = samples, samples.skips

    def __len__(self) -> int:
        return 2 * len(self._samples)

    def sample(self, index: int) -> PairSample:
        """The video of a number. Raises DataError as `Samples.sample`."""
        pair = self._samples.sample(index // 2)
        video = pair.target if index % 2 else pair.source
        still = np.tile(np.eye(4), (len(video), 1, 1))
        return replace(
            pair,
            source=first_frame(video),
            target=video,
            target_classes=None,
            source_from_target=still,
            start=None,
            deltas=None,
            visible=None,
        )


def first_frame(video: Bytes) -> Bytes:
    """uint8 [T, H, W, 3] -> its first frame, T times."""
    return np.repeat(video[:1], len(video), axis=0)
