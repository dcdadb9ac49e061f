"""`gcd-train distill`: from a teacher of many steps to a student of few, without guidance."""

import logging
import os
import signal
import threading
import warnings
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, TypeAlias, get_args

import torch
import typer
from typer import Argument, Option

from gcd_train.cli.errors import errors_shown
from gcd_train.errors import RecipeError
from gcd_train.recipe import DistillStageName

if TYPE_CHECKING:
    from gcd_train.distillation.recipe import DistillRecipe
    from gcd_train.run_data import DataPlaces

RecipeFile: TypeAlias = Annotated[
    str,
    Argument(
        metavar="RECIPE",
        help="A TOML file, or package:distill-driving-small, package:distill-objects-small, package:distill-kubric.",
    ),
]
Data: TypeAlias = Annotated[Path, Option(help="Pairs to learn from: the recipe's data.kind says what lies there.")]
Valid: TypeAlias = Annotated[
    Path | None, Option(help="Held-out data of the same kind to measure on; left out, a part of --data (data.split).")
]
Out: TypeAlias = Annotated[Path, Option(help="Folder of the run; run again to go on.")]
Latents: TypeAlias = Annotated[
    Path | None, Option(help="Folder for encoded clips, shared by runs of one teacher; else in --out.")
]
Stage: TypeAlias = Annotated[str | None, Option(help=f"Only this one: {', '.join(get_args(DistillStageName))}.")]
Threads: TypeAlias = Annotated[int | None, Option(min=1, help="CPU threads; else torch's own choice.")]
Changes: TypeAlias = Annotated[
    list[str] | None,
    Option("--set", metavar="KEY=VALUE", help="Change the recipe: student.steps=4, for one; may be repeated."),
]


def distill(
    recipe: RecipeFile,
    data: Data,
    out: Out,
    valid: Valid = None,
    latents: Latents = None,
    stage: Stage = None,
    threads: Threads = None,
    changes: Changes = None,
) -> None:
    """Teach a student to do in a few steps what its teacher does in many, or go on where that stopped.

    Ctrl-C stops after the update and saves.
    """
    # a remark on speed that torch makes once, about the decoder's last layer
    warnings.filterwarnings("ignore", message="grad and param do not obey the gradient layout contract")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if threads is not None:
        torch.set_num_threads(threads)
    from gcd_train.distillation.recipe import load_distillation
    from gcd_train.run_data import DataPlaces

    with errors_shown():
        _require_one_process()
        loaded = load_distillation(recipe, changes or ())
        _run(loaded, DataPlaces(data=data, valid=valid), out, latents, _stage_named(stage))


def _run(
    recipe: "DistillRecipe", places: "DataPlaces", out: Path, latents: Path | None, stage: DistillStageName | None
) -> None:
    from gcd_train.data_kinds import open_data
    from gcd_train.distillation.distiller import Distiller, DistillInputs
    from gcd_train.distillation.teacher import as_training, teacher_of
    from gcd_train.monitor.board import TensorBoard
    from gcd_train.run_folder import RunFolder

    stop = threading.Event()

    def ask(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, ask)
    signal.signal(signal.SIGTERM, ask)
    teacher = teacher_of(recipe)
    inputs = DistillInputs(
        recipe=recipe,
        teacher=teacher,
        data=open_data(as_training(recipe, teacher), teacher.config, teacher.family, places),
        folder=RunFolder(out, TensorBoard(out / "tensorboard") if recipe.log.tensorboard else None),
        stop=stop,
        latents=latents,
    )
    Distiller(inputs).run(stage)


def _require_one_process() -> None:
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise RecipeError("a distillation is the work of one process; start `gcd-train distill` without torchrun")


def _stage_named(name: str | None) -> DistillStageName | None:
    for known in get_args(DistillStageName):
        if name == known:
            return known
    if name is not None:
        raise typer.BadParameter(f"no stage is called {name!r}; there are {', '.join(get_args(DistillStageName))}")
    return None
