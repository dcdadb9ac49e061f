"""What the target camera sees on average, frame number by frame number, over training clips."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gcd_train.baselines.predictor import to_pictures
from gcd_train.datasets.clip_source import Bytes, ClipSource
from gcd_train.errors import DataError


@dataclass(frozen=True, kw_only=True, slots=True)
class TargetStatistics:
    """Means over training targets, by pixel and frame number.

    mean: float32 [T, 3, H, W] in [0, 1]. majority: uint8 [T, H, W], the commonest class of each pixel; None where the
    world has no ontology.
    """

    mean: Tensor
    majority: Tensor | None = None

    @property
    def constant(self) -> "TargetStatistics":
        """The same without a place: each frame's mean colour and commonest class, everywhere in the frame."""
        colour = self.mean.mean(dim=(2, 3), keepdim=True).expand_as(self.mean)
        if self.majority is None:
            return replace(self, mean=colour)
        frames = [torch.full_like(frame, int(frame.flatten().mode().values)) for frame in self.majority]
        return replace(self, mean=colour, majority=torch.stack(frames))


def fit_statistics(clips: ClipSource, *, progress: Callable[[int, int], None] | None = None) -> TargetStatistics:
    """Mean picture and majority class of training targets.

    Args:
        clips: of one size and length, at least one.
        progress: called with (clips done, clips).
    Raises:
        DataError: there are no clips.
    """
    if len(clips) == 0:
        raise DataError("mean target and majority map want training clips, got an empty folder; generate some first")
    total = to_pictures(clips.rgb(0)[1]).double().zero_()  # [T, 3, H, W]
    votes = [np.zeros(clips.target_classes(0).shape, dtype=np.int32) for _ in clips.classes]  # K times [T, H, W]
    for index in range(len(clips)):
        total += to_pictures(clips.rgb(index)[1])
        if votes:
            _count(votes, clips.target_classes(index))
        if progress is not None:
            progress(index + 1, len(clips))
    majority = torch.from_numpy(np.stack(votes).argmax(axis=0).astype(np.uint8)) if votes else None
    return TargetStatistics(mean=(total / len(clips)).float(), majority=majority)


def _count(votes: Sequence[np.ndarray[tuple[int, ...], np.dtype[np.int32]]], labels: Bytes) -> None:
    for label, count in enumerate(votes):
        count += labels == label
