"""`gcd-node weights`: look into checkpoints, convert them."""

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Argument, Option, Typer

from gcd_model import ModelConfig, WeightsReport, convert_weights, inspect_weights, weights_path
from gcd_node.cli.main import progress_bar, table

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
    with progress_bar("converting") as advance:
        report = convert_weights(
            weights_path(str(file)),
            out,
            layout=layout,
            dtype=dtype,
            family=family,
            head_width=head_width,
            image_heads=image_heads,
            overwrite=overwrite,
            progress=partial(advance, "converting"),
        )
    console = Console(markup=False)
    _show(console, report)
    console.print(f"wrote {out}", soft_wrap=True)


def _show(console: Console, report: WeightsReport) -> None:
    console.print(_facts(report))
    rows = (
        (each.name, f"{each.parameters:,}", each.tensors, ", ".join(each.dtypes), _mb(each.size))
        for each in report.networks
    )
    console.print(table(rows, ("network", ">parameters", ">tensors", "stored as", ">MB"), "Used"))
    left_out: list[tuple[object, ...]] = [(each.kind, each.tensors, _mb(each.size)) for each in report.leftovers]
    if report.optimizer_size:
        left_out.append(("optimizer state, never read", "", _mb(report.optimizer_size)))
    if report.other_entries and left_out:
        left_out.append((f"other entries: {', '.join(report.other_entries)}", "", ""))
    if left_out:
        console.print(table(left_out, ("what", ">tensors", ">MB"), "Left out"))


def _facts(report: WeightsReport) -> Table:
    config = report.config
    family = "unknown: no limits are checked, --motion-bucket must be given"
    if report.family is not None:
        family = f"{report.family} (told by {report.told_by})"
    path = "direct" if report.move_time == 0 else f"the goal is reached in frame {report.move_time}"
    scale = "not measured"
    if report.uncertainty_scale is not None:
        scale = f"{report.uncertainty_scale:.3g}: the deviation over samples times this is calibrated"
    rows = (
        ("layout", report.layout),
        ("family", family),
        ("camera control", config.camera),
        ("trajectory", path),
        ("frames, trained size", f"{config.frames}, {config.width}x{config.height}"),
        *_widths(report),
        ("parameters used", f"{report.parameters:,}"),
        ("size on disk", f"{_mb(report.size)} MB"),
        ("digest", report.digest),
        ("trained", "yes" if report.trained else "no: random weights"),
        ("uncertainty scale", scale),
    )
    return table(rows, title=report.path)


def _widths(report: WeightsReport) -> tuple[tuple[str, str], ...]:
    config = report.config
    if not isinstance(config, ModelConfig):
        depth, paint = (", ".join(map(str, each.widths)) for each in (config.depth, config.paint))
        return ("depth widths", depth), ("paint widths", paint), ("paint steps", str(config.steps))
    tower = config.image_encoder
    heads = "no image tower" if tower is None else str(tower.heads)
    return (
        ("U-Net widths", ", ".join(map(str, config.unet.widths))),
        ("head width, image heads", f"{config.unet.head_width}, {heads}"),
    )


def _mb(size: int) -> str:
    return f"{size / 1e6:,.1f}"
