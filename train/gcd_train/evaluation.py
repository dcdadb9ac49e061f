"""Predictors against held-out clips: figures of each clip, of all together, and how sure those are.

The first frame is left out everywhere: there the target camera stands where the source camera does.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Protocol, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model import Clip, ViewSynthesizer
from gcd_model.class_head import SemanticClass
from gcd_model.geometry import CameraMount
from gcd_train import metrics
from gcd_train.baselines import Prediction, Predictor, SourceClip, to_pictures
from gcd_train.datasets.clip_source import ClipSource, to_network
from gcd_train.datasets.paired import PairedClip
from gcd_train.errors import DataError

FIRST_MEASURED = 1
"""Frames before this one, counted from 0, are not measured."""


class HeldOutClips(ClipSource, Protocol):
    """Clips to be measured on; `PairedClips` is one. frames, height, width: T, H and W of each."""

    def __getitem__(self, number: int, /) -> PairedClip: ...
    @property
    def fps(self) -> float: ...
    @property
    def frames(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def width(self) -> int: ...


@dataclass(frozen=True, kw_only=True, slots=True)
class SynthesizedViews:
    """A model as it ships: its own sampler settings, its fixed view.

    mount: what is declared for the source camera; None for the trained one.
    """

    synthesizer: ViewSynthesizer
    fps: float
    mount: CameraMount | None = None
    privileged: bool = False

    @classmethod
    def of(cls, synthesizer: ViewSynthesizer, clips: HeldOutClips, mount: CameraMount | None = None) -> Self:
        """A model that is measured on these clips. Raises DataError where the two do not fit together."""
        traits = synthesizer.traits
        trained = traits.mount or CameraMount()
        wanted = (traits.config.frames, traits.config.height, traits.config.width)
        given = (clips.frames, clips.height, clips.width)
        if wanted != given:
            raise DataError(
                f"{traits.name} was trained on clips of T, H, W = {wanted}, got {given}; generate such ones"
            )
        if traits.classes and _names(traits.classes) != _names(clips.classes):
            raise DataError(f"{traits.name} has classes {_names(traits.classes)}, the clips {_names(clips.classes)}")
        return cls(synthesizer=synthesizer, fps=clips.fps, mount=None if mount == trained else mount)

    @property
    def name(self) -> str:
        """The weights' name."""
        return self.synthesizer.traits.name

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor."""
        made = Clip(video=to_network(clip.source), fps=self.fps, mount=self.mount)
        path = self.synthesizer.traits.plan_view(mount=self.mount)
        (view,) = self.synthesizer.render(self.synthesizer.encode(made), [path])
        return Prediction(video=view.video, classes=None if view.classes is None else view.classes[0])


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
class Figures:
    """What is reported. NaN where there is nothing to measure.

    psnr_db, ssim: means over frames and clips. last_psnr_db: of the last frame. gradient_energy, flicker: views over
    targets, 1 is ideal. miou, accuracy, class_iou: at the class grid. miou_full, class_iou_full: at picture size.
    """

    psnr_db: float
    last_psnr_db: float
    ssim: float
    gradient_energy: float
    flicker: float
    miou: float
    miou_full: float
    accuracy: float
    class_iou: tuple[float, ...]
    class_iou_full: tuple[float, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Evaluation:
    """One predictor on a set of clips.

    clips: figures of each clip. total: of all frames and pixels together. error: standard error of `total` over clips.
    seconds_per_clip: of the predictor alone.
    """

    name: str
    privileged: bool
    clips: tuple[Figures, ...]
    total: Figures
    error: Figures
    seconds_per_clip: float


def evaluate(
    predictors: Sequence[Predictor],
    clips: HeldOutClips,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Evaluation, ...]:
    """Every predictor on the same clips, each read once.

    Args:
        progress: called with (clips done, clips).
    Raises:
        DataError: there is no clip, or a clip has no frame to measure.
    """
    count, grid = len(clips), class_grid(clips)
    if count < 1 or clips.frames <= FIRST_MEASURED + 1:
        raise DataError(f"evaluation wants a clip of 3 frames or more, got {count} of {clips.frames}; generate some")
    measured: list[list[Measures]] = [[] for _ in predictors]
    seconds = [0.0] * len(predictors)
    for number in range(count):
        clip = clips[number]
        for place, predictor in enumerate(predictors):
            start = time.perf_counter()
            prediction = predictor.predict(clip)
            seconds[place] += time.perf_counter() - start
            measured[place].append(measure(prediction, clip, grid=grid, classes=len(clips.classes)))
        if progress is not None:
            progress(number + 1, count)
    return tuple(
        _summed_up(predictor, each, spent) for predictor, each, spent in zip(predictors, measured, seconds, strict=True)
    )


def class_grid(clips: HeldOutClips) -> tuple[int, int]:
    """Height and width at which class maps are compared: half the pictures', the grid of our small class head."""
    return clips.height // 2, clips.width // 2


def require_same_kind(training: HeldOutClips, clips: HeldOutClips) -> None:
    """Raises DataError unless means over the training clips fit the held-out ones."""
    sizes = [(each.frames, each.height, each.width) for each in (training, clips)]
    if sizes[0] != sizes[1] or _names(training.classes) != _names(clips.classes):
        raise DataError(
            f"training and held-out clips must be of one kind, got T, H, W = {sizes[0]} and {sizes[1]}, "
            f"classes {_names(training.classes)} and {_names(clips.classes)}; generate both alike"
        )


def measure(prediction: Prediction, clip: PairedClip, *, grid: tuple[int, int], classes: int) -> Measures:
    """One clip's sums. grid: height and width of the class grid. classes: how many there are. Raises ShapeError."""
    measured = slice(FIRST_MEASURED, None)
    psnr, ssim, gradient, change = _picture_measures(prediction.video, to_pictures(clip.target), measured)
    at_grid = full = torch.zeros(classes, classes, dtype=torch.int64)
    if prediction.classes is not None:
        predicted, target = prediction.classes[measured], torch.from_numpy(clip.target_classes.copy())[measured]
        full = metrics.confusion_matrix(predicted, target, classes)
        coarse = [metrics.majority_classes(labels, *grid, classes) for labels in (predicted, target)]
        at_grid = metrics.confusion_matrix(coarse[0], coarse[1], classes)
    return Measures(clips=1, psnr_db=psnr, ssim=ssim, gradient=gradient, change=change, grid=at_grid, full=full)


def figures(measures: Measures) -> Figures:
    """From sums to figures: ratios and intersections of the sums, not means of the clips' own."""
    frames = measures.clips * len(measures.psnr_db)
    iou, iou_full = metrics.class_iou(measures.grid), metrics.class_iou(measures.full)
    return Figures(
        psnr_db=float(measures.psnr_db.sum()) / frames,
        last_psnr_db=float(measures.psnr_db[-1]) / measures.clips,
        ssim=float(measures.ssim.sum()) / frames,
        gradient_energy=float(measures.gradient[0] / measures.gradient[1]),
        flicker=float(measures.change[0] / measures.change[1]),
        miou=float(iou.nanmean()),
        miou_full=float(iou_full.nanmean()),
        accuracy=metrics.pixel_accuracy(measures.grid),
        class_iou=tuple(iou.tolist()),
        class_iou_full=tuple(iou_full.tolist()),
    )


def standard_error(measures: Sequence[Measures]) -> Figures:
    """Standard error of the figures of all clips together; NaN for a single clip.

    Source: the jackknife, Efron 1982; for means it is the usual s / sqrt(n), for ratios and pooled intersections it
    needs no other formula.
    """
    total, count = reduce(add, measures), len(measures)
    if count < 2:
        return _from_numbers(np.full_like(_to_numbers(figures(total)), np.nan))
    without = np.stack([_to_numbers(figures(total - each)) for each in measures])
    spread = ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    return _from_numbers(np.sqrt(spread * (count - 1) / count))


def _names(classes: Sequence[SemanticClass]) -> str:
    return ", ".join(each.name for each in classes)


def _picture_measures(video: Tensor | None, target: Tensor, measured: slice) -> tuple[Tensor, ...]:
    target = target[measured]
    if video is None:
        frames = target.new_full((len(target),), torch.nan, dtype=torch.float64)
        return frames, frames, frames[:2], frames[:2]
    video = video[measured].float().cpu()
    gradient = torch.stack([metrics.gradient_magnitude(each).double().sum() for each in (video, target)])
    change = torch.stack([metrics.frame_change(each).double().sum() for each in (video, target)])
    return metrics.psnr(video, target).double(), metrics.ssim(video, target).double(), gradient, change


def _summed_up(predictor: Predictor, measures: Sequence[Measures], seconds: float) -> Evaluation:
    return Evaluation(
        name=predictor.name,
        privileged=predictor.privileged,
        clips=tuple(map(figures, measures)),
        total=figures(reduce(add, measures)),
        error=standard_error(measures),
        seconds_per_clip=seconds / len(measures),
    )


def _to_numbers(given: Figures) -> NDArray[np.float64]:
    scalars = (given.psnr_db, given.last_psnr_db, given.ssim, given.gradient_energy, given.flicker)
    shares = (given.miou, given.miou_full, given.accuracy)
    return np.array([*scalars, *shares, *given.class_iou, *given.class_iou_full])


def _from_numbers(numbers: NDArray[np.float64]) -> Figures:
    psnr, last, ssim, gradient, flicker, miou, full, accuracy, *classes = numbers.tolist()
    half = len(classes) // 2
    return Figures(
        psnr_db=psnr,
        last_psnr_db=last,
        ssim=ssim,
        gradient_energy=gradient,
        flicker=flicker,
        miou=miou,
        miou_full=full,
        accuracy=accuracy,
        class_iou=tuple(classes[:half]),
        class_iou_full=tuple(classes[half:]),
    )
