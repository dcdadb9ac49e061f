"""`gcd-node`: every command in one place, and what becomes of errors."""

import logging
import sys
from typing import Annotated, cast

import typer

from gcd_model import (
    Cancelled,
    CheckpointError,
    DeviceMemoryError,
    ModelError,
    NonFiniteError,
    OptionError,
    PoseError,
    ShapeError,
)
from gcd_node.cli.bench import bench
from gcd_node.cli.check import check_launch
from gcd_node.cli.control import ctl, keys
from gcd_node.cli.node import demo, run, view
from gcd_node.cli.soak import soak
from gcd_node.cli.status import status
from gcd_node.cli.synthesize import synthesize
from gcd_node.cli.weights import weights
from gcd_node.errors import NodeError

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Virtual camera views from one camera, live.\n\n"
    "Start with [bold]gcd-node demo[/bold]. Every pixel of a view is generated: never evidence of free space.",
)
app.command()(demo)
app.command()(run)
app.command("check")(check_launch)
app.command()(view)
app.command()(status)
app.command()(synthesize)
app.command()(ctl)
app.command()(soak)
app.add_typer(keys, name="keys")
app.add_typer(weights, name="weights")
app.add_typer(bench, name="bench")

EXIT_CODES: tuple[tuple[type[ModelError], int], ...] = (
    (CheckpointError, 65),
    (OptionError, 64),
    (PoseError, 64),
    (ShapeError, 65),
    (DeviceMemoryError, 70),
    (NonFiniteError, 70),
    (Cancelled, 130),
    (ModelError, 70),
)
"""sysexits of the model's errors; the node's own carry theirs."""

_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__mro__[1])  # wherever this typer keeps it


@app.callback()
def setup(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what happens, with times.")] = False,
) -> None:
    """Log to stderr, so that stdout stays for results."""
    line = "%(asctime)s %(levelname)s %(name)s: %(message)s" if verbose else "%(levelname)s: %(message)s"
    logging.basicConfig(level="INFO" if verbose else "WARNING", format=line, stream=sys.stderr, force=True)


def main() -> None:
    """Entry point: runs a command; an expected error becomes one line and its exit code."""
    sys.exit(run_app(sys.argv[1:]))


def run_app(arguments: list[str]) -> int:
    """Run one command line and give its exit code."""
    try:
        return int(app(arguments, standalone_mode=False) or 0)
    except NodeError as error:
        return _failed(str(error), error.exit_code)
    except ModelError as error:
        return _failed(str(error), next(code for kind, code in EXIT_CODES if isinstance(error, kind)))
    except _UsageError as error:
        return _bad_command_line(error)
    except (KeyboardInterrupt, typer.Abort):
        return _failed("interrupted", 130)


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
