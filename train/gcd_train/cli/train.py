"""`gcd-train train`: from a recipe and data to a weight file; `gcd-train recipes`: what there is to train."""

import logging
import signal
import threading
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, TypeAlias, TypeVar, get_args

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from typer import Argument, BadParameter, Option

from gcd_train.cli.common import command_line, errors_shown
from gcd_train.errors import RecipeError
from gcd_train.live.recipe import LiveRecipe, is_live, live_recipes, live_toml, load_live_recipe
from gcd_train.recipe import Recipe
from gcd_train.recipe_data import Budget, ComputeRecipe, StageName
from gcd_train.recipe_files import load_recipe, packaged_recipes, to_toml

if TYPE_CHECKING:
    from gcd_train.data.open import DataPlaces
    from gcd_train.training.distributed import Processes

Name = TypeVar("Name", bound=str)

RecipeFile: TypeAlias = Annotated[
    str, Argument(metavar="RECIPE", help="A TOML file, or package:NAME for one that ships (`gcd-train recipes`).")
]
Shown: TypeAlias = Annotated[
    str | None, Argument(metavar="[RECIPE]", help="Show this one whole, with its bases and every default.")
]
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
Stage: TypeAlias = Annotated[
    str | None,
    Option(help=f"Only this one: {', '.join(get_args(StageName))}."),
]
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
    # remarks on views that nobody writes into, and on the speed of the decoder's last layer
    warnings.filterwarnings("ignore", message="FSDP2-wrapped module|grad and param do not obey the gradient layout")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if threads is not None:
        import torch

        torch.set_num_threads(threads)
    from gcd_train.data.open import DataPlaces

    with errors_shown():
        if is_live(recipe):
            _train_live(recipe, data, valid, out)
            return
        loaded = load_recipe(recipe, small=small, changes=changes or ())
        _in_processes(
            loaded, DataPlaces(data=data, valid=valid), out, latents, _stage_named(stage, get_args(StageName))
        )


def _stop_when_asked() -> threading.Event:
    """Set by Ctrl-C and by SIGTERM from now on; the run then stops after its update and saves."""
    stop = threading.Event()

    def ask(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, ask)
    signal.signal(signal.SIGTERM, ask)
    return stop


def _stage_named(name: str | None, known: Sequence[Name]) -> Name | None:
    """The stage with this name, None for all of them. Raises BadParameter if there is none."""
    if name is not None and name not in known:
        raise BadParameter(f"no stage is called {name!r}; there are {', '.join(known)}")
    return next((each for each in known if each == name), None)


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
            train_live(loaded, places, _stop_when_asked(), processes)


def recipes(recipe: Shown = None, small: Small = False, changes: Changes = None) -> None:
    """List the recipes that ship, or show one whole: on its bases, with every default."""
    console = Console(highlight=False, soft_wrap=True)
    with errors_shown():
        if recipe is not None and is_live(recipe):
            console.print(live_toml(recipe), markup=False, end="")
            return
        if recipe is not None:
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
        # a name that is cut off cannot be given to `train`: a narrow terminal breaks lines instead
        widest = console.measure(table, options=console.options.update(max_width=1000)).maximum
        console.width = max(console.width, widest)
        console.print(table)


def _row(recipe: Recipe) -> tuple[str, ...]:
    data, unet, model = recipe.data, recipe.unet, recipe.model
    kind = data.kind if data.modality == "rgb" else f"{data.kind}, classes"
    clips = f"{unet.clip_batch * unet.parts}"
    base = model.base if recipe.student is None else f"student, {recipe.student.steps} steps"
    return kind, f"{base} ({model.family})", _length(unet.budget), clips, model.weights or "nothing"


def _live_row(recipe: LiveRecipe) -> tuple[str, ...]:
    return "live", "live", _length(recipe.paint.budget), f"{recipe.paint.batch} views", "nothing"


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
    from gcd_train.training.run import Trainer
    from gcd_train.training.setup import family_of, run_config

    stop = _stop_when_asked()
    board = TensorBoard(out / "tensorboard") if recipe.log.tensorboard and processes.first else None
    data = open_data(recipe, run_config(recipe), family_of(recipe.model), places)
    folder = RunFolder(out, board)
    trainer = Trainer(recipe=recipe, data=data, folder=folder, stop=stop, latents=latents, processes=processes)
    with folder.begun(recipe, command_line()) if processes.first else nullcontext():
        trainer.run(stage)
