"""`gcd-train train`: from a recipe and data to a weight file; `recipes`, `lora`: what there is to train."""

import logging
import signal
import warnings
from collections.abc import Generator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias, cast, get_args

import torch
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from typer import Argument, BadParameter, Option, Typer

from gcd_model.weights.card import precision
from gcd_model.weights.load import load_adapted, read_adapter, save_weights
from gcd_model.weights.save import write_published
from gcd_train.cli.common import Dtype, command_line, errors_shown, say
from gcd_train.errors import RecipeError
from gcd_train.recipe import LiveRecipe, Recipe
from gcd_train.recipe_data import Budget, ComputeRecipe, StageName
from gcd_train.recipe_files import load_recipe, packaged_recipes, to_toml

if TYPE_CHECKING:  # `recipes` wants none of it
    from gcd_train.training.distributed import Processes

Small: TypeAlias = Annotated[
    bool, Option("--small", help="Model, size, batch and budget of the recipe's table `small`, for a CPU.")
]
Changes: TypeAlias = Annotated[
    list[str] | None,
    Option("--set", metavar="KEY=VALUE", help="Change the recipe: log.save_s=60, for one; may be repeated."),
]

lora = Typer(no_args_is_help=True, help="Adapters that a run with model.train = lora writes, and their bases.")


def train(
    recipe: Annotated[
        str, Argument(metavar="RECIPE", help="A TOML file, or package:NAME for one that ships (`gcd-train recipes`).")
    ],
    data: Annotated[Path, Option(help="What to learn from: the recipe's data.kind says what lies there.")],
    out: Annotated[Path, Option(help="Folder of the run; run again to go on.")],
    valid: Annotated[
        Path | None,
        Option(help="Held-out data of the same kind to measure on; left out, a part of --data (data.split)."),
    ] = None,
    latents: Annotated[
        Path | None, Option(help="Folder for encoded clips, shared by runs of one autoencoder; else in --out.")
    ] = None,
    stage: Annotated[str | None, Option(help=f"Only this one: {', '.join(get_args(StageName))}.")] = None,
    threads: Annotated[int | None, Option(min=1, help="CPU threads; else torch's own choice.")] = None,
    small: Small = False,
    changes: Changes = None,
) -> None:
    """Train a model on clips, or go on where a run stopped. Ctrl-C stops after the update and saves."""
    # remarks on views that nobody writes into, and on the speed of the decoder's last layer
    warnings.filterwarnings("ignore", message="FSDP2-wrapped module|grad and param do not obey the gradient layout")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if threads is not None:
        torch.set_num_threads(threads)
    with errors_shown():
        loaded = load_recipe(recipe, small=small, changes=changes or ())
        if stage is not None and stage not in get_args(StageName):
            raise BadParameter(f"no stage is called {stage!r}; there are {', '.join(get_args(StageName))}")
        if isinstance(loaded, LiveRecipe) and valid is None:
            raise RecipeError(
                "a live model is measured on clips of their own: give --valid (`gcd-train generate live`)"
            )
        if isinstance(loaded, LiveRecipe) and (stage is not None or latents is not None):
            raise RecipeError("--stage and --latents are of diffusion models; a live one trains its stages in order")
        compute = ComputeRecipe(device=loaded.device) if isinstance(loaded, LiveRecipe) else loaded.compute
        with _in_processes(compute) as processes:
            _train(loaded, data, valid, out, latents, cast("StageName | None", stage), processes)


@contextmanager
def _in_processes(compute: ComputeRecipe) -> Generator["Processes"]:
    """Those that torchrun started, of which the first one alone logs."""
    from gcd_train.training.distributed import processes_of

    with processes_of(compute) as processes:
        if not processes.first:
            logging.getLogger().setLevel(logging.WARNING)
        yield processes


def _stop_when_asked() -> Event:
    """Set by Ctrl-C and by SIGTERM from now on; the run then stops after its update and saves."""
    stop = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stop.set())
    return stop


def _train(
    recipe: Recipe | LiveRecipe,
    data: Path,
    valid: Path | None,
    out: Path,
    latents: Path | None,
    stage: StageName | None,
    processes: "Processes",
) -> None:
    from gcd_train.data.open import open_data
    from gcd_train.live.training import train_live
    from gcd_train.training.monitor import RunFolder, TensorBoard
    from gcd_train.training.run import Trainer
    from gcd_train.training.setup import family_of, run_config

    stop = _stop_when_asked()
    board = TensorBoard(out / "tensorboard") if recipe.log.tensorboard and processes.first else None
    folder = RunFolder(out, board)
    if isinstance(recipe, LiveRecipe):
        assert valid is not None, "refused before"
        run = partial(train_live, recipe, data, valid, folder, stop, processes)
    else:
        opened = open_data(recipe, run_config(recipe), family_of(recipe.model), data, valid)
        trainer = Trainer(recipe=recipe, data=opened, folder=folder, stop=stop, latents=latents, processes=processes)
        run = partial(trainer.run, stage)
    with folder.begun(recipe, command_line()) if processes.first else nullcontext():
        run()


def recipes(
    recipe: Annotated[
        str | None, Argument(metavar="[RECIPE]", help="Show this one whole, with its bases and every default.")
    ] = None,
    small: Small = False,
    changes: Changes = None,
) -> None:
    """List the recipes that ship, or show one whole: on its bases, with every default."""
    console = Console(highlight=False, soft_wrap=True)
    with errors_shown():
        if recipe is not None:
            console.print(to_toml(load_recipe(recipe, small=small, changes=changes or ())), markup=False, end="")
            return
        table = Table(box=SIMPLE, pad_edge=False, padding=(0, 0))
        for column in ("recipe", "data", "model", "updates", "clips an update", "starts from"):
            table.add_column(column, no_wrap=True)
        for name in packaged_recipes():
            table.add_row(f"package:{name}", *_row(load_recipe(f"package:{name}")))
        # a name that is cut off cannot be given to `train`: a narrow terminal breaks lines instead
        widest = console.measure(table, options=console.options.update(max_width=1000)).maximum
        console.width = max(console.width, widest)
        console.print(table)


def _row(recipe: Recipe | LiveRecipe) -> tuple[str, ...]:
    if isinstance(recipe, LiveRecipe):
        length = " + ".join(_length(each.budget) for each in (recipe.depth, recipe.paint, recipe.detail))
        return "live", "live", length, f"{recipe.paint.batch} views", recipe.weights or "nothing"
    data, unet, model = recipe.data, recipe.unet, recipe.model
    kind = data.kind if data.modality == "rgb" else f"{data.kind}, classes"
    base = model.base if recipe.student is None else f"student, {recipe.student.steps} steps"
    start = f"{model.weights or 'nothing'}{', its U-Net not' if model.weights and model.scratch else ''}"
    return kind, f"{base} ({model.family})", _length(unet.budget), f"{unet.clip_batch * unet.parts}", start


def _length(budget: Budget) -> str:
    return f"{budget.updates}" if budget.updates is not None else f"{budget.minutes:g} min"


@lora.callback()
def about() -> None:
    """Keep `lora` a command with sub-commands, however many there are."""


@lora.command()
def merge(
    base: Annotated[Path, Argument(metavar="BASE", help="The weight file the adapter was trained from, any layout.")],
    adapter: Annotated[Path, Argument(metavar="ADAPTER", help="NAME-adapter.safetensors of a run.")],
    out: Annotated[Path, Argument(metavar="OUT", help="The file to write: .safetensors, or .ckpt.")],
    layout: Annotated[
        Literal["gcd-node", "gcd-ckpt"], Option(help="Our .safetensors, or the .ckpt of the released code.")
    ] = "gcd-node",
    dtype: Dtype = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace OUT if it is there.")] = False,
) -> None:
    """Join an adapter with its base to plain weights. OUT appears whole or not at all."""
    with errors_shown():
        from gcd_train.training.setup import loaded_base

        wanted = None if dtype is None else precision(dtype)
        given = read_adapter(adapter)
        start = loaded_base(str(base), given.card.diffusion)
        joined = load_adapted(start, given)
        networks = joined.diffusion if wanted is None else joined.diffusion.to(wanted)
        card = replace(joined.card, trained=True, origin="")
        if layout == "gcd-ckpt":
            write_published(out, networks.state_dict(), card, carried=start.carried, overwrite=overwrite)
        else:
            save_weights(networks, out, card, overwrite=overwrite)
    say(f"wrote {out}", stderr=False)
