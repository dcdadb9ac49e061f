"""What the commands that train have in common: options, how they log, and how they are stopped."""

import logging
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Annotated, TypeAlias, TypeVar

import torch
import typer
from typer import Option

Data: TypeAlias = Annotated[Path, Option(help="What to learn from: the recipe's data.kind says what lies there.")]
Valid: TypeAlias = Annotated[
    Path | None, Option(help="Held-out data of the same kind to measure on; left out, a part of --data (data.split).")
]
Out: TypeAlias = Annotated[Path, Option(help="Folder of the run; run again to go on.")]
Latents: TypeAlias = Annotated[
    Path | None, Option(help="Folder for encoded clips, shared by runs of one autoencoder; else in --out.")
]
Threads: TypeAlias = Annotated[int | None, Option(min=1, help="CPU threads; else torch's own choice.")]
Changes: TypeAlias = Annotated[
    list[str] | None,
    Option("--set", metavar="KEY=VALUE", help="Change the recipe: log.save_s=60, for one; may be repeated."),
]

Name = TypeVar("Name", bound=str)


def prepare_process(threads: int | None) -> None:
    """Log to the terminal, leave out remarks that mean nothing here, and use so many threads."""
    # a remark on speed that torch makes once, about the decoder's last layer
    warnings.filterwarnings("ignore", message="grad and param do not obey the gradient layout contract")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if threads is not None:
        torch.set_num_threads(threads)


def command_line() -> str:
    """As it could be typed again."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def stop_when_asked() -> threading.Event:
    """Set by Ctrl-C and by SIGTERM from now on; the run then stops after its update and saves."""
    stop = threading.Event()

    def ask(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, ask)
    signal.signal(signal.SIGTERM, ask)
    return stop


def stage_named(name: str | None, known: Sequence[Name]) -> Name | None:
    """The stage with this name, None for all of them.

    Raises:
        BadParameter: there is none.
    """
    for each in known:
        if name == each:
            return each
    if name is not None:
        raise typer.BadParameter(f"no stage is called {name!r}; there are {', '.join(known)}")
    return None
