"""Tables of a set of clips: the paper's, or the same columns for clips of our own, and paired differences."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product, zip_longest
from math import isnan, nan

import numpy as np

from gcd_train.evaluation.baselines import FROM_EXACT_CLASSES
from gcd_train.evaluation.paper import CLASS_COLUMNS, PICTURE_COLUMNS, Column, row_label, tables_for
from gcd_train.evaluation.runs import EvaluatedSet, MethodRecords
from gcd_train.evaluation.statistics import FIGURE_NAMES, SPANS, FigureName, Interval, Span
from gcd_train.evaluation.store import FRAMES_IN, REGIONS, Region

NOT_RUN, NO_WEIGHTS, NOTHING = "not run", "no weights given", "-"
_LINE = "———"
_OWN_NAMES: dict[Span, str] = {"2-last": "main", "last": "last_frame", "all": "all_frames"}
_BRACKETS = "In brackets: 95 % interval, bootstrap over scenes. * is given more than the source video."
_CROPPED = (
    "† Measured on the middle {} x {} of a frame's {} x {} pixels, which is all that is shown: {}. These are other "
    "pixels than those of other rows, so no difference to them is drawn."
)
_ELSEWHERE = "{}: made elsewhere, read from {} (digest {})."
_COPIED = "mIoU of {}: these class maps are made from the source's exact ones, which no model is given."


@dataclass(frozen=True, kw_only=True, slots=True)
class Cell:
    """One figure of a table, or why there is none.

    digits: behind the point. note: stands in for the figure.
    """

    figure: Interval = Interval(value=nan)  # noqa: RUF009  it is frozen
    digits: int = 2
    note: str = NOTHING

    def __str__(self) -> str:
        if not self.figure.known:
            return self.note
        values = [f"{number:.{self.digits}f}" for number in (self.figure.value, self.figure.low, self.figure.high)]
        bounds = "" if isnan(self.figure.low) else f" [{values[1]}, {values[2]}]"  # of one scene there are none
        return values[0] + bounds


def numbers(figure: Interval) -> list[str]:
    """Value and bounds in full, empty for none."""
    return ["" if isnan(each) else f"{each:.6g}" for each in (figure.value, figure.low, figure.high)]


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """label: of the row. method: whose figures these are, empty for none. clips: how many it was measured on. printed:
    what the paper prints in it, cell by cell, its own data.
    """

    label: str = ""
    method: str = ""
    clips: str = ""
    cells: tuple[Cell, ...]
    printed: Sequence[float | None] = ()


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
    heads, rows = ["", "method", "clips", *table.headings], list[list[str]]()
    papers = any(row.printed for row in table.rows)
    for row in (*table.rows, *table.below):
        printed = ", ".join(NOTHING if value is None else f"{value:g}" for value in row.printed)
        rows.append([row.label, row.method, row.clips, *map(str, row.cells), *([printed] if papers else [])])
    heads += ["paper (its own data)"] if papers else []
    if table.below:
        rows.insert(len(table.rows), [_LINE] * len(heads))
    lines = [f"### {table.title}", "", *markdown_rows(heads, rows)]
    return "\n".join([*lines, *(f"\n{note}" for note in table.notes)]) + "\n"


def to_csv(table: Table) -> str:
    """For each column its value, the bounds and what the paper prints; what is missing is empty."""
    heads = [f"{heading}{what}" for heading in table.headings for what in ("", " low", " high", " paper")]
    lines: list[list[str]] = []
    for row in (*table.rows, *table.below):
        line = [row.label, row.method or NOT_RUN, row.clips]
        for cell, printed in zip_longest(row.cells, row.printed):
            line += [*numbers(cell.figure), "" if printed is None else f"{printed:g}"]
        lines.append(line)
    return csv_text(["row", "method", "clips", *heads], lines)


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
    made = [
        _own_table(of, every, frames, _OWN_NAMES[frames], f"{of.title}: {frames_told(of, frames)}")
        for frames in spans
        if frames not in papers
    ]
    for paper in (each for frames, each in papers.items() if frames in spans):
        labels = {m.name: row_label(m.name, m.details, paper) or "" for m in of.methods}
        rows: list[Row] = []
        for label, printed in paper.rows.items():
            found = [method for method in of.methods if labels[method.name] == label]
            rows += [_row(of, each, paper.columns, paper.frames, label, printed) for each in found]
            if not found:
                rows.append(Row(label=label, cells=(Cell(note=NOT_RUN),) * len(printed), printed=printed))
        rows += [_gain(rows, *gain) for gain in paper.gains]
        others = [method for method in of.methods if labels[method.name] not in paper.rows]
        below: list[Row] = []
        for method in sorted(others, key=lambda each: list(labels.values()).index(labels[each.name])):
            label = f"{labels[method.name]}, not in this table" if labels[method.name] else "not in the paper"
            below.append(_row(of, method, paper.columns, paper.frames, label))
        made.append(
            Table(
                name=paper.name,
                title=f"{paper.title} ({of.title})",
                headings=tuple(column.heading for column in paper.columns),
                rows=tuple(rows),
                below=tuple(below),
                notes=_notes(of, paper.columns, paper.frames),
            )
        )
    return tuple(made)


def region_table(of: EvaluatedSet, frames: Span = "2-last") -> Table:
    """Every method on all, visible and occluded pixels; its diversity, sharpness and flicker on all."""
    title = f"Visible and occluded pixels, diversity, sharpness, flicker: {frames_told(of, frames)}"
    notes = {
        "diversity": "Diversity: standard deviation over the draws of one view; of two draws or more.",
        "gradient energy": "Gradient energy: view over target, 1 is as sharp as the target.",
        "flicker": "Flicker: change from frame to frame, view over target; above 1 it changes more than the scene.",
    }
    table = _own_table(of, _REGION_COLUMNS, frames, "regions", title)
    return replace(table, notes=(*table.notes, *(notes[name] for name in table.headings if name in notes)))


def class_table(of: EvaluatedSet, frames: Span = "2-last") -> Table:
    """Intersection over union of each class at picture size; what occurs nowhere is left out."""
    columns = [Column(heading=name, figure=label) for label, name in enumerate(of.note.classes)]
    methods = tuple(method for method in of.methods if method.makes_classes)
    title = f"IoU of each class: {frames_told(of, frames)}"
    return _own_table(replace(of, methods=methods), columns, frames, "classes", title)


def _own_table(of: EvaluatedSet, columns: Sequence[Column], frames: Span, name: str, title: str) -> Table:
    """Of the columns in which any method has a figure."""
    columns = [column for column in columns if column.region in of.regions]
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


def _row(
    of: EvaluatedSet,
    method: MethodRecords,
    columns: Sequence[Column],
    frames: Span,
    label: str = "",
    printed: Sequence[float | None] = (),
) -> Row:
    """A method's figures, beside what the paper prints in its row."""
    cells: list[Cell] = []
    for column in columns:
        why_not = NOTHING if column.region in of.regions else "unknown"
        cells.append(
            Cell(
                figure=method.sums(frames, column.region).interval(column.figure),
                digits=column.digits,
                note=NO_WEIGHTS if column.figure == "lpips" and method.makes_pictures else why_not,
            )
        )
    clips = f"{len(method.records)} of {of.wanted}"
    return Row(label=label, method=method.starred, clips=clips, cells=tuple(cells), printed=printed)


def _gain(rows: Sequence[Row], better: str, worse: str, printed: float) -> Row:
    """The mean difference of the first column between variants that differ in this alone, where all were measured; of
    several methods in a row the first."""
    first = {row.label: row.cells[0].figure for row in reversed(rows)}
    apart = [first[label].value - first[label.replace(better, worse)].value for label in first if better in label]
    figure = Interval(value=sum(apart) / len(apart))  # not known as soon as one is not
    more = len(rows[0].cells) - 1
    cells = (Cell(figure=figure, note=NOT_RUN), *[Cell()] * more)
    return Row(label=f"{better} over {worse}, mean of variants", cells=cells, printed=(printed, *[None] * more))


def _notes(of: EvaluatedSet, columns: Sequence[Column], frames: Span) -> tuple[str, ...]:
    """What stands below a table: its frames and clips, what brackets and stars mean, what is not known."""
    span = frames_told(of, frames)
    notes = [f"{span[0].upper()}{span[1:]} of {len(of.clips)} clips of {of.scenes} scenes. {_BRACKETS}"]
    if equal := [each.name for each in of.methods if each.repeats(frames)]:
        notes.append(f"Frames that equal the target count as 100 dB: some of {', '.join(equal)} do.")
    for crop in dict.fromkeys(each.crop for each in of.methods if each.crop is not None):
        daggers = " and ".join(each.name for each in of.methods if each.crop == crop)
        notes.append(_CROPPED.format(crop[2], crop[3], of.note.width, of.note.height, daggers))
    for name, details in ((each.name, each.details) for each in of.methods if FRAMES_IN in each.details):
        notes.append(_ELSEWHERE.format(name, details[FRAMES_IN], details.get("digest", "unknown")))
    for name, draws in ((each.name, sorted({record.draws for record in each.records})) for each in of.methods):
        notes += [f"{name} has {draws[0]} to {draws[-1]} draws of a clip."] if len(draws) > 1 else []
    copied = [each.name for each in of.methods if each.details.get("baseline") in FROM_EXACT_CLASSES]
    if copied and any(isinstance(column.figure, int) or column.figure == "miou_common" for column in columns):
        notes.append(_COPIED.format(" and ".join(copied)))
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
    Column(heading="flicker", figure="flicker"),
)


def all_figures(of: EvaluatedSet) -> str:
    """Every figure of every method, frames and pixels with its interval, as CSV: one figure a line."""
    lines: list[list[str]] = []
    for method, frames, region in product(of.methods, SPANS, of.regions):
        sums, clips = method.sums(frames, region), str(len(method.records))
        cells: Mapping[FigureName, list[str]] = {name: numbers(sums.interval(name)) for name in FIGURE_NAMES}
        lines += [[method.name, frames, region, name, *cell, clips] for name, cell in cells.items() if cell[0]]
    return csv_text(["method", "frames", "pixels", "figure", "value", "low", "high", "clips"], lines)


def clips_csv(of: EvaluatedSet, frames: Span = "2-last") -> str:
    """Every method on every clip: one line each."""
    regions: tuple[Region, ...] = ("all", "occluded")
    by_clip: tuple[FigureName, ...] = ("psnr_db", "ssim", "miou_full")
    lines: list[list[str]] = []
    for method in of.methods:
        sums = [method.table.clip_sums(frames, region) for region in regions]
        values = np.stack([each.figure(name) for each in sums for name in by_clip], axis=1)
        for record, row in zip(method.records, values.tolist(), strict=True):
            change = ("", "", "") if record.change is None else tuple(f"{part:g}" for part in record.change)
            cells = ["" if isnan(value) else f"{value:.6g}" for value in row]
            lines.append([method.name, record.key, record.scene, *change, *cells, f"{record.seconds:.4g}"])
    named = [f"{name} {region}" for region in regions for name in by_clip]
    return csv_text(["method", "clip", "scene", "azimuth", "elevation", "radius", *named, "seconds"], lines)


@dataclass(frozen=True, kw_only=True, slots=True)
class Difference:
    """How far one method lies above another in one figure. clips: that both have."""

    first: str
    other: str
    column: Column
    frames: Span
    clips: int
    apart: Interval

    @property
    def verdict(self) -> str:
        """ "better" or "worse" where zero lies outside the interval, "open" where it does not."""
        if not self.apart.off_zero:
            return "open"
        return "better" if (self.apart.value > 0) != (self.column.figure == "lpips") else "worse"

    def __str__(self) -> str:
        each = (self.apart.value, self.apart.low, self.apart.high)
        value, low, high = (f"{number:+.{self.column.digits}f}" for number in each)
        if isnan(self.apart.low):  # one scene tells nothing of it
            return value
        text = f"{value} [{low}, {high}]"
        return text if self.verdict == "open" else f"**{text}** {self.verdict}"


def differences(
    first: MethodRecords,
    other: MethodRecords,
    frames: Span = "2-last",
    *,
    keys: Sequence[str] | None = None,
    columns: Sequence[Column] = (*PICTURE_COLUMNS, *CLASS_COLUMNS),
) -> tuple[Difference, ...]:
    """One method against another, in the columns that both have figures in; none if they are of different pixels.

    Args:
        keys: of the clips; by default all that both were measured on.
    """
    keys, found = first.common_keys(other) if keys is None else keys, list[Difference]()
    if first.crop != other.crop:
        return ()
    for column in columns if keys else ():
        ours, theirs = (each.sums(frames, column.region, keys) for each in (first, other))
        apart = ours.interval(column.figure, theirs)
        if apart.known:
            found.append(
                Difference(
                    first=first.name,
                    other=other.name,
                    column=column,
                    frames=frames,
                    clips=len(keys),
                    apart=apart,
                )
            )
    return tuple(found)


def differences_csv(found: Sequence[Difference]) -> str:
    """One difference a line."""
    lines = [[e.first, e.other, e.frames, e.column.heading, *numbers(e.apart), str(e.clips), e.verdict] for e in found]
    return csv_text(["first", "other", "frames", "figure", "first ahead", "low", "high", "clips", "verdict"], lines)


def differences_markdown(found: Sequence[Difference], of: EvaluatedSet) -> str:
    """A row for each other method, a column for each figure; bold where zero lies outside the interval."""
    headings = list(dict.fromkeys(each.column.heading for each in found))
    cells = {(each.other, each.column.heading): str(each) for each in found}
    others = list(dict.fromkeys(each.other for each in found))
    rows = [[of.method(name).starred, *(cells.get((name, head), NOTHING) for head in headings)] for name in others]
    return "\n".join(markdown_rows(["", *headings], rows)) + "\n"
