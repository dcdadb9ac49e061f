"""`gcd-node weights`: look into checkpoints, convert them."""

from dataclasses import astuple, fields
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from rich.console import Console
from rich.text import Text
from typer import Argument, Option, Typer

from gcd_model import WeightsReport, convert_weights, inspect_weights, weights_path
from gcd_node.cli.main import table

weights = Typer(no_args_is_help=True, help="Look into checkpoints, convert them.")

WeightsPath = Annotated[
    Path,
    Argument(
        metavar="FILE",
        help="A .ckpt of GCD, svd.safetensors, a diffusers folder, our own .safetensors, or package:NAME.",
        show_default=False,
    ),
]
FamilyOption = Annotated[
    str | None,
    Option(help="kubric90, kubric180, driving, driving-semantic, manipulation, svd or live; else told from the file."),
]
HeadWidth = Annotated[int | None, Option(help="Width of a U-Net attention head, for unpublished widths.")]
ImageHeads = Annotated[int | None, Option(help="Attention heads of the image tower, for unpublished widths.")]


@weights.command("inspect")
def inspect(
    file: WeightsPath,
    family: FamilyOption = None,
    head_width: HeadWidth = None,
    image_heads: ImageHeads = None,
    full_digest: Annotated[bool, Option(help="Digest every byte, also of large files.")] = False,
) -> None:
    """Say what a checkpoint holds: architecture, family, sizes, and what will be left out. Loads no weights."""
    console = Console(markup=False)
    with Console(stderr=True, markup=False).status(Text(f"reading {file}")):
        report = inspect_weights(
            weights_path(str(file)),
            family=family,
            head_width=head_width,
            image_heads=image_heads,
            full_digest=full_digest,
        )
    _show(console, report)


@weights.command("convert")
def convert(
    file: WeightsPath,
    out: Annotated[Path, Argument(metavar="OUT", help="The file to write: .safetensors, or .ckpt.")],
    layout: Annotated[
        Literal["gcd-node", "gcd-ckpt"], Option(help="Our .safetensors, or the .ckpt of the released code.")
    ] = "gcd-node",
    dtype: Annotated[str | None, Option(help="float32, bfloat16 or float16; else as stored.")] = None,
    family: FamilyOption = None,
    head_width: HeadWidth = None,
    image_heads: ImageHeads = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace OUT if it is there.")] = False,
) -> None:
    """Strip a checkpoint to what inference needs, or write what the released code reads, with the configuration inside.

    OUT appears whole or not at all.
    """
    with Console(stderr=True, markup=False).status(Text(f"converting {file}")):
        report = convert_weights(
            weights_path(str(file)),
            out,
            layout=layout,
            dtype=dtype,
            family=family,
            head_width=head_width,
            image_heads=image_heads,
            overwrite=overwrite,
        )
    _show(console := Console(markup=False), report)
    console.print(f"wrote {out}", soft_wrap=True)


def _show(console: Console, report: WeightsReport) -> None:
    """All that is known, by its names in WeightsReport; sizes are bytes."""
    facts = {each.name: getattr(report, each.name) for each in fields(report)}
    networks, leftovers, config = (facts.pop(name) for name in ("networks", "leftovers", "config"))
    facts["family"] = report.family and report.family.name
    facts |= {"parameters": f"{report.parameters:,}", "config": msgspec.json.encode(config).decode()}
    console.print(table(facts.items()))
    console.print(table(map(astuple, networks), ("network", ">parameters", ">tensors", "stored as", ">bytes"), "Used"))
    if leftovers:
        console.print(table(map(astuple, leftovers), ("what", ">tensors", ">bytes"), "Left out"))
