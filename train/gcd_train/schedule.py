"""From a recipe to an optimiser, and its learning rate at every point of a stage."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn

from gcd_train.recipe import OptimiserRecipe


@dataclass(frozen=True, kw_only=True, slots=True)
class ParameterGroup:
    """Parameters that share a learning rate: `factor` times the recipe's."""

    parameters: Sequence[nn.Parameter]
    factor: float = 1.0


def rate_factor(update: int, share: float, recipe: OptimiserRecipe) -> float:
    """Learning rate as a share of the recipe's.

    update: number of updates done before this one. share: how much of the budget is used.
    """
    warm = min(1.0, (update + 1) / recipe.warm_up) if recipe.warm_up else 1.0
    if share <= recipe.flat:
        return warm
    down = (share - recipe.flat) / (1 - recipe.flat)
    if recipe.shape == "cosine":
        down = (1 - math.cos(math.pi * down)) / 2
    return warm * (1 + (recipe.final - 1) * down)


def build_optimiser(groups: Sequence[ParameterGroup], recipe: OptimiserRecipe) -> torch.optim.Optimizer:
    """Adam, or AdamW with decoupled weight decay."""
    listed = [{"params": list(group.parameters), "factor": group.factor} for group in groups]
    if recipe.kind == "adam":
        return torch.optim.Adam(listed, lr=recipe.rate, betas=recipe.betas, weight_decay=recipe.weight_decay)
    return torch.optim.AdamW(listed, lr=recipe.rate, betas=recipe.betas, weight_decay=recipe.weight_decay, fused=True)


def set_rate(optimiser: torch.optim.Optimizer, update: int, share: float, recipe: OptimiserRecipe) -> float:
    """Set every group's learning rate for the next update; returns the rate without the groups' factors."""
    rate = recipe.rate * rate_factor(update, share, recipe)
    for group in optimiser.param_groups:
        group["lr"] = rate * group["factor"]
    return rate
