"""`gcd-node bench`: how a node keeps up on this machine."""

from pathlib import Path
from typing import Annotated, Any, TypeAlias

import msgspec
from rich.console import Console
from rich.table import Table
from typer import Argument, Option

from gcd_node.bench import RATES_HZ, bench
from gcd_node.cli.check import Changes
from gcd_node.config import load_config, parse_config
from gcd_node.config_dump import to_toml
from gcd_node.errors import OutputError

LaunchFile: TypeAlias = Annotated[
    Path | None, Argument(metavar="[CONFIG]", help="A launch file; the packaged drive where left out.")
]
Rates: TypeAlias = Annotated[
    list[float] | None, Option("--rate", min=0.1, help="Input rate for latency, Hz; 5, 10 and 15. Again for more.")
]
Seconds: TypeAlias = Annotated[float, Option(min=1.0, help="How long each run is watched after its first view.")]
Stream: TypeAlias = Annotated[bool, Option("--stream", help="One run alone, at the source's own rate.")]
JsonFile: TypeAlias = Annotated[Path | None, Option("--json", help="Also a file, in the names of Isaac ROS Benchmark.")]

_ROWS: dict[str, tuple[str, int]] = {
    "input frames": ("BasicPerformanceMetrics.NUM_FRAMES_SENT", 0),
    "missed": ("BasicPerformanceMetrics.NUM_MISSED_FRAMES", 0),
    "views": ("GcdNodeMetrics.NUM_VIEWS", 0),
    "throughput, frames/s": ("BasicPerformanceMetrics.MEAN_FRAME_RATE", 1),
    "age of a view on arrival, mean, ms": ("BasicPerformanceMetrics.MEAN_LATENCY", 0),
    "p50": ("GcdNodeMetrics.P50_LATENCY", 0),
    "p95": ("GcdNodeMetrics.P95_LATENCY", 0),
    "p99": ("GcdNodeMetrics.P99_LATENCY", 0),
    "max": ("BasicPerformanceMetrics.MAX_LATENCY", 0),
    "jitter, mean, ms": ("BasicPerformanceMetrics.MEAN_JITTER", 0),
    "jitter, max, ms": ("BasicPerformanceMetrics.MAX_JITTER", 0),
    "process start to first view, s": ("GcdNodeMetrics.FIRST_VIEW", 1),
    "CPU of the machine, idle, %": ("ResourceMetrics.BASELINE_OVERALL_CPU_UTILIZATION", 0),
    "the same over idle while the node runs, %": ("GcdNodeMetrics.CPU_OVER_IDLE", 0),
    "cores the node used": ("GcdNodeMetrics.CPU_CORES", 2),
    "peak memory, MiB": ("GcdNodeMetrics.PEAK_MEMORY", 0),
}
"""What the table shows: the figure's name, and its decimals."""


def bench_command(
    config: LaunchFile = None,
    rates: Rates = None,
    seconds: Seconds = 20.0,
    stream: Stream = False,
    changes: Changes = None,
    json_file: JsonFile = None,
) -> None:
    """Run a launch file in a process of its own and read its views: latency, throughput, missed frames, cost.

    First as fast as the node can take the input, then at 5, 10 and 15 Hz; or with --stream as the source plays.
    """
    if json_file is not None and not json_file.parent.is_dir():
        raise OutputError(f"cannot write {json_file}: there is no folder {json_file.parent}; make it, or give another")
    if config is None:
        from gcd_node.demo import demo_config

        settings = parse_config(to_toml(demo_config(Path())).encode(), "the packaged drive", changes or ())
    else:
        settings = load_config(config, changes or ())
    with Console(stderr=True).status("idle") as status:
        figures = bench(settings, status.update, rates_hz=rates or RATES_HZ, seconds=seconds, stream=stream)
    Console().print(bench_table(figures, "stream" if stream else "as fast as it can"))
    if json_file is not None:
        try:
            json_file.write_bytes(msgspec.json.format(msgspec.json.encode(figures), indent=2) + b"\n")
        except OSError as error:
            raise OutputError(f"cannot write {json_file}: {error.strerror}; give another path with --json") from error


def bench_table(figures: dict[str, Any], first: str) -> Table:
    """A column for each run, `first` above that whose figures stand at the top."""
    rates = [name for name in figures if name.endswith("fps")]
    table = Table("", first, *(f"{rate.removesuffix('.0fps').removesuffix('fps')} Hz" for rate in rates))
    for label, (name, decimals) in _ROWS.items():
        table.add_row(label, *(f"{run[name]:.{decimals}f}" for run in (figures, *(figures[rate] for rate in rates))))
    return table
