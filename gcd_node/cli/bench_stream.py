"""`gcd-node bench stream`: a whole node on a stream."""

from typing import Annotated, TypeAlias

import typer
from typer import Option

from gcd_node.cli.bench_output import JsonFile, PlotFile, measured_and_shown
from gcd_node.load.stream_bench import PACKAGED, SYNTHETIC, StreamBenchOptions, bench_stream

Weights: TypeAlias = Annotated[str | None, Option(help="As in a launch file; the demo's where left out.")]
Source: TypeAlias = Annotated[str, Option(help=f"A video file, played in a loop, or {SYNTHETIC}: a drawn street.")]
Fps: TypeAlias = Annotated[float, Option(min=0.1, help="Frames per second of the source.")]
Seconds: TypeAlias = Annotated[float, Option(min=1.0, help="How long, after the first view.")]
Stride: TypeAlias = Annotated[int | None, Option(min=1, help="Frames from one window to the next; no overlap.")]
Threads: TypeAlias = Annotated[int | None, Option(min=1, help="CPU threads of the model.")]
Steps: TypeAlias = Annotated[int | None, Option(min=1, help="Network evaluations; as the checkpoint was made for.")]
Device: TypeAlias = Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")]
Dtype: TypeAlias = Annotated[str | None, Option(help="float32, bfloat16 or float16.")]


def stream(
    context: typer.Context,
    weights: Weights = None,
    source: Source = PACKAGED,
    fps: Fps = 10.0,
    seconds: Seconds = 60.0,
    stride: Stride = None,
    threads: Threads = None,
    steps: Steps = None,
    device: Device = "auto",
    dtype: Dtype = None,
    json_file: JsonFile = None,
    plot: PlotFile = None,
) -> None:
    """A node in a process of its own, everything on, and a reader in another: how old views are when they arrive,
    whether it keeps up, how soon the first one comes, and what the process takes."""
    options = StreamBenchOptions(
        weights=weights,
        source=source,
        fps=fps,
        seconds=seconds,
        stride=stride,
        threads=threads,
        steps=steps,
        device=device,
        dtype=dtype,
    )
    measured_and_shown(context, lambda on_part: bench_stream(options, on_part), json_file, plot)
