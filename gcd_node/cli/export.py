"""`gcd-node export`: a checkpoint as ONNX graphs, for onnxruntime and what reads ONNX."""

from pathlib import Path
from typing import Annotated, TypeAlias

from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from typer import Option

from gcd_model import ExportPrecision, Manifest, export_weights
from gcd_node.cli.weights import FamilyOption, HeadWidth, ImageHeads
from gcd_node.errors import UsageError

_NARROW = "Narrower numbers"

OnnxFolder: TypeAlias = Annotated[
    Path, Option("--onnx", metavar="DIR", help="Folder to write; it appears whole or not at all.", show_default=False)
]
Weights: TypeAlias = Annotated[
    str, Option(help="A checkpoint, a diffusers folder, package:NAME, or random:FAMILY (noise).", show_default=False)
]
Half: TypeAlias = Annotated[
    bool,
    Option("--fp16", help="Half precision, for GPUs; decoder and plane mix stay float32.", rich_help_panel=_NARROW),
]
EightBits: TypeAlias = Annotated[
    bool, Option("--int8", help="Weights of eight bits, computed in float32; as above.", rich_help_panel=_NARROW)
]
Height: TypeAlias = Annotated[int | None, Option(help="Instead of the trained height; the graphs take no other.")]
Width: TypeAlias = Annotated[int | None, Option(help="Instead of the trained width; the graphs take no other.")]
Adapter: TypeAlias = Annotated[Path | None, Option("--adapter", help="Low-rank adapter trained on these weights.")]
Overwrite: TypeAlias = Annotated[bool, Option("--overwrite", help="Replace the export that is there.")]


def export(
    onnx: OnnxFolder,
    weights: Weights,
    fp16: Half = False,
    int8: EightBits = False,
    height: Height = None,
    width: Width = None,
    family: FamilyOption = None,
    head_width: HeadWidth = None,
    image_heads: ImageHeads = None,
    adapter: Adapter = None,
    overwrite: Overwrite = False,
) -> None:
    """Write every network of a checkpoint as an ONNX graph of one size, with a manifest.

    `gcd-node synthesize --weights DIR` and `[model] weights` take the folder. Needs the extra `onnx`.
    """
    if fp16 and int8:
        raise UsageError("--fp16 and --int8 exclude each other; leave one out")
    precision: ExportPrecision = "float16" if fp16 else "int8" if int8 else "float32"
    errors = Console(stderr=True, markup=False)
    with Progress(console=errors, transient=True, disable=not errors.is_terminal) as progress:
        task = progress.add_task("loading", total=None)

        def advance(graph: str, done: int, total: int) -> None:
            progress.update(task, description=graph, completed=done, total=total)

        manifest = export_weights(
            weights,
            onnx,
            precision=precision,
            height=height,
            width=width,
            family=family,
            head_width=head_width,
            image_heads=image_heads,
            adapter=adapter,
            overwrite=overwrite,
            progress=advance,
        )
    console = Console(markup=False)
    console.print(_table(manifest))
    console.print(f"wrote {onnx}", soft_wrap=True)


def _table(manifest: Manifest) -> Table:
    table = Table(title=f"{manifest.card['gcd.name']}, {manifest.precision}, digest {manifest.sha256_12}")
    for column in ("graph", "precision", "takes", "MB"):
        table.add_column(column, justify="right" if column == "MB" else "left")
    for name, graph in manifest.graphs.items():
        takes = ", ".join(f"{each.name} {'x'.join(map(str, each.shape))}" for each in graph.inputs)
        table.add_row(name, graph.precision, takes, f"{sum(file.size for file in graph.files) / 1e6:,.1f}")
    return table
