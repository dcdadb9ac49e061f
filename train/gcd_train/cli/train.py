"""`gcd-train train`: from clips to a weight file, stage by stage; `gcd-train recipes`: what there is to train."""

import logging
import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias, get_args

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
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
from gcd_train.live.recipe import LiveRecipe, is_live, live_recipes, live_toml, load_live_recipe
from gcd_train.recipe import Recipe
from gcd_train.recipe_data import Budget, ComputeRecipe, StageName
from gcd_train.recipe_files import TEACHER, load_recipe, packaged_recipes, read_merged, to_toml
from gcd_train.training.distill_recipe import DistillRecipe, load_distillation, packaged_distillations

if TYPE_CHECKING:
    from gcd_train.data.open import DataPlaces
    from gcd_train.training.distributed import Processes

RecipeFile: TypeAlias = Annotated[
    str, Argument(metavar="RECIPE", help="A TOML file, or package:NAME for one that ships (`gcd-train recipes`).")
]
Shown: TypeAlias = Annotated[
    str | None, Argument(metavar="[RECIPE]", help="Show this one whole, with its bases and every default.")
]
Stage: TypeAlias = Annotated[str | None, Option(help=f"Only this one: {', '.join(get_args(StageName))}.")]
Small: TypeAlias = Annotated[
    bool, Option("--small", help="Model, size, batch and budget of the recipe's table `small`, for a CPU.")
]


def train(
    recipe: RecipeFile,
    data: Data,
    out: Out,
    valid: Valid = None,
    latents: Latents = None,
    stage: Stage = None,
    threads: Threads = None,
    small: Small = False,
    changes: Changes = None,
) -> None:
    """Train a model on clips, or go on where a run stopped. Ctrl-C stops after the update and saves."""
    # projected embeddings are views of what their layer made; nobody writes into them
    warnings.filterwarnings("ignore", message="FSDP2-wrapped module")
    prepare_process(threads)
    from gcd_train.data.open import DataPlaces

    with errors_shown():
        if is_live(recipe):
            _train_live(recipe, data, valid, out)
            return
        loaded = load_recipe(recipe, small=small, changes=changes or ())
        _in_processes(loaded, DataPlaces(data=data, valid=valid), out, latents, stage_named(stage, get_args(StageName)))


def _train_live(recipe: str, data: Path, valid: Path | None, out: Path) -> None:
    from gcd_train.live.training import LivePlaces, train_live
    from gcd_train.training.distributed import processes_of
    from gcd_train.training.monitor import RunFolder

    if valid is None:
        raise RecipeError("a live model is measured on clips of their own: give --valid, see `gcd-train generate live`")
    loaded, places = load_live_recipe(recipe), LivePlaces(data=data, valid=valid, out=out)
    with processes_of(ComputeRecipe(device=loaded.device, parallel="ddp")) as processes:
        if not processes.first:
            logging.getLogger().setLevel(logging.WARNING)
        with RunFolder(out).begun(loaded, command_line()) if processes.first else nullcontext():
            train_live(loaded, places, stop_when_asked(), processes)


def recipes(recipe: Shown = None, small: Small = False, changes: Changes = None) -> None:
    """List the recipes that ship, or show one whole: on its bases, with every default."""
    console = Console(highlight=False, soft_wrap=True)
    with errors_shown():
        if recipe is not None and is_live(recipe):
            console.print(live_toml(recipe), markup=False, end="")
            return
        if recipe is not None:
            if TEACHER in read_merged(recipe).table:
                whole = to_toml(load_distillation(recipe, changes or ()))
            else:
                whole = to_toml(load_recipe(recipe, small=small, changes=changes or ()))
            console.print(whole, markup=False, end="")
            return
        table = Table(box=SIMPLE, pad_edge=False, padding=(0, 0))
        for column in ("recipe", "data", "model", "updates", "clips an update", "starts from"):
            table.add_column(column, no_wrap=True)
        for name in packaged_recipes():
            table.add_row(f"package:{name}", *_row(load_recipe(f"package:{name}")))
        for name in live_recipes():
            table.add_row(f"package:{name}", *_live_row(load_live_recipe(f"package:{name}")))
        for name in packaged_distillations():
            table.add_row(f"package:{name}", *_student_row(load_distillation(f"package:{name}")))
        # a name that is cut off cannot be given to `train`: a narrow terminal breaks lines instead
        widest = console.measure(table, options=console.options.update(max_width=1000)).maximum
        console.width = max(console.width, widest)
        console.print(table)


def _row(recipe: Recipe) -> tuple[str, ...]:
    data, unet, model = recipe.data, recipe.unet, recipe.model
    kind = data.kind if data.modality == "rgb" else f"{data.kind}, classes"
    clips = f"{unet.clip_batch * unet.parts}"
    return kind, f"{model.base} ({model.family})", _length(unet.budget), clips, model.weights or "nothing"


def _live_row(recipe: LiveRecipe) -> tuple[str, ...]:
    return "live", "live", _length(recipe.paint.budget), f"{recipe.paint.batch} views", "nothing"


def _student_row(recipe: DistillRecipe) -> tuple[str, ...]:
    clips, steps = recipe.batches.clip_batch * recipe.batches.accumulate, recipe.student.steps
    return (
        recipe.data.kind,
        f"student, {steps} steps",
        _length(recipe.paired.budget),
        f"{clips}",
        recipe.teacher.weights,
    )


def _length(budget: Budget) -> str:
    return f"{budget.updates}" if budget.updates is not None else f"{budget.minutes:g} min"


def _in_processes(
    recipe: Recipe, places: "DataPlaces", out: Path, latents: Path | None, stage: StageName | None
) -> None:
    from gcd_train.training.distributed import processes_of

    with processes_of(recipe.compute) as processes:
        if not processes.first:
            logging.getLogger().setLevel(logging.WARNING)
        _run(recipe, places, out, latents, stage, processes)


def _run(
    recipe: Recipe,
    places: "DataPlaces",
    out: Path,
    latents: Path | None,
    stage: StageName | None,
    processes: "Processes",
) -> None:
    from gcd_train.data.open import open_data
    from gcd_train.training.monitor import RunFolder, TensorBoard
    from gcd_train.training.run import RunInputs, Trainer
    from gcd_train.training.setup import family_of, model_config

    stop = stop_when_asked()
    board = TensorBoard(out / "tensorboard") if recipe.log.tensorboard and processes.first else None
    data = open_data(recipe, model_config(recipe.model), family_of(recipe.model), places)
    folder = RunFolder(out, board)
    inputs = RunInputs(recipe=recipe, data=data, latents=latents, folder=folder, stop=stop, processes=processes)
    trainer = Trainer(inputs)
    with folder.begun(recipe, command_line()) if processes.first else nullcontext():
        trainer.run(stage)
