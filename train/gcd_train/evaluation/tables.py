"""Tables of a set of clips: the paper's, or the same columns for clips of our own, and paired differences."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product, zip_longest
from math import isnan, nan
from typing import TypeAlias

import numpy as np

from gcd_train.evaluation.paper import (
    CLASS_COLUMNS,
    PICTURE_COLUMNS,
    Column,
    PaperTable,
    row_label,
    tables_for,
)
from gcd_train.evaluation.runs import EvaluatedSet, Method
from gcd_train.evaluation.statistics import (
    FIGURE_NAMES,
    FigureName,
    Interval,
    Selection,
    Span,
    class_iou,
    common_clips,
    difference,
)
from gcd_train.evaluation.store import REGIONS, Region

NOT_RUN, NO_WEIGHTS, NOTHING = "not run", "no weights given", "-"
_LINE = "———"
_SPANS: tuple[Span, ...] = ("2-last", "last", "all")
_OWN_NAMES: dict[Span, str] = {"2-last": "main", "last": "last_frame", "all": "all_frames"}
_BRACKETS = "In brackets: 95 % interval, bootstrap over scenes. * is given more than the source video."
STAR_OF_FIGURE = "A * behind a mIoU: these class maps are made from the source's exact ones, which no model is given."
"""Stands below tables with such a star."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Cell:
    """One figure of a table, or why there is none.

    digits: behind the point. note: stands in for the figure. paper: what the paper prints there, its own data. starred:
    the method was given more for this figure than for its others.
    """

    figure: Interval | None = None
    digits: int = 2
    note: str = NOTHING
    paper: float | None = None
    starred: bool = False

    def __str__(self) -> str:
        if self.figure is None or not self.figure.known:
            return self.note
        star, value = " *" if self.starred else "", f"{self.figure.value:.{self.digits}f}"
        if isnan(self.figure.low):  # of one scene
            return value + star
        return f"{value} [{self.figure.low:.{self.digits}f}, {self.figure.high:.{self.digits}f}]{star}"

    def numbers(self) -> tuple[str, str, str]:
        """Value and bounds in full, empty for none."""
        numbers = (nan,) * 3 if self.figure is None else (self.figure.value, self.figure.low, self.figure.high)
        value, low, high = ("" if isnan(number) else f"{number:.6g}" for number in numbers)
        return value, low, high

    @property
    def printed(self) -> str:
        """What the paper prints, empty for nothing."""
        return "" if self.paper is None else f"{self.paper:g}"


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """label: of the row. method: whose figures these are, empty for none. clips: how many it was measured on."""

    label: str = ""
    method: str = ""
    clips: str = ""
    cells: tuple[Cell, ...]

    @property
    def printed(self) -> str:
        """What the paper prints in it, in one cell."""
        each = [cell.printed for cell in self.cells]
        return ", ".join(text or NOTHING for text in each) if any(each) else ""


@dataclass(frozen=True, kw_only=True, slots=True)
class Table:
    """name: of its file. title, notes: above and below it. headings: of the cells' columns. below: under a line."""

    name: str
    title: str
    headings: tuple[str, ...]
    rows: tuple[Row, ...]
    below: tuple[Row, ...] = ()
    notes: tuple[str, ...] = ()


def to_markdown(table: Table) -> str:
    """With a heading of the third level."""
    every = (*table.rows, *table.below)
    has_paper = any(row.printed for row in every)
    heads = ["", "method", "clips", *table.headings, *(["paper (its own data)"] if has_paper else [])]
    rows = [
        [row.label, row.method, row.clips, *map(str, row.cells), *([row.printed] if has_paper else [])] for row in every
    ]
    if table.below:
        rows.insert(len(table.rows), [_LINE] * len(heads))
    lines = [f"### {table.title}", "", *markdown_rows(heads, rows)]
    return "\n".join([*lines, *(f"\n{note}" for note in table.notes)]) + "\n"


def to_csv(table: Table) -> str:
    """For each column its value, the bounds and what the paper prints; what is missing is empty."""
    parts = [f"{heading}{what}" for heading in table.headings for what in ("", " low", " high", " paper")]
    rows: list[list[str]] = []
    for row in (*table.rows, *table.below):
        cells = [part for cell in row.cells for part in (*cell.numbers(), cell.printed)]
        rows.append([row.label, row.method or NOT_RUN, row.clips, *cells])
    return csv_text(["row", "method", "clips", *parts], rows)


def csv_text(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """RFC 4180, with line feeds."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([headings, *rows])
    return out.getvalue()


def markdown_rows(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table; a bar inside a cell is escaped."""
    every = (headings, ["---"] * len(headings), *rows)
    return [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |" for cells in every]


def counted(number: int, what: str) -> str:
    """ "1 scene", "2 scenes"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def frames_told(of: EvaluatedSet, frames: Span) -> str:
    """Which frames a table is over, in words."""
    return {"2-last": f"frames 2-{of.note.frames}", "last": "last frame", "all": f"all {of.note.frames} frames"}[frames]


def main_tables(of: EvaluatedSet, spans: Sequence[Span] = ("2-last", "last")) -> tuple[Table, ...]:
    """The paper's tables for clips of its sets, tables of the same columns under their own title for others.

    Args:
        spans: only tables over these frames. The paper has none over all frames, so that one is always our own.
    """
    papers = {each.frames: each for each in tables_for(of.note)}
    pictures, classes = any(m.makes_pictures for m in of.methods), any(m.makes_classes for m in of.methods)
    every = (*(PICTURE_COLUMNS if pictures else ()), *(CLASS_COLUMNS if classes else ()))
    columns = tuple(column for column in every if column.region in of.regions)
    ours = tuple(
        _own_table(of, columns, frames, _OWN_NAMES[frames], f"{of.title}: {frames_told(of, frames)}")
        for frames in spans
        if frames not in papers
    )
    return (*ours, *(_paper_table(of, each) for frames, each in papers.items() if frames in spans))


def region_table(of: EvaluatedSet, frames: Span = "2-last") -> Table:
    """Every method on all, visible and occluded pixels side by side, with its diversity and sharpness on all."""
    title = f"Visible and occluded pixels, diversity, sharpness: {frames_told(of, frames)}"
    notes = {
        "diversity": "Diversity: standard deviation over the draws of one view; of two draws or more.",
        "gradient energy": "Gradient energy: view over target, 1 is as sharp as the target.",
    }
    columns = tuple(column for column in _REGION_COLUMNS if column.region in of.regions)
    table = _own_table(of, columns, frames, "regions", title)
    return replace(table, notes=(*table.notes, *(notes[name] for name in table.headings if name in notes)))


def class_table(of: EvaluatedSet, frames: Span = "2-last") -> Table:
    """Intersection over union of each class at picture size; what occurs nowhere is left out."""
    methods = [method for method in of.methods if method.makes_classes]
    iou = [class_iou(of.sums(each, Selection(frames=frames)).classes.sum(axis=0)) for each in methods]
    there = [place for place in range(len(of.note.classes)) if any(np.isfinite(each[place]) for each in iou)]
    rows = tuple(
        Row(
            method=method.starred,
            clips=f"{len(method.records)} of {len(of.keys)}",
            cells=tuple(
                Cell(figure=Interval(value=float(each[place]), low=nan, high=nan), starred=method.copies_classes)
                for place in there
            ),
        )
        for method, each in zip(methods, iou, strict=True)
    )
    names = tuple(of.note.classes[place] for place in there)
    return Table(name="classes", title=f"IoU of each class: {frames_told(of, frames)}", headings=names, rows=rows)


def _own_table(of: EvaluatedSet, columns: Sequence[Column], frames: Span, name: str, title: str) -> Table:
    """Of the columns in which any method has a figure."""
    rows = [_row(of, method, columns, frames) for method in of.methods]
    there = [place for place, _ in enumerate(columns) if any(str(row.cells[place]) != NOTHING for row in rows)]
    kept = [columns[place] for place in there]
    return Table(
        name=name,
        title=title,
        headings=tuple(column.heading for column in kept),
        rows=tuple(replace(row, cells=tuple(row.cells[place] for place in there)) for row in rows),
        notes=_notes(of, kept, frames),
    )


def _paper_table(of: EvaluatedSet, table: PaperTable) -> Table:
    placed: dict[str, list[Method]] = {}
    for method in of.methods:
        label = of.rows.get(method.name) or row_label(method.name, method.details, table)
        placed.setdefault(label or "", []).append(method)
    rows, columns, frames = list[Row](), table.columns, table.frames
    for label, printed in table.rows.items():
        found = placed.pop(label, [])
        rows += [_row(of, each, columns, frames, label, printed) for each in found]
        rows += [] if found else [Row(label=label, cells=_not_run(printed, columns))]
    below = [  # label: of a row in another of the paper's tables, or empty
        _row(of, each, columns, frames, f"{label}, not in this table" if label else "not in the paper")
        for label, methods in placed.items()
        for each in methods
    ]
    return Table(
        name=table.name,
        title=f"{table.title} ({of.title})",
        headings=tuple(column.heading for column in table.columns),
        rows=tuple(rows),
        below=tuple(below),
        notes=_notes(of, table.columns, table.frames),
    )


Printed: TypeAlias = Sequence[float | None]


def _row(
    of: EvaluatedSet,
    method: Method,
    columns: Sequence[Column],
    frames: Span,
    label: str = "",
    printed: Printed = (),
) -> Row:
    """A method's figures, beside what the paper prints in its row."""
    cells = tuple(
        Cell(
            figure=of.sums(method, Selection(frames=frames, region=column.region)).interval(column.figure),
            digits=column.digits,
            note=_why_not(of, method, column),
            paper=blank.paper,
            starred=method.copies_classes and column.of_classes,
        )
        for column, blank in zip(columns, _not_run(printed, columns), strict=True)
    )
    clips = f"{len(method.records)} of {len(of.keys)}"
    return Row(label=label, method=method.starred, clips=clips, cells=cells)


def _not_run(printed: Printed, columns: Sequence[Column]) -> tuple[Cell, ...]:
    return tuple(Cell(note=NOT_RUN, paper=paper) for _, paper in zip_longest(columns, printed))


def _why_not(of: EvaluatedSet, method: Method, column: Column) -> str:
    """What stands where there is no figure."""
    if column.figure == "lpips" and method.makes_pictures:
        return NO_WEIGHTS
    return NOTHING if column.region in of.regions else "unknown"


def _notes(of: EvaluatedSet, columns: Sequence[Column], frames: Span) -> tuple[str, ...]:
    """What stands below a table: its frames and clips, what brackets and stars mean, what is not known."""
    told = frames_told(of, frames)
    notes = [f"{told[0].upper()}{told[1:]} of {len(of.keys)} clips of {of.scenes} scenes. {_BRACKETS}"]
    if any(column.of_classes for column in columns) and any(each.copies_classes for each in of.methods):
        notes.append(STAR_OF_FIGURE)
    if any(column.region not in of.regions for column in columns):
        notes.append("Unknown: nobody knows which pixels of these clips the source camera saw.")
    if any(column.figure == "lpips" for column in columns) and len(of.regions) > 1:
        notes.append("LPIPS is over all pixels alone: its network sees patches, which no region cuts out.")
    return tuple(notes)


_BY_REGION: tuple[tuple[str, FigureName, int], ...] = (
    ("PSNR", "psnr_db", 2),
    ("SSIM", "ssim", 3),
    ("mIoU", "miou_common", 3),
)
_REGION_COLUMNS = (
    *(
        Column(heading=f"{name} {region}", figure=figure, region=region, digits=digits)
        for name, figure, digits in _BY_REGION
        for region in REGIONS
    ),
    Column(heading="diversity", figure="diversity", digits=4),
    Column(heading="gradient energy", figure="gradient_energy"),
)


def all_figures(of: EvaluatedSet) -> str:
    """Every figure of every method, frames and pixels with its interval, as CSV: one figure a line."""
    lines: list[list[str]] = []
    for method, frames, region in product(of.methods, _SPANS, of.regions):
        sums, clips = of.sums(method, Selection(frames=frames, region=region)), str(len(method.records))
        cells = {name: Cell(figure=sums.interval(name)).numbers() for name in FIGURE_NAMES}
        lines += [[method.name, frames, region, name, *cell, clips] for name, cell in cells.items() if cell[0]]
    return csv_text(["method", "frames", "pixels", "figure", "value", "low", "high", "clips"], lines)


_BY_CLIP: tuple[FigureName, ...] = ("psnr_db", "ssim", "miou_full")


def clips_csv(of: EvaluatedSet) -> str:
    """Every method on every clip: one line each, frames 2 to the last."""
    regions: tuple[Region, ...] = ("all", "occluded")
    columns: list[tuple[FigureName, Region]] = [(name, region) for region in regions for name in _BY_CLIP]
    lines: list[list[str]] = []
    for method in of.methods:
        by_clip = np.stack([of.by_clip(method, region, name) for name, region in columns], axis=1)
        for record, values in zip(method.records, by_clip.tolist(), strict=True):
            change = ("", "", "") if record.change is None else tuple(f"{part:g}" for part in record.change)
            cells = ["" if np.isnan(value) else f"{value:.6g}" for value in values]
            lines.append([method.name, record.key, record.scene, *change, *cells, f"{record.seconds:.4g}"])
    named = [f"{name} {region}" for name, region in columns]
    return csv_text(["method", "clip", "scene", "azimuth", "elevation", "radius", *named, "seconds"], lines)


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


def differences(of: EvaluatedSet, first: Method, frames: Span = "2-last") -> tuple[Difference, ...]:
    """A method against every other one, in all columns that both have figures in, on the clips that both have."""
    found: list[Difference] = []
    for other in of.methods:
        ours, theirs = common_clips(first.records, other.records)
        for column in (*PICTURE_COLUMNS, *CLASS_COLUMNS) if ours and other.name != first.name else ():
            chosen = Selection(frames=frames, region=column.region)
            apart = difference(of.sums(first, chosen, ours), of.sums(other, chosen, theirs), column.figure)
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
    cells = {(each.other, each.column.heading): _difference_told(each) for each in found}
    others = list(dict.fromkeys(each.other for each in found))
    rows = [[of.method(name).starred, *(cells.get((name, head), NOTHING) for head in headings)] for name in others]
    return "\n".join(markdown_rows(["", *headings], rows)) + "\n"


def _difference_told(each: Difference) -> str:
    value, low, high = (
        f"{number:+.{each.column.digits}f}" for number in (each.apart.value, each.apart.low, each.apart.high)
    )
    star = " *" if each.starred else ""
    if np.isnan(each.apart.low):  # one scene tells nothing of it
        return value + star
    text = f"{value} [{low}, {high}]"
    return (text if each.verdict == "open" else f"**{text}** {each.verdict}") + star
