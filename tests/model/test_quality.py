"""What the qualities make of a checkpoint's own sampling, and what they cost where the denoiser is known exactly."""

from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from msgspec import structs
from small_models import TINY, draw, random_clip, synthesize, tiny_synthesizer
from torch import Tensor

from gcd_model.config import PLAIN_SMALL, SVD_14, SamplingConfig
from gcd_model.diffusion import (
    PRESETS,
    QUALITIES,
    Quality,
    RenderOptions,
    Sampler,
    Schedule,
    SolverName,
    edm_sigmas,
    sample,
    solver_steps,
)
from gcd_model.errors import OptionError
from gcd_model.geometry import SphericalDelta
from gcd_model.synthesizer import Synthesizer

PUBLISHED = SamplingConfig()


CENTRES, NOISE, SPREAD = draw(24, 32, seed=2).double(), draw(64, 32, seed=3).double(), 0.3


def denoised(x: Tensor, sigma: float) -> Tensor:
    """Exactly, of data that are a mixture of Gaussians at CENTRES: the mean of what x [N, D] could be without noise."""
    variance = SPREAD**2 + sigma**2
    nearness = -((x[:, None] - CENTRES) ** 2).sum(dim=2) / (2 * variance)
    mean = nearness.softmax(dim=1) @ CENTRES
    return mean + SPREAD**2 / variance * (x - mean)


@lru_cache
def flow(solver: SolverName, steps: int) -> Tensor:
    """Where the noise ends up: [64, 32]."""
    table = solver_steps(solver, edm_sigmas(PUBLISHED, steps))
    start = NOISE * (table[0].sigma ** 2 + 1) ** 0.5
    return sample(lambda x, i: denoised(x, table[i].sigma), start, table)


def error(solver: SolverName, steps: int) -> float:
    """How far the samples end from where many steps bring them, relative, mean."""
    limit = flow("dpmpp_2m", 1200)
    return ((flow(solver, steps) - limit).norm(dim=1) / limit.norm(dim=1)).mean().item()


@pytest.mark.parametrize("quality", QUALITIES)
def test_exact_is_what_was_published_and_few_steps_are_their_checkpoints_own(quality: Quality) -> None:
    assert Sampler.of(PUBLISHED, RenderOptions()) == Sampler(steps=25, solver="euler", guidance=(1.0, 1.5))
    few = PLAIN_SMALL.sampling
    own = Sampler(steps=few.steps, solver="euler", guidance=few.guidance)
    assert Sampler.of(few, RenderOptions(quality=quality)) == own


@pytest.mark.parametrize("steps", [1, 2, 5, 25, 59])
def test_no_quality_takes_more_of_the_network_than_a_better_one(steps: int) -> None:
    config = structs.replace(SVD_14, sampling=SamplingConfig(steps=steps))
    cost = [Schedule.of(config, RenderOptions(quality=quality)).evaluations for quality in QUALITIES]
    assert cost == sorted(cost, reverse=True)
    assert cost[0] == 2 * steps


@pytest.mark.parametrize("quality", QUALITIES)
def test_what_is_named_wins_over_the_quality_and_what_is_not_is_as_the_quality_has_it(quality: Quality) -> None:
    named = RenderOptions(quality=quality, steps=7, solver="euler", guidance=(2.0, 3.0), guidance_interval=(0.5, 5.0))
    assert Sampler.of(PUBLISHED, named) == Sampler(
        steps=7, solver="euler", guidance=(2.0, 3.0), guidance_interval=(0.5, 5.0)
    )
    usual = Sampler.of(PUBLISHED, RenderOptions(quality=quality))
    assert Sampler.of(PUBLISHED, RenderOptions(quality=quality, steps=7)) == replace(usual, steps=7)
    assert Sampler.of(PUBLISHED, RenderOptions(quality=quality, solver="heun")) == replace(usual, solver="heun")


def test_fast_is_no_farther_from_the_limit_than_25_euler_steps_are_and_fastest_at_most_three_times_as_far() -> None:
    fast, exact, fastest = error(*PRESETS["fast"]), error("euler", 25), error(*PRESETS["fastest"])
    assert fast <= exact < fastest <= 3 * exact


STEPS = 4


@pytest.fixture(scope="module")
def synthesizer() -> Synthesizer:
    return tiny_synthesizer()


def latents(synthesizer: Synthesizer, options: RenderOptions) -> Tensor:
    path = synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=30.0))
    return synthesize(synthesizer, random_clip(), path, replace(options, steps=STEPS)).latents


def test_guidance_applies_within_its_interval_alone() -> None:
    levels = [step.sigma for step in Schedule.of(TINY, RenderOptions(steps=STEPS)).steps]
    schedule = Schedule.of(TINY, RenderOptions(steps=STEPS, guidance_interval=(levels[2], levels[1])))
    assert schedule.guided == (False, True, True, False)
    assert (schedule.branches, schedule.evaluations) == (2, STEPS + 2)


@pytest.mark.parametrize("guidance", [None, (1.0, 3.0)])
def test_an_interval_over_all_noise_levels_changes_no_bit(
    synthesizer: Synthesizer, guidance: tuple[float, float] | None
) -> None:
    everywhere = RenderOptions(guidance=guidance)
    bounded = replace(everywhere, guidance_interval=(0.0, 1e9))
    assert torch.equal(latents(synthesizer, everywhere), latents(synthesizer, bounded))


def test_outside_the_interval_the_network_sees_the_conditional_rows_alone(
    synthesizer: Synthesizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    unet, seen = synthesizer.networks.unet, list[int]()
    forward = unet.forward

    def counted(rows: Tensor, *inputs: Tensor) -> Tensor:
        seen.append(len(rows))
        return forward(rows, *inputs)

    monkeypatch.setattr(unet, "forward", counted)
    levels = [step.sigma for step in Schedule.of(TINY, RenderOptions(steps=STEPS)).steps]
    latents(synthesizer, RenderOptions(guidance_interval=(levels[1], levels[0])))
    assert seen == [2 * TINY.frames, 2 * TINY.frames, TINY.frames, TINY.frames]


@pytest.mark.parametrize("interval", [(2.0, 1.0), (-1.0, 1.0), (float("nan"), 1.0)])
def test_an_interval_that_is_none_is_refused(interval: tuple[float, float]) -> None:
    with pytest.raises(OptionError):
        RenderOptions(guidance_interval=interval)
