"""Records of clips as sums that add up, for one choice of frames and pixels; every figure is a function of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from gcd_train.evaluation.class_counts import ClassCounts, class_counts
from gcd_train.evaluation.record import ClipRecord, Frames, Region, RegionRecord

FIRST_MEASURED = 1
"""Frames before this one, counted from 0, are left out: a gradual path begins where the source camera stands."""

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
"""One number of a set of clips."""

FIGURE_NAMES: tuple[FigureName, ...] = get_args(FigureName)

Array = NDArray[np.float64]
_MEANS: tuple[FigureName, ...] = ("psnr_db", "last_psnr_db", "ssim", "lpips", "diversity")
_RATIOS: tuple[FigureName, ...] = ("gradient_energy", "flicker")


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


MAIN = Selection()
"""Frames 2 to the last, all pixels."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Tallies:
    """Sums over clips; the leading dimensions are free, of clips, of scenes or of draws from them.

    means: [..., 5, 2], sum of the clips' means and how many clips have one; PSNR, PSNR of the last frame, SSIM, LPIPS,
    diversity. ratios: [..., 2, 2], of views and of targets; gradient, change between frames.
    grid, full: [..., 3, K], pixels that are right, predicted and true by class, at the class grid and at picture size.
    common: ids of the commonest classes.
    """

    means: Array
    ratios: Array
    grid: Array
    full: Array
    common: tuple[int, ...] = ()

    def weighted(self, weights: Array) -> Self:
        """Sums [..., n] x [n, ...]: each of the n rows as often as it weighs."""
        made = (np.tensordot(weights, each, axes=1) for each in (self.means, self.ratios, self.grid, self.full))
        means, ratios, grid, full = made
        return type(self)(means=means, ratios=ratios, grid=grid, full=full, common=self.common)

    def grouped(self, groups: Sequence[str]) -> Self:
        """Sums [G, ...] of rows by group, in the order of each group's first row."""
        order = list(dict.fromkeys(groups))
        weights = np.array([[float(group == each) for group in groups] for each in order])
        return self.weighted(weights)

    def part(self, name: FigureName) -> Self:
        """Only the sums that one figure is made of, as a tenth of all is quicker to draw from."""
        grid, full = name in ("accuracy", "miou"), name in ("miou_full", "miou_common")
        return type(self)(
            means=self.means if name in _MEANS else self.means[..., :0],
            ratios=self.ratios if name in _RATIOS else self.ratios[..., :0],
            grid=self.grid if grid else self.grid[..., :0],
            full=self.full if full else self.full[..., :0],
            common=self.common,
        )

    def figure(self, name: FigureName) -> Array:
        """One figure, [...]; NaN where there is nothing to measure."""
        if name in _MEANS:
            return _divided(self.means[..., _MEANS.index(name), 0], self.means[..., _MEANS.index(name), 1])
        if name in _RATIOS:
            return _divided(self.ratios[..., _RATIOS.index(name), 0], self.ratios[..., _RATIOS.index(name), 1])
        if name == "accuracy":
            return _divided(self.grid[..., 0, :].sum(-1), self.grid[..., 2, :].sum(-1))
        if name == "miou":
            return _nanmean(class_iou(self.grid))
        iou = class_iou(self.full)
        return _nanmean(iou[..., list(self.common)] if name == "miou_common" else iou)


def class_iou(counts: Array) -> Array:
    """Intersection over union of each class, [..., K], from counts [..., 3, K]; NaN for one nobody predicts or sees."""
    right, predicted, true = np.moveaxis(counts, -2, 0)
    return _divided(right, predicted + true - right)


def tallies(
    records: Sequence[ClipRecord], selection: Selection, *, classes: int = 0, counts: ClassCounts | None = None
) -> Tallies:
    """Sums of each clip, leading dimension [n].

    Args:
        classes: how many there are at least; ids beyond make it more. counts: of these records, where they are known.
    """
    clips, counts = len(records), counts or class_counts(records, classes)
    grid, full, frames = counts.grid, counts.of(selection.region), selection.frame_slice()
    return Tallies(
        means=np.array([_means(record, selection) for record in records]).reshape(clips, len(_MEANS), 2),
        ratios=np.array([_ratios(record, selection) for record in records]).reshape(clips, len(_RATIOS), 2),
        grid=(grid if selection.region == "all" else np.zeros_like(grid))[:, frames].sum(axis=1),
        full=full[:, frames].sum(axis=1),
        common=counts.common,
    )


def clip_mean(values: Sequence[Frames] | None, frames: slice) -> float:
    """Mean over draws and frames of [S][T] values, of those that there are; NaN for none."""
    return float("nan") if values is None else float(_nanmean(_array(values)[:, frames].ravel()))


def _means(record: ClipRecord, selection: Selection) -> list[tuple[float, float]]:
    region, frames = record.regions.get(selection.region), selection.frame_slice()
    lpips = record.lpips if selection.region == "all" else None
    found = [
        clip_mean(region and region.psnr_db, frames),
        clip_mean(region and region.psnr_db, slice(-1, None)),
        clip_mean(region and region.ssim, frames),
        clip_mean(lpips, frames),
        clip_mean(None if region is None or region.diversity is None else (region.diversity,), frames),
    ]
    return [(0.0, 0.0) if np.isnan(value) else (value, 1.0) for value in found]


def _ratios(record: ClipRecord, selection: Selection) -> list[tuple[float, float]]:
    region, nothing = record.regions.get(selection.region), (0.0, 0.0)
    return [
        nothing if region is None else _gradients(region, selection.frame_slice()),
        _ratio(record.step, record.step_target, selection.step_slice()) if selection.region == "all" else nothing,
    ]


def _gradients(region: RegionRecord, chosen: slice) -> tuple[float, float]:
    """Of views and targets, each frame by the region's share of it; a frame without such pixels adds nothing."""
    if region.gradient is None or region.gradient_target is None:
        return 0.0, 0.0
    share = _array(region.pixels)
    views = tuple(tuple(np.nan_to_num(_array(draw)) * share) for draw in region.gradient)
    return _ratio(views, tuple(np.nan_to_num(_array(region.gradient_target)) * share), chosen)


def _ratio(views: Sequence[Frames] | None, targets: Frames, chosen: slice) -> tuple[float, float]:
    """Sums over frames of views, a mean over draws, and of targets; nothing of either where there is no view."""
    if views is None:
        return 0.0, 0.0
    return float(_array(views)[:, chosen].mean(axis=0).sum()), float(_array(targets)[chosen].sum())


def _array(values: Sequence[Frames] | Frames) -> Array:
    """Values with NaN for None."""
    return np.array(values, dtype=np.float64)


def _divided(above: Array, below: Array) -> Array:
    """Above over below, NaN for nothing over nothing."""
    return np.divide(above, below, out=np.full(np.shape(above), np.nan), where=np.asarray(below) != 0)


def _nanmean(values: Array) -> Array:
    """Mean over the last dimension of what is not NaN; NaN if all is."""
    there = ~np.isnan(values)
    return _divided(np.where(there, values, 0.0).sum(-1), there.sum(-1).astype(np.float64))
