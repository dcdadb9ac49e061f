"""Figures of clips and of all clips together, and how sure those are."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, fields
from functools import reduce
from operator import add

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_train import metrics
from gcd_train.evaluation.measures import Measures


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

    clips: figures of each clip. total: of all frames and pixels together. error: standard error of `total` over scenes.
    without: figures of all scenes but one, for each scene; errors of differences follow from them.
    seconds_per_clip: of the predictor alone.
    """

    name: str
    privileged: bool
    clips: tuple[Figures, ...]
    total: Figures
    error: Figures
    without: tuple[Figures, ...]
    seconds_per_clip: float


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


def summed_up(
    name: str, measures: Sequence[Measures], scenes: Sequence[Hashable], *, seconds: float, privileged: bool = False
) -> Evaluation:
    """Figures and errors from one predictor's sums of each clip.

    Args:
        scenes: which scene each clip is of; clips of one scene are alike, so errors are over scenes.
        seconds: the predictor took for all of them.
    """
    total = reduce(add, measures)
    without = left_out(measures, scenes)
    return Evaluation(
        name=name,
        privileged=privileged,
        clips=tuple(map(figures, measures)),
        total=figures(total),
        error=_over_fields(without, _jackknife) if without else _over_fields([figures(total)], _unknown),
        without=without,
        seconds_per_clip=seconds / len(measures),
    )


def left_out(measures: Sequence[Measures], scenes: Sequence[Hashable]) -> tuple[Figures, ...]:
    """Figures of all scenes but one, for each scene in the order of its first clip; empty for a single scene."""
    total = reduce(add, measures)
    each: dict[Hashable, Measures] = {}
    for scene, clip in zip(scenes, measures, strict=True):
        each[scene] = each[scene] + clip if scene in each else clip
    if len(each) < 2:
        return ()
    return tuple(figures(total - each[scene]) for scene in each)


def lead(first: Evaluation, other: Evaluation, figure: Callable[[Figures], float]) -> tuple[float, float]:
    """How far `first` is above `other` in a figure of all clips, and the paired standard error of that over scenes."""
    ahead = figure(first.total) - figure(other.total)
    if not first.without or len(first.without) != len(other.without):
        return ahead, float("nan")
    apart = [figure(a) - figure(b) for a, b in zip(first.without, other.without, strict=True)]
    return ahead, float(_jackknife(np.array(apart)))


def _jackknife(without: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard error from the figures of all but one, along the first axis.

    Source: the jackknife, Efron 1982; for means it is the usual s / sqrt(n), for ratios and pooled intersections it
    needs no other formula.
    """
    spread = ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    return np.sqrt(spread * (len(without) - 1) / len(without))


def _unknown(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full_like(rows[0], np.nan)


def _over_fields(rows: Sequence[Figures], work: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Figures:
    """One number for each figure, from its values in all rows."""
    made = {each.name: work(np.array([getattr(row, each.name) for row in rows])).tolist() for each in fields(Figures)}
    return msgspec.convert(made, Figures)
