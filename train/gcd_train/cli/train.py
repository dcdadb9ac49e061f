"""`gcd-train train`: from clips to a weight file, stage by stage."""

import logging
import signal
import threading
import warnings
from pathlib import Path
from types import FrameType
from typing import Annotated, TypeAlias, get_args

import torch
import typer
from typer import Argument, Option

from gcd_train.cli.errors import errors_shown
from gcd_train.recipe import StageName, load_recipe

RecipeFile: TypeAlias = Annotated[
    str, Argument(metavar="RECIPE", help="A TOML file, or package:driving-small for one that ships.")
]
Data: TypeAlias = Annotated[Path, Option(help="Folder of clips to learn from.")]
Valid: TypeAlias = Annotated[Path, Option(help="Folder of held-out clips to measure on.")]
Out: TypeAlias = Annotated[Path, Option(help="Folder of the run; run again to go on.")]
Stage: TypeAlias = Annotated[str | None, Option(help=f"Only this one: {', '.join(get_args(StageName))}.")]
Threads: TypeAlias = Annotated[int | None, Option(min=1, help="CPU threads; else torch's own choice.")]


def train(recipe: RecipeFile, data: Data, valid: Valid, out: Out, stage: Stage = None, threads: Threads = None) -> None:
    """Train a model on clips, or go on where a run stopped. Ctrl-C stops after the update and saves."""
    # a remark on speed that torch makes once, about the decoder's last layer
    warnings.filterwarnings("ignore", message="grad and param do not obey the gradient layout contract")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if threads is not None:
        torch.set_num_threads(threads)
    with errors_shown():
        _run(recipe, data, valid, out, _stage_named(stage))


def _run(recipe: str, data: Path, valid: Path, out: Path, stage: StageName | None) -> None:
    from gcd_train.datasets.paired import PairedClips, require_apart
    from gcd_train.run_folder import RunFolder
    from gcd_train.trainer import RunInputs, Trainer

    stop = threading.Event()

    def ask(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, ask)
    signal.signal(signal.SIGTERM, ask)
    loaded = load_recipe(recipe)
    clips, held_out = PairedClips.open(data), PairedClips.open(valid)
    require_apart(clips, held_out)
    inputs = RunInputs(
        recipe=loaded,
        clips=clips,
        valid=held_out,
        folder=RunFolder(out),
        stop=stop,
    )
    Trainer(inputs).run(stage)


def _stage_named(name: str | None) -> StageName | None:
    for known in get_args(StageName):
        if name == known:
            return known
    if name is not None:
        raise typer.BadParameter(f"no stage is called {name!r}; there are {', '.join(get_args(StageName))}")
    return None
