"""`gcd-train`: data, training and evaluation from the command line."""

from typing import Annotated

import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from gcd_model import FAMILIES, Family
from gcd_train.cli import bench, data, generate, lerobot, lora
from gcd_train.cli.cache import cache
from gcd_train.cli.calibrate import calibrate_command
from gcd_train.cli.distill import distill
from gcd_train.cli.evaluate import evaluate_command
from gcd_train.cli.gallery import gallery_command
from gcd_train.cli.report import report_command
from gcd_train.cli.show import show
from gcd_train.cli.train import recipes, train
from gcd_train.cli.verify import verify_command

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    help="Data, training and evaluation for virtual camera views.",
)


app.add_typer(generate.app, name="generate")
app.add_typer(bench.app, name="bench")
app.add_typer(data.app, name="data")
app.add_typer(lerobot.app, name="export")
app.add_typer(lora.app, name="lora")
app.command()(cache)
app.command("calibrate")(calibrate_command)
app.command()(distill)
app.command("evaluate")(evaluate_command)
app.command("gallery")(gallery_command)
app.command("lerobot")(lerobot.lerobot_command)
app.command("report")(report_command)
app.command()(show)
app.command()(recipes)
app.command()(train)
app.command("verify")(verify_command)


@app.callback()
def about() -> None:
    """Keep `gcd-train` a command with sub-commands, however many there are."""


@app.command()
def families(
    name: Annotated[str | None, typer.Argument(help="Show one family only.", metavar="FAMILY")] = None,
) -> None:
    """List the model families: how each was trained, and what a finetuned checkpoint will accept."""
    if name is not None and name not in FAMILIES:
        raise typer.BadParameter(f"no family is called {name!r}; there are {', '.join(FAMILIES)}")
    table = Table(title="Model families", box=SIMPLE, pad_edge=False, padding=(0, 0))
    for column in ("family", "camera", "az / el / r", "rates", "hfov", "size"):
        table.add_column(column, no_wrap=True)
    for family in FAMILIES.values():
        if name in (None, family.name):
            table.add_row(*_family_row(family))
    Console().print(table)


def _family_row(family: Family) -> tuple[str, ...]:
    limits = family.limits
    span = "fixed"
    if limits is not None:
        span = f"±{limits.azimuth_deg:g}° ±{limits.elevation_deg:g}° ±{limits.radius_m:g}"
    rates = ", ".join(f"{rate:g}" for rate in family.rates) or "any"
    hfov = "any" if family.hfov_deg is None else f"{family.hfov_deg:g}°"
    return family.name, family.camera, span, rates, hfov, f"{family.width}x{family.height}"


def main() -> None:
    """Entry point."""
    app()
