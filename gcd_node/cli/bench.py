"""`gcd-node bench`: figures of this machine."""

from typing import Annotated, TypeAlias

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from typer import Option

from gcd_node.cli.bench_model import model
from gcd_node.cli.bench_page import page
from gcd_node.cli.bench_stream import stream
from gcd_node.cli.soak import quiet_node
from gcd_node.load.bench import BenchOptions, BenchReport, Latency, bench_node

bench = typer.Typer(no_args_is_help=True, help="Measure on this machine.")
bench.command("model")(model)
bench.command("stream")(stream)
bench.command("page")(page)

Windows: TypeAlias = Annotated[int, Option(min=3, help="Windows for the latency.")]
SlowWindows: TypeAlias = Annotated[int, Option(min=3, help="Windows of the slow model.")]
Stall: TypeAlias = Annotated[float, Option(min=1.0, help="Seconds a reader does not read.")]
Returns: TypeAlias = Annotated[int, Option(min=1, help="Times the camera goes and comes back.")]
Starts: TypeAlias = Annotated[int, Option(min=1, help="Processes with the packaged model.")]
AsJson: TypeAlias = Annotated[bool, Option("--json", help="Print the figures as one line of JSON.")]


@bench.callback()
def group() -> None:
    """Nothing of its own; with it, a single command keeps its name."""


@bench.command("node")
def node(
    windows: Windows = 100,
    slow_windows: SlowWindows = 12,
    stall: Stall = 60.0,
    returns: Returns = 3,
    starts: Starts = 3,
    as_json: AsJson = False,
) -> None:
    """Everything but the model: a scripted camera, a stand-in for the model, readers in processes of their own. And how
    long it takes from the start of a process to the first view of the packaged model.

    Takes about four minutes, with nothing else running. Needs no camera.
    """
    options = BenchOptions(windows=windows, slow_windows=slow_windows, stall_s=stall, returns=returns, starts=starts)
    with Console(stderr=True).status("starting") as status, quiet_node():
        report = bench_node(options, lambda part: status.update(part))
    if as_json:
        typer.echo(msgspec.json.encode(report).decode())
    else:
        Console().print(bench_table(report))


def bench_table(report: BenchReport) -> Table:
    """The figures for people, each with what is wanted of two shared cores."""
    title = f"{report.frames} x {report.height} x {report.width} rgb8 over ipc"
    table = Table("", "measured", "wanted", title=title, title_style="dim")
    slow, stalled, back = report.slow_model, report.stalled_reader, report.source_back
    first = report.first_view
    stages = ", ".join(f"{name} {each:.1f}" for name, each in report.stages_ms.items() if name != "capture_gap")
    rows = (
        ("frame to view, ms", _latency(report.latency), "p50 10, p99 30"),
        ("stages of that, p50 ms", stages, ""),
        (
            f"model of {slow.work_ms:.0f} ms for windows every {slow.window_ms:.0f} ms: age, ms",
            f"{slow.first_ms:.0f}, at the end {slow.last_ms:.0f}, most {slow.most_ms:.0f}",
            f"no growth: never over {slow.work_ms + slow.window_ms:.0f} and what is beside the model",
        ),
        ("its backlog, windows", f"{slow.backlog_windows}, {slow.dropped} dropped", "at most 1"),
        ("healthy reader alone, ms", _latency(stalled.before), ""),
        (f"beside one stalled for {stalled.stall_s:.0f} s, ms", _latency(stalled.during), "the same"),
        ("memory of the node meanwhile, MiB", f"{stalled.memory_growth_mb:+.1f}", "under +64"),
        (
            "camera back, its first frame to a view, ms",
            f"{back.after_first_ms:.0f}, most {back.after_first_most_ms:.0f}",
            f"{1000 + back.window_ms:.0f}",
        ),
        (
            f"the same from when it could be opened, gone {back.outage_s:g} s",
            f"{back.after_plugged_ms:.0f}, most {back.after_plugged_most_ms:.0f}",
            "",
        ),
        ("process start to first view, packaged model, s", f"{first.median_s:.1f}, most {first.most_s:.1f}", "10"),
        ("load of the machine before", f"{report.machine_load:.1f}", "0: ages are those of a starved one else"),
    )
    for row in rows:
        table.add_row(*row)
    return table


def _latency(each: Latency) -> str:
    return f"p50 {each.p50_ms:.1f}, p99 {each.p99_ms:.1f} ({each.count} windows)"
