"""The losses against formulas written out here, against kornia and against torch."""

import pytest
import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor
from torch.testing import assert_close

from gcd_model.vae import Posterior
from gcd_train.training.losses import (
    PARALLEL_DOMAIN_WEIGHTS,
    PLAIN_BLEND,
    RELEASED_BLEND,
    ClassWeight,
    FocalBlend,
    class_emphasis,
    edm_weight,
    focal_fraction,
    focal_mean,
    frame_losses,
    gradient_l1,
    kl_to_normal,
    ssim,
)


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(
    ("step", "kept"), [(0, 1.0), (1250, 0.775), (2500, 0.55), (5000, 0.1), (5001, 0.1), (13000, 0.1)]
)
def test_the_focal_loss_keeps_less_and_less_until_step_5000(step: int, kept: float) -> None:
    assert focal_fraction(step) == pytest.approx(kept)


def test_the_weight_of_a_noise_level_is_that_of_a_unit_weight_on_v_and_can_be_capped() -> None:
    sigma = torch.tensor([0.1, 1.0, 80.0], dtype=torch.float64)
    target, error, noise = 0.3, 0.2, 1.1
    v = (noise - sigma * target) / (1 + sigma**2).sqrt()
    noisy = target + sigma * noise
    denoised = noisy / (1 + sigma**2) - sigma / (1 + sigma**2).sqrt() * (v + error)
    assert_close(edm_weight(sigma) * (denoised - target) ** 2, torch.full_like(sigma, error**2))
    assert_close(edm_weight(torch.tensor([0.1, 80.0]), 5.0), torch.tensor([5.0, 1 + 1 / 6400]))


@pytest.mark.parametrize(
    ("rows", "fraction", "wanted"),
    [
        ([[0.0, 1.0, 2.0, 3.0, 10.0], [5.0, 0.0, 0.0, 0.0, 0.0]], 1.0, [3.2, 1.0]),  # the plain mean
        ([[0.0, 1.0, 2.0, 3.0, 10.0], [5.0, 0.0, 0.0, 0.0, 0.0]], 0.5, [0.9 * 6.5 + 0.32, 0.9 * 2.5 + 0.1]),
        ([[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]], 0.39, [0.9 * 8 + 0.1 * 4.5]),  # three of ten
    ],
)
def test_the_largest_elements_of_each_frame_are_kept_and_their_number_is_rounded_down(
    rows: list[list[float]], fraction: float, wanted: list[float]
) -> None:
    assert_close(focal_mean(torch.tensor(rows), fraction), torch.tensor(wanted))


def test_class_weights_act_half_before_and_half_after_the_selection_and_all_before_it_in_the_plain_blend() -> None:
    denoised, target = numbers(2, 3, 4, 5), numbers(2, 3, 4, 5, seed=1)
    emphasis = numbers(2, 1, 4, 5, seed=2).abs()
    raw = (denoised - target) ** 2
    total = (raw + 0.5 * raw * emphasis).flatten(1)
    top = total.sort(dim=1, descending=True).values[:, :18].mean(1)  # 0.3 of 60
    expected = 0.9 * top + 0.1 * total.mean(1) + 0.5 * (raw * emphasis).flatten(1).mean(1)
    assert_close(frame_losses(denoised, target, fraction=0.3, emphasis=emphasis), expected)
    plain = (raw * (1 + emphasis)).flatten(1).sort(descending=True).values[:, :18].mean(1)
    assert_close(frame_losses(denoised, target, fraction=0.3, emphasis=emphasis, blend=PLAIN_BLEND), plain)


@pytest.mark.parametrize("blend", [RELEASED_BLEND, PLAIN_BLEND])
def test_both_blends_are_the_weighted_mean_while_everything_is_kept(blend: FocalBlend) -> None:
    denoised, target, emphasis = numbers(2, 3, 4, 5), numbers(2, 3, 4, 5, seed=1), numbers(2, 1, 4, 5, seed=2).abs()
    loss = frame_losses(denoised, target, fraction=1.0, emphasis=emphasis, blend=blend)
    assert_close(loss, ((denoised - target) ** 2 * (1 + emphasis)).mean((1, 2, 3)))


def test_channel_weights_multiply_the_squared_error() -> None:
    denoised, target, weights = numbers(2, 3, 2, 2), numbers(2, 3, 2, 2, seed=1), torch.tensor([1.0, 0.0, 3.0])
    raw = (denoised - target) ** 2
    expected = (raw[:, 0] + 3 * raw[:, 2]).mean((1, 2)) / 3
    assert_close(frame_losses(denoised, target, fraction=1.0, channel_weights=weights.double()), expected)


def test_a_class_is_where_its_colour_is_and_masks_are_averaged_over_areas() -> None:
    weights = (ClassWeight(colour=(220, 20, 60), weight=7.0), ClassWeight(colour=(0, 0, 142), weight=3.0))
    picture = torch.zeros(1, 3, 4, 8)
    picture[..., :2, :2] = torch.tensor([220, 20, 60]).view(3, 1, 1) / 127.5 - 1
    picture[..., :2, 2:4] = torch.tensor([220, 20, 69]).view(3, 1, 1) / 127.5 - 1  # more than three levels off
    picture[..., :4, 4:] = torch.tensor([0, 2, 141]).view(3, 1, 1) / 127.5 - 1  # within the tolerance
    assert_close(class_emphasis(picture, weights, (1, 2)), torch.tensor([[[[6.0 * 4 / 16, 2.0]]]]))


def test_living_beings_weigh_seven_and_vehicles_three() -> None:
    assert sorted(weight.weight for weight in PARALLEL_DOMAIN_WEIGHTS) == [3.0] * 9 + [7.0] * 5


# between pictures


def pictures(seed: int) -> Tensor:
    return torch.rand((2, 3, 16, 20), generator=torch.Generator().manual_seed(seed)) * 2 - 1


def test_similarity_is_kornias() -> None:
    a, b = pictures(0), 0.7 * pictures(0) + 0.3 * pictures(1)
    assert_close(ssim(a, b), kornia_ssim((a + 1) / 2, (b + 1) / 2, 7, padding="valid").mean())


def test_a_ramp_differs_from_flat_by_its_slope_and_an_offset_does_not() -> None:
    ramp = torch.arange(8.0).expand(1, 1, 4, 8)
    assert float(gradient_l1(ramp, torch.zeros_like(ramp))) == pytest.approx(1.0)
    assert float(gradient_l1(pictures(0), pictures(0) + 0.5)) == pytest.approx(0.0, abs=1e-6)


def test_the_divergence_is_torchs() -> None:
    mean, log_variance = pictures(2), pictures(3)
    normal = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    expected = torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0)).mean()
    assert_close(kl_to_normal(Posterior(mean, log_variance)), expected)
