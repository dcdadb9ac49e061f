"""Methods held against each other: paired differences, and a method's worst clips beside whoever does best there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcd_train.evaluation.paper import CLASS_COLUMNS, PICTURE_COLUMNS, Column
from gcd_train.evaluation.runs import EvaluatedSet, Measured, Method
from gcd_train.evaluation.statistics import FigureName, Interval, Selection, Span, common_clips, difference
from gcd_train.evaluation.tables import NOTHING, WORST_REGIONS, Cell, csv_text, markdown_rows


@dataclass(frozen=True, slots=True)
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
        return "better" if (self.apart.value > 0) != (self.column.figure == "lpips") else "worse"


def differences(measured: Measured, first: Method, frames: Span = "2-last") -> tuple[Difference, ...]:
    """A method against every other one, in all columns that both have figures in, on the clips that both have."""
    found: list[Difference] = []
    for other in measured.of.methods:
        ours, theirs = common_clips(first.records, other.records)
        for column in (*PICTURE_COLUMNS, *CLASS_COLUMNS) if ours and other.name != first.name else ():
            chosen = Selection(frames=frames, region=column.region)
            apart = difference(measured.sums(first, chosen, ours), measured.sums(other, chosen, theirs), column.figure)
            starred = (first.copies_classes or other.copies_classes) and column.of_classes
            if apart.known:
                found.append(Difference(first.name, other.name, column, frames, len(ours), apart, starred))
    return tuple(found)


def differences_csv(found: Sequence[Difference]) -> str:
    """One difference a line."""
    lines = [
        [e.first, e.other, e.frames, e.column.heading, *Cell(figure=e.apart).numbers(), str(e.clips), e.verdict]
        for e in found
    ]
    return csv_text(["first", "other", "frames", "figure", "first ahead", "low", "high", "clips", "verdict"], lines)


def differences_markdown(found: Sequence[Difference], of: EvaluatedSet) -> str:
    """A row for each other method, a column for each figure; bold where zero lies outside the interval."""
    headings = list(dict.fromkeys(each.column.heading for each in found))
    cells = {(each.other, each.column.heading): _told(each) for each in found}
    others = list(dict.fromkeys(each.other for each in found))
    rows = [[of.method(name).starred, *(cells.get((name, head), NOTHING) for head in headings)] for name in others]
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


@dataclass(frozen=True, slots=True)
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
    values, occluded = (measured.by_clip(method, region, name) for region in WORST_REGIONS)
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
        of_method = (float(values[place]), float(occluded[place]))
        found.append(WorstClip(record.key, *of_method, best, best_value, record.change))
    return tuple(found)


def worst_markdown(name: FigureName, found: Sequence[WorstClip]) -> str:
    """A row for each clip."""
    heading, digits = ("PSNR dB", 2) if name == "psnr_db" else ("mIoU", 3)

    def shown(value: float) -> str:
        return NOTHING if np.isnan(value) else f"{value:.{digits}f}"

    rows: list[list[str]] = []
    for each in found:
        change = NOTHING if each.change is None else ", ".join(f"{part:+.1f}" for part in each.change)
        figures = [shown(each.value), shown(each.occluded), each.best or NOTHING, shown(each.best_value)]
        rows.append([each.key, change, *figures])
    headings = ["clip", "azimuth, elevation, radius", heading, f"{heading} occluded", "best other", f"its {heading}"]
    return "\n".join(markdown_rows(headings, rows)) + "\n"
