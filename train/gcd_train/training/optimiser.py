"""Optimisers, learning rates and the moving average of the weights."""

import math
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

import torch
from torch import Tensor, nn

from gcd_train.errors import RecipeError
from gcd_train.recipe import EmaRecipe, OptimiserRecipe


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
    common: dict[str, Any] = {"lr": recipe.rate, "betas": recipe.betas, "weight_decay": recipe.weight_decay}
    if recipe.kind not in ("adam8bit", "adamw8bit") and weights == "float32":
        kind = torch.optim.Adam if recipe.kind == "adam" else torch.optim.AdamW
        return kind(listed, **common, fused=True)
    try:
        library = import_module("torchao.optim")
    except ImportError as error:
        raise RecipeError(
            f'optimiser.kind "{recipe.kind}" with compute.weights "{weights}" needs torchao, which is not installed; '
            "`pip install 'gcd-node[train]'`, or choose "
            '"adam" or "adamw" with float32 weights'
        ) from error
    if recipe.kind == "adam" and recipe.weight_decay:
        raise RecipeError(
            'optimiser.kind "adam" with weight_decay is not offered for bfloat16 weights; '
            'take "adamw" or "adam8bit", or leave weight_decay out'
        )
    # without weight decay, Adam and AdamW are the same
    names = {"adam": "_AdamW", "adamw": "_AdamW", "adam8bit": "Adam8bit", "adamw8bit": "AdamW8bit"}
    return getattr(library, names[recipe.kind])(listed, **common, bf16_stochastic_round=weights == "bfloat16")


def set_rate(optimiser: torch.optim.Optimizer, update: int, share: float, recipe: OptimiserRecipe) -> None:
    """Set every group's learning rate for the next update."""
    rate = recipe.rate * rate_factor(update, share, recipe)
    for group in optimiser.param_groups:
        if isinstance(group["lr"], Tensor):  # torchao compiles its step once, for a rate that is a tensor
            group["lr"].fill_(rate * group["factor"])
        else:
            group["lr"] = rate * group["factor"]


def ema_decay(update: int, recipe: EmaRecipe) -> float:
    """How much of the average stays at the given update (1 for the first).

        without a horizon: (1 + k) / (10 + k)        with one: h / (1 + h), h = horizon * k        at most `limit`

    Source: the first is the ramp of the released GCD and SVD code's average; the second is ours, a window that
    grows with the run.
    """
    if recipe.horizon is None:
        return min(recipe.limit, (1 + update) / (10 + update))
    length = recipe.horizon * update
    return min(recipe.limit, length / (1 + length))


class Ema:
    """The average of all floating-point weights and buffers of a module, in float32 at least."""

    def __init__(self, module: nn.Module, recipe: EmaRecipe) -> None:
        self._module, self._recipe = module, recipe
        self._live = {name: value for name, value in module.state_dict().items() if value.is_floating_point()}
        self._average = {name: _precise(value).clone() for name, value in self._live.items()}

    @torch.no_grad()
    def update(self, number: int) -> None:
        """Take the module's weights in, after update `number` (1 for the first)."""
        share = 1 - ema_decay(number, self._recipe)
        for name, value in self._live.items():
            self._average[name].lerp_(_precise(value), share)

    @torch.no_grad()
    def restart(self) -> None:
        """Forget the past: the average is the module as it is now."""
        for name, value in self._live.items():
            self._average[name].copy_(value)

    @contextmanager
    def applied(self) -> Generator[None]:
        """The module has the averaged weights inside the block."""
        kept = {name: value.clone() for name, value in self._live.items()}
        self._fill(self._average)
        try:
            yield
        finally:
            self._fill(kept)

    @torch.no_grad()
    def _fill(self, weights: dict[str, Tensor]) -> None:
        for name, value in self._live.items():
            value.copy_(weights[name])

    def state_dict(self) -> dict[str, Tensor]:
        """The averaged weights by name."""
        return dict(self._average)


def _precise(value: Tensor) -> Tensor:
    return value.float() if value.dtype in (torch.bfloat16, torch.float16) else value
