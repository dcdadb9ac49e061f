"""The denoising loop: one function; the network is a callable, the solver a table of coefficients."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from gcd_model.clip import CancelSignal, SolverName
from gcd_model.errors import Cancelled


@dataclass(frozen=True, slots=True)
class SolverStep:
    """One step as a sum: x <- keep * x + new * D(x) + before * (D of the step before)."""

    keep: float
    new: float
    before: float = 0.0


def solver_steps(solver: SolverName, sigmas: Tensor) -> tuple[SolverStep, ...]:
    """The whole schedule. sigmas: [S + 1], falling; the last may be 0."""
    levels: list[float] = sigmas.tolist()
    return euler_steps(levels) if solver == "euler" else multistep_steps(levels)


def euler_steps(levels: list[float]) -> tuple[SolverStep, ...]:
    """Euler: x <- x + (sigma[i+1] - sigma[i]) * (x - D) / sigma[i].

    Source: Karras et al. 2022, Algorithm 1 without the correction and without added noise.
    """
    return tuple(SolverStep(after / now, 1 - after / now) for now, after in pairwise(levels))


def multistep_steps(levels: list[float]) -> tuple[SolverStep, ...]:
    """DPM-Solver++ (2M): D along the logarithm of the noise level, drawn through this step and the one before.

    The first step and one that ends without noise are of first order: nothing lies before the one, and in the other the
    logarithm has no end. Source: Lu et al. 2022 (DPM-Solver++), Algorithm 2, for data without scaling (alpha 1).
    """
    first = euler_steps(levels)
    made = list(first[:1])
    for (earlier, now, after), plain in zip(zip(levels, levels[1:], levels[2:], strict=False), first[1:], strict=True):
        if after <= 0:
            made.append(plain)
            continue
        ahead = math.log(now / after) / (2 * math.log(earlier / now))
        made.append(SolverStep(plain.keep, plain.new * (1 + ahead), -plain.new * ahead))
    return tuple(made)


def sample(
    denoise: Callable[[Tensor, int], Tensor],
    start: Tensor,
    steps: tuple[SolverStep, ...],
    *,
    progress: Callable[[int, int], None] | None = None,
    cancel: CancelSignal | None = None,
) -> Tensor:
    """From noise to a clean sample.

    Args:
        denoise: (x, i) -> D(x, sigma[i]), same shape as x.
        start: any shape, noise at sigma[0]. steps: see `solver_steps`.
        progress: called with (steps done, S). cancel: asked before every step.
    Raises:
        Cancelled: `cancel` was set.
    """
    x, before = start, start
    for i, step in enumerate(steps):
        if cancel is not None and cancel.is_set():
            raise Cancelled(f"stopped before step {i + 1} of {len(steps)}")
        denoised = denoise(x, i)
        x = advanced(x, denoised, before, step)
        before = denoised
        if progress is not None:
            progress(i + 1, len(steps))
    return x


def advanced(x: Tensor, denoised: Tensor, before: Tensor, step: SolverStep) -> Tensor:
    """One step on. before: what the denoiser gave a step earlier; anything where the step does not count it."""
    if step.before == 0.0:
        return torch.lerp(denoised, x, step.keep)
    return (x * step.keep).add_(denoised, alpha=step.new).add_(before, alpha=step.before)


def guided(unconditional: Tensor, conditional: Tensor, scale: Tensor) -> Tensor:
    """Classifier-free guidance on denoised predictions: D_u + g_t * (D_c - D_u).

    Args:
        unconditional, conditional: [K, T, C, h, w]. scale: [T], one per frame.
    Source: Ho and Salimans 2022; a scale per frame as in Blattmann et al. 2023 (SVD).
    """
    weight = scale.to(conditional)[:, None, None, None]
    return unconditional + weight * (conditional - unconditional)
