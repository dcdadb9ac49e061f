"""`gcd-train families`: how checkpoints were trained."""

from typing import Annotated

import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from gcd_model import FAMILIES, Family


def families_command(
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
