"""Figures of clips and of all clips together, and how sure those are."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError
from gcd_train.evaluation.record import ClipRecord
from gcd_train.evaluation.tallies import FIGURE_NAMES, MAIN, Selection, Tallies, class_iou, tallies


@dataclass(frozen=True, kw_only=True, slots=True)
class Figures:
    """What is reported. NaN where there is nothing to measure.

    psnr_db, ssim, lpips: means over frames, draws and clips, each clip weighing the same. last_psnr_db: of the last
    frame. diversity: mean spread of a pixel over draws. gradient_energy, flicker: views over targets, 1 is ideal.
    miou, accuracy, class_iou: at the class grid. miou_full, class_iou_full: at picture size. miou_common: at picture
    size, mean over the ten commonest classes of the targets.
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
    lpips: float = float("nan")
    diversity: float = float("nan")
    miou_common: float = float("nan")


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


def figures(records: Sequence[ClipRecord], selection: Selection = MAIN, *, classes: int = 0) -> Figures:
    """Figures of one method's clips together: ratios and intersections of the sums, not means of the clips' own.

    Args:
        classes: how many there are, where the records need not name all.
    """
    (total,) = _rows(tallies(records, selection, classes=classes).weighted(np.ones((1, len(records)))))
    return total


def summed_up(records: Sequence[ClipRecord], selection: Selection = MAIN, *, classes: int = 0) -> Evaluation:
    """Figures and errors of one method; clips of one scene are alike, so errors are over scenes.

    Args:
        records: of one method, in the order of the clips. classes: see `figures`.
    Raises:
        DataError: there is no record, or they are of several methods.
    """
    names = {record.method for record in records}
    if len(names) != 1:
        raise DataError(f"figures want records of one method, got {sorted(names) or 'none'}; evaluate it first")
    clips = tallies(records, selection, classes=classes)
    (total,) = _rows(clips.weighted(np.ones((1, len(records)))))
    without = _rows(left_out(clips.grouped([record.scene for record in records])))
    return Evaluation(
        name=records[0].method,
        privileged=records[0].privileged,
        clips=_rows(clips),
        total=total,
        error=_over_fields(without, jackknife) if without else _over_fields([total], _unknown),
        without=without,
        seconds_per_clip=sum(record.seconds for record in records) / len(records),
    )


def left_out(scenes: Tallies) -> Tallies:
    """Sums of all scenes but one, for each scene; none for a single scene."""
    count = len(scenes.means)
    return scenes.weighted(1.0 - np.eye(count) if count > 1 else np.zeros((0, count)))


def lead(first: Evaluation, other: Evaluation, figure: Callable[[Figures], float]) -> tuple[float, float]:
    """How far `first` is above `other` in a figure of all clips, and the paired standard error of that over scenes."""
    ahead = figure(first.total) - figure(other.total)
    if not first.without or len(first.without) != len(other.without):
        return ahead, float("nan")
    apart = [figure(a) - figure(b) for a, b in zip(first.without, other.without, strict=True)]
    return ahead, float(jackknife(np.array(apart)))


def jackknife(without: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard error from the figures of all but one, along the first axis.

    Source: the jackknife, Efron 1982; for means it is the usual s / sqrt(n), for ratios and pooled intersections it
    needs no other formula.
    """
    spread = ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    return np.sqrt(spread * (len(without) - 1) / len(without))


def _rows(sums: Tallies) -> tuple[Figures, ...]:
    """The figures of each row of sums [n, ...]."""
    numbers = {name: sums.figure(name).tolist() for name in FIGURE_NAMES}
    grid, full = class_iou(sums.grid).tolist(), class_iou(sums.full).tolist()
    return tuple(
        Figures(
            **{name: values[row] for name, values in numbers.items()},
            class_iou=tuple(grid[row]),
            class_iou_full=tuple(full[row]),
        )
        for row in range(len(sums.means))
    )


def _unknown(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full_like(rows[0], np.nan)


def _over_fields(rows: Sequence[Figures], work: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Figures:
    """One number for each figure, from its values in all rows."""
    made = {each.name: work(np.array([getattr(row, each.name) for row in rows])).tolist() for each in fields(Figures)}
    return msgspec.convert(made, Figures)
