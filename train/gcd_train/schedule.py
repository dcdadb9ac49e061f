"""Which parameters learn how fast, and the learning rate at every point of a stage."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

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
