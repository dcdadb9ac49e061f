"""Weights in eight bits a number, for files that are to be small: each row of a matrix with a scale of its own.

Only storage: networks are filled with the numbers they stand for. Pure: tensors in, tensors out.
"""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from gcd_model.errors import CheckpointError

SCALE = ":scale"
"""What follows the name of a packed weight in the name of its scales; no parameter's name has a colon."""
_LEAST = 1024  # numbers; below it nothing is gained, and biases and norms, which everything hangs on, stay exact
_MOST = 127


@dataclass(frozen=True, slots=True)
class Packed:
    """codes: int8, shaped like the weight. scales: float32 [rows], its first dimension."""

    codes: Tensor
    scales: Tensor

    @classmethod
    def of(cls, weight: Tensor) -> Self:
        """The nearest codes. Off by at most half a scale: 1/254 of the largest number of the row."""
        rows = weight.detach().float().flatten(1)
        scales = (rows.abs().amax(dim=1) / _MOST).clamp_min(torch.finfo(torch.float32).tiny)
        return cls((rows / scales[:, None]).round().to(torch.int8).view_as(weight), scales)

    def unpacked(self) -> Tensor:
        """The weight, float32. Raises CheckpointError unless there is one scale a row, all of them finite."""
        if self.scales.shape != self.codes.shape[:1] or not self.scales.isfinite().all():
            raise CheckpointError(
                f"a weight of {list(self.codes.shape)} has scales of {list(self.scales.shape)}, wanted is one finite "
                "number a row; convert the weights again"
            )
        return (self.codes.flatten(1).float() * self.scales.float()[:, None]).view_as(self.codes)


def is_packable(shape: tuple[int, ...]) -> bool:
    """Whether a weight of this shape is stored in eight bits where that is asked for."""
    return len(shape) > 1 and torch.Size(shape).numel() >= _LEAST


def divided(tensors: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """A file's tensors: weights by name, and the scales of those that are packed.

    Raises: CheckpointError if codes and scales do not belong to each other.
    """
    scales = {name.removesuffix(SCALE): tensor for name, tensor in tensors.items() if name.endswith(SCALE)}
    weights = {name: tensor for name, tensor in tensors.items() if not name.endswith(SCALE)}
    alone = scales.keys() ^ {name for name, tensor in weights.items() if tensor.dtype == torch.int8}
    if alone:
        raise CheckpointError(
            f"{len(alone)} weights in eight bits lack codes or scales, first: {min(alone)}; convert again"
        )
    return weights, scales
