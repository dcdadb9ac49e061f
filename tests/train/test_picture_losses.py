import pytest
import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor
from torch.testing import assert_close

from gcd_model.vae import Posterior
from gcd_train.training.losses import gradient_l1, kl_to_normal, ssim


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


def test_the_divergence_is_torchs() -> None:
    mean, log_variance = pictures(2), pictures(3)
    normal = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    expected = torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0)).mean()
    assert_close(kl_to_normal(Posterior(mean, log_variance)), expected)
