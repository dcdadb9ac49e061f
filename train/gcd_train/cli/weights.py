"""Weights: adapters joined with their bases, and how the families of checkpoints were trained."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from typer import Argument, BadParameter, Option, Typer

from gcd_model import FAMILIES, Family
from gcd_train.cli.common import errors_shown

lora = Typer(no_args_is_help=True, help="Adapters that a run with model.train = lora writes, and their bases.")


@lora.callback()
def about() -> None:
    """Keep `lora` a command with sub-commands, however many there are."""


@lora.command()
def merge(
    base: Annotated[Path, Argument(metavar="BASE", help="The weight file the adapter was trained from, any layout.")],
    adapter: Annotated[Path, Argument(metavar="ADAPTER", help="NAME-adapter.safetensors of a run.")],
    out: Annotated[Path, Argument(metavar="OUT", help="The file to write: .safetensors, or .ckpt.")],
    layout: Annotated[
        Literal["gcd-node", "gcd-ckpt"], Option(help="Our .safetensors, or the .ckpt of the released code.")
    ] = "gcd-node",
    dtype: Annotated[str | None, Option(help="float32, bfloat16 or float16; else as the base is stored.")] = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace OUT if it is there.")] = False,
) -> None:
    """Join an adapter with its base to plain weights. OUT appears whole or not at all."""
    with errors_shown():
        from gcd_model.weights.card import precision
        from gcd_model.weights.load import load_adapted, read_adapter, save_weights
        from gcd_model.weights.save import write_published
        from gcd_train.training.setup import loaded_base

        wanted = None if dtype is None else precision(dtype)
        given = read_adapter(adapter)
        start = loaded_base(str(base), given.card.diffusion)
        joined = load_adapted(start, given)
        networks = joined.diffusion if wanted is None else joined.diffusion.to(wanted)
        card = replace(joined.card, trained=True, origin="")
        if layout == "gcd-ckpt":
            write_published(out, networks.state_dict(), card, carried=start.carried, overwrite=overwrite)
        else:
            save_weights(networks, out, card, overwrite=overwrite)
    Console(markup=False).print(f"wrote {out}", soft_wrap=True)


def families_command(
    name: Annotated[str | None, Argument(help="Show one family only.", metavar="FAMILY")] = None,
) -> None:
    """List the model families: how each was trained, and what a finetuned checkpoint will accept."""
    if name is not None and name not in FAMILIES:
        raise BadParameter(f"no family is called {name!r}; there are {', '.join(FAMILIES)}")
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
