"""What the loop is given: which processes compute, how they share a module, what saves memory, where states go."""

from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import nn

from gcd_train.engine.blocks import compile_blocks, recompute_blocks
from gcd_train.engine.keepers import FileStates, FolderStates
from gcd_train.engine.parallel import held_back, replicated, share_out
from gcd_train.engine.processes import ALONE, Processes
from gcd_train.engine.states import StateFolder, StateKeeper
from gcd_train.engine.trained import Trained
from gcd_train.recipe import ComputeRecipe, LogRecipe


@dataclass(frozen=True, kw_only=True, slots=True)
class Engine:
    """How a stage computes. The default is one process with float32 weights, as they are."""

    processes: Processes = ALONE
    compute: ComputeRecipe = field(default_factory=ComputeRecipe)

    def prepare(self, module: nn.Module) -> nn.Module:
        """Make a module ready to be trained, in place; returns what its losses are to be computed through.

        Weights keep their names. Must come before the optimiser is made.
        """
        compute = self.compute
        if compute.weights == "bfloat16":
            for parameter in module.parameters():
                if parameter.requires_grad:
                    parameter.data = parameter.data.bfloat16()
        if compute.compile:
            compile_blocks(module)
        if compute.checkpoint_activations:
            recompute_blocks(module, int(compute.checkpoint_activations))
        if not self.processes.several or compute.parallel == "none":
            return module
        if compute.parallel == "ddp":
            return replicated(module)
        share_out(module, self.processes)
        return module

    def backward_of(self, network: nn.Module, part: int, parts: int) -> AbstractContextManager[object]:
        """Context of the forward and backward pass of a batch of an update; the last one settles the gradients."""
        return held_back(network, last=part + self.processes.count >= parts)

    def share_of_loss(self, parts: int) -> float:
        """What a batch's loss is multiplied with, so that an update's gradient is the mean over its `parts` batches."""
        return self.processes.count / parts  # the processes' gradients are averaged

    def seed_rounding(self, seed: int) -> None:
        """Let stochastic rounding follow from the number of the update: the same in every copy, and when resumed."""
        if self.compute.weights == "bfloat16":
            torch.manual_seed(seed)

    def keeper(self, stage_folder: Path, trained: Trained, stage: str, identity: str, log: LogRecipe) -> StateKeeper:
        """What saves and finds the stage's states."""
        folder = StateFolder(stage_folder, log)
        if not self.processes.several:
            return FileStates(folder, trained, stage, identity)
        return FolderStates(folder, trained, stage, identity, self.processes, beside=log.save == "async")
