"""Errors of every `gcd-train` command, as its user sees them."""

from collections.abc import Generator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

import typer
from rich.console import Console

from gcd_model import ModelError, printable
from gcd_train.errors import Interrupted, RunError, TrainError

_LONGEST = 4000  # of a message, in which a file may have put what it likes
_OPTION = 78  # sysexits: what the model refuses here is an option or a weight file the user named


@contextmanager
def errors_shown() -> Generator[None]:
    """What a user can do something about becomes one line and an exit code; the rest stays a traceback."""
    try:
        yield
    except (TrainError, ModelError) as error:
        _say(error)
        raise typer.Exit(error.exit_code if isinstance(error, TrainError) else _OPTION) from error
    except KeyboardInterrupt as error:
        _say("stopped; what is finished stays, run the same line to go on")
        raise typer.Exit(Interrupted.exit_code) from error
    except BrokenProcessPool as error:
        _say("a worker was killed, most likely for want of memory; give fewer --workers, the finished part stays")
        raise typer.Exit(RunError.exit_code) from error
    except RuntimeError as error:
        if "Symlink loop" in str(error):  # pathlib's, before Python 3.13
            _say(f"{error}: a link leads to itself; check the path")
            raise typer.Exit(RunError.exit_code) from error
        if not _out_of_memory(error):
            raise
        _say(
            f"{error}; give fewer clips at once (clip_batch), compute.checkpoint_activations, 8-bit Adam or precision "
            '"bfloat16": `gcd-train bench train` says what each takes'
        )
        raise typer.Exit(RunError.exit_code) from error
    except OSError as error:
        _say(f"{error}; see to the disk or the path, then run the same line to go on")
        raise typer.Exit(RunError.exit_code) from error


def _out_of_memory(error: RuntimeError) -> bool:
    """Whether a device, or the host, had no memory left. By name: torch is not imported for an error's sake."""
    return type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in str(error)


def _say(message: object) -> None:
    line = printable(" ".join(str(message).split()), _LONGEST)
    Console(stderr=True, highlight=False).print(f"gcd-train: {line}", markup=False, soft_wrap=True)
