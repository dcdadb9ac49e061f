"""Savers of memory and time that take the U-Net block by block, without renaming a weight."""

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch._dynamo import config as dynamo
from torch.utils.checkpoint import checkpoint

from gcd_model.unet import Stage, StageInputs

_Forward = Callable[[Tensor, StageInputs, int | None], Tensor]
Module = TypeVar("Module", bound=nn.Module)


def stages_of(module: nn.Module) -> list[Stage]:
    """The U-Net's blocks in the order of the forward pass; none for a module without a U-Net."""
    return [part for part in module.modules() if isinstance(part, Stage)]


def compile_blocks(module: nn.Module) -> None:
    """Compile each block's forward pass; shapes are fixed but for single frames, which compile once more."""
    stages = stages_of(module)
    # all blocks are one function to the compiler, which gives up after 8 versions of a function
    dynamo.recompile_limit = max(dynamo.recompile_limit, 4 * len(stages))
    for stage in stages:
        stage.forward = torch.compile(stage.forward)


def recompute_blocks(module: nn.Module, every: int) -> None:
    """Let every n-th block forget what it computed and compute it anew in the backward pass.

    Trades a second forward pass of those blocks for their activations. Gradients stay the same.
    """
    for stage in stages_of(module)[every - 1 :: every]:
        stage.forward = _recomputed(stage.forward)  # pyright: ignore[reportAttributeAccessIssue]


def _recomputed(forward: _Forward) -> _Forward:
    def twice(x: Tensor, inputs: StageInputs, frames: int | None) -> Tensor:
        if not torch.is_grad_enabled():
            return forward(x, inputs, frames)
        done = checkpoint(forward, x, inputs, frames, use_reentrant=False, preserve_rng_state=False)
        assert isinstance(done, Tensor), "a block returns one tensor"
        return done

    return twice
