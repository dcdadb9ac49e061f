"""The clips that a method does worst on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcd_train.evaluation.figures import figures
from gcd_train.evaluation.record import ClipRecord, Region
from gcd_train.evaluation.tallies import FigureName, Selection
from gcd_train.reports.figure_tables import Measured
from gcd_train.reports.material import Method
from gcd_train.reports.table import NOTHING, csv_text, markdown_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class WorstClip:
    """One clip of a method. occluded: the figure there; NaN for none. best, best_value: of the other methods on it.

    best is starred where it was given more for this figure than the source video.
    """

    key: str
    value: float
    occluded: float
    best: str
    best_value: float
    change: tuple[float, float, float] | None


def worst_figure(method: Method) -> FigureName:
    """What clips are ordered by: PSNR, or mIoU of a method without pictures."""
    return "psnr_db" if method.makes_pictures else "miou_full"


def worst_clips(measured: Measured, method: Method, count: int) -> tuple[WorstClip, ...]:
    """So many clips, the worst first, in frames 2 to the last; what has no figure comes last."""
    name, others = worst_figure(method), [each for each in measured.of.methods if each.name != method.name]
    values = [_of(record, "all", name) for record in method.records]
    order = np.argsort(np.nan_to_num(values, nan=np.inf), kind="stable")[:count]
    return tuple(_told(method.records[place], name, others) for place in order)


def to_markdown(name: FigureName, found: Sequence[WorstClip]) -> str:
    """A row for each clip."""
    told, digits = ("PSNR dB", 2) if name == "psnr_db" else ("mIoU", 3)
    headings = ["clip", "azimuth, elevation, radius", told, f"{told} occluded", "best other", f"its {told}"]
    rows = [
        [
            each.key,
            NOTHING if each.change is None else ", ".join(f"{part:+.1f}" for part in each.change),
            _shown(each.value, digits),
            _shown(each.occluded, digits),
            each.best or NOTHING,
            _shown(each.best_value, digits),
        ]
        for each in found
    ]
    return "\n".join(markdown_rows(headings, rows)) + "\n"


def clips_csv(measured: Measured) -> str:
    """Every method on every clip: one line each, frames 2 to the last."""
    lines = [
        [
            method.name,
            record.key,
            record.scene,
            *(("", "", "") if record.change is None else (f"{part:g}" for part in record.change)),
            *_figures_of(record),
            f"{record.seconds:.4g}",
        ]
        for method in measured.of.methods
        for record in method.records
    ]
    named = [f"{name} {region}" for region in _REGIONS for name in _FIGURES]
    return csv_text(["method", "clip", "scene", "azimuth", "elevation", "radius", *named, "seconds"], lines)


_REGIONS: tuple[Region, ...] = ("all", "occluded")
_FIGURES: tuple[FigureName, ...] = ("psnr_db", "ssim", "miou_full")


def _figures_of(record: ClipRecord) -> list[str]:
    of_region = [figures([record], Selection(region=region)) for region in _REGIONS]
    values = [float(getattr(found, name)) for found in of_region for name in _FIGURES]
    return ["" if np.isnan(value) else f"{value:.6g}" for value in values]


def _told(record: ClipRecord, name: FigureName, others: Sequence[Method]) -> WorstClip:
    same = [(_starred(other, name), each) for other in others for each in other.records if each.key == record.key]
    rivals = [(_of(each, "all", name), rival) for rival, each in same]
    best_value, best = max((pair for pair in rivals if np.isfinite(pair[0])), default=(float("nan"), ""))
    return WorstClip(
        key=record.key,
        value=_of(record, "all", name),
        occluded=_of(record, "occluded", name),
        best=best,
        best_value=best_value,
        change=record.change,
    )


def _starred(method: Method, name: FigureName) -> str:
    return f"{method.name} *" if method.copies_classes and name != "psnr_db" else method.starred


def _of(record: ClipRecord, region: Region, name: FigureName) -> float:
    """One figure of one clip."""
    return float(getattr(figures([record], Selection(region=region)), name))


def _shown(value: float, digits: int) -> str:
    return NOTHING if np.isnan(value) else f"{value:.{digits}f}"
