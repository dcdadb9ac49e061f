"""`gcd-node weights`: look into checkpoints, convert them."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from gcd_model import inspect_weights

weights = typer.Typer(no_args_is_help=True, help="Look into checkpoints, convert them.")

WeightsPath = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="A .ckpt of GCD, svd.safetensors, a diffusers folder, or our own .safetensors.",
        show_default=False,
    ),
]
FamilyOption = Annotated[
    str | None,
    typer.Option(
        help="kubric90, kubric180, driving, driving-semantic or svd; else told from the file.", show_default=False
    ),
]
HeadWidth = Annotated[
    int | None, typer.Option(help="Width of a U-Net attention head, for unpublished widths.", show_default=False)
]
ImageHeads = Annotated[
    int | None, typer.Option(help="Attention heads of the image tower, for unpublished widths.", show_default=False)
]


@weights.command("inspect")
def inspect(
    file: WeightsPath,
    family: FamilyOption = None,
    head_width: HeadWidth = None,
    image_heads: ImageHeads = None,
) -> None:
    """Say what a checkpoint holds: architecture, family, sizes, and what will be left out. Loads nothing."""
    report = inspect_weights(file, family=family, head_width=head_width, image_heads=image_heads)
    console = Console()
    console.print(_facts(report))
    console.print(_networks(report))
