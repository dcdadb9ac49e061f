"""The paper's letters: noise levels, preconditioning, solvers, guidance, presets, and the network they drive."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, Self

import torch
from torch import Tensor

from gcd_model.clip import CancelSignal, Guidance, NoiseInterval, Quality, RenderOptions, SolverName
from gcd_model.conditioning import Conditioning
from gcd_model.config import ModelConfig, Prediction, SamplingConfig
from gcd_model.errors import Cancelled
from gcd_model.unet import StageInputs, UNetPlan


@dataclass(frozen=True, slots=True)
class Preconditioning:
    """The four coefficients of a denoiser, shaped like the noise level they were made from."""

    c_skip: Tensor
    c_out: Tensor
    c_in: Tensor
    c_noise: Tensor


def preconditioning(sigma: Tensor, prediction: Prediction = "v") -> Preconditioning:
    """Coefficients that turn the raw network F into the denoiser D.

        D(x, sigma) = c_skip * x + c_out * F(c_in * x, c_noise)

    Args:
        sigma: noise level, positive, any shape.
        prediction: "v" as published; "x0", where F is the clean sample itself, is ours, for small networks.
    Source: Karras et al. 2022, Eq. 7, with the v-prediction coefficients of Stable Video Diffusion (sigma_data 1).
    """
    scale = (sigma**2 + 1).rsqrt()
    if prediction == "x0":
        skip, out = torch.zeros_like(sigma), torch.ones_like(sigma)
        return Preconditioning(c_skip=skip, c_out=out, c_in=scale, c_noise=sigma.log() / 4)
    return Preconditioning(c_skip=scale**2, c_out=-sigma * scale, c_in=scale, c_noise=sigma.log() / 4)


def edm_sigmas(config: SamplingConfig, steps: int) -> Tensor:
    """Noise levels of the sampler, from sigma_max down to sigma_min, then 0: float64 [steps + 1].

    One step uses sigma_max alone.
    Source: Karras et al. 2022, Eq. 5, with the range that Stable Video Diffusion samples from.
    """
    high, low = config.sigma_max ** (1 / config.rho), config.sigma_min ** (1 / config.rho)
    ramp = torch.linspace(0, 1, steps, dtype=torch.float64)
    sigmas = (high + ramp * (low - high)) ** config.rho
    return torch.cat([sigmas, sigmas.new_zeros(1)])


def guidance_scale(first: float, last: float, frames: int) -> Tensor:
    """Guidance per frame, linear from the first to the last: float64 [T]. Source: Blattmann et al. 2023 (SVD)."""
    return torch.linspace(first, last, frames, dtype=torch.float64)


def unit_noise(shape: tuple[int, ...], seed: int, stream: int = 0) -> Tensor:
    """Standard normal float32, the same on every device.

    seed, stream: draws with another seed or another stream (sample number) are independent.
    """
    mixed = (seed * 0x9E3779B97F4A7C15 + stream * 0xBF58476D1CE4E5B9 + 1) % 2**63
    return torch.randn(shape, generator=torch.Generator().manual_seed(mixed))


# --- the denoising loop, and the solver as a table of coefficients ---------------------------------------------------


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


# --- qualities: a checkpoint's own way of sampling, or a cheaper one -------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class Sampler:
    """A way to sample, complete.

    steps: network evaluations, guided ones counted once. guidance: scale of the first and the last frame.
    guidance_interval: see `RenderOptions`; None where guidance applies everywhere.
    """

    steps: int
    solver: SolverName
    guidance: Guidance
    guidance_interval: NoiseInterval | None = None


PRESETS: dict[Quality, tuple[SolverName, int]] = {"fast": ("dpmpp_2m", 16), "fastest": ("dpmpp_2m", 10)}
"""Solver and steps of the cheaper qualities. "fast" is no farther from the limit of many steps than 25 Euler steps, on
mixtures whose denoiser is known exactly; "fastest" at most three times as far. Trained small models of many steps are
nearer to the limit with either than with 25 Euler steps; guidance is left alone, as nothing was measured of it."""


def sampler_of(sampling: SamplingConfig, options: RenderOptions) -> Sampler:
    """What `options` come to for a checkpoint.

    What they name counts; what they leave open is as their quality has it: "exact" is the checkpoint's own way, Euler
    steps with guidance everywhere; "fast" and "fastest" are presets for checkpoints that take more steps than those. A
    checkpoint of fewer steps, such as our small models, is sampled its own way in every quality.
    """
    solver, steps = "euler", sampling.steps
    preset = PRESETS.get(options.quality)
    if preset is not None and preset[1] < steps:
        solver, steps = preset
    return Sampler(
        steps=options.steps or steps,
        solver=options.solver or solver,
        guidance=options.guidance or sampling.guidance,
        guidance_interval=options.guidance_interval,
    )


# --- one run of the sampler ------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class Schedule:
    """One run of the sampler, all of it known before it starts.

    sigmas: float64 [S + 1], falling to 0. steps: what the solver does with each D, one per noise level above 0.
    guidance: float64 [T], scale per frame. guided: per step, whether the unconditional branch counts, too.
    """

    sigmas: Tensor
    steps: tuple[SolverStep, ...]
    guidance: Tensor
    guided: tuple[bool, ...]
    prediction: Prediction

    @classmethod
    def of(cls, config: ModelConfig, options: RenderOptions | None = None) -> Self:
        """What `sampler_of` makes of the options."""
        sampler = sampler_of(config.sampling, RenderOptions() if options is None else options)
        sigmas = edm_sigmas(config.sampling, sampler.steps)
        first, last = sampler.guidance
        guides = (first, last) != (1.0, 1.0)
        low, high = sampler.guidance_interval or (0.0, float("inf"))
        return cls(
            sigmas=sigmas,
            steps=solver_steps(sampler.solver, sigmas),
            guidance=guidance_scale(first, last, config.frames),
            guided=tuple(guides and low <= sigma <= high for sigma in sigmas[:-1].tolist()),
            prediction=config.prediction,
        )

    @property
    def branches(self) -> int:
        """Rows the network is told of per view: 2 where any step is guided."""
        return 2 if any(self.guided) else 1

    @property
    def evaluations(self) -> int:
        """How often the network sees a view: guided steps count twice."""
        return len(self.steps) + sum(self.guided)

    def start(self, noise: Tensor, views: int) -> Tensor:
        """Unit noise [S, T, C, h, w] -> [views * S, T, C, h, w], as strong as the first level asks."""
        return noise.repeat(views, 1, 1, 1, 1) * torch.sqrt(self.sigmas[0] ** 2 + 1).item()


# --- the network as the sampler calls it: preconditioned and guided --------------------------------------------------


class Backbone(Protocol):
    """Whatever evaluates the network F."""

    def plan(self, labels: Tensor, given: Conditioning) -> UNetPlan:
        """All that does not depend on the pixels. labels: float32 [S], c_noise of every step, anywhere."""
        ...

    def predict(self, rows: Tensor, condition: Tensor, inputs: StageInputs) -> Tensor:
        """One evaluation, see `VideoUNet.forward`. rows: float32 [N, C, h, w] -> float32, the same shape."""
        ...


Network = Callable[[Tensor, int, int], Tensor]
"""F by rows, step and branches: rows float32 [R*K*T, C, h, w], scaled by c_in -> float32, the same shape."""


class GuidedDenoiser:
    """D(x, sigma_i) with guidance, for one batch of views, whatever computes the network."""

    def __init__(self, network: Network, schedule: Schedule, device: torch.device) -> None:
        self._network, self._schedule = network, schedule
        levels = preconditioning(schedule.sigmas[:-1], schedule.prediction)
        self._c_in, self._c_out, self._c_skip = (c.tolist() for c in (levels.c_in, levels.c_out, levels.c_skip))
        self._guidance = schedule.guidance.to(device)

    def __call__(self, x: Tensor, step: int) -> Tensor:
        """x: [K, T, C, h, w] float32 -> the same shape."""
        branches = 2 if self._schedule.guided[step] else 1
        rows = (x * self._c_in[step]).flatten(0, 1).repeat(branches, 1, 1, 1)
        raw = self._network(rows, step, branches).unflatten(0, (branches, *x.shape[:2]))
        return denoised(x, raw, self._c_skip[step], self._c_out[step], self._guidance)


def denoised(x: Tensor, raw: Tensor, c_skip: Tensor | float, c_out: Tensor | float, guidance: Tensor) -> Tensor:
    """D of what the network said, guided where it said it for both branches. raw: [R, K, T, C, h, w]. guidance: [T]."""
    both = c_skip * x + c_out * raw
    return guided(both[0], both[1], guidance) if len(both) == 2 else both[0]


def planned_denoiser(backbone: Backbone, given: Conditioning, schedule: Schedule) -> GuidedDenoiser:
    """A denoiser whose network computes once what does not depend on the pixels."""
    plan = backbone.plan(preconditioning(schedule.sigmas[:-1]).c_noise.float(), given)

    def network(rows: Tensor, step: int, branches: int) -> Tensor:
        condition, inputs = given.latents, plan.step(step)
        if branches < given.branches:
            condition = condition.chunk(given.branches)[-1]
            inputs = inputs.chunk(given.branches)[-1]  # the conditional rows come last
        return backbone.predict(rows, condition, inputs)

    return GuidedDenoiser(network, schedule, given.latents.device)
