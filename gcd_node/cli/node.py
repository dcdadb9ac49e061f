"""`gcd-node demo`, `run` and `view`: the live side of the command line."""

import gc
import os
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer
from rich.console import Console
from rich.live import Live
from rich.status import Status
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from gcd_model import Traits
from gcd_node.cli.check import Changes, ConfigPath, PrintConfig
from gcd_node.cli.control import KeyFolder, NodeKey, client_keys
from gcd_node.config import LifeConfig, load_config
from gcd_node.config_dump import to_toml
from gcd_node.demo import HEADINGS, DemoReport, run_demo, run_open_demo
from gcd_node.inference import WindowReport
from gcd_node.node import NodeOptions
from gcd_node.pipeline import Summary
from gcd_node.service import ServiceManager, background_logging
from gcd_node.session import ends_by_itself, open_session, run_until_signal
from gcd_node.watching.views import ViewRow, WatchRequest, render, watch

_SWITCH_S = 0.001

DemoOut: TypeAlias = Annotated[Path, Option(help="Folder for the pictures.")]
Show: TypeAlias = Annotated[
    bool, Option("--open", help="Run in a loop, and open the page on which to watch and steer it; ends with Ctrl-C.")
]
Once: TypeAlias = Annotated[
    bool | None, Option("--once/--stay", help="End with the source or the first failure; else wait for commands.")
]
Endpoint: TypeAlias = Annotated[str, Argument(metavar="ENDPOINT", help="ipc, ipc://PATH or tcp://HOST:PORT.")]
ViewName: TypeAlias = Annotated[str | None, Option("--view", help="One view's id; else all.")]
Kind: TypeAlias = Annotated[
    Literal["win", "frm", "std", "cls", "vis", "depth", "all"],
    Option(help="Windows, frames at the goal pose, deviations, class maps, what was seen, depth, or all of these."),
]
Save: TypeAlias = Annotated[Path | None, Option(help="Folder for PNG files and a lossless MKV per view.")]
Hatch: TypeAlias = Annotated[
    bool, Option("--hatch", help="Save windows with lines over their painted pixels; over all where nobody says.")
]
Limit: TypeAlias = Annotated[int | None, Option(min=1, help="End after so many messages.")]
Timeout: TypeAlias = Annotated[float | None, Option(help="End when nothing came for so many seconds.")]


def demo(out: DemoOut = Path("gcd-demo"), show: Show = False) -> None:
    """Replay the packaged drive through the model and over ZeroMQ into a second process.

    Writes side_by_side.mp4, .webp and .png; needs neither camera nor GPU. With --open the drive runs in a loop
    instead, with the page on which to watch it.
    """
    console = Console(markup=False)
    if show:
        _demo_page(console)
        return
    with console.status("loading"):
        report = run_demo(out, _told(console))
    console.print(_table(report.summary, f"{report.received} windows in the other process"))
    console.print(_shown(report), soft_wrap=True)
    console.print(f"wrote {' and '.join(map(str, report.files))}", soft_wrap=True)


def _demo_page(console: Console) -> None:
    console.print("Every pixel of the view is generated. End with Ctrl-C.")
    with console.status("running"):
        summary = run_open_demo()
    console.print(_table(summary, "on the page"))


def run(config: ConfigPath, changes: Changes = None, print_config: PrintConfig = False, once: Once = None) -> None:
    """Run the node on a launch file: on a recording until that ends, else until shutdown or Ctrl-C."""
    settings = load_config(config, changes or ())
    if print_config:
        typer.echo(to_toml(settings), nl=False)
        return
    apply_scheduling(settings.life)
    console = Console(stderr=True, markup=False)
    status = console.status(Text(f"loading {settings.model.weights}"))
    options = NodeOptions(
        once=ends_by_itself(settings) if once is None else once,
        on_configured=lambda traits: _tell_configured(console, status, traits),
        service=ServiceManager(os.environ),
    )
    logging = background_logging(as_json=settings.health.log == "json")
    with logging, status, open_session(settings, _told(console), options, viewer=True) as (node, publisher):
        console.print(f"views on {publisher.endpoint}, status on {publisher.status_endpoint}", soft_wrap=True)
        summary = run_until_signal(node, publisher)
    console.print(_table(summary, f"{publisher.stats.sent} messages sent"))


def apply_scheduling(life: LifeConfig) -> None:
    """Of this process and its threads, which are all the node's.

    A thread with a reply waits for one that computes at most a millisecond instead of five (measured with three busy
    threads: median 23 ms, then 11). What was imported is never searched for garbage, which stops all threads for 0.1 s.
    """
    os.nice(life.nice)
    sys.setswitchinterval(_SWITCH_S)
    gc.freeze()


def _tell_configured(console: Console, status: Status, traits: Traits) -> None:
    if traits.classes:
        console.print("each view comes with its class map, topic view/<id>/cls", highlight=False)
    if not traits.trained:
        console.print(f"{traits.name}: these weights are random, so every picture is noise.")
    status.update("running")


def view(
    endpoint: Endpoint = "ipc",
    name: ViewName = None,
    kind: Kind = "win",
    save: Save = None,
    hatch: Hatch = False,
    limit: Limit = None,
    timeout: Timeout = None,
    key_folder: KeyFolder = None,
    node_key: NodeKey = None,
) -> None:
    """Watch the views of a node: a live table, and with --save pictures on disk."""
    if hatch and kind not in ("win", "all"):
        raise typer.BadParameter("--hatch is for windows: --kind win or all")
    wanted = None if kind == "all" else ("win", "vis") if hatch else kind
    request = WatchRequest(
        endpoint=endpoint,
        view=name,
        kind=wanted,
        save=save,
        hatch=hatch,
        limit=limit,
        timeout_s=timeout,
        keys=client_keys(key_folder, node_key),
    )
    console = Console(markup=False)
    with Live(console=console, auto_refresh=False) as live:

        def show(rows: Sequence[ViewRow]) -> None:
            live.update(render(rows), refresh=True)

        report = watch(request, show)
    ending = "the stream ended" if report.ended else "stopped"
    console.print(f"{report.received} messages, {report.files} files, {report.damaged} damaged; {ending}")


def _shown(report: DemoReport) -> str:
    """What the demo's pictures show."""
    shown = f"Shown, from left to right: {'; '.join(HEADINGS)}. "
    if report.noise:
        return shown + "These weights are random: the plumbing is real, what is generated is noise."
    return shown + f"Generated by {report.model} from the input alone, never evidence of free space."


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
