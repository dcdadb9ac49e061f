"""What is summed over the pixels and frames of clips.

The first frame is left out everywhere: there the target camera of a gradual path stands where the source camera does.
"""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from gcd_train import metrics
from gcd_train.baselines import Prediction, to_pictures
from gcd_train.baselines.predictor import to_labels
from gcd_train.datasets.paired import PairedClip

FIRST_MEASURED = 1
"""Frames before this one, counted from 0, are not measured."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Measures:
    """Sums over measured frames; those of several clips add up. NaN where there is no picture.

    psnr_db, ssim: float64 [T-1]. gradient, change: float64 [2], of views and of targets.
    grid, full: confusion matrices int64 [K, K] at the class grid and at picture size.
    """

    clips: int
    psnr_db: Tensor
    ssim: Tensor
    gradient: Tensor
    change: Tensor
    grid: Tensor
    full: Tensor

    def __add__(self, other: Self) -> Self:
        return self._combined(other, 1)

    def __sub__(self, other: Self) -> Self:
        return self._combined(other, -1)

    def _combined(self, other: Self, sign: int) -> Self:
        return type(self)(
            clips=self.clips + sign * other.clips,
            psnr_db=self.psnr_db + sign * other.psnr_db,
            ssim=self.ssim + sign * other.ssim,
            gradient=self.gradient + sign * other.gradient,
            change=self.change + sign * other.change,
            grid=self.grid + sign * other.grid,
            full=self.full + sign * other.full,
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class TrueView:
    """What a view of a clip is compared with, worked out once for all predictors; measured frames only.

    video: float32 [T-1, 3, H, W]. gradient, change: sums over it, see `Measures`. full: class ids uint8 [T-1, H, W], or
    None; grid: the same at the class grid.
    """

    video: Tensor
    gradient: Tensor
    change: Tensor
    full: Tensor | None
    grid: Tensor | None

    @classmethod
    def of(cls, clip: PairedClip, *, grid: tuple[int, int], classes: int) -> Self:
        """The target of a clip. grid: height and width of the class grid. classes: how many there are, 0 for none."""
        video = to_pictures(clip.target)[FIRST_MEASURED:]
        labels = to_labels(clip.target_classes if classes else None)
        full = None if labels is None else labels[FIRST_MEASURED:]
        return cls(
            video=video,
            gradient=metrics.gradient_magnitude(video).double().sum(),
            change=metrics.frame_change(video).double().sum(),
            full=full,
            grid=None if full is None else metrics.majority_classes(full, *grid, classes),
        )


def measure(prediction: Prediction, true: TrueView, *, classes: int) -> Measures:
    """One clip's sums. classes: how many there are, 0 for none. Raises ShapeError."""
    psnr, ssim, gradient, change = _of_pictures(prediction.video, true)
    grid = full = torch.zeros(classes, classes, dtype=torch.int64)
    if prediction.classes is not None and true.full is not None and true.grid is not None:
        labels = prediction.classes[FIRST_MEASURED:]
        full = metrics.confusion_matrix(labels, true.full, classes)
        coarse = metrics.majority_classes(labels, true.grid.shape[-2], true.grid.shape[-1], classes)
        grid = metrics.confusion_matrix(coarse, true.grid, classes)
    return Measures(clips=1, psnr_db=psnr, ssim=ssim, gradient=gradient, change=change, grid=grid, full=full)


def _of_pictures(video: Tensor | None, true: TrueView) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    target = true.video
    if video is None:
        frames = target.new_full((len(target),), torch.nan, dtype=torch.float64)
        return frames, frames, frames[:1].expand(2), frames[:1].expand(2)
    video = video[FIRST_MEASURED:].float().cpu()
    gradient = torch.stack([metrics.gradient_magnitude(video).double().sum(), true.gradient])
    change = torch.stack([metrics.frame_change(video).double().sum(), true.change])
    return metrics.psnr(video, target).double(), metrics.ssim(video, target).double(), gradient, change
