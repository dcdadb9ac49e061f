"""An exponential moving average of a module's weights, with a ramp."""

from collections.abc import Generator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from gcd_train.recipe import EmaRecipe


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

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state_dict`. Raises KeyError for a missing weight."""
        for name, value in self._average.items():
            value.copy_(state[name])


def _precise(value: Tensor) -> Tensor:
    return value.float() if value.dtype in (torch.bfloat16, torch.float16) else value
