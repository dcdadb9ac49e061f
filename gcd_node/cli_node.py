"""`gcd-node demo`, `run` and `view`: the live side of the command line."""

import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from rich.console import Console
from rich.live import Live
from rich.table import Table
from typer import Argument, Option

from gcd_node.config import load_config
from gcd_node.demo import run_demo
from gcd_node.model_worker import WindowReport
from gcd_node.node import Summary
from gcd_node.session import open_session, run_until_signal
from gcd_node.viewing import ViewRow, WatchRequest, render, watch

DemoOut: TypeAlias = Annotated[Path, Option(help="Folder for the pictures.")]
ConfigPath: TypeAlias = Annotated[Path, Argument(metavar="CONFIG", help="A launch file, such as launch/demo.toml.")]
Endpoint: TypeAlias = Annotated[str, Argument(metavar="ENDPOINT", help="ipc, ipc://PATH or tcp://HOST:PORT.")]
ViewName: TypeAlias = Annotated[str | None, Option("--view", help="One view's id; else all.")]
Kind: TypeAlias = Annotated[
    Literal["win", "frm", "std"], Option(help="Windows, frames at the goal pose, or deviations.")
]
Save: TypeAlias = Annotated[Path | None, Option(help="Folder for PNG files and a lossless MKV per view.")]
Limit: TypeAlias = Annotated[int | None, Option(min=1, help="End after so many messages.")]
Timeout: TypeAlias = Annotated[float | None, Option(help="End when nothing came for so many seconds.")]


def demo(out: DemoOut = Path("gcd-demo")) -> None:
    """Replay the packaged drive through the model and over ZeroMQ into a second process.

    Writes side_by_side.mp4 and strip.png; needs neither camera nor GPU.
    """
    console = Console()
    with console.status("loading"):
        report = run_demo(out, _told(console))
    console.print(_table(report.summary, f"{report.received} windows in the other process"))
    if report.noise:
        console.print("These weights are random: the plumbing is real, the picture on the right is noise.")
    console.print(f"wrote {report.video} and {report.strip}", soft_wrap=True)


def run(config: ConfigPath) -> None:
    """Run the node on a launch file until its source ends, or Ctrl-C."""
    settings = load_config(config)
    console = Console(stderr=True)
    status = console.status(f"loading {settings.model.weights}")
    with status, open_session(settings, _told(console)) as (node, publisher):
        console.print(f"views on {publisher.endpoint}, status on {publisher.status_endpoint}", soft_wrap=True)
        if not node.traits.trained:
            console.print(f"{node.traits.name}: these weights are random, so every picture is noise.")
        status.update("running")
        summary = run_until_signal(node, publisher)
    sent = publisher.stats.sent
    console.print(_table(summary, f"{sent} messages sent"))


def view(
    endpoint: Endpoint = "ipc",
    name: ViewName = None,
    kind: Kind = "win",
    save: Save = None,
    limit: Limit = None,
    timeout: Timeout = None,
) -> None:
    """Watch the views of a node: a live table, and with --save pictures on disk."""
    request = WatchRequest(endpoint=endpoint, view=name, kind=kind, save=save, limit=limit, timeout_s=timeout)
    console = Console()
    with Live(console=console, auto_refresh=False) as live:

        def show(rows: Sequence[ViewRow]) -> None:
            live.update(render(rows), refresh=True)

        report = watch(request, show)
    ending = "the stream ended" if report.ended else "stopped"
    console.print(f"{report.received} messages, {report.files} files, {report.damaged} damaged; {ending}")


def _told(console: Console) -> Callable[[WindowReport], None]:
    """A callback that says one line per window."""

    def tell(report: WindowReport) -> None:
        line = f"window {report.window.window_id}: {report.render_s * 1000:.0f} ms, age {report.age_ms:.0f} ms"
        console.print(line, highlight=False)

    return tell


def _table(summary: Summary, delivered: str) -> Table:
    """What a run came to. Real-time factor: video time per window over inference time; 1 and above keeps up."""
    counts = summary.counts
    table = Table(show_header=False)
    rows = [("frames read", str(summary.frames)), ("windows rendered", str(counts.windows)), ("delivered", delivered)]
    if counts.windows:
        median_s = statistics.median(counts.render_s)
        rows += [
            ("ms per window (median)", f"{median_s * 1000:.0f}"),
            ("real-time factor", f"{summary.window_s / median_s:.2f}"),
            ("age at publish, ms (median)", f"{statistics.median(counts.age_ms):.0f}"),
        ]
    rejected = ", ".join(f"{count} {reason}" for reason, count in summary.rejected.items()) or "0"
    rows += [("windows dropped", str(summary.dropped)), ("windows rejected", rejected)]
    rows += [("windows with NaN", str(counts.nan_windows))]
    for row in rows:
        table.add_row(*row)
    return table
