"""The paper's letters: noise levels, preconditioning, solvers, guidance, presets, and the network they drive."""

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple, Protocol, Self, TypeAlias, get_args

import torch
from torch import Tensor

from gcd_model.conditioning import Conditioning
from gcd_model.config import ModelConfig, Prediction, SamplingConfig
from gcd_model.errors import Cancelled, OptionError
from gcd_model.unet import UNetPlan

SolverName = Literal["euler", "dpmpp_2m", "heun"]
"""How the probability-flow ODE is followed, see `solver_steps`."""
SOLVERS: tuple[SolverName, ...] = get_args(SolverName)

Quality = Literal["exact", "fast", "fastest"]
"""How much of a checkpoint's own sampling is kept, see `Sampler.of`."""
QUALITIES: tuple[Quality, ...] = get_args(Quality)

Guidance: TypeAlias = tuple[float, float]
"""Scale of the first and of the last frame, linear between."""
NoiseInterval: TypeAlias = tuple[float, float]
"""A lowest and a highest noise level, both within."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RenderOptions:
    """How to sample. None means: as `quality` has it, which by default is what the checkpoint was made for.

    steps: from one noise level to the next, each one network evaluation (with "heun" two, but for the last).
    guidance: scale of the first and the last frame, linear between.
    guidance_interval: lowest and highest noise level at which guidance applies; elsewhere the conditional branch counts
        alone and is computed alone (Kynkäänniemi et al. 2024). None: everywhere, unless the quality has an interval.
    solver: "euler" as published; "dpmpp_2m" or "heun", of second order, which need fewer steps for the same error.
    quality: what is left open here is the checkpoint's own ("exact"), or cheaper; see `Sampler.of`.
    samples: draws per view. seed: sample s draws from (seed, s), whatever else is rendered with it.
    initial_noise: float32 [T, C, h, w] or [S, T, C, h, w], unit variance, used instead of a draw.
    motion_bucket: the motion number, instead of the formula's.
    whole_levels: pictures as uint8, which is what a GPU hands over fastest.
    progress: called with (network evaluations done, all of them). cancel: asked before each.
    """

    steps: int | None = None
    guidance: Guidance | None = None
    guidance_interval: NoiseInterval | None = None
    solver: SolverName | None = None
    quality: Quality = "exact"
    samples: int = 1
    seed: int = 0
    initial_noise: Tensor | None = None
    motion_bucket: float | None = None
    whole_levels: bool = False
    progress: Callable[[int, int], None] | None = None
    cancel: threading.Event | None = None

    def __post_init__(self) -> None:
        if self.samples < 1 or (self.steps is not None and self.steps < 1):
            raise OptionError(f"samples and steps must be at least 1, got {self.samples} and {self.steps}")
        numbers = (*(self.guidance or ()), 0.0 if self.motion_bucket is None else self.motion_bucket)
        if not all(map(math.isfinite, numbers)):
            raise OptionError(f"guidance and motion bucket must be finite, got {self.guidance}, {self.motion_bucket}")
        low, high = self.guidance_interval or (0.0, math.inf)
        if not 0.0 <= low <= high:
            raise OptionError(f"guidance_interval goes from a noise level up to another, got {low:g} to {high:g}")
        if self.solver not in (None, *SOLVERS):
            raise OptionError(f"the solver must be one of {', '.join(SOLVERS)}, got {self.solver!r}")
        if self.quality not in QUALITIES:
            raise OptionError(f"the quality must be one of {', '.join(QUALITIES)}, got {self.quality!r}")


# --- noise levels and preconditioning ---------------------------------------------------------------------------------


class Preconditioning(NamedTuple):
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


def unit_noise(shape: tuple[int, ...], seed: int, stream: int = 0, device: torch.device | str = "cpu") -> Tensor:
    """Standard normal float32.

    seed, stream: draws with another seed or another stream (sample number) are independent.
    device: where it is drawn, and lies; a GPU draws other numbers than a CPU.
    """
    mixed = (seed * 0x9E3779B97F4A7C15 + stream * 0xBF58476D1CE4E5B9 + 1) % 2**63
    return torch.randn(shape, generator=torch.Generator(device).manual_seed(mixed), device=device)


# --- solvers as tables of coefficients, and the loop that follows them ----------------------------------------------


class SolverStep(NamedTuple):
    """One network evaluation and what follows it: x <- D + keep * (x - D) + gain * (D - D of the evaluation before).

    Its weights add up to 1, as those of every consistent solver do. What can be written so runs in every engine.
    """

    sigma: float
    keep: float
    gain: float = 0.0


def solver_steps(solver: SolverName, sigmas: Tensor) -> tuple[SolverStep, ...]:
    """The whole schedule. sigmas: [S + 1], falling; the last may be 0."""
    tables = {"euler": euler_steps, "dpmpp_2m": multistep_steps, "heun": heun_steps}
    return tuple(tables[solver](sigmas.tolist()))


def euler_steps(levels: list[float]) -> list[SolverStep]:
    """Euler: x <- x + (sigma[i+1] - sigma[i]) * (x - D) / sigma[i].

    Source: Karras et al. 2022, Algorithm 1 without the correction and without added noise.
    """
    return [SolverStep(now, after / now) for now, after in pairwise(levels)]


def heun_steps(levels: list[float]) -> list[SolverStep]:
    """Heun: an Euler step to x', then a correction by the slope there; a step that ends without noise has none.

    The mean of both slopes leads to x' + (sigma[i] / sigma[i+1] - 1) / 2 * (D(x') - D(x)).
    Source: Karras et al. 2022, Algorithm 1 without added noise.
    """
    steps = list[SolverStep]()
    for now, after in pairwise(levels):
        steps.append(SolverStep(now, after / now))
        if after > 0:
            steps.append(SolverStep(after, 1.0, (now / after - 1) / 2))
    return steps


def multistep_steps(levels: list[float]) -> list[SolverStep]:
    """DPM-Solver++ (2M): D along the logarithm of the noise level, drawn through this step and the one before.

    The first step and one that ends without noise are of first order: nothing lies before the one, and in the other the
    logarithm has no end. Source: Lu et al. 2022 (DPM-Solver++), Algorithm 2, for data without scaling (alpha 1).
    """
    steps = euler_steps(levels)
    for i, (earlier, now, after) in enumerate(zip(levels, levels[1:], levels[2:], strict=False), start=1):
        if after > 0:
            ahead = math.log(now / after) / (2 * math.log(earlier / now))
            steps[i] = SolverStep(now, after / now, (1 - after / now) * ahead)
    return steps


def sample(
    denoise: Callable[[Tensor, int], Tensor],
    start: Tensor,
    steps: Sequence[SolverStep],
    options: RenderOptions | None = None,
) -> Tensor:
    """From noise to a clean sample.

    Args:
        denoise: (x, i) -> D(x, steps[i].sigma), same shape as x.
        start: any shape, noise at the first level. steps: see `solver_steps`.
        options: whom to tell of progress, and who may cancel.
    Raises:
        Cancelled: `options.cancel` was set.
    """
    x, before = start, start
    for i in watched(len(steps), options or RenderOptions()):
        denoised = denoise(x, i)
        x, before = advanced(x, denoised, before, *steps[i][1:]), denoised
    return x


def watched(count: int, options: RenderOptions) -> Iterator[int]:
    """0 to count - 1; before each one `options.cancel` is asked, and after it `options.progress` is told.

    Raises: Cancelled.
    """
    for i in range(count):
        if options.cancel is not None and options.cancel.is_set():
            raise Cancelled(f"stopped before step {i + 1} of {count}")
        yield i
        if options.progress is not None:
            options.progress(i + 1, count)


def advanced(x: Tensor, denoised: Tensor, before: Tensor, keep: Tensor | float, gain: Tensor | float) -> Tensor:
    """One step on, see `SolverStep`."""
    return torch.lerp(denoised, x, keep) + gain * (denoised - before)


def guided(unconditional: Tensor, conditional: Tensor, scale: Tensor) -> Tensor:
    """Classifier-free guidance on denoised predictions: D_u + g_t * (D_c - D_u).

    Args:
        unconditional, conditional: [K, T, C, h, w]. scale: [T], one per frame.
    Source: Ho and Salimans 2022; a scale per frame as in Blattmann et al. 2023 (SVD).
    """
    weight = scale.to(conditional)[:, None, None, None]
    return unconditional + weight * (conditional - unconditional)


# --- qualities: a checkpoint's own way of sampling, or a cheaper one -------------------------------------------------


PRESETS: dict[Quality, tuple[SolverName, int]] = {"fast": ("dpmpp_2m", 16), "fastest": ("dpmpp_2m", 10)}
"""Solver and steps of the cheaper qualities. "fast" is no farther from the limit of many steps than 25 Euler steps, on
mixtures whose denoiser is known exactly; "fastest" at most three times as far. Trained small models of many steps are
nearer to the limit with either than with 25 Euler steps; guidance is left alone, as nothing was measured of it."""


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

    @classmethod
    def of(cls, sampling: SamplingConfig, options: RenderOptions) -> Self:
        """What `options` come to for a checkpoint.

        What they name counts; what they leave open is as their quality has it: "exact" is the checkpoint's own way,
        Euler steps with guidance everywhere; "fast" and "fastest" are presets for checkpoints that take more steps than
        those. A checkpoint of fewer steps, such as our small models, is sampled its own way in every quality.
        """
        solver, steps = "euler", sampling.steps
        preset = PRESETS.get(options.quality)
        if preset is not None and preset[1] < steps:
            solver, steps = preset
        return cls(
            steps=options.steps or steps,
            solver=options.solver or solver,
            guidance=options.guidance or sampling.guidance,
            guidance_interval=options.guidance_interval,
        )


# --- one run of the sampler, and the network as it calls it -----------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class Schedule:
    """One run of the sampler, all of it known before it starts.

    steps: one per network evaluation. guidance: float64 [T], scale per frame, linear (Blattmann et al. 2023). guided:
    per evaluation, whether the unconditional branch counts, too.
    """

    steps: tuple[SolverStep, ...]
    guidance: Tensor
    guided: tuple[bool, ...]
    prediction: Prediction

    @classmethod
    def of(cls, config: ModelConfig, options: RenderOptions | None = None) -> Self:
        """What `Sampler.of` makes of the options."""
        sampler = Sampler.of(config.sampling, RenderOptions() if options is None else options)
        steps = solver_steps(sampler.solver, edm_sigmas(config.sampling, sampler.steps))
        guides = sampler.guidance != (1.0, 1.0)
        low, high = sampler.guidance_interval or (0.0, math.inf)
        return cls(
            steps=steps,
            guidance=torch.linspace(*sampler.guidance, config.frames, dtype=torch.float64),
            guided=tuple(guides and low <= step.sigma <= high for step in steps),
            prediction=config.prediction,
        )

    @property
    def branches(self) -> int:
        """Rows the network is told of per view: 2 where any evaluation is guided."""
        return 2 if any(self.guided) else 1

    @property
    def evaluations(self) -> int:
        """How often the network sees a view: guided evaluations count twice."""
        return len(self.steps) + sum(self.guided)

    def start(self, noise: Tensor, views: int) -> Tensor:
        """Unit noise [S, T, C, h, w] -> [views * S, T, C, h, w], as strong as the first level asks."""
        return noise.repeat(views, 1, 1, 1, 1) * math.sqrt(self.steps[0].sigma ** 2 + 1)


class StepInputs(NamedTuple):
    """What one evaluation and its step take besides x; rows of both branches, the conditional ones last.

    numbers: [5], c_in, c_out, c_skip, keep, gain. guidance: [T]. condition: [R*K*T, C', h, w].
    embeddings: [K*T, E], the same for both branches. crosses: [R*K*T, X] or None.
    """

    numbers: Tensor
    guidance: Tensor
    condition: Tensor
    embeddings: Tensor
    crosses: Tensor | None


class Backbone(Protocol):
    """Whatever evaluates the network F."""

    def plan(self, labels: Tensor, given: Conditioning) -> UNetPlan:
        """All that does not depend on the pixels. labels: float32 [S], c_noise of every evaluation, anywhere."""
        ...

    def predict(self, rows: Tensor, condition: Tensor, embeddings: Tensor, crosses: Tensor | None) -> Tensor:
        """One evaluation, see `VideoUNet.forward`. rows: float32 [N, C, h, w] -> float32, the same shape."""
        ...


class GuidedDenoiser:
    """D(x, sigma_i) with guidance, for one batch of views, whatever computes the network."""

    def __init__(self, backbone: Backbone, given: Conditioning, schedule: Schedule, like: Tensor) -> None:
        """like: what the sampler works on. Plans what does not depend on it, for all evaluations."""
        self._backbone, self._guided, self._condition = backbone, schedule.guided, given.latents
        sigmas = torch.tensor([step.sigma for step in schedule.steps], dtype=torch.float64)
        solver = torch.tensor([step[1:] for step in schedule.steps], dtype=torch.float64)
        levels = preconditioning(sigmas, schedule.prediction)
        scales = torch.stack([levels.c_in, levels.c_out, levels.c_skip], dim=1)
        self._numbers, self._guidance = torch.cat([scales, solver], dim=1).to(like), schedule.guidance.to(like)
        self._plan = backbone.plan(levels.c_noise.float(), given)

    def inputs(self, step: int) -> StepInputs:
        """Of this evaluation."""
        embeddings, crosses = self._plan
        return StepInputs(self._numbers[step], self._guidance, self._condition, embeddings[step], crosses)

    def __call__(self, x: Tensor, step: int) -> Tensor:
        """x: [K, T, C, h, w] float32 -> the same shape."""
        inputs = self.inputs(step)
        return denoised(x, evaluated(self._backbone, x, inputs, 1 + self._guided[step]), inputs)


def evaluated(backbone: Backbone, x: Tensor, inputs: StepInputs, branches: int) -> Tensor:
    """What the network says of x [K, T, C, h, w]: [R, K, T, C, h, w]. branches: R, 1 for the conditional one alone."""
    rows = (x * inputs.numbers[0]).flatten(0, 1).repeat(branches, 1, 1, 1)
    crosses = None if inputs.crosses is None else inputs.crosses[-len(rows) :]
    raw = backbone.predict(rows, inputs.condition[-len(rows) :], inputs.embeddings.repeat(branches, 1), crosses)
    return raw.unflatten(0, (branches, *x.shape[:2]))


def denoised(x: Tensor, raw: Tensor, inputs: StepInputs) -> Tensor:
    """D of what the network said, guided where it said it for both branches. raw: [R, K, T, C, h, w]."""
    _, c_out, c_skip, *_ = inputs.numbers.unbind()
    both = c_skip * x + c_out * raw
    return guided(both[0], both[1], inputs.guidance) if len(both) == 2 else both[0]
