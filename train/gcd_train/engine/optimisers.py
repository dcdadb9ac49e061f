"""From a recipe to an optimiser: torch's own, or torchao's for 8-bit moments and bfloat16 weights."""

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType
from typing import Any, Literal

import torch
from torch import Tensor

from gcd_train.errors import RecipeError
from gcd_train.recipe import OptimiserRecipe
from gcd_train.schedule import ParameterGroup, rate_factor

Weights = Literal["float32", "bfloat16"]


def build_optimiser(
    groups: Sequence[ParameterGroup], recipe: OptimiserRecipe, weights: Weights = "float32"
) -> torch.optim.Optimizer:
    """Adam, or AdamW with decoupled weight decay; fused, or with 8-bit moments, or for bfloat16 weights.

    Raises RecipeError where torchao is wanted and missing, or has no such optimiser.
    """
    listed: list[dict[str, Any]] = [
        {"params": list(group.parameters), "factor": group.factor} for group in groups if group.parameters
    ]
    if recipe.kind in ("adam8bit", "adamw8bit") or weights == "bfloat16":
        return _from_torchao(listed, recipe, weights)
    kind = torch.optim.Adam if recipe.kind == "adam" else torch.optim.AdamW
    return kind(listed, lr=recipe.rate, betas=recipe.betas, weight_decay=recipe.weight_decay, fused=True)


def _from_torchao(listed: list[dict[str, Any]], recipe: OptimiserRecipe, weights: Weights) -> torch.optim.Optimizer:
    library = torchao_optimisers(f'optimiser.kind "{recipe.kind}" with compute.weights "{weights}"')
    if recipe.kind == "adam" and recipe.weight_decay:
        raise RecipeError(
            'optimiser.kind "adam" with weight_decay is not offered for bfloat16 weights; '
            'take "adamw" or "adam8bit", or leave weight_decay out'
        )
    # without weight decay, Adam and AdamW are the same
    names = {"adam": "_AdamW", "adamw": "_AdamW", "adam8bit": "Adam8bit", "adamw8bit": "AdamW8bit"}
    return getattr(library, names[recipe.kind])(
        listed,
        lr=recipe.rate,
        betas=recipe.betas,
        weight_decay=recipe.weight_decay,
        bf16_stochastic_round=weights == "bfloat16",
    )


def torchao_optimisers(wanted_for: str) -> ModuleType:
    """torchao's optimisers; importing them also lets their states be read. Raises RecipeError without torchao."""
    try:
        return import_module("torchao.optim")
    except ImportError as error:
        raise RecipeError(
            f"{wanted_for} needs torchao, which is not installed; `pip install 'gcd-node[train]'`, or choose "
            '"adam" or "adamw" with float32 weights'
        ) from error


def set_rate(optimiser: torch.optim.Optimizer, update: int, share: float, recipe: OptimiserRecipe) -> float:
    """Set every group's learning rate for the next update; returns the rate without the groups' factors."""
    rate = recipe.rate * rate_factor(update, share, recipe)
    for group in optimiser.param_groups:
        if isinstance(group["lr"], Tensor):  # torchao compiles its step once, for a rate that is a tensor
            group["lr"].fill_(rate * group["factor"])
        else:
            group["lr"] = rate * group["factor"]
    return rate
