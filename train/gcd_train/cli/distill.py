"""`gcd-train distill`: from a teacher of many steps to a student of few, without guidance."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias, get_args

from typer import Argument, Option

from gcd_train.cli.errors import errors_shown
from gcd_train.cli.training_run import (
    Changes,
    Data,
    Latents,
    Out,
    Threads,
    Valid,
    command_line,
    prepare_process,
    stage_named,
    stop_when_asked,
)
from gcd_train.errors import RecipeError
from gcd_train.recipe_data import DistillStageName

if TYPE_CHECKING:
    from gcd_train.data.open import DataPlaces
    from gcd_train.training.distill_recipe import DistillRecipe

RecipeFile: TypeAlias = Annotated[str, Argument(metavar="RECIPE", help="A TOML file, or package:distill-kubric.")]
Stage: TypeAlias = Annotated[str | None, Option(help=f"Only this one: {', '.join(get_args(DistillStageName))}.")]


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
    prepare_process(threads)
    from gcd_train.data.open import DataPlaces
    from gcd_train.training.distill_recipe import load_distillation

    with errors_shown():
        _require_one_process()
        loaded = load_distillation(recipe, changes or ())
        _run(loaded, DataPlaces(data=data, valid=valid), out, latents, stage_named(stage, get_args(DistillStageName)))


def _run(
    recipe: "DistillRecipe", places: "DataPlaces", out: Path, latents: Path | None, stage: DistillStageName | None
) -> None:
    from gcd_train.data.open import open_data
    from gcd_train.training.distill import Distiller, as_training, teacher_of
    from gcd_train.training.monitor import RunFolder, TensorBoard
    from gcd_train.training.run import RunInputs

    stop, teacher = stop_when_asked(), teacher_of(recipe)
    training = as_training(recipe, teacher)
    folder = RunFolder(out, TensorBoard(out / "tensorboard") if recipe.log.tensorboard else None)
    data = open_data(training, teacher.config, teacher.family, places)
    inputs = RunInputs(recipe=training, data=data, folder=folder, stop=stop, latents=latents)
    distiller = Distiller(inputs, recipe, teacher)
    with folder.begun(recipe, command_line()):
        distiller.run(stage)


def _require_one_process() -> None:
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise RecipeError("a distillation is the work of one process; start `gcd-train distill` without torchrun")
