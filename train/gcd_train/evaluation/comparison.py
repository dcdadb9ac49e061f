"""One method against the others on the same clips, with paired intervals, and its worst clips."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcd_train.evaluation.paper import CLASS_COLUMNS, PICTURE_COLUMNS, Column
from gcd_train.evaluation.runs import EvaluatedSet, Method
from gcd_train.evaluation.statistics import FigureName, Interval, Selection, Span, common_clips, difference
from gcd_train.evaluation.store import Region
from gcd_train.evaluation.tables import NOTHING, Cell, Measured, csv_text, markdown_rows

COLUMNS = (*PICTURE_COLUMNS, *CLASS_COLUMNS)
_BETTER_IF_LOW = ("lpips",)


@dataclass(frozen=True, kw_only=True, slots=True)
class Difference:
    """How far one method lies above another in one figure. clips: that both have.

    starred: one of them was given more for this figure than for its others, see `Method.copies_classes`.
    """

    first: str
    other: str
    column: Column
    frames: Span
    clips: int
    apart: Interval
    starred: bool = False

    @property
    def verdict(self) -> str:
        """ "better" or "worse" where zero lies outside the interval, "open" where it does not."""
        if not self.apart.off_zero:
            return "open"
        return "better" if (self.apart.value > 0) != (self.column.figure in _BETTER_IF_LOW) else "worse"


def differences(measured: Measured, first: Method, frames: Span = "2-last") -> tuple[Difference, ...]:
    """A method against every other one, in all columns that both have figures in, on the clips that both have."""
    found: list[Difference] = []
    for other in measured.of.methods:
        ours, theirs = common_clips(first.records, other.records)
        for column in COLUMNS if ours and other.name != first.name else ():
            selection = Selection(frames=frames, region=column.region)
            apart = difference(
                measured.sums(first, selection, ours), measured.sums(other, selection, theirs), column.figure
            )
            if apart.known:
                found.append(
                    Difference(
                        first=first.name,
                        other=other.name,
                        column=column,
                        frames=frames,
                        clips=len(ours),
                        apart=apart,
                        starred=(first.copies_classes or other.copies_classes) and column.of_classes,
                    )
                )
    return tuple(found)


def differences_csv(found: Sequence[Difference]) -> str:
    """One difference a line."""
    lines = [
        [
            each.first,
            each.other,
            each.frames,
            each.column.heading,
            *Cell(figure=each.apart).numbers(),
            str(each.clips),
            each.verdict,
        ]
        for each in found
    ]
    return csv_text(["first", "other", "frames", "figure", "first ahead", "low", "high", "clips", "verdict"], lines)


def differences_markdown(found: Sequence[Difference], of: EvaluatedSet) -> str:
    """A row for each other method, a column for each figure; bold where zero lies outside the interval.

    Stars as in the other tables of the set.
    """
    headings = list(dict.fromkeys(each.column.heading for each in found))
    cells = {(each.other, each.column.heading): _told(each) for each in found}
    others = list(dict.fromkeys(each.other for each in found))
    rows = [
        [of.method(other).starred, *(cells.get((other, heading), NOTHING) for heading in headings)] for other in others
    ]
    return "\n".join(markdown_rows(["", *headings], rows)) + "\n"


def _told(each: Difference) -> str:
    value, low, high = (
        f"{number:+.{each.column.digits}f}" for number in (each.apart.value, each.apart.low, each.apart.high)
    )
    star = " *" if each.starred else ""
    if np.isnan(each.apart.low):  # one scene tells nothing of it
        return value + star
    text = f"{value} [{low}, {high}]"
    return (text if each.verdict == "open" else f"**{text}** {each.verdict}") + star


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
    name = worst_figure(method)
    values, occluded = (measured.by_clip(method, region, name) for region in _REGIONS)
    rivals = [
        (
            f"{other.name} *" if other.copies_classes and name != "psnr_db" else other.starred,
            dict(zip(other.keys, measured.by_clip(other, "all", name).tolist(), strict=True)),
        )
        for other in measured.of.methods
        if other.name != method.name
    ]
    found: list[WorstClip] = []
    for place in np.argsort(np.nan_to_num(values, nan=np.inf), kind="stable")[:count]:
        record = method.records[place]
        theirs = [(by_key.get(record.key, np.nan), rival) for rival, by_key in rivals]
        best_value, best = max((pair for pair in theirs if np.isfinite(pair[0])), default=(float("nan"), ""))
        found.append(
            WorstClip(
                key=record.key,
                value=float(values[place]),
                occluded=float(occluded[place]),
                best=best,
                best_value=best_value,
                change=record.change,
            )
        )
    return tuple(found)


def worst_markdown(name: FigureName, found: Sequence[WorstClip]) -> str:
    """A row for each clip."""
    heading, digits = ("PSNR dB", 2) if name == "psnr_db" else ("mIoU", 3)

    def shown(value: float) -> str:
        return NOTHING if np.isnan(value) else f"{value:.{digits}f}"

    rows = [
        [
            each.key,
            NOTHING if each.change is None else ", ".join(f"{part:+.1f}" for part in each.change),
            shown(each.value),
            shown(each.occluded),
            each.best or NOTHING,
            shown(each.best_value),
        ]
        for each in found
    ]
    headings = ["clip", "azimuth, elevation, radius", heading, f"{heading} occluded", "best other", f"its {heading}"]
    return "\n".join(markdown_rows(headings, rows)) + "\n"


def clips_csv(measured: Measured) -> str:
    """Every method on every clip: one line each, frames 2 to the last."""
    columns: list[tuple[FigureName, Region]] = [(name, region) for region in _REGIONS for name in _FIGURES]
    lines: list[list[str]] = []
    for method in measured.of.methods:
        by_clip = np.stack([measured.by_clip(method, region, name) for name, region in columns], axis=1)
        for record, values in zip(method.records, by_clip.tolist(), strict=True):
            change = ("", "", "") if record.change is None else tuple(f"{part:g}" for part in record.change)
            cells = ["" if np.isnan(value) else f"{value:.6g}" for value in values]
            lines.append([method.name, record.key, record.scene, *change, *cells, f"{record.seconds:.4g}"])
    named = [f"{name} {region}" for name, region in columns]
    return csv_text(["method", "clip", "scene", "azimuth", "elevation", "radius", *named, "seconds"], lines)


_REGIONS: tuple[Region, ...] = ("all", "occluded")
_FIGURES: tuple[FigureName, ...] = ("psnr_db", "ssim", "miou_full")
