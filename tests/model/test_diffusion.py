"""The paper's letters: noise levels, preconditioning, guidance, solvers, qualities, and what they cost and miss."""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import msgspec
import pytest
import torch
from msgspec import structs
from plain_unet import plain_unet
from published import released_unet
from small_models import TINY, draw, random_clip, relative_error, synthesize, tiny_synthesizer
from torch import Tensor
from torch.testing import assert_close

from gcd_model.conditioning import SourceFeatures
from gcd_model.config import PLAIN_SMALL, SVD_14, SamplingConfig
from gcd_model.diffusion import (
    PRESETS,
    QUALITIES,
    SOLVERS,
    Quality,
    RenderOptions,
    Sampler,
    Schedule,
    SolverName,
    edm_sigmas,
    guided,
    heun_steps,
    multistep_steps,
    preconditioning,
    sample,
    solver_steps,
    unit_noise,
)
from gcd_model.errors import OptionError
from gcd_model.geometry import SphericalDelta

PUBLISHED = SamplingConfig()


def test_25_noise_levels_have_the_published_values() -> None:
    sigmas = edm_sigmas(PUBLISHED, 25)
    expected = {
        0: 700.0,
        1: 545.729246,
        2: 421.569136,
        3: 322.453683,
        12: 15.589968,
        22: 0.024803,
        23: 0.007882,
        24: 0.002,
        25: 0.0,
    }
    assert sigmas.shape == (26,)
    assert {i: round(sigmas[i].item(), 6) for i in expected} == expected


@pytest.mark.parametrize("sigma", [0.002, 0.5, 1.0, 30.0, 700.0])
def test_a_network_that_predicts_v_exactly_makes_the_denoiser_exact(sigma: float) -> None:
    clean, noise = draw(5).double(), draw(5, seed=1).double()
    noisy = clean + sigma * noise
    v = (noise - sigma * clean) / math.sqrt(1 + sigma**2)
    c = preconditioning(torch.tensor(sigma, dtype=torch.float64))
    assert_close(c.c_skip * noisy + c.c_out * v, clean, rtol=0, atol=1e-9)


def test_guidance_moves_each_frame_away_from_the_unconditional_prediction_by_its_own_scale() -> None:
    unconditional, conditional = draw(2, 3, 4, 2, 2), draw(2, 3, 4, 2, 2, seed=1)
    scale = torch.tensor([0.0, 1.0, 2.5], dtype=torch.float64)
    result = guided(unconditional, conditional, scale)
    assert_close(result[:, 0], unconditional[:, 0])
    assert_close(result[:, 1], conditional[:, 1])
    assert_close(result[:, 2], 2.5 * conditional[:, 2] - 1.5 * unconditional[:, 2])


@pytest.mark.parametrize(("solver", "order", "bound"), [("euler", 1, 0.02), ("dpmpp_2m", 2, 0.0005), ("heun", 2, 5e-4)])
def test_a_solver_approaches_the_true_flow_of_a_gaussian_with_its_order(
    solver: SolverName, order: int, bound: float
) -> None:
    spread = 2.0  # data ~ N(0, 2^2): D(x, s) = x * 4 / (4 + s^2), and x(s) grows with sqrt(4 + s^2)
    start = torch.tensor([1.0], dtype=torch.float64)
    exact = start * spread / math.sqrt(spread**2 + PUBLISHED.sigma_max**2)

    def error(steps: int) -> float:
        table = solver_steps(solver, edm_sigmas(PUBLISHED, steps))
        final = sample(lambda x, i: x * spread**2 / (spread**2 + table[i].sigma ** 2), start, table)
        return (final / exact - 1).abs().item()

    assert error(400) < bound
    assert math.log2(error(400) / error(800)) == pytest.approx(order, abs=0.15)


def test_the_multistep_solver_uses_the_prediction_of_half_way_where_it_is_a_line_over_the_logarithm() -> None:
    levels = [9.0, 5.0, 2.0, 1.0, 0.3]

    def line(log_sigma: float) -> float:
        return 3.0 - 0.7 * log_sigma

    for i, step in list(enumerate(multistep_steps(levels)))[1:]:
        earlier, now, after = (math.log(level) for level in levels[i - 1 : i + 2])
        counted = (1 - step.keep) * line(now) + step.gain * (line(now) - line(earlier))
        assert counted == pytest.approx((1 - step.keep) * line((now + after) / 2))


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_heun_is_algorithm_1_of_karras_without_churn(steps: int) -> None:
    """Line by line as printed, on a denoiser that is no straight line."""
    sigmas = edm_sigmas(PUBLISHED, steps)

    def denoise(x: Tensor, sigma: float) -> Tensor:
        return torch.tanh(x / (1 + sigma**2) ** 0.5)

    x = start = 700 * draw(5).double()
    for now, after in pairwise(sigmas.tolist()):
        slope = (x - denoise(x, now)) / now
        ahead = x + (after - now) * slope
        if after != 0:
            slope_ahead = (ahead - denoise(ahead, after)) / after
            ahead = x + (after - now) * (slope / 2 + slope_ahead / 2)
        x = ahead
    table = heun_steps(sigmas.tolist())
    assert len(table) == 2 * steps - 1
    assert_close(sample(lambda x, i: denoise(x, table[i].sigma), start, table), x, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("steps", [1, 2, 3, 25])
@pytest.mark.parametrize("solver", SOLVERS)
def test_the_first_step_asks_for_nothing_before_and_the_last_leaves_no_noise(solver: SolverName, steps: int) -> None:
    made = solver_steps(solver, edm_sigmas(PUBLISHED, steps))
    assert made[0].gain == 0.0
    assert made[-1][1:] == (0.0, 0.0)


def test_unit_noise_is_fixed_by_seed_and_stream_and_differs_between_them() -> None:
    first, again, *others = (
        unit_noise((4, 5000), seed=seed, stream=stream) for seed, stream in [(3, 1), (3, 1), (3, 2), (4, 1), (1, 3)]
    )
    assert torch.equal(first, again)
    for other in others:
        assert torch.corrcoef(torch.stack([first.flatten(), other.flatten()]))[0, 1].abs() < 0.03
    assert first.mean().abs() < 0.03
    assert first.std().item() == pytest.approx(1.0, abs=0.03)


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
def test_exact_is_what_was_published_few_steps_are_their_checkpoints_own_and_what_is_named_wins(
    quality: Quality,
) -> None:
    assert Sampler.of(PUBLISHED, RenderOptions()) == Sampler(steps=25, solver="euler", guidance=(1.0, 1.5))
    few = PLAIN_SMALL.sampling
    own = Sampler(steps=few.steps, solver="euler", guidance=few.guidance)
    assert Sampler.of(few, RenderOptions(quality=quality)) == own
    wanted = {"steps": 7, "solver": "euler", "guidance": (2.0, 3.0), "guidance_interval": (0.5, 5.0)}
    assert Sampler.of(PUBLISHED, RenderOptions(quality=quality, **wanted)) == Sampler(**wanted)  # type: ignore[arg-type]
    usual = Sampler.of(PUBLISHED, RenderOptions(quality=quality))
    assert Sampler.of(PUBLISHED, RenderOptions(quality=quality, steps=7)) == replace(usual, steps=7)
    assert Sampler.of(PUBLISHED, RenderOptions(quality=quality, solver="heun")) == replace(usual, solver="heun")


def test_no_quality_takes_more_of_the_network_than_a_better_one() -> None:
    for steps in (1, 2, 5, 25, 59):
        config = structs.replace(SVD_14, sampling=SamplingConfig(steps=steps))
        cost = [Schedule.of(config, RenderOptions(quality=quality)).evaluations for quality in QUALITIES]
        assert cost == sorted(cost, reverse=True)
        assert cost[0] == 2 * steps


def test_fast_is_no_farther_from_the_limit_than_25_euler_steps_are_and_fastest_at_most_three_times_as_far() -> None:
    fast, exact, fastest = error(*PRESETS["fast"]), error("euler", 25), error(*PRESETS["fastest"])
    assert fast <= exact < fastest <= 3 * exact


def test_guidance_applies_within_its_interval_alone_and_elsewhere_the_network_sees_conditional_rows_alone() -> None:
    synthesizer, seen = tiny_synthesizer(), list[int]()
    levels = [step.sigma for step in Schedule.of(TINY, RenderOptions(steps=4)).steps]
    options = RenderOptions(steps=4, guidance_interval=(levels[2], levels[1]))
    schedule = Schedule.of(TINY, options)
    assert schedule.guided == (False, True, True, False)
    assert (schedule.branches, schedule.evaluations) == (2, 6)
    synthesizer.networks.unet.register_forward_pre_hook(lambda _, given: seen.append(len(given[0])))
    synthesize(synthesizer, random_clip(), synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=30.0)), options)
    assert seen == [TINY.frames, 2 * TINY.frames, 2 * TINY.frames, TINY.frames]


@pytest.mark.parametrize("interval", [(2.0, 1.0), (-1.0, 1.0), (float("nan"), 1.0)])
def test_an_interval_that_is_none_is_refused(interval: tuple[float, float]) -> None:
    with pytest.raises(OptionError):
        RenderOptions(guidance_interval=interval)


FRAMES, EULER_STEPS = 14, 25
CONFIG = msgspec.structs.replace(
    TINY,
    frames=FRAMES,
    height=16,
    width=32,
    unet=msgspec.structs.replace(TINY.unet, width=32, norm_groups=32),
    sampling=SamplingConfig(),
)
DELTA = (30.0, 10.0, 1.5)  # azimuth and elevation in degrees, radius in metres, destination minus source


@dataclass(frozen=True, kw_only=True, slots=True)
class Reference:
    """Everything the formulas need, in float64."""

    weights: dict[str, Tensor]
    camera_weight: Tensor
    camera_bias: Tensor
    features: SourceFeatures
    noise: Tensor

    def sample(self) -> Tensor:
        """x0 of 25 Euler steps: [T, C, h, w]."""
        x = self.noise.double() * math.sqrt(1 + 700.0**2)
        sigmas = self._sigmas()
        scale = torch.tensor([1.0 + 0.5 * t / (FRAMES - 1) for t in range(FRAMES)], dtype=torch.float64)
        for sigma, following in pairwise(sigmas):
            unconditional, conditional = self._denoised(x, sigma)
            denoised = unconditional + scale[:, None, None, None] * (conditional - unconditional)
            x = x + (following - sigma) * (x - denoised) / sigma
        return x

    def _sigmas(self) -> list[float]:
        high, low = 700 ** (1 / 7), 0.002 ** (1 / 7)
        return [(high + i / (EULER_STEPS - 1) * (low - high)) ** 7 for i in range(EULER_STEPS)] + [0.0]

    def _denoised(self, x: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
        """D(x, sigma) without and with the image token and the source latents; all else is the same in both."""
        c_skip, c_out = 1 / (sigma**2 + 1), -sigma / math.sqrt(sigma**2 + 1)
        c_in, c_noise = 1 / math.sqrt(sigma**2 + 1), 0.25 * math.log(sigma)
        assert self.features.tokens is not None
        source, tokens, vector = self.features.latents.double(), self.features.tokens.double(), self._vector()
        raw = plain_unet(
            self.weights,
            torch.cat([(c_in * x).repeat(2, 1, 1, 1), torch.cat([torch.zeros_like(source), source])], dim=1),
            noise_label=torch.full((2 * FRAMES,), c_noise, dtype=torch.float64),
            vector=torch.cat([vector, vector]),
            tokens=torch.cat([torch.zeros_like(tokens), tokens]),
            frames=FRAMES,
            head_width=CONFIG.unet.head_width,
        )
        return c_skip * x + c_out * raw[:FRAMES], c_skip * x + c_out * raw[FRAMES:]

    def _vector(self) -> Tensor:
        """[T, 24 + 8]: frame rate, motion and augmentation strength, then the embedded camera."""
        motion = round(255 * math.hypot(DELTA[0], DELTA[1]) / math.hypot(90, 30))
        micro = [number for value in (12.0, motion, 0.02) for number in _sinusoid(value, 8)]
        rows = []
        for t in range(FRAMES):
            azimuth, elevation = (math.radians(angle) * t / (FRAMES - 1) for angle in DELTA[:2])
            fourier = [f(m * angle) for angle in (azimuth, elevation) for m in (1, 2, 4) for f in (math.cos, math.sin)]
            features = torch.tensor([*fourier, DELTA[2] * t / (FRAMES - 1)], dtype=torch.float64)
            camera = self.camera_weight @ features + self.camera_bias
            rows.append(torch.cat([torch.tensor(micro, dtype=torch.float64), camera]))
        return torch.stack(rows)


def _sinusoid(value: float, width: int) -> list[float]:
    angles = [value * 10000 ** (-i / (width // 2)) for i in range(width // 2)]
    return [math.cos(angle) for angle in angles] + [math.sin(angle) for angle in angles]


def test_25_guided_steps_equal_the_reference() -> None:
    synthesizer = tiny_synthesizer(CONFIG)
    features, camera = synthesizer.encode(random_clip(CONFIG)), synthesizer.networks.camera
    noise = draw(FRAMES, 4, *features.latents.shape[2:], seed=5)
    delta = SphericalDelta(azimuth_deg=DELTA[0], elevation_deg=DELTA[1], radius_m=DELTA[2])
    path = synthesizer.traits.plan_view(delta)
    (view,) = synthesizer.render(features, [path], RenderOptions(initial_noise=noise))
    assert camera is not None
    reference = Reference(
        weights={name: weight.double() for name, weight in released_unet(synthesizer.networks.unet).items()},
        camera_weight=camera.proj.weight.double(),
        camera_bias=camera.proj.bias.double(),
        features=features,
        noise=noise,
    )
    with torch.inference_mode():
        assert relative_error(view.latents[0], reference.sample()) < 1e-4
