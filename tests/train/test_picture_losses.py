import pytest
import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor
from torch.testing import assert_close

from gcd_model.vae import Posterior
from gcd_train.training.losses import energy_l1, gradient_l1, kl_to_normal, ssim


def pictures(seed: int) -> Tensor:
    return torch.rand((2, 3, 16, 20), generator=torch.Generator().manual_seed(seed)) * 2 - 1


def test_equal_pictures_are_wholly_similar() -> None:
    assert float(ssim(pictures(0), pictures(0))) == pytest.approx(1.0)


def test_similarity_is_kornias() -> None:
    a, b = pictures(0), 0.7 * pictures(0) + 0.3 * pictures(1)
    assert_close(ssim(a, b), kornia_ssim((a + 1) / 2, (b + 1) / 2, 7, padding="valid").mean())


def test_a_constant_offset_has_no_gradient_difference() -> None:
    assert float(gradient_l1(pictures(0), pictures(0) + 0.5)) == pytest.approx(0.0, abs=1e-6)


def test_a_ramp_differs_from_flat_by_its_slope() -> None:
    ramp = torch.arange(8.0).expand(1, 1, 4, 8)
    assert float(gradient_l1(ramp, torch.zeros_like(ramp))) == pytest.approx(1.0)


def test_how_much_is_drawn_is_compared_cell_by_cell_and_not_where() -> None:
    lines = torch.zeros(1, 1, 17, 17)
    lines[..., 2::8] = 1.0
    moved = lines.roll(3, dims=-1)
    assert float(energy_l1(lines, moved)) == pytest.approx(0.0, abs=1e-6)
    assert float(gradient_l1(lines, moved)) > 0.4
    # an upright line of height 1 has two slopes of 1 in each row of its cell of 8 by 8
    assert float(energy_l1(lines, torch.zeros_like(lines))) == pytest.approx(2 / 8, abs=1e-3)


def test_where_nothing_is_drawn_the_energy_still_has_a_gradient() -> None:
    flat = torch.zeros(1, 1, 17, 17, requires_grad=True)
    energy_l1(flat, pictures(0)[:1, :1, :, :17].repeat(1, 1, 2, 1)[..., :17, :17]).backward()
    assert flat.grad is not None
    assert bool(flat.grad.isfinite().all())


def test_the_divergence_is_torchs() -> None:
    mean, log_variance = pictures(2), pictures(3)
    normal = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    expected = torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0)).mean()
    assert_close(kl_to_normal(Posterior(mean, log_variance)), expected)
