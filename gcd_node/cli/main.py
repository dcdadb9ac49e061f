"""`gcd-node`: finds the command, and what becomes of errors. The commands themselves: cli.commands."""

import contextlib
import os
import signal
import sys
import threading
from types import FrameType
from typing import cast

import typer

from gcd_node.cli.quick import QUICK
from gcd_node.cli.quick import app as quick
from gcd_node.errors import NodeError

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
        return int(_app_for(arguments)(arguments, standalone_mode=False) or 0)
    except NodeError as error:
        return _failed(str(error), error.exit_code)
    except _UsageError as error:
        return _bad_command_line(error)
    except (KeyboardInterrupt, typer.Abort):
        return _failed("interrupted", 130)
    except Exception as error:
        code = _exit_code_of(error)
        if code is None:
            raise
        return _failed(str(error), code)


def _app_for(arguments: list[str]) -> typer.Typer:
    """All commands, or those alone that need no torch, where one of these is asked for: importing it takes seconds."""
    if _command(arguments) in QUICK:
        return quick
    from gcd_node.cli.commands import app

    return app


def _command(arguments: list[str]) -> str:
    return next((word for word in arguments if not word.startswith("-")), "")


def _exit_code_of(error: Exception) -> int | None:
    """Of an error of the model; None for any other, and while nothing of the model was imported."""
    if "gcd_model" not in sys.modules:
        return None
    from gcd_node.cli.exit_codes import exit_code_of

    return exit_code_of(error)


def _bad_command_line(error: typer.BadParameter) -> int:
    """A command without arguments shows its help, anything else is one line."""
    message = str(error.format_message()).strip().rstrip(".")
    if not message:
        error.show()
        return 64
    return _failed(f"{message}; see --help", 64)


def _failed(message: str, code: int) -> int:
    line = " ".join(message.split())
    typer.echo(typer.style("error: ", fg="red", bold=True) + line, err=True)
    return code
