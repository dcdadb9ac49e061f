"""How a window is sampled where the caller does not say it in full: a checkpoint's own way, or a cheaper one."""

from dataclasses import dataclass

from gcd_model.clip import Guidance, NoiseInterval, Quality, RenderOptions, SolverName
from gcd_model.config import SamplingConfig


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


@dataclass(frozen=True, kw_only=True, slots=True)
class Preset:
    """What a quality makes of a checkpoint with more steps than its own. guidance_interval: as in `Sampler`."""

    steps: int
    solver: SolverName
    guidance_interval: NoiseInterval | None = None


FAST = Preset(steps=16, solver="dpmpp_2m")
"""No farther from the limit of many steps than 25 Euler steps are, on mixtures whose denoiser is known exactly."""
FASTEST = Preset(steps=10, solver="dpmpp_2m")
"""At most three times as far, on the same. Trained small models of many steps are nearer to the limit with either than
with 25 Euler steps; guidance is left alone, as nothing was measured of it."""
_PRESETS: dict[Quality, Preset] = {"fast": FAST, "fastest": FASTEST}


def own_sampler(sampling: SamplingConfig) -> Sampler:
    """What a checkpoint was made for, and what was published: Euler steps, guidance everywhere."""
    return Sampler(steps=sampling.steps, solver="euler", guidance=sampling.guidance)


def sampler_of(sampling: SamplingConfig, options: RenderOptions) -> Sampler:
    """What `options` come to for a checkpoint.

    What they name counts; what they leave open is as their quality has it: "exact" is the checkpoint's own way, "fast"
    and "fastest" are presets for checkpoints that take more steps than those. A checkpoint of fewer steps, such as our
    small models, is sampled its own way in every quality.
    """
    usual = _of_quality(own_sampler(sampling), options.quality)
    return Sampler(
        steps=options.steps or usual.steps,
        solver=options.solver or usual.solver,
        guidance=options.guidance or usual.guidance,
        guidance_interval=options.guidance_interval or usual.guidance_interval,
    )


def _of_quality(own: Sampler, quality: Quality) -> Sampler:
    preset = _PRESETS.get(quality)
    if preset is None or own.steps <= preset.steps:
        return own
    return Sampler(
        steps=preset.steps, solver=preset.solver, guidance=own.guidance, guidance_interval=preset.guidance_interval
    )
