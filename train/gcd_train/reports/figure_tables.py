"""The main tables of a set of clips: the paper's, or the same columns for clips of our own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import nan
from statistics import fmean

import numpy as np

from gcd_train.evaluation.class_counts import ClassCounts, class_counts
from gcd_train.evaluation.record import Region
from gcd_train.evaluation.tallies import FIGURE_NAMES, FIRST_MEASURED, FigureName, Selection, Span
from gcd_train.reports.intervals import Drawn, Interval, drawn
from gcd_train.reports.material import EvaluatedSet, Method
from gcd_train.reports.paper import (
    CLASS_COLUMNS,
    PICTURE_COLUMNS,
    Column,
    Gain,
    PaperRow,
    PaperTable,
    row_label,
    tables_for,
)
from gcd_train.reports.table import NO_WEIGHTS, NOT_RUN, NOTHING, Cell, Row, Table, csv_text

_SPANS: tuple[Span, ...] = ("2-last", "last", "all")
_OWN_NAMES: dict[Span, str] = {"2-last": "main", "last": "last_frame", "all": "all_frames"}
_BRACKETS = "In brackets: 95 % interval, bootstrap over scenes. * is given more than the source video."
STAR_OF_FIGURE = "A * behind a mIoU: these class maps are made from the source's exact ones, which no model is given."
"""Stands below tables with such a star."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Measured:
    """A set of clips with the sums of its methods, each worked out once.

    seed: of the bootstrap. rows: method to the row of the paper's tables that a user says it belongs in.
    """

    of: EvaluatedSet
    seed: int = 0
    rows: Mapping[str, str] = field(default_factory=dict[str, str])
    _known: dict[tuple[str, Selection], Drawn] = field(
        default_factory=dict[tuple[str, Selection], Drawn], init=False, repr=False, compare=False
    )

    _counts: dict[str, ClassCounts] = field(
        default_factory=dict[str, ClassCounts], init=False, repr=False, compare=False
    )

    def sums(self, method: Method, selection: Selection) -> Drawn:
        """A method's sums for some frames and pixels."""
        at = (method.name, selection)
        if at not in self._known:
            self._known[at] = drawn(method.records, selection, seed=self.seed, counts=self._counted(method))
        return self._known[at]

    def _counted(self, method: Method) -> ClassCounts:
        if method.name not in self._counts:
            self._counts[method.name] = class_counts(method.records, len(self.of.note.classes))
        return self._counts[method.name]

    def interval(self, method: Method, column: Column, frames: Span | int) -> Interval:
        """One figure with its bounds."""
        return self.sums(method, Selection(frames=frames, region=column.region)).interval(column.figure)


def main_tables(measured: Measured, spans: Sequence[Span] = ("2-last", "last")) -> tuple[Table, ...]:
    """The paper's tables for clips of its sets, tables of the same columns under their own title for others.

    Args:
        spans: only tables over these frames. The paper has none over all frames, so that one is always our own.
    """
    columns, papers = _columns(measured.of), {each.frames: each for each in tables_for(measured.of.note)}
    ours = tuple(_own_table(measured, columns, frames) for frames in spans if frames not in papers)
    return (*ours, *(_paper_table(measured, each) for frames, each in papers.items() if frames in spans))


def all_figures(measured: Measured) -> str:
    """Every figure of every method, frames and pixels with its interval, as CSV: one figure a line."""
    lines: list[list[str]] = []
    for method in measured.of.methods:
        for frames in _SPANS:
            for region in measured.of.regions:
                sums = measured.sums(method, Selection(frames=frames, region=region))
                for name in FIGURE_NAMES:
                    cell = Cell(figure=sums.interval(name))
                    if cell.numbers()[0]:
                        lines.append([method.name, frames, region, name, *cell.numbers(), str(len(method.records))])
    return csv_text(["method", "frames", "pixels", "figure", "value", "low", "high", "clips"], lines)


def _columns(of: EvaluatedSet) -> tuple[Column, ...]:
    pictures = any(method.makes_pictures for method in of.methods)
    classes = any(method.makes_classes for method in of.methods)
    every = (*(PICTURE_COLUMNS if pictures else ()), *(CLASS_COLUMNS if classes else ()))
    return tuple(column for column in every if column.region in of.regions)


def _own_table(measured: Measured, columns: Sequence[Column], frames: Span) -> Table:
    told = frames_told(measured.of, frames)
    rows = [measured_row(measured, method, columns, frames, PaperRow(label="")) for method in measured.of.methods]
    return Table(
        name=_OWN_NAMES[frames],
        title=f"{measured.of.title}: {told}",
        headings=tuple(column.heading for column in columns),
        rows=tuple(rows),
        notes=table_notes(measured, columns, frames),
    )


def _paper_table(measured: Measured, table: PaperTable) -> Table:
    placed: dict[str, list[Method]] = {}
    for method in measured.of.methods:
        label = measured.rows.get(method.name) or row_label(method.name, method.details, table)
        placed.setdefault(label or "", []).append(method)
    rows: list[Row] = []
    for row in table.rows:
        found = placed.pop(row.label, [])
        rows += [measured_row(measured, each, table.columns, table.frames, row) for each in found]
        rows += [] if found else [_not_run(row, table.columns)]
    below = [
        measured_row(measured, each, table.columns, table.frames, PaperRow(label=_below(label)))
        for label, methods in placed.items()
        for each in methods
    ]
    return Table(
        name=table.name,
        title=f"{table.title} ({measured.of.title})",
        headings=tuple(column.heading for column in table.columns),
        rows=(*rows, *(_gain(rows, each, table.columns) for each in table.gains)),
        below=tuple(below),
        notes=table_notes(measured, table.columns, table.frames),
    )


def _gain(rows: Sequence[Row], gain: Gain, columns: Sequence[Column]) -> Row:
    """The mean difference of the first column, where every variant was measured; of several in a row the first."""
    known = {row.label: row.cells[0].figure for row in reversed(rows)}
    pairs = [(known[label], known[label.replace(gain.better, gain.worse)]) for label in known if gain.better in label]
    apart = [one.value - other.value for one, other in pairs if one is not None and other is not None]
    figure = None
    if len(apart) == len(pairs):
        figure = Interval(value=fmean(apart), low=nan, high=nan)
    first = Cell(figure=figure, digits=columns[0].digits, note=NOT_RUN, paper=gain.printed)
    return Row(
        label=f"{gain.better} over {gain.worse}, mean of variants",
        cells=(first, *(Cell(note=NOTHING) for _ in columns[1:])),
    )


def _below(label: str) -> str:
    """How a method is called below the paper's rows. label: of its row in another of the paper's tables, or empty."""
    return f"{label}, not in this table" if label else "not in the paper"


def measured_row(measured: Measured, method: Method, columns: Sequence[Column], frames: Span, row: PaperRow) -> Row:
    """A method's figures, beside what the paper prints in its row."""
    printed = (*row.printed, *(None,) * len(columns))
    return Row(
        label=row.label,
        method=method.starred,
        clips=f"{len(method.records)} of {len(measured.of.keys)}",
        cells=tuple(
            Cell(
                figure=measured.interval(method, column, frames),
                digits=column.digits,
                note=_why_not(measured.of, method, column),
                paper=paper,
                starred=method.copies_classes and column.of_classes,
            )
            for column, paper in zip(columns, printed, strict=False)
        ),
    )


def _not_run(row: PaperRow, columns: Sequence[Column]) -> Row:
    printed = (*row.printed, *(None,) * len(columns))
    cells = tuple(Cell(note=NOT_RUN, paper=paper) for _, paper in zip(columns, printed, strict=False))
    return Row(label=row.label, cells=cells)


def _why_not(of: EvaluatedSet, method: Method, column: Column) -> str:
    """What stands where there is no figure."""
    if column.figure == "lpips" and method.makes_pictures:
        return NO_WEIGHTS
    return "unknown" if _unknown_region(of, column.region) else NOTHING


def _unknown_region(of: EvaluatedSet, region: Region) -> bool:
    return region not in of.regions


def frames_told(of: EvaluatedSet, frames: Span) -> str:
    """Which frames a table is over, in words."""
    return {"2-last": f"frames 2-{of.note.frames}", "last": "last frame", "all": f"all {of.note.frames} frames"}[frames]


def table_notes(measured: Measured, columns: Sequence[Column], frames: Span) -> tuple[str, ...]:
    """What stands below a table: its frames and clips, what brackets and stars mean, what is not known."""
    of, told = measured.of, frames_told(measured.of, frames)
    notes = [f"{told[0].upper()}{told[1:]} of {len(of.keys)} clips of {of.scenes} scenes. {_BRACKETS}"]
    if any(column.of_classes for column in columns) and any(each.copies_classes for each in of.methods):
        notes.append(STAR_OF_FIGURE)
    if any(_unknown_region(of, column.region) for column in columns):
        notes.append("Unknown: nobody knows which pixels of these clips the source camera saw.")
    if any(column.figure == "lpips" for column in columns) and len(of.regions) > 1:
        notes.append("LPIPS is over all pixels alone: its network sees patches, which no region cuts out.")
    return tuple(notes)


_COLUMNS = (
    Column(heading="PSNR all", figure="psnr_db"),
    Column(heading="PSNR visible", figure="psnr_db", region="visible"),
    Column(heading="PSNR occluded", figure="psnr_db", region="occluded"),
    Column(heading="SSIM all", figure="ssim", digits=3),
    Column(heading="SSIM visible", figure="ssim", region="visible", digits=3),
    Column(heading="SSIM occluded", figure="ssim", region="occluded", digits=3),
    Column(heading="mIoU all", figure="miou_common", digits=3),
    Column(heading="mIoU visible", figure="miou_common", region="visible", digits=3),
    Column(heading="mIoU occluded", figure="miou_common", region="occluded", digits=3),
    Column(heading="diversity", figure="diversity", digits=4),
    Column(heading="gradient energy", figure="gradient_energy"),
)
_BY_FRAME: tuple[FigureName, ...] = (
    "psnr_db",
    "ssim",
    "lpips",
    "diversity",
    "gradient_energy",
    "flicker",
    "miou_common",
)


def region_table(measured: Measured, frames: Span = "2-last") -> Table:
    """Every method on all, visible and occluded pixels side by side, with its diversity and sharpness on all."""
    of = measured.of
    columns = tuple(column for column in _COLUMNS if column.region in of.regions and _has(of, column))
    return Table(
        name="regions",
        title=f"Visible and occluded pixels, diversity, sharpness: {frames_told(of, frames)}",
        headings=tuple(column.heading for column in columns),
        rows=tuple(measured_row(measured, method, columns, frames, PaperRow(label="")) for method in of.methods),
        notes=(*table_notes(measured, columns, frames), *_told(columns)),
    )


def frames_csv(measured: Measured) -> str:
    """Every figure of every method in each frame from the second on: one figure a line, without intervals."""
    lines: list[list[str]] = []
    for method in measured.of.methods:
        for frame in range(FIRST_MEASURED + 1, measured.of.note.frames + 1):
            for region in measured.of.regions:
                sums = measured.sums(method, Selection(frames=frame, region=region))
                values = [(name, sums.value(name)) for name in _BY_FRAME]
                lines += [
                    [method.name, str(frame), region, name, f"{value:.6g}"]
                    for name, value in values
                    if not np.isnan(value)
                ]
    return csv_text(["method", "frame", "pixels", "figure", "value"], lines)


def _has(of: EvaluatedSet, column: Column) -> bool:
    """Whether any method can have such a figure."""
    if column.of_classes:
        return any(method.makes_classes for method in of.methods)
    if column.figure == "diversity":
        return any(record.draws > 1 for method in of.methods for record in method.records if method.makes_pictures)
    return any(method.makes_pictures for method in of.methods)


def _told(columns: tuple[Column, ...]) -> tuple[str, ...]:
    figures = {column.figure for column in columns}
    notes = {
        "diversity": "Diversity: standard deviation over the draws of one view; of two draws or more.",
        "gradient_energy": "Gradient energy: view over target, 1 is as sharp as the target.",
    }
    return tuple(note for figure, note in notes.items() if figure in figures)
