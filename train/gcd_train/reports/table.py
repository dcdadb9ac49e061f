"""A table, as Markdown for people and as CSV for programs."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

from gcd_train.reports.intervals import Interval

NOT_RUN, NO_WEIGHTS, NOTHING = "not run", "no weights given", "-"


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
        if self.figure.low != self.figure.low:  # NaN: one scene tells nothing of it
            return value + star
        return f"{value} [{self.figure.low:.{self.digits}f}, {self.figure.high:.{self.digits}f}]{star}"

    def numbers(self) -> tuple[str, str, str]:
        """Value and bounds in full, empty for none."""
        if self.figure is None or not self.figure.known:
            return "", "", ""
        numbers = (self.figure.value, self.figure.low, self.figure.high)
        value, low, high = ("" if number != number else f"{number:.6g}" for number in numbers)
        return value, low, high


_LINE = "———"


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """label: of the row. method: whose figures these are, empty for nobody's. clips: how many it was measured on."""

    label: str
    method: str = ""
    clips: str = ""
    cells: tuple[Cell, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Table:
    """name: of its file. title, notes: above and below it. headings: of the cells' columns. below: under a line."""

    name: str
    title: str
    headings: tuple[str, ...]
    rows: tuple[Row, ...]
    below: tuple[Row, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def has_paper(self) -> bool:
        """Whether the paper prints any figure of it."""
        return any(cell.paper is not None for row in self.rows for cell in row.cells)


def to_markdown(table: Table) -> str:
    """With a heading of the third level."""
    heads = ["", "method", "clips", *table.headings, *(["paper (its own data)"] if table.has_paper else [])]
    rows = [
        [row.label, row.method, row.clips, *map(str, row.cells), *([_printed(row)] if table.has_paper else [])]
        for row in (*table.rows, *table.below)
    ]
    if table.below:
        rows.insert(len(table.rows), [_LINE] * len(heads))
    lines = [f"### {table.title}", "", *markdown_rows(heads, rows)]
    return "\n".join([*lines, *(f"\n{note}" for note in table.notes)]) + "\n"


def to_csv(table: Table) -> str:
    """For each column its value, the bounds and what the paper prints; what is missing is empty."""
    heads = ["row", "method", "clips"]
    for heading in table.headings:
        heads += [heading, f"{heading} low", f"{heading} high", f"{heading} paper"]
    rows: list[list[str]] = []
    for row in (*table.rows, *table.below):
        cells = [part for cell in row.cells for part in (*cell.numbers(), _number(cell.paper))]
        rows.append([row.label, row.method or NOT_RUN, row.clips, *cells])
    return csv_text(heads, rows)


def csv_text(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """RFC 4180, with line feeds."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([headings, *rows])
    return out.getvalue()


def markdown_rows(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table; a bar inside a cell is escaped."""
    rule = ["---"] * len(headings)
    return [
        f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |" for cells in (headings, rule, *rows)
    ]


def _printed(row: Row) -> str:
    return (
        ", ".join(_number(cell.paper) or NOTHING for cell in row.cells)
        if any(cell.paper is not None for cell in row.cells)
        else ""
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:g}"
