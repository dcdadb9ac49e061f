"""Records as sums that add up, the figures that are functions of them, and how sure those are.

Every figure of some clips is a function of sums over them, so any grouping or weighting of clips is one product.
Intervals are the bootstrap over scenes, Efron 1979: scenes are drawn, not clips, as clips of one scene are
alike; the same seed draws the same scenes of every method, so that differences are paired.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.store import REGIONS, ClipRecord, Counted, Frames, Region, RegionRecord

FIRST_MEASURED = 1
"""Frames before this one, counted from 0, are left out: a gradual path begins where the source camera stands."""
COMMON_CLASSES = 10
"""Classes that the paper's mIoU is a mean over: the commonest of the evaluated targets."""
DRAWS, COVERAGE, SEED = 10_000, 0.95, 0
FEW_SCENES = 10
"""Of fewer, no claim can rest on what was found: the bootstrap knows no more scenes than it is given."""

Span: TypeAlias = Literal["2-last", "last", "all"]
"""Which frames are measured."""

FigureName: TypeAlias = Literal[
    "psnr_db", "ssim", "lpips", "diversity", "gradient_energy", "flicker", "miou_full", "miou_common"
]
"""One number of a set of clips.

psnr_db, ssim, lpips: means over frames, draws and clips, each clip weighing the same. diversity: mean spread of a pixel
over draws. gradient_energy, flicker: views over targets, 1 is ideal. miou_full: mean over the classes. miou_common:
the same, mean over the ten commonest classes.
"""

FIGURE_NAMES: tuple[FigureName, ...] = get_args(FigureName)
_PARTS = FIGURE_NAMES[:6]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Selection:
    """Which frames and pixels figures are of.

    frames: "2-last" as the paper's main tables, "last" as its ablations, "all" as the released script, or one frame
    counted from 1. region: which pixels of the target. LPIPS and flicker are of all pixels only.
    """

    frames: Span | int = "2-last"
    region: Region = "all"

    def frame_slice(self) -> slice:
        """The frames, of values from the first frame on."""
        if isinstance(self.frames, int):
            return slice(self.frames - 1, self.frames)
        return {"2-last": slice(FIRST_MEASURED, None), "last": slice(-1, None), "all": slice(None)}[self.frames]

    def step_slice(self) -> slice:
        """The changes between these frames, of values from frames 1 to 2 on; for one frame the change into it."""
        if isinstance(self.frames, int):
            return slice(max(self.frames - 2, 0), self.frames - 1)
        return self.frame_slice()


@dataclass(frozen=True, kw_only=True, slots=True)
class ClassCounts:
    """Pixels that are right, predicted and true by class, of n clips with T frames and K classes.

    regions: [n, T, 3, K], of regions that any clip has. common: ids of the commonest classes.
    """

    regions: Mapping[Region, Array]
    common: tuple[int, ...] = ()


def class_counts(records: Sequence[ClipRecord], classes: int = 0) -> ClassCounts:
    """Counts of one method's clips. classes: how many there are at least; ids beyond make it more."""
    found: dict[Region, list[Sequence[Counted]]] = {
        name: [(record.regions[name].confusion if name in record.regions else None) or () for record in records]
        for name in REGIONS
        if any(name in record.regions for record in records)
    }
    ids = {
        label for clips in found.values() for clip in clips for frame in clip for each in frame for label in each[:2]
    }
    count = max([classes, *(1 + label for label in ids - {NO_CLASS})])
    regions: dict[Region, Array] = {
        name: np.array([_counts(clip, records[0].frames, count) for clip in clips]) for name, clips in found.items()
    }
    true = regions["all"][:, :, 2].sum(axis=(0, 1))
    commonest = np.argsort(-true, kind="stable")[:COMMON_CLASSES].tolist()
    return ClassCounts(regions=regions, common=tuple(sorted(label for label in commonest if true[label] > 0)))


def _counts(clip: Sequence[Counted], frames: int, classes: int) -> Array:
    """[T, 3, K] of one clip; zeros where nothing was counted."""
    counts = np.zeros((frames, 3, classes))
    for frame, counted in zip(counts, clip, strict=bool(clip)):
        if counted:
            true, predicted, pixels = np.array(counted).T
            known = predicted < classes  # the others are of no class, and wrong
            np.add.at(frame[0], true, pixels * (true == predicted))
            np.add.at(frame[1], predicted[known], pixels[known])
            np.add.at(frame[2], true, pixels)
    return counts


@dataclass(frozen=True, kw_only=True, slots=True)
class Interval:
    """A figure and where it lies in 95 of 100 draws of scenes. NaN bounds for a single scene."""

    value: float
    low: float
    high: float

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

    parts: [n, 6, 2], of each figure that is no mIoU what is divided and by what: the clips' means by how many clips
    have one, or views by targets. classes: [n, 3, K], pixels that are right, predicted and true by class. common: ids
    of the commonest classes.
    """

    parts: Array
    classes: Array
    common: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.parts)

    def figure(self, name: FigureName, weights: Array | None = None) -> Array:
        """One figure of each row, or of the rows as often as each weighting [..., n] says; NaN for nothing."""
        if name in ("miou_full", "miou_common"):
            iou = class_iou(_weighted(self.classes, weights))
            return _nanmean(iou[..., list(self.common)] if name == "miou_common" else iou)
        part = _weighted(self.parts[:, _PARTS.index(name)], weights)
        return _divided(part[..., 0], part[..., 1])

    def value(self, name: FigureName) -> float:
        """One figure of all rows."""
        return float(self.figure(name, np.ones(len(self))))

    def again(self, name: FigureName) -> Array:
        """The figure of rows drawn with repetition, [DRAWS]; NaN for a single row."""
        return np.full(DRAWS, np.nan) if len(self) < 2 else self.figure(name, scene_weights(len(self)))

    def interval(self, name: FigureName) -> Interval:
        """One figure with its bounds."""
        return _interval(self.value(name), lambda: self.again(name))

    def grouped(self, groups: Sequence[str]) -> "Sums":
        """Sums of rows by group, in the order of each group's first row."""
        weights = np.array([[float(group == each) for group in groups] for each in dict.fromkeys(groups)])
        return replace(self, parts=_weighted(self.parts, weights), classes=_weighted(self.classes, weights))


def class_iou(counts: Array) -> Array:
    """Intersection over union of each class, [..., K], from counts [..., 3, K]; NaN for one that is nowhere."""
    right, predicted, true = np.moveaxis(counts, -2, 0)
    return _divided(right, predicted + true - right)


def clip_sums(records: Sequence[ClipRecord], selection: Selection, counts: ClassCounts | None = None) -> Sums:
    """Sums of each clip of one method. counts: of these records, where they are known."""
    counts = counts or class_counts(records)
    of_region = counts.regions.get(selection.region, np.zeros_like(counts.regions["all"]))
    return Sums(
        parts=np.array([_parts(record, selection) for record in records]),
        classes=of_region[:, selection.frame_slice()].sum(axis=1),
        common=counts.common,
    )


def scene_sums(records: Sequence[ClipRecord], selection: Selection, counts: ClassCounts | None = None) -> Sums:
    """`clip_sums` of each scene, ready to be drawn from."""
    return clip_sums(records, selection, counts).grouped([record.scene for record in records])


def _parts(record: ClipRecord, selection: Selection) -> list[tuple[float, float]]:
    """Of one clip, in the order of `_PARTS`. Gradients: each frame by the region's share of it, so that one without
    such pixels adds nothing."""
    frames, everywhere = selection.frame_slice(), selection.region == "all"
    region = record.regions.get(selection.region, RegionRecord(pixels=(), gradient_target=()))
    spread = None if region.diversity is None else (region.diversity,)
    lpips = record.lpips if everywhere else None
    means = [_clip_mean(values, frames) for values in (region.psnr_db, region.ssim, lpips, spread)]
    gradients = flicker = (0.0, 0.0)
    if region.gradient is not None:
        share = _array(region.pixels)
        views, targets = (np.nan_to_num(_array(each)) * share for each in (region.gradient, region.gradient_target))
        gradients = _ratio(views, targets, frames)
    if everywhere and record.step is not None:
        flicker = _ratio(_array(record.step), _array(record.step_target), selection.step_slice())
    return [*((0.0, 0.0) if np.isnan(value) else (value, 1.0) for value in means), gradients, flicker]


def _clip_mean(values: Sequence[Frames] | None, frames: slice) -> float:
    """Mean over draws and frames of [S][T] values, of those that there are; NaN for none."""
    return float("nan") if values is None else float(_nanmean(_array(values)[:, frames].ravel()))


def _ratio(views: Array, targets: Array, chosen: slice) -> tuple[float, float]:
    """Sums over frames of views [S, T], a mean over draws, and of targets [T]."""
    return float(views[:, chosen].mean(axis=0).sum()), float(targets[chosen].sum())


def _array(values: Sequence[Frames] | Frames) -> Array:
    """Values with NaN for None."""
    return np.array(values, dtype=np.float64)


def _weighted(sums: Array, weights: Array | None) -> Array:
    return sums if weights is None else np.tensordot(weights, sums, axes=1)


def _divided(above: Array, below: Array) -> Array:
    """Above over below, NaN for nothing over nothing."""
    return np.divide(above, below, out=np.full(np.shape(above), np.nan), where=np.asarray(below) != 0)


def _nanmean(values: Array) -> Array:
    """Mean over the last dimension of what is not NaN; NaN if all is."""
    there = ~np.isnan(values)
    return _divided(np.where(there, values, 0.0).sum(-1), there.sum(-1).astype(np.float64))


@lru_cache(maxsize=4)
def scene_weights(count: int) -> Array:
    """How often each of so many scenes is drawn: [DRAWS, count], each row's sum is `count`."""
    random = np.random.default_rng(SEED)
    return random.multinomial(count, np.full(count, 1.0 / count), size=DRAWS).astype(np.float64)


def difference(first: Sums, other: Sums, name: FigureName) -> Interval:
    """How far `first` lies above `other`, both on the same clips: in each draw the same scenes of both."""
    return _interval(first.value(name) - other.value(name), lambda: first.again(name) - other.again(name))


def common_clips(
    first: Sequence[ClipRecord], other: Sequence[ClipRecord]
) -> tuple[tuple[ClipRecord, ...], tuple[ClipRecord, ...]]:
    """The records of the clips that both have, in one order."""
    of_first, of_other = ({record.key: record for record in records} for records in (first, other))
    both = [key for key in of_first if key in of_other]
    return tuple(of_first[key] for key in both), tuple(of_other[key] for key in both)


def _interval(value: float, again: Callable[[], Array]) -> Interval:
    """The middle 95 % of what is not NaN; `again` is called only for a figure that there is."""
    drawn = np.empty(0) if np.isnan(value) else again()
    known = drawn[~np.isnan(drawn)]
    if not known.size:
        return Interval(value=value, low=float("nan"), high=float("nan"))
    low, high = np.quantile(known, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    return Interval(value=value, low=float(low), high=float(high))
