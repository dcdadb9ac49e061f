"""`gcd-node`: finds the command, and what becomes of errors; the tables that commands print."""

import contextlib
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Collection, Generator, Iterable, Sequence
from importlib import import_module, metadata
from typing import TYPE_CHECKING, Annotated, cast

import typer

from gcd_client.protocol import ClientError
from gcd_node.errors import NodeError, SourceError

if TYPE_CHECKING:
    from rich.table import Table

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("run:demo", "Replay the packaged drive through the model and over ZeroMQ into a second process."),
    "run": ("run:run", "Run the node on a launch file, until its recording ends or it is told to."),
    "serve": ("run:serve", "Serve a model to many nodes, on Ray Serve: one replica a GPU."),
    "check": ("run:check", "Look at all that a launch file needs, before anything is started; loads no weights."),
    "calibrate-view": (
        "calibrate:calibrate_view",
        "Find where the camera of a reference picture stood, for a canonical view.",
    ),
    "view": ("watch:view", "Watch the views of a node: a live table, and with --save pictures on disk."),
    "viewer": ("watch:viewer", "Serve the page for a running node; ends with Ctrl-C."),
    "replay": (
        "run:replay_launch",
        "Replay a launch file's recording in lockstep into a run that can be compared, or into a ROS 2 bag.",
    ),
    "diff": ("run:diff", "Compare two runs: identical, or how far apart, where first, and what they were made from."),
    "status": ("watch:status", "Watch how a node does: states, rates, ages, drops, stage times and events."),
    "synthesize": (
        "offline:synthesize",
        "See one clip from another camera, offline: frames, video, class map, depth, and what was seen.",
    ),
    "export": ("offline:export", "Write every network of a checkpoint as an ONNX graph of one size, with a manifest."),
    "ctl": ("control:ctl", "Send one request to a running node: `gcd-node ctl set_view view=top azimuth_deg=30`."),
    "bench": ("bench:bench", "Measure a node in a process of its own: latency, throughput, missed frames, cost."),
    "keys": ("control:keys", "CURVE keys, for nodes that are reached over a network."),
    "weights": ("weights:weights", "Look into checkpoints, convert them."),
}
"""Where each command stands in this package, and what its help begins with: only the one that is asked for is imported,
as torch takes seconds."""

_LONGEST = 4000  # of a message, in which a file may have put what it likes
_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__mro__[1])  # wherever this typer keeps it


def main() -> None:
    """Entry point: runs a command; an expected error becomes one line and its exit code."""
    if _command(sys.argv[1:]) == "run":
        signal.signal(signal.SIGTERM, lambda _number, _frame: os._exit(0))  # nothing to end until the node listens
    code = run_app(sys.argv[1:])
    if not any(thread.daemon for thread in threading.enumerate()):
        sys.exit(code)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # closed, or nobody reads
            stream.flush()
    os._exit(code)  # a thread left in a driver would wake up while Python clears away, and abort the process


def run_app(arguments: list[str]) -> int:
    """Run one command line and give its exit code."""
    try:
        return int(new_app((_command(arguments),))(arguments, standalone_mode=False) or 0)
    except (NodeError, ClientError) as error:
        return _failed(str(error), error.exit_code)
    except _UsageError as error:
        message = str(error.format_message()).strip().rstrip(".")
        if not message:  # a command without arguments shows its help
            error.show()
            return 64
        return _failed(f"{message}; see --help", 64)
    except (KeyboardInterrupt, typer.Abort):
        return _failed("interrupted", 130)
    except Exception as error:
        if (code := _exit_code(error)) is None:
            raise
        return _failed(str(error), code)


def new_app(loaded: Collection[str]) -> typer.Typer:
    """`gcd-node` with these commands, and of the others their names."""
    app = typer.Typer(
        no_args_is_help=True,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        help="Virtual camera views from one camera, live.\n\n"
        "Start with [bold]gcd-node demo[/bold]. Every pixel of a view is generated: never evidence of free space.",
    )
    app.callback()(_setup)
    for name, (place, summary) in COMMANDS.items():
        if name not in loaded:
            app.command(name, help=summary)(lambda: None)  # for the list of commands alone
            continue
        module, _, attribute = place.partition(":")
        command = getattr(import_module(f"gcd_node.cli.{module}"), attribute)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            text = re.sub(r"(\[[a-z])", r"\\\1", command.__doc__ or "")  # [model] is no markup
            app.command(name, help=text)(command)
    return app


def table(rows: Iterable[Sequence[object]], columns: Sequence[str] = (), title: str | None = None) -> "Table":
    """A table to print. columns: headings, ">" before those of numbers; none of a list of facts."""
    from rich.table import Table  # many commands print none

    made = Table(title=title, show_header=bool(columns))
    for name in columns:
        justify = "right" if name.startswith(">") else "left"
        made.add_column(name.removeprefix(">"), justify=justify, no_wrap=name == columns[0])
    for row in rows:
        made.add_row(*map(str, row))
    for column in made.columns:
        column.overflow = "fold"
    return made


@contextlib.contextmanager
def progress_bar(first: str) -> Generator[Callable[[str, int, int], None]]:
    """On a terminal. Gives what moves it: what is being done, how much of it is done, and how much there is."""
    from rich.console import Console

    with Console(stderr=True, markup=False).status(first) as status:
        yield lambda what, done, total: status.update(f"{what}, {done} of {total}")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"gcd-node {metadata.version('gcd-node')}")
        raise typer.Exit


def _setup(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what happens, with times.")] = False,
    version: Annotated[bool, typer.Option("--version", is_eager=True, callback=_print_version)] = False,
) -> None:
    """Log to stderr, so that stdout stays for results."""
    line = "%(asctime)s %(levelname)s %(name)s: %(message)s" if verbose else "%(levelname)s: %(message)s"
    logging.basicConfig(level="INFO" if verbose else "WARNING", format=line, stream=sys.stderr, force=True)


def _command(arguments: list[str]) -> str:
    return next((word for word in arguments if not word.startswith("-")), "")


def _exit_code(error: Exception) -> int | None:
    """Of a file that cannot be opened, or an error of the model; None for any other."""
    if isinstance(error, OSError) and error.filename:
        return SourceError.exit_code
    codes = {"OptionError": 64, "PoseError": 64, "CheckpointError": 65, "ShapeError": 65, "Cancelled": 130}
    codes |= {"AlignmentError": 65, "FileError": 78}
    codes["ModelError"] = 70  # the root of them; by name, as their package brings torch
    kinds = [kind.__name__ for kind in type(error).__mro__ if kind.__module__ == "gcd_model.errors"]
    return next((codes[kind] for kind in kinds if kind in codes), None)


def _failed(message: str, code: int) -> int:
    words = " ".join(message[:_LONGEST].split())
    line = "".join(each if each.isprintable() else ascii(each)[1:-1] for each in words)
    typer.echo(typer.style("error: ", fg="red", bold=True) + line, err=True)
    return code
