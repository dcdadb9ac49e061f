"""Records as sums that add up, the figures that are functions of them, and how sure those are.

Every figure of some clips is a function of sums over them, so any grouping or weighting of clips is one product.
Intervals are the bootstrap over scenes, Efron 1979: scenes are drawn, not clips, as clips of one scene are
alike; the same seed draws the same scenes of every method, so that differences are paired.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.store import REGIONS, ClipRecord, Counted, Frames, Region

FIRST_MEASURED = 1
"""Frames before this one, counted from 0, are left out: a gradual path begins where the source camera stands."""
COMMON_CLASSES = 10
"""Classes that the paper's mIoU is a mean over: the commonest of the evaluated targets."""
DRAWS, COVERAGE = 10_000, 0.95
FEW_SCENES = 10
"""Of fewer, no claim can rest on what was found: the bootstrap knows no more scenes than it is given."""

Span: TypeAlias = Literal["2-last", "last", "all"]
"""Which frames are measured."""

FigureName: TypeAlias = Literal[
    "psnr_db",
    "last_psnr_db",
    "ssim",
    "lpips",
    "diversity",
    "gradient_energy",
    "flicker",
    "miou",
    "miou_full",
    "miou_common",
    "accuracy",
]
"""One number of a set of clips.

psnr_db, ssim, lpips: means over frames, draws and clips, each clip weighing the same. last_psnr_db: of the last frame.
diversity: mean spread of a pixel over draws. gradient_energy, flicker: views over targets, 1 is ideal. miou, accuracy:
at the class grid. miou_full: at picture size. miou_common: the same, mean over the ten commonest classes.
"""

FIGURE_NAMES: tuple[FigureName, ...] = get_args(FigureName)
_MEANS: tuple[FigureName, ...] = ("psnr_db", "last_psnr_db", "ssim", "lpips", "diversity")
_RATIOS: tuple[FigureName, ...] = ("gradient_energy", "flicker")

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Selection:
    """Which frames and pixels figures are of.

    frames: "2-last" as the paper's main tables, "last" as its ablations, "all" as the released script, or one frame
    counted from 1. region: which pixels of the target. LPIPS, flicker and figures at the class grid are of all pixels
    only.
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

    grid: [n, T, 3, K] at the class grid. regions: the same at picture size, of regions that any clip has.
    common: ids of the commonest classes.
    """

    grid: Array
    regions: Mapping[Region, Array] = field(default_factory=dict[Region, Array])
    common: tuple[int, ...] = ()


def class_counts(records: Sequence[ClipRecord], classes: int = 0) -> ClassCounts:
    """Counts of one method's clips. classes: how many there are at least; ids beyond make it more."""
    confusions: dict[Region | None, list[Sequence[Counted]]] = {
        None: [record.grid_confusion or () for record in records]
    }
    for name in REGIONS:
        found = [record.regions.get(name) for record in records]
        if any(found):
            confusions[name] = [(each and each.confusion) or () for each in found]
    ids = (label for clips in confusions.values() for clip in clips for frame in clip for e in frame for label in e[:2])
    count = max([classes, *(1 + label for label in set(ids) - {NO_CLASS})])
    frames = records[0].frames if records else 0
    counts: dict[Region | None, Array] = {
        name: np.array([_counts(clip, frames, count) for clip in clips]).reshape(len(records), frames, 3, count)
        for name, clips in confusions.items()
    }
    true = counts.get("all", counts[None])[:, :, 2].sum(axis=(0, 1))
    commonest = np.argsort(-true, kind="stable")[:COMMON_CLASSES].tolist()
    return ClassCounts(
        grid=counts[None],
        regions={name: each for name, each in counts.items() if name is not None},
        common=tuple(sorted(label for label in commonest if true[label] > 0)),
    )


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
class Sums:
    """Sums of n rows, each a clip or a scene.

    means: [n, 5, 2], sum of the clips' means and how many clips have one, see `_MEANS`. ratios: [n, 2, 2], of views and
    of targets; gradient, change between frames. grid, full: [n, 3, K], pixels that are right, predicted and true by
    class, at the class grid and at picture size. common: ids of the commonest classes.
    """

    means: Array
    ratios: Array
    grid: Array
    full: Array
    common: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.means)

    def figure(self, name: FigureName, weights: Array | None = None) -> Array:
        """One figure of each row, or of the rows as often as each weighting [..., n] says; NaN for nothing."""
        if name in ("accuracy", "miou"):
            grid = _weighted(self.grid, weights)
            right, true = grid[..., 0, :].sum(-1), grid[..., 2, :].sum(-1)
            return _divided(right, true) if name == "accuracy" else _nanmean(class_iou(grid))
        if name in ("miou_full", "miou_common"):
            iou = class_iou(_weighted(self.full, weights))
            return _nanmean(iou[..., list(self.common)] if name == "miou_common" else iou)
        kept = self.means[:, _MEANS.index(name)] if name in _MEANS else self.ratios[:, _RATIOS.index(name)]
        part = _weighted(kept, weights)
        return _divided(part[..., 0], part[..., 1])

    def grouped(self, groups: Sequence[str]) -> "Sums":
        """Sums of rows by group, in the order of each group's first row."""
        order = list(dict.fromkeys(groups))
        weights = np.array([[float(group == each) for group in groups] for each in order])
        sums = {name: _weighted(getattr(self, name), weights) for name in ("means", "ratios", "grid", "full")}
        return replace(self, **sums)


def class_iou(counts: Array) -> Array:
    """Intersection over union of each class, [..., K], from counts [..., 3, K]; NaN for one that is nowhere."""
    right, predicted, true = np.moveaxis(counts, -2, 0)
    return _divided(right, predicted + true - right)


def clip_sums(
    records: Sequence[ClipRecord], selection: Selection, *, classes: int = 0, counts: ClassCounts | None = None
) -> Sums:
    """Sums of each clip of one method. classes: see `class_counts`. counts: of these records, where they are known."""
    counts = counts or class_counts(records, classes)
    frames, nothing = selection.frame_slice(), np.zeros_like(counts.grid)
    return Sums(
        means=np.array([_means(record, selection) for record in records]).reshape(-1, len(_MEANS), 2),
        ratios=np.array([_ratios(record, selection) for record in records]).reshape(-1, len(_RATIOS), 2),
        grid=(counts.grid if selection.region == "all" else nothing)[:, frames].sum(axis=1),
        full=counts.regions.get(selection.region, nothing)[:, frames].sum(axis=1),
        common=counts.common,
    )


def _means(record: ClipRecord, selection: Selection) -> list[tuple[float, float]]:
    region, frames = record.regions.get(selection.region), selection.frame_slice()
    spread = None if region is None or region.diversity is None else (region.diversity,)
    found = [
        _clip_mean(region and region.psnr_db, frames),
        _clip_mean(region and region.psnr_db, slice(-1, None)),
        _clip_mean(region and region.ssim, frames),
        _clip_mean(record.lpips if selection.region == "all" else None, frames),
        _clip_mean(spread, frames),
    ]
    return [(0.0, 0.0) if np.isnan(value) else (value, 1.0) for value in found]


def _clip_mean(values: Sequence[Frames] | None, frames: slice) -> float:
    """Mean over draws and frames of [S][T] values, of those that there are; NaN for none."""
    return float("nan") if values is None else float(_nanmean(_array(values)[:, frames].ravel()))


def _ratios(record: ClipRecord, selection: Selection) -> list[tuple[float, float]]:
    """Gradients, each frame by the region's share of it (without such pixels it adds nothing), and flicker."""
    region, gradients, flicker = record.regions.get(selection.region), (0.0, 0.0), (0.0, 0.0)
    if region is not None and region.gradient is not None and region.gradient_target is not None:
        share = _array(region.pixels)
        views, targets = (np.nan_to_num(_array(each)) * share for each in (region.gradient, region.gradient_target))
        gradients = _ratio(views, targets, selection.frame_slice())
    if selection.region == "all" and record.step is not None:
        flicker = _ratio(_array(record.step), _array(record.step_target), selection.step_slice())
    return [gradients, flicker]


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
class Bootstrap:
    """A method's sums by scene, and the seed that scenes are drawn by."""

    scenes: Sums
    seed: int = 0

    def value(self, name: FigureName) -> float:
        """One figure of all scenes."""
        return float(self.scenes.figure(name, np.ones(len(self.scenes))))

    def again(self, name: FigureName) -> Array:
        """The figure of scenes drawn with repetition, [DRAWS]; NaN for a single scene."""
        weights = self.weights
        return np.full(DRAWS, np.nan) if weights is None else self.scenes.figure(name, weights)

    def interval(self, name: FigureName) -> Interval:
        """One figure with its bounds."""
        return _interval(self.value(name), lambda: self.again(name))

    @property
    def weights(self) -> Array | None:
        """How often each scene is drawn, [DRAWS, n]; None for a single scene."""
        return scene_weights(len(self.scenes), seed=self.seed) if len(self.scenes) > 1 else None


@lru_cache(maxsize=4)
def scene_weights(count: int, *, draws: int = DRAWS, seed: int = 0) -> Array:
    """How often each of so many scenes is drawn: [draws, count], each row's sum is `count`."""
    random = np.random.default_rng(seed)
    return random.multinomial(count, np.full(count, 1.0 / count), size=draws).astype(np.float64)


def bootstrap(
    records: Sequence[ClipRecord],
    selection: Selection,
    *,
    classes: int = 0,
    seed: int = 0,
    counts: ClassCounts | None = None,
) -> Bootstrap:
    """Sums of one method, ready to be drawn from. classes, counts: see `clip_sums`."""
    clips = clip_sums(records, selection, classes=classes, counts=counts)
    return Bootstrap(scenes=clips.grouped([record.scene for record in records]), seed=seed)


def difference(first: Bootstrap, other: Bootstrap, name: FigureName) -> Interval:
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
