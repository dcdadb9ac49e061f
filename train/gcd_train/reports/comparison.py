"""One method against the others on the same clips, with paired intervals: what a claim rests on."""

from collections.abc import Sequence
from dataclasses import dataclass

from gcd_train.evaluation.tallies import Selection, Span
from gcd_train.reports.figure_tables import Measured
from gcd_train.reports.intervals import Drawn, Interval, common_clips, difference, drawn
from gcd_train.reports.material import EvaluatedSet, Method
from gcd_train.reports.paper import CLASS_COLUMNS, PICTURE_COLUMNS, Column
from gcd_train.reports.table import NOTHING, Cell, csv_text, markdown_rows

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
    """A method against every other one, in all columns that both have figures in."""
    others = [method for method in measured.of.methods if method.name != first.name]
    return tuple(each for other in others for each in _apart(measured, first, other, frames))


def _apart(measured: Measured, first: Method, other: Method, frames: Span) -> list[Difference]:
    found: list[Difference] = []
    for column in COLUMNS:
        pair = _sums(measured, first, other, Selection(frames=frames, region=column.region))
        apart = None if pair is None else difference(pair.first, pair.other, column.figure)
        if pair is not None and apart is not None and apart.known:
            found.append(
                Difference(
                    first=first.name,
                    other=other.name,
                    column=column,
                    frames=frames,
                    clips=pair.clips,
                    apart=apart,
                    starred=(first.copies_classes or other.copies_classes) and column.of_classes,
                )
            )
    return found


@dataclass(frozen=True, kw_only=True, slots=True)
class _Pair:
    first: Drawn
    other: Drawn
    clips: int


def _sums(measured: Measured, first: Method, other: Method, selection: Selection) -> _Pair | None:
    """Both methods' sums of the clips that both have; None where there is no such clip."""
    if first.keys == other.keys:
        both = measured.sums(first, selection), measured.sums(other, selection)
        return _Pair(first=both[0], other=both[1], clips=len(first.keys))
    ours, theirs = common_clips(first.records, other.records)
    if not ours:
        return None
    classes, seed = len(measured.of.note.classes), measured.seed
    both = tuple(drawn(records, selection, classes=classes, seed=seed) for records in (ours, theirs))
    return _Pair(first=both[0], other=both[1], clips=len(ours))


def to_csv(found: Sequence[Difference]) -> str:
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


def to_markdown(found: Sequence[Difference], of: EvaluatedSet) -> str:
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
    if each.apart.low != each.apart.low:  # NaN: one scene tells nothing of it
        return value + star
    text = f"{value} [{low}, {high}]"
    return (text if each.verdict == "open" else f"**{text}** {each.verdict}") + star
