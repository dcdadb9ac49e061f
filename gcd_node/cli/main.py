"""`gcd-node`: finds the command, and what becomes of errors."""

import contextlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Collection
from importlib import import_module
from types import FrameType
from typing import Annotated, cast

import typer

from gcd_client.protocol import ClientError
from gcd_node.errors import NodeError, SourceError

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("node:demo", "Replay the packaged drive through the model and over ZeroMQ into a second process."),
    "run": (
        "node:run",
        "Run the node on a launch file: on a recording until that ends, else until shutdown or Ctrl-C.",
    ),
    "check": (
        "check:check_launch",
        "Look at endpoints, camera or recording, weights, memory, views and time of a launch file; loads no weights.",
    ),
    "view": ("node:view", "Watch the views of a node: a live table, and with --save pictures on disk."),
    "viewer": (
        "viewer:viewer",
        "Serve the page for a running node, which it reads as any client does; ends with Ctrl-C.",
    ),
    "replay": (
        "replay:replay_launch",
        "Replay a launch file's recording in lockstep, as fast as the model goes, into a run that can be compared.",
    ),
    "diff": (
        "replay:diff",
        "Compare two runs window by window: identical, or how far apart, where first, and what they were made from.",
    ),
    "status": ("status:status", "Watch how a node does: states, rates, ages, drops, stage times and events."),
    "synthesize": (
        "offline:synthesize",
        "See one clip from another camera, offline: frames, video, class map, depth, and what was seen.",
    ),
    "export": ("offline:export", "Write every network of a checkpoint as an ONNX graph of one size, with a manifest."),
    "ctl": ("control:ctl", "Send one request to a running node: `gcd-node ctl set_view view=top azimuth_deg=30`."),
    "bench": (
        "bench:bench_command",
        "Run a launch file in a process of its own and read its views: latency, throughput, missed frames, cost.",
    ),
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
        signal.signal(signal.SIGTERM, _end_early)
    code = run_app(sys.argv[1:])
    if any(thread.daemon for thread in threading.enumerate()):
        _leave(code)
    sys.exit(code)


def _end_early(_: int, __: FrameType | None) -> None:
    """Until the node itself listens to signals, there is nothing to end."""
    os._exit(0)


def _leave(code: int) -> None:
    """End at once. A thread that was left behind in a driver or a library wakes up while Python clears away, and that
    aborts the process, whatever its exit code was."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # closed, or nobody reads
            stream.flush()
    os._exit(code)


def run_app(arguments: list[str]) -> int:
    """Run one command line and give its exit code."""
    try:
        return int(new_app((_command(arguments),))(arguments, standalone_mode=False) or 0)
    except (NodeError, ClientError) as error:
        return _failed(str(error), error.exit_code)
    except _UsageError as error:
        return _bad_command_line(error)
    except (KeyboardInterrupt, typer.Abort):
        return _failed("interrupted", 130)
    except Exception as error:
        code = SourceError.exit_code if isinstance(error, OSError) and error.filename else _exit_code_of(error)
        if code is None:
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
            app.command(name, help=summary)(_named_alone)
            continue
        module, _, attribute = place.partition(":")
        command = getattr(import_module(f"gcd_node.cli.{module}"), attribute)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name)(command)
    return app


def _named_alone() -> None:
    """Never called: see new_app."""


def _setup(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what happens, with times.")] = False,
) -> None:
    """Log to stderr, so that stdout stays for results."""
    line = "%(asctime)s %(levelname)s %(name)s: %(message)s" if verbose else "%(levelname)s: %(message)s"
    logging.basicConfig(level="INFO" if verbose else "WARNING", format=line, stream=sys.stderr, force=True)


def _command(arguments: list[str]) -> str:
    return next((word for word in arguments if not word.startswith("-")), "")


def _exit_code_of(error: Exception) -> int | None:
    """Of an error of the model (sysexits; the node's own carry theirs); None for any other."""
    if "gcd_model" not in sys.modules:
        return None
    import gcd_model as model

    codes = (
        (model.OptionError, 64),
        (model.PoseError, 64),
        (model.CheckpointError, 65),
        (model.ShapeError, 65),
        (model.Cancelled, 130),
        (model.ModelError, 70),
    )
    return next((code for kind, code in codes if isinstance(error, kind)), None)


def _bad_command_line(error: typer.BadParameter) -> int:
    """A command without arguments shows its help, anything else is one line."""
    message = str(error.format_message()).strip().rstrip(".")
    if not message:
        error.show()
        return 64
    return _failed(f"{message}; see --help", 64)


def _failed(message: str, code: int) -> int:
    words = " ".join(message[:_LONGEST].split())
    line = "".join(each if each.isprintable() else ascii(each)[1:-1] for each in words)
    typer.echo(typer.style("error: ", fg="red", bold=True) + line, err=True)
    return code
