"""What commands have in common: options, errors as their user sees them, what is said meanwhile, how they stop."""

import shlex
import signal
import sys
from collections.abc import Callable, Generator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import MISSING, fields
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, TypeAlias, get_type_hints

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gcd_model import ModelError, printable
from gcd_train.errors import Interrupted, RunError, TrainError

Workers: TypeAlias = Annotated[int, typer.Option(min=1, help="Processes.")]
Ray: TypeAlias = Annotated[
    str | None, typer.Option("--ray", help="Run on this Ray cluster (auto, HOST:PORT; extra `cluster`).")
]
Limit: TypeAlias = Annotated[int | None, typer.Option(min=1, help="Only the first so many scenes.")]
Device: TypeAlias = Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")]
Dtype: TypeAlias = Annotated[str | None, typer.Option(help="float32, bfloat16 or float16; by default as stored.")]
FamilyName: TypeAlias = Annotated[
    str | None, typer.Option("--family", help="Family of the weights, where their file does not tell.")
]
"""Options that several commands have."""

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
            '"bfloat16"; docs/training.md says what each takes'
        )
        raise typer.Exit(RunError.exit_code) from error
    except OSError as error:
        _say(f"{error}; see to the disk or the path, then run the same line to go on")
        raise typer.Exit(RunError.exit_code) from error


def _out_of_memory(error: RuntimeError) -> bool:
    """Whether a device, or the host, had no memory left. By name: torch is not imported for an error's sake."""
    return type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in str(error)


def _say(message: object) -> None:
    say("gcd-train: " + printable(" ".join(str(message).split()), _LONGEST))


@contextmanager
def progress_bar(what: str, total: int, *, keep: bool = False) -> Generator[Callable[[int], None]]:
    """A bar on stderr; call what this gives with the number done so far. keep: leave the bar there at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=not keep) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)


def say(line: str, *, stderr: bool = True) -> None:
    """A line on stderr, or stdout, as it is."""
    Console(stderr=stderr, highlight=False).print(line, markup=False, soft_wrap=True)


def stop_as_by_ctrl_c() -> None:
    """From now on SIGTERM ends this process as Ctrl-C does, so that no worker is left behind."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def command_line() -> str:
    """As it could be typed again."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def with_fields_of(kind: type[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command, beside its own options, one for each field of a dataclass, which it gets by keyword.

    A field is annotated as an option of a command: `Annotated[int, typer.Option(help=...)]`.
    """

    def changed(command: Callable[..., None]) -> Callable[..., None]:
        hints, own = get_type_hints(kind, include_extras=True), list(signature(command).parameters.values())
        more = [
            Parameter(
                field.name,
                Parameter.KEYWORD_ONLY,
                default=Parameter.empty if field.default is MISSING else field.default,
                annotation=hints[field.name],
            )
            for field in fields(kind)
        ]
        each = [*more, *(parameter for parameter in own if parameter.kind is not Parameter.VAR_KEYWORD)]
        each = [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in each]
        command.__signature__ = Signature(each)  # pyright: ignore[reportFunctionMemberAccess]
        command.__annotations__ = {parameter.name: parameter.annotation for parameter in each}
        return command

    return changed
