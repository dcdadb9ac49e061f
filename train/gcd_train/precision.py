"""Where the networks compute, and in which arithmetic."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor, nn

from gcd_train.model_setup import compute_device, to_channels_last
from gcd_train.recipe import ComputeRecipe

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True, slots=True)
class Precision:
    """A device, the arithmetic on it, and the memory layout of pictures."""

    device: torch.device
    half: bool
    channels_last: bool

    @classmethod
    def of(cls, recipe: ComputeRecipe) -> "Precision":
        """As a recipe asks. Raises RecipeError for a device that is not there."""
        device = compute_device(recipe)
        # CPU kernels are slow in it, so only weights kept in it make a CPU compute in it
        kept = "bfloat16" in (recipe.weights, recipe.frozen)
        half = kept or (recipe.precision == "bfloat16" and device.type == "cuda")
        return cls(device, half, recipe.channels_last)

    def arithmetic(self) -> AbstractContextManager[object]:
        """Context in which networks compute in bfloat16, if asked for; weights stay float32."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.half else nullcontext()

    def placed(self, module: Module) -> Module:
        """The module on the device, in training mode."""
        module.to(self.device).train()
        if self.channels_last:
            to_channels_last(module)
        return module

    def frames(self, rows: Tensor) -> Tensor:
        """[N, C, H, W] on the device, in the layout the networks like."""
        rows = rows.to(self.device)
        return rows.contiguous(memory_format=torch.channels_last) if self.channels_last else rows
