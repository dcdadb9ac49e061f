"""`gcd-train report`: runs of `gcd-train evaluate` as tables, plots and galleries."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from gcd_train.cli.common import command_line, errors_shown
from gcd_train.errors import RecipeError


def report_command(
    runs: Annotated[list[Path], typer.Argument(help="Folders that `gcd-train evaluate` wrote.", metavar="RUN...")],
    out: Annotated[Path, typer.Option(help="Folder for report.md, tables/, plots/ and gallery/.")],
    lead: Annotated[
        list[str] | None, typer.Option(help="Method to compare with all others; by default every model.")
    ] = None,
    row: Annotated[
        list[str] | None, typer.Option(help="METHOD=ROW: where a method stands in the paper's tables.")
    ] = None,
    clips: Annotated[int, typer.Option(min=0, help="Clips in the gallery.")] = 4,
    plots: Annotated[bool, typer.Option(help="Draw plots; needs matplotlib.")] = True,
) -> None:
    """Write the paper's tables, or the same for our own clips, from what was measured; nothing is measured again."""
    from gcd_train.evaluation.report import make_report  # here: `--help` wants none of it

    with errors_shown():
        path = make_report(
            runs, out, leads=lead or (), rows=_rows(row or ()), clips=clips, drawn=plots, command=command_line()
        )
    typer.echo(f"wrote {path}")


def _rows(given: Sequence[str]) -> dict[str, str]:
    """METHOD=ROW, several times."""
    pairs = [text.partition("=") for text in given]
    for text, (method, _, label) in zip(given, pairs, strict=True):
        if not method or not label:
            raise RecipeError(f"--row wants METHOD=ROW, got {text!r}; write --row 'my-model=GCD (gradual, finetuned)'")
    return {method: label for method, _, label in pairs}
