"""How a CPU is served best: working sets that fit its caches and the memory it has at hand.

A buffer above 32 MB is fetched from the system afresh each time, page by page; writing it then costs more than what
is computed for it. Smaller ones are used again. None of this changes what is computed.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

REUSED_FLOATS = 7 * 2**20
"""The largest buffer that is used again instead of being fetched anew, in float32 values."""


def frugal(x: Tensor) -> bool:
    """Whether to work in pieces: on a CPU, without gradient, and while nobody records a graph of the network."""
    return x.device.type == "cpu" and not torch.is_grad_enabled() and not torch.compiler.is_compiling()


def rows_at_once(x: Tensor, floats_per_row: int) -> int:
    """How many rows of x to compute at once, if each needs a buffer of `floats_per_row`: all of them or a few."""
    return max(1, REUSED_FLOATS // max(1, floats_per_row)) if frugal(x) else len(x)


def by_rows(compute: Callable[[Tensor], Tensor], x: Tensor, floats_per_row: int) -> Tensor:
    """compute(x), for what gives every row of x for itself and in its shape, in pieces where `rows_at_once` says so."""
    at_once = rows_at_once(x, floats_per_row)
    if at_once >= len(x):
        return compute(x)
    result = torch.empty_like(x)
    for few, into in zip(x.split(at_once), result.split(at_once), strict=True):
        into.copy_(compute(few))
    return result


def silu(fresh: Tensor) -> Tensor:
    """SiLU of values that nobody else needs, such as what a norm has just given: in their own place where frugal."""
    return F.silu(fresh, inplace=frugal(fresh))


def added(fresh: Tensor, more: Tensor) -> Tensor:
    """The sum of both, in the place of `fresh`, which nobody else needs, where frugal. more: broadcasts over fresh."""
    return fresh.add_(more) if frugal(fresh) else fresh + more


def laid_out(x: Tensor) -> Tensor:
    """x: [N, C, H, W], in the order of memory in which a CPU convolves it fastest; elsewhere as it is.

    Channels last is faster, and makes tokens of pixels without a copy, but re-orders the 9 C^2 weights in each
    call: it pays where there are many more pixels than channels.
    """
    if not frugal(x):
        return x
    pixels = x.numel() // x.shape[1]
    last = pixels >= 4 * x.shape[1]
    return x.contiguous(memory_format=torch.channels_last if last else torch.contiguous_format)
