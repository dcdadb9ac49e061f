"""The sampler: noise levels, preconditioning, guidance, Euler steps, and the whole of it against a plain reference."""

import math
from itertools import pairwise

import pytest
import torch
from small_models import draw
from torch import Tensor
from torch.testing import assert_close

from gcd_model.config import SamplingConfig
from gcd_model.diffusion import (
    SOLVERS,
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
    shape = (4, 5000)
    first = unit_noise(shape, seed=3, stream=1)
    assert torch.equal(first, unit_noise(shape, seed=3, stream=1))
    others = [
        unit_noise(shape, seed=3, stream=2),
        unit_noise(shape, seed=4, stream=1),
        unit_noise(shape, seed=1, stream=3),
    ]
    for other in others:
        assert torch.corrcoef(torch.stack([first.flatten(), other.flatten()]))[0, 1].abs() < 0.03
    assert first.mean().abs() < 0.03
    assert first.std().item() == pytest.approx(1.0, abs=0.03)
