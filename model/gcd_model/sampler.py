"""The denoising loop: one function; the network is a callable."""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from gcd_model.clip import CancelSignal
from gcd_model.errors import Cancelled


def euler(
    denoise: Callable[[Tensor, int], Tensor],
    start: Tensor,
    sigmas: Tensor,
    *,
    progress: Callable[[int, int], None] | None = None,
    cancel: CancelSignal | None = None,
) -> Tensor:
    """Follow the probability-flow ODE from noise to a clean sample with Euler steps.

        x <- x + (sigma[i+1] - sigma[i]) * (x - D(x, sigma[i])) / sigma[i]

    Args:
        denoise: (x, i) -> D(x, sigma[i]), same shape as x.
        start: any shape, noise at sigma[0]. sigmas: [S + 1], falling; the last may be 0.
        progress: called with (steps done, S). cancel: asked before every step.
    Raises:
        Cancelled: `cancel` was set.
    Source: Karras et al. 2022, Algorithm 1 without the correction and without added noise.
    """
    x, levels = start, sigmas.tolist()
    for i, (sigma, following) in enumerate(pairwise(levels)):
        if cancel is not None and cancel.is_set():
            raise Cancelled(f"stopped before step {i + 1} of {len(levels) - 1}")
        x = torch.lerp(denoise(x, i), x, following / sigma)
        if progress is not None:
            progress(i + 1, len(levels) - 1)
    return x


def guided(unconditional: Tensor, conditional: Tensor, scale: Tensor) -> Tensor:
    """Classifier-free guidance on denoised predictions: D_u + g_t * (D_c - D_u).

    Args:
        unconditional, conditional: [K, T, C, h, w]. scale: [T], one per frame.
    Source: Ho and Salimans 2022; a scale per frame as in Blattmann et al. 2023 (SVD).
    """
    weight = scale.to(conditional)[:, None, None, None]
    return unconditional + weight * (conditional - unconditional)
