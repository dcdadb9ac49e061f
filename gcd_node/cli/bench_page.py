"""`gcd-node bench page`: measurements as a page."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer
from typer import Argument, Option

from gcd_node.errors import OutputError
from gcd_node.load.bench_record import read_record
from gcd_node.load.performance_page import performance_page

Records: TypeAlias = Annotated[list[Path], Argument(help="Files that --json wrote.", show_default=False)]
Out: TypeAlias = Annotated[Path, Option(help="The page, Markdown.")]

NOTES = "notes.md"
"""Beside the first record: what people have written; goes to the end of the page."""


def page(records: Records, out: Out) -> None:
    """Write the page of measurements from files that `bench model` and `bench stream` wrote.

    Sections of its own may stand in notes.md beside the first file; they come last.
    """
    text = written_page(records)
    try:
        out.write_text(text)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}; give another path with --out") from error
    typer.echo(f"{out}: {len(records)} measurements")


def written_page(records: list[Path]) -> str:
    """The page of these files, in the order of their names, with the notes beside them. Raises: see read_record."""
    ordered = sorted(records, key=lambda path: path.name)
    notes = records[0].with_name(NOTES)
    return performance_page(
        {path.name: read_record(path) for path in ordered}, notes.read_text() if notes.is_file() else ""
    )
