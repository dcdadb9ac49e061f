"""Records as one table of sums that add up, the figures that are ratios of them, and how sure those are.

Every figure is a ratio of two sums over clips, or, of classes, a mean of such ratios; so any grouping or weighting of
clips is one product. Intervals are the bootstrap over scenes, Efron 1979: scenes are drawn, not clips, as clips of one
scene are alike; the same seed draws the same scenes of every method, so that differences are paired.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, Self, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.store import REGIONS, ClipRecord, Counted, Region

FIRST_MEASURED = 1
"""Frames before this one, counted from 0, are left out: a gradual path begins where the source camera stands."""
COMMON_CLASSES = 10
"""Classes that the paper's mIoU is a mean over: the commonest of the evaluated targets."""
DRAWS, COVERAGE, SEED = 10_000, 0.95, 0
FEW_SCENES = 10
"""Of fewer, no claim can rest on what was found: the bootstrap knows no more scenes than it is given."""

Span: TypeAlias = Literal["2-last", "last", "all"]
"""Which frames are measured: as the paper's main tables, as its ablations, or as the released script."""
SPANS: tuple[Span, ...] = get_args(Span)
FRAMES_OF: dict[Span, slice] = {"2-last": slice(FIRST_MEASURED, None), "last": slice(-1, None), "all": slice(None)}

FigureName: TypeAlias = Literal[
    "psnr_db", "ssim", "lpips", "diversity", "gradient_energy", "flicker", "miou_full", "miou_common"
]
"""One number of a set of clips.

psnr_db, ssim, lpips: means over frames, draws and clips, each clip weighing the same. diversity: mean spread of a pixel
over draws. gradient_energy, flicker: views over targets, 1 is ideal. miou_full: mean over the classes. miou_common:
the same, mean over the ten commonest classes. LPIPS and flicker are of all pixels only.
"""

FIGURE_NAMES: tuple[FigureName, ...] = get_args(FigureName)
_CLASSES = FIGURE_NAMES.index("miou_full")  # the first column of a class; before it one of each figure that is no mIoU
_MEANS, _GRADIENT, _FLICKER = 4, 4, 5

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Interval:
    """A figure and where it lies in 95 of 100 draws of scenes. NaN bounds for a single scene."""

    value: float
    low: float = np.nan
    high: float = np.nan

    @property
    def known(self) -> bool:
        """Whether there was anything to measure."""
        return not np.isnan(self.value)

    @property
    def off_zero(self) -> bool:
        """Whether zero lies outside; never for unknown bounds."""
        return self.low > 0.0 or self.high < 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Sums:
    """Sums of n rows, each a clip or a scene.

    above, below: [n, 6 + K], what is divided and by what: of each figure that is no mIoU the clips' means by how many
    clips have one, or views by targets; of each class pixels that are right by those predicted or true. common: ids of
    the commonest classes.
    """

    above: Array
    below: Array
    common: tuple[int, ...]

    def figure(self, name: FigureName | int, weights: Array | None = None) -> Array:
        """One figure of each row, or of the rows as often as each weighting [..., n] says; NaN for nothing.

        name: of the figure, or the id of a class for its intersection over union.
        """
        if isinstance(name, int):
            columns = [_CLASSES + name]
        elif name == "miou_common":
            columns = [_CLASSES + label for label in self.common]
        elif name == "miou_full":
            columns = list(range(_CLASSES, self.above.shape[1]))
        else:
            columns = [FIGURE_NAMES.index(name)]
        above, below = self.above[:, columns], self.below[:, columns]
        if weights is not None:
            above, below = weights @ above, weights @ below
        ratio = _divided(above, below)
        there = ~np.isnan(ratio)
        return _divided(np.where(there, ratio, 0.0).sum(-1), there.sum(-1))

    def value(self, name: FigureName | int) -> float:
        """One figure of all rows."""
        return float(self.figure(name, np.ones(len(self.above))))

    def interval(self, name: FigureName | int, other: "Sums | None" = None) -> Interval:
        """One figure with the middle 95 % of its draws; or how far it lies above that of others of the same clips, in
        each draw of the same scenes."""
        rows, both = len(self.above), (self, *(() if other is None else (other,)))
        value = float(np.subtract.reduce([each.value(name) for each in both]))
        if np.isnan(value) or rows < 2:
            return Interval(value=value)
        drawn = np.subtract.reduce([each.figure(name, scene_weights(rows)) for each in both])
        known = drawn[~np.isnan(drawn)]
        if not known.size:
            return Interval(value=value)
        low, high = np.quantile(known, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
        return Interval(value=value, low=float(low), high=float(high))


@lru_cache(maxsize=4)
def scene_weights(count: int) -> Array:
    """How often each of so many scenes is drawn: [DRAWS, count], each row's sum is `count`."""
    random = np.random.default_rng(SEED)
    return random.multinomial(count, np.full(count, 1.0 / count), size=DRAWS).astype(np.float64)


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipTable:
    """All that one method was measured as: a row for each clip and frame, a column for all that figures are made of.

    scenes: of the n clips. above, below: [n, T, 6 + K] by region, see `Sums`, summed over draws, nothing after the end
    of clips that are shorter than others. true: [n, K], pixels
    of each class in all of a clip's targets.
    """

    scenes: tuple[str, ...]
    above: dict[Region, Array]
    below: dict[Region, Array]
    true: Array

    @classmethod
    def of(cls, records: Sequence[ClipRecord], classes: int = 0) -> Self:
        """The table of these records. classes: how many there are at least; ids beyond make it more."""
        maps = [region.confusion for record in records for region in record.regions.values() if region.confusion]
        ids = {label for clip in maps for frame in clip for entry in frame for label in entry[:2]}
        count = max([classes, *(1 + label for label in ids - {NO_CLASS})])
        true = np.zeros((len(records), count))
        shape = (len(REGIONS), len(records), max(record.frames for record in records), _CLASSES + count)
        above, below = np.zeros(shape), np.zeros(shape)
        for place, name in enumerate(REGIONS):
            for row, record in enumerate(records):
                if name in record.regions:
                    own = above[place, row, : record.frames], below[place, row, : record.frames]
                    _add_pictures(record, name, *own)
                    counts = _add_classes(record.regions[name].confusion or (), *own)
                    true[row] += counts if name == "all" else 0.0
        return cls(
            scenes=tuple(record.scene for record in records),
            above=dict(zip(REGIONS, above, strict=True)),
            below=dict(zip(REGIONS, below, strict=True)),
            true=true,
        )

    def clip_sums(self, frames: Span = "2-last", region: Region = "all", rows: Sequence[int] | None = None) -> Sums:
        """Sums of each clip. rows: only these clips; None for all."""
        rows = range(len(self.scenes)) if rows is None else rows
        each = [table[region][rows] for table in (self.above, self.below)]
        above, below = (table[:, FRAMES_OF[frames]].sum(axis=1) for table in each)
        if frames == "2-last":  # the change into the first of these frames is none between them
            above[:, _FLICKER], below[:, _FLICKER] = (
                table[:, FIRST_MEASURED + 1 :, _FLICKER].sum(axis=1) for table in each
            )
        means = _divided(above[:, :_MEANS], below[:, :_MEANS])
        above[:, :_MEANS], below[:, :_MEANS] = np.nan_to_num(means), ~np.isnan(means)
        true = self.true[rows].sum(axis=0)
        commonest = np.argsort(-true, kind="stable")[:COMMON_CLASSES].tolist()
        return Sums(above=above, below=below, common=tuple(sorted(label for label in commonest if true[label] > 0)))

    def scene_sums(self, frames: Span = "2-last", region: Region = "all", rows: Sequence[int] | None = None) -> Sums:
        """`clip_sums` added up over each scene, in the order of their first clips, ready to be drawn from."""
        sums = self.clip_sums(frames, region, rows)
        scenes = self.scenes if rows is None else [self.scenes[row] for row in rows]
        weights = np.array([[float(scene == each) for scene in scenes] for each in dict.fromkeys(scenes)])
        return replace(sums, above=weights @ sums.above, below=weights @ sums.below)


def _add_pictures(record: ClipRecord, name: Region, above: Array, below: Array) -> None:
    """Fill in what a clip's pictures are, [T, 6 + K]; the change from a frame to the next stands at the next.

    Gradients count by the region's share of each frame, so that one without such pixels adds nothing.
    """
    region, everywhere = record.regions[name], name == "all"
    spread = None if region.diversity is None else (region.diversity,)
    for column, values in enumerate((region.psnr_db, region.ssim, record.lpips if everywhere else None, spread)):
        if values is not None:
            each = np.array(values, np.float64)  # [S, T], NaN for None
            above[:, column], below[:, column] = np.nan_to_num(each).sum(axis=0), (~np.isnan(each)).sum(axis=0)
    if region.gradient is not None:
        views, targets = (np.array(each, np.float64) for each in (region.gradient, region.gradient_target))
        above[:, _GRADIENT] = (np.nan_to_num(views) * region.pixels).mean(axis=0)
        below[:, _GRADIENT] = np.nan_to_num(targets) * region.pixels
    if everywhere and record.step is not None:
        above[1:, _FLICKER], below[1:, _FLICKER] = np.mean(record.step, axis=0), record.step_target


def _add_classes(confusion: Sequence[Counted], above: Array, below: Array) -> Array:
    """Fill in what a clip's class maps are; gives how many pixels are truly of each class, [K]."""
    truly = np.zeros(above.shape[1] - _CLASSES)
    for right, united, counted in zip(above[:, _CLASSES:], below[:, _CLASSES:], confusion, strict=bool(confusion)):
        if counted:
            true, predicted, pixels = np.array(counted).T
            known = predicted < len(truly)  # the others are of no class, and wrong
            np.add.at(right, true, pixels * (true == predicted))
            np.add.at(united, true, pixels)
            np.add.at(united, predicted[known], (pixels * (true != predicted))[known])
            np.add.at(truly, true, pixels)
    return truly


def _divided(above: Array, below: Array) -> Array:
    """Above over below, NaN for nothing over nothing."""
    return np.divide(above, below, out=np.full(np.shape(above), np.nan), where=np.asarray(below) != 0)
