"""`gcd-train bench`: figures of this machine."""

import tempfile
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table

from gcd_train.bench_data import BenchDataOptions, DataReport, Figure, bench_data
from gcd_train.cli.errors import errors_shown

app = typer.Typer(no_args_is_help=True, help="Measure on this machine.")


@app.callback()
def about() -> None:
    """Keep `bench` a command with sub-commands."""


@app.command()
def data(
    quick: Annotated[
        bool, typer.Option(help="Make scenes in part and extrapolate: minutes, not half an hour.")
    ] = False,
    scenes: Annotated[int, typer.Option(min=1, help="Whole scenes of each kind; not with --quick.")] = 1,
    samples: Annotated[int, typer.Option(min=1, help="Training samples of each kind; not with --quick.")] = 2,
    shrink: Annotated[int, typer.Option(min=1, max=16, help="Divide the sides of pictures, for trying out.")] = 1,
    folder: Annotated[Path | None, typer.Option(help="Where to make the scenes; removed afterwards.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as one line of JSON.")] = False,
) -> None:
    """Making scenes, reading them, drawing targets from their points, and bytes per training sample.

    Scenes are made compact without anti-aliasing, and in the published layout with it.

    Needs the extra `scenes` and 3 GB of disk without --quick.
    """
    options = BenchDataOptions(scenes=scenes, samples=samples, quick=quick, shrink=shrink)
    with (
        errors_shown(),
        tempfile.TemporaryDirectory(prefix="gcd-bench-", dir=folder) as place,
        Console(stderr=True).status("starting") as status,
    ):
        report = bench_data(Path(place), options, lambda part: status.update(part))
    if as_json:
        typer.echo(msgspec.json.encode(report).decode())
    else:
        Console().print(bench_table(report))


def bench_table(report: DataReport) -> Table:
    """The figures for people."""
    title = f"data on {report.cores} cores, one used; load average before {report.machine_load:.1f}"
    if report.shrink != 1:
        title += f"; pictures {report.shrink} times smaller than published"
    table = Table("", "unit", "median", "count", "wanted", "released tools", "note", title=title, title_style="dim")
    for figure in report.figures:
        table.add_row(*_row(figure))
    return table


def _row(figure: Figure) -> tuple[str, ...]:
    spread = f" ({figure.lowest:.3g}-{figure.highest:.3g})" if figure.count > 1 else ""
    wanted = "" if figure.wanted is None else f"<= {figure.wanted:g}"
    return (
        figure.name,
        figure.unit,
        f"{figure.median:.3g}{spread}",
        str(figure.count),
        wanted,
        figure.published,
        figure.note,
    )
