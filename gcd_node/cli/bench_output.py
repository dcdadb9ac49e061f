"""What every `gcd-node bench` command does with its figures: a table, a JSON file, a plot."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeAlias

import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from typer import Option

from gcd_node.load.bench_record import Measurement, Report, write_record
from gcd_node.load.figure_tables import FigureTable
from gcd_node.load.performance_page import report_tables
from gcd_node.load.plots import require_matplotlib, write_plot

JsonFile: TypeAlias = Annotated[Path | None, Option("--json", help="File for the figures, for `bench page`.")]
PlotFile: TypeAlias = Annotated[Path | None, Option("--plot", help="PNG file of the figures; needs matplotlib.")]

_OUTPUTS = ("json_file", "plot")
_WIDTH = 150


def measured_and_shown(
    context: typer.Context,
    measure: Callable[[Callable[[str], None]], Report],
    json_file: Path | None,
    plot: Path | None,
) -> None:
    """Measure, print the tables, write what was asked for. Raises OutputError as write_record and write_plot."""
    if plot is not None:
        require_matplotlib()
    measurement = Measurement(said_command(context))
    with Console(stderr=True).status("starting") as status:
        report = measure(lambda part: status.update(part))
    if json_file is not None:
        write_record(json_file, measurement.record(report))
    if plot is not None:
        write_plot(plot, report)
    console = Console()
    wide = console if console.is_terminal else Console(width=_WIDTH)
    for table in report_tables(report):
        wide.print(table.title, style="dim", highlight=False)
        wide.print(rich_table(table))


def rich_table(table: FigureTable) -> Table:
    """For a terminal, without its title."""
    drawn = Table(box=SIMPLE)
    for number, column in enumerate(table.columns):
        drawn.add_column(column, justify="left" if number < table.names else "right", no_wrap=True)
    for row in table.rows:
        drawn.add_row(*row)
    return drawn


def said_command(context: typer.Context) -> list[str]:
    """The command line in its long form, with what was said and without where figures go: those paths are local."""
    names, above = [context.info_name or ""], context.parent
    while above is not None and above.parent is not None:  # the outermost is the program, whatever it is called
        names.insert(0, above.info_name or "")
        above = above.parent
    words = ["gcd-node", *names]
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in _OUTPUTS or source is None or source.name != "COMMANDLINE":
            continue
        words += _said(parameter.opts[0], context.params[parameter.name or ""])
    return words


def _said(option: str, value: object) -> list[str]:
    if value is True:
        return [option]
    if isinstance(value, tuple):
        return [option, *map(str, value)]
    if isinstance(value, list):
        return [word for each in value for word in (option, str(each))]
    return [option, str(value)]
