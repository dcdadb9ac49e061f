"""What is done with a launch file: `gcd-node run`, `check`, `replay` and the `diff` of two runs; and `demo`, which has
one of its own. What brings torch is imported when called."""

import contextlib
import gc
import os
import signal
import statistics
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from gcd_node.cli.main import table
from gcd_node.config import LifeConfig, NodeConfig, load_config, to_toml
from gcd_node.errors import UsageError
from gcd_node.service import ServiceManager, background_logging

if TYPE_CHECKING:
    from gcd_node.pipeline import Summary
    from gcd_node.work import WindowReport

ConfigPath: TypeAlias = Annotated[Path, Argument(metavar="CONFIG", help="A launch file, such as launch/demo.toml.")]
Changes: TypeAlias = Annotated[
    list[str] | None, Option("--set", metavar="KEY=VALUE", help="Change a setting, as model.steps=4. Again for more.")
]
PrintConfig: TypeAlias = Annotated[bool, Option("--print-config", help="Print the whole configuration, and end.")]

_SWITCH_S = 0.001
_NOISE = "These weights are random: every picture is noise."
_STYLES = {"ok": "green", "warning": "yellow", "failed": "red"}


def run(
    config: ConfigPath,
    changes: Changes = None,
    print_config: PrintConfig = False,
    once: Annotated[
        bool | None, Option("--once/--stay", help="End with the source or the first failure; else wait for commands.")
    ] = None,
) -> None:
    """Run the node on a launch file, until its recording ends or it is told to."""
    settings = _settings(config, changes, print_config)
    from gcd_node.session import open_session, run_until_signal

    apply_scheduling(settings.life)
    console = Console(stderr=True, markup=False)
    with console.status(Text(f"loading {settings.model.weights}")) as status:
        session = open_session(
            settings,
            once=once,
            on_configured=lambda traits: None if traits.trained else console.print(_NOISE),
            on_window=lambda report: status.update(_words(report)),
            service=ServiceManager(os.environ),
            viewer=True,
        )
        with background_logging(as_json=settings.health.log == "json"), session as (node, publisher, _):
            console.print(f"views on {publisher.endpoint}, status on {publisher.status_endpoint}", soft_wrap=True)
            summary = run_until_signal(node, publisher)
    console.print(_summary_table(summary, f"{publisher.stats.sent} messages sent"))


def _settings(config: Path, changes: list[str] | None, print_config: bool) -> NodeConfig:
    """Of a launch file. print_config: print them, and end."""
    settings = load_config(config, changes or ())
    if print_config:
        typer.echo(to_toml(settings), nl=False)
        raise typer.Exit
    return settings


def apply_scheduling(life: LifeConfig) -> None:
    """Of this process and its threads, which are all the node's.

    A thread with a reply waits for one that computes at most a millisecond instead of five (measured with three busy
    threads: median 23 ms, then 11). What was imported is never searched for garbage, which stops all threads for 0.1 s.
    """
    os.nice(life.nice)
    sys.setswitchinterval(_SWITCH_S)
    gc.freeze()


def check(config: ConfigPath, changes: Changes = None, print_config: PrintConfig = False) -> None:
    """Look at all that a launch file needs, before anything is started; loads no weights.

    Endpoints, camera or recording, weights and memory, views. Ends with what a start would fail with: 65 weights, 66 a
    recording, 69 no camera, 73 an endpoint, 78 a setting.
    """
    settings = _settings(config, changes, print_config)
    from gcd_model import printable
    from gcd_node.check import check_launch

    with Console(stderr=True, markup=False).status("looking"):
        findings = list(check_launch(settings))
    rows = ((each.topic, each.verdict, printable(each.detail, 4000)) for each in findings)
    shown = table(rows)
    for row, each in zip(shown.rows, findings, strict=True):
        row.style = _STYLES[each.verdict]
    Console(markup=False).print(shown)
    for each in findings:
        if each.error is not None:
            raise each.error


def serve(
    config: Annotated[Path, Argument(metavar="CONFIG", help="A file such as launch/serve.toml.")],
) -> None:
    """Serve a model to many nodes, on Ray Serve: one replica a GPU.

    Deploys on the Ray cluster of this machine, or of RAY_ADDRESS, and ends; the service stays until `serve shutdown`.
    Without a cluster it serves on this machine alone, until Ctrl-C. Nodes name its address: [model] engine = "remote".
    """
    from gcd_node.fleet import deployed, load_service

    settings = load_service(config)
    console = Console(stderr=True, markup=False)
    console.print(Text(f"deploying {settings.model.weights}"))
    with deployed(settings) as ends_with_us, contextlib.suppress(KeyboardInterrupt):
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        console.print(f"serving on {settings.serve.url}", soft_wrap=True)
        if ends_with_us:
            signal.pause()


def demo(
    out: Annotated[Path, Option(help="Folder for the pictures.")] = Path("gcd-demo"),
    show: Annotated[
        bool,
        Option("--open", help="Run in a loop, and open the page on which to watch and steer it; ends with Ctrl-C."),
    ] = False,
) -> None:
    """Replay the packaged drive through the model and over ZeroMQ into a second process.

    Writes side_by_side.mp4 and .png; needs neither camera nor GPU. With --open the drive runs in a loop instead, with
    the page on which to watch it.
    """
    from gcd_node.demo import HEADINGS, run_demo, run_open_demo

    console = Console(markup=False)
    if show:
        console.print("Every pixel of the view is generated. End with Ctrl-C.")
        with console.status("running"):
            summary = run_open_demo()
        console.print(_summary_table(summary, "on the page"))
        return
    with console.status("loading") as status:
        summary, traits, received = run_demo(out, lambda report: status.update(_words(report)))
    console.print(_summary_table(summary, f"{received} pictures in the other process"))
    made_by = f"Generated by {traits.name} from the input alone, never evidence of free space."
    console.print(f"Shown, from left to right: {'; '.join(HEADINGS)}. {made_by if traits.trained else _NOISE}")
    console.print(f"wrote {out}/side_by_side.mp4 and .png", soft_wrap=True)


def replay_launch(
    config: ConfigPath,
    out: Annotated[Path | None, Option("--out", metavar="RUN", help="Folder for the run; new, or empty.")] = None,
    bag: Annotated[Path | None, Option("--bag", metavar="BAG", help="Instead, a ROS 2 bag for its views.")] = None,
    changes: Changes = None,
) -> None:
    """Replay a launch file's recording in lockstep into a run that can be compared, or into a ROS 2 bag.

    RUN gets manifest.json (what it was made from, and a SHA-256 of every view of every window) and the pixels without
    loss. BAG gets the views with the stamps of the log they were made from, to be played or merged with it. Both appear
    when they are complete. Opens no socket; the same machine gives the same hashes every time.
    """
    if (out is None) == (bag is None):
        raise UsageError("a replay is written either as a run, --out RUN, or as a ROS 2 bag, --bag BAG; give one")
    from gcd_node.replay.lockstep import replay, replay_to_bag

    settings = load_config(config, changes or ())
    loading, console = Text(f"loading {settings.model.weights}"), Console(markup=False)
    with Console(stderr=True, markup=False).status(loading) as status:
        if bag is not None:
            summary = replay_to_bag(settings, bag, lambda report: status.update(_words(report)))
            console.print(f"wrote {bag}: {summary.counts.windows} windows", soft_wrap=True, highlight=False)
            return
        assert out is not None
        run = replay(settings, out, lambda report: status.update(_words(report)))
    manifest = run.manifest
    totals = {"frames": manifest.frames, "windows": len(manifest.windows), "windows with NaN": manifest.nan_windows}
    console.print(table([*manifest.made_from.items(), *totals.items(), *manifest.rejected.items()]))
    console.print(f"wrote {run.path}", soft_wrap=True, highlight=False)


def diff(
    run_a: Annotated[Path, Argument(metavar="RUN_A", help="A run of `gcd-node replay`, such as the golden one.")],
    run_b: Annotated[Path, Argument(metavar="RUN_B", help="The run to compare with it.")],
    min_psnr: Annotated[
        float | None,
        Option(metavar="DB", help="What each frame of each view must reach; else all pixels must be identical."),
    ] = None,
    max_class_share: Annotated[
        float, Option(metavar="SHARE", help="Of a view's class pixels in a window, how many may differ, 0 to 1.")
    ] = 0.0,
    as_json: Annotated[bool, Option("--json", help="Print the whole comparison as one line of JSON.")] = False,
) -> None:
    """Compare two runs: identical, or how far apart, where first, and what they were made from.

    Ends with 0 if they are identical or near enough, with 1 if not, with 65 or 66 if one is damaged or missing.
    """
    from gcd_node.replay.compare import Tolerance, compare, report_text
    from gcd_node.replay.run import open_run

    tolerance = Tolerance(min_psnr_db=min_psnr, max_class_share=max_class_share)
    runs = open_run(run_a), open_run(run_b)
    with Console(stderr=True, markup=False).status("comparing"):
        comparison = compare(*runs)
    typer.echo(msgspec.json.encode(comparison).decode() if as_json else report_text(comparison, tolerance))
    if comparison.failures(tolerance):
        raise typer.Exit(1)


def _words(report: "WindowReport") -> str:
    return f"window {report.window.window_id}: {1000 * report.render_s:.0f} ms, age {report.age_ms:.0f} ms"


def _summary_table(summary: "Summary", delivered: str) -> Table:
    """What a run came to; times are medians."""
    counts = summary.counts
    rows = {
        "frames read": summary.frames,
        "windows rendered": counts.windows,
        "delivered": delivered,
        "ms per window": f"{1000 * statistics.median(counts.render_s or [0.0]):.0f}",
        "age at publish, ms": f"{statistics.median(counts.age_ms or [0.0]):.0f}",
        "windows dropped": summary.dropped,
        "windows rejected": ", ".join(f"{count} {reason}" for reason, count in summary.rejected.items()) or "0",
        "windows with NaN": counts.nan_windows,
    }
    return table(rows.items())
