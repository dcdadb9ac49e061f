"""What a live model is trained from and for how long: `kind = "live"` in a TOML file."""

import re
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gcd_model import explain_settings_error
from gcd_model.live.config import LiveConfig
from gcd_train.errors import RecipeError
from gcd_train.recipe import EmaRecipe, OptimiserRecipe
from gcd_train.recipe_data import Budget, LiveStageName, LogRecipe
from gcd_train.recipe_files import PACKAGED, place_of, read_merged


class LiveStage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How long a stage trains and how.

    batch: frames (depth) or views (paint, detail) of a batch. parts: batches an update, which the processes that
    `torchrun` starts share; of the detail, one. small_share: so much of its time depth and paint learn from pictures
    of half the size, at a quarter of the cost.
    """

    budget: Budget
    batch: Annotated[int, Meta(ge=1)] = 8
    parts: Annotated[int, Meta(ge=1)] = 1
    small_share: Annotated[float, Meta(ge=0, le=1)] = 0.6
    optimiser: OptimiserRecipe
    ema: EmaRecipe = EmaRecipe(limit=0.998, horizon=0.15)


class LiveRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A live model's training.

    weights: a live weight file to begin from, at random without. keep: stages that are left as it has them.
    exact_every, learned_every: of the clips, every so many-th has its inputs worked out by exact and by learned depth.
    workers: processes that work out inputs; 0 for none but this one.
    """

    kind: Literal["live"]
    name: str
    seed: int = 1
    model: LiveConfig = LiveConfig()
    weights: str | None = None
    keep: frozenset[LiveStageName] = frozenset()
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: Annotated[int, Meta(ge=0)] = 0
    depth: LiveStage
    exact_every: Annotated[int, Meta(ge=1)] = 4
    learned_every: Annotated[int, Meta(ge=1)] = 1
    paint: LiveStage
    detail: LiveStage
    log: LogRecipe = LogRecipe()

    def __post_init__(self) -> None:
        if self.keep and self.weights is None:
            raise RecipeError(f"keep = {sorted(self.keep)} needs weights, a live weight file that has them")
        if self.detail.parts != 1:
            raise RecipeError(f"the detail stage takes one batch an update, got detail.parts = {self.detail.parts}")


def live_recipe(source: str) -> LiveRecipe | None:
    """A live model's recipe by `package:NAME` or path; None for what is none, or cannot be read at all.

    Raises RecipeError for one that has unknown keys or values out of range.
    """
    try:  # what ships lies in a folder of its own
        table, (place, *_) = read_merged(place_of(re.sub("^package:", "package:live/", source)))
    except RecipeError:
        return None
    if table.get("kind") != "live":
        return None
    try:
        return msgspec.convert(table, LiveRecipe)
    except msgspec.ValidationError as error:
        raise RecipeError(f"{place}: {explain_settings_error(str(error), LiveRecipe)}") from error


def live_recipes() -> dict[str, LiveRecipe]:
    """Those that ship, by name."""
    found = {path.stem: live_recipe(f"package:{path.stem}") for path in sorted((PACKAGED / "live").glob("*.toml"))}
    return {name: recipe for name, recipe in found.items() if recipe is not None}
