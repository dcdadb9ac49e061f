"""`gcd-train bench`: figures of this machine."""

import sys
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from gcd_train.cli.errors import errors_shown

if TYPE_CHECKING:
    from gcd_train.training.bench import TrainReport

app = typer.Typer(no_args_is_help=True, help="Measure on this machine.")


@app.callback()
def about() -> None:
    """Keep `bench` a command with sub-commands."""


@app.command()
def train(
    full: Annotated[
        bool | None, typer.Option("--full/--small", help="Which model to measure; by default full on a GPU.")
    ] = None,
    clips: Annotated[int, typer.Option(min=1, help="Clips of an update.")] = 1,
    updates: Annotated[int, typer.Option(min=1, help="Measured updates, after three others.")] = 10,
    eight_bit: Annotated[bool, typer.Option(help="8-bit Adam (torchao).")] = False,
    recompute: Annotated[bool, typer.Option(help="Compute blocks anew in the backward pass.")] = True,
    measure: Annotated[bool, typer.Option(help="Also run updates; without, only count memory.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as one line of JSON.")] = False,
) -> None:
    """Memory of an update of the full model, and how many clips a second this machine trains.

    Memory is counted from shapes, for any machine. How long data is waited for stands in a run's log (`wait_s`).
    """
    import torch

    from gcd_train.training.bench import BenchTrainOptions, bench_train

    options = BenchTrainOptions(
        full=torch.cuda.is_available() if full is None else full,
        clips=clips,
        updates=updates,
        eight_bit=eight_bit,
        recompute=recompute,
        measure=measure,
    )
    with errors_shown(), Console(stderr=True).status("starting") as status:
        report = bench_train(options, lambda part: status.update(part))
    if as_json:
        typer.echo(msgspec.json.encode(report).decode())
    else:
        console = Console() if sys.stdout.isatty() else Console(width=120)
        console.print(memory_table(report))
        if report.speed:
            console.print(speed_table(report))


def memory_table(report: "TrainReport") -> Table:
    """Memory of one clip's update of the full model, for people."""
    title = "one clip's update of the full model, GB, counted from shapes"
    table = Table(title=title, title_justify="left", box=SIMPLE)
    for column in ("", "encoders", "weights", "gradients", "state", "activations", "all"):
        table.add_column(column, no_wrap=True)
    for row in report.memory:
        table.add_row(
            row.name,
            "cached" if row.cached else f"{row.encoders:.1f}",
            *(f"{value:.1f}" for value in (row.weights, row.gradients, row.state, row.activations, row.total)),
        )
    return table


def speed_table(report: "TrainReport") -> Table:
    """Measured updates, for people."""
    clips = f"{report.clips} clip{'' if report.clips == 1 else 's'}"
    title = (
        f"{clips} an update, {report.model} model, {report.tflop_per_clip:.3g} TFLOP a clip; "
        f"{report.device}, torch {report.torch}"
    )
    table = Table(title=title, title_justify="left", box=SIMPLE)
    for column in ("", "clips/s", "arithmetic used", "peak GB", "hours for Kubric-4D"):
        table.add_column(column, no_wrap=True)
    for row in report.speed:
        table.add_row(
            row.name,
            f"{row.clips_per_s:.3g} ({row.lowest:.3g}-{row.highest:.3g})",
            "not known" if row.utilisation is None else f"{row.utilisation:.0%}",
            "" if row.peak_gb is None else f"{row.peak_gb:.1f}",
            "full model on a GPU only" if row.hours is None else f"{row.hours:.1f}",
        )
    return table
