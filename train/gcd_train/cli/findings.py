"""`gcd-train findings`: whether the claims of the small-scale study hold."""

from pathlib import Path
from typing import Annotated

import typer

from gcd_train.cli.errors import errors_shown


def findings_command(
    runs: Annotated[list[Path], typer.Argument(help="Folders that `gcd-train evaluate` wrote.", metavar="RUN...")],
    out: Annotated[Path, typer.Option(help="Folder for findings.md and findings.csv.")],
    small: Annotated[bool, typer.Option("--small", help="Of models trained with --small.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws of scenes that intervals come from.")] = 0,
) -> None:
    """Say which claims of the small-scale study hold; a claim needs its 95 % interval off zero."""
    from gcd_train.evaluation.report import write_file  # here: `--help` wants none of it
    from gcd_train.reports.comparison import to_csv
    from gcd_train.reports.findings import findings, study_claims, to_markdown
    from gcd_train.reports.material import Run

    with errors_shown():
        found = findings([Run.read(run) for run in runs], study_claims("-small" if small else ""), seed=seed)
        text = to_markdown(found)
        write_file(out / "findings.md", text.encode())
        write_file(out / "findings.csv", to_csv([each for finding in found for each in finding.apart]).encode())
    typer.echo(text)
