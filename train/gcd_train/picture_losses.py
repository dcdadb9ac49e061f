"""Differences between pictures: gradients, structural similarity, and the autoencoder's Kullback-Leibler term."""

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.vae import Posterior

_C1, _C2 = 0.01**2, 0.03**2
_WINDOW, _WINDOW_SIGMA = 7, 1.5
_CELL = 8
_FLAT = 1e-6  # keeps the root differentiable where nothing changes; brightness squared


def gradient_l1(pictures: Tensor, targets: Tensor) -> Tensor:
    """Mean absolute difference of horizontal and vertical pixel differences, [N, C, H, W] each -> scalar."""
    difference = pictures - targets
    across = (difference[..., 1:] - difference[..., :-1]).abs().mean()
    down = (difference[..., 1:, :] - difference[..., :-1, :]).abs().mean()
    return across + down


def energy_l1(pictures: Tensor, targets: Tensor) -> Tensor:
    """Mean absolute difference of how much is drawn in cells of 8 pixels a side, [N, C, H, W] each -> scalar.

    How much is the mean length of the gradient. Where it lies within a cell is not asked: being sharp at all pays here,
    which differences pixel by pixel punish. What is left over beside whole cells is not looked at.
    """
    return (_energy(pictures) - _energy(targets)).abs().mean()


def ssim(pictures: Tensor, targets: Tensor) -> Tensor:
    """Structural similarity of pictures in [-1, 1], mean over all: [N, C, H, W] each -> scalar.

    Source: Wang et al. 2004, on brightness 0 to 1, with a Gaussian window of 7 pixels and no padding: smaller and
    cheaper than the measure that is reported, because crops are small.
    """
    a, b = (pictures + 1) / 2, (targets + 1) / 2
    mean_a, mean_b, aa, bb, ab = _smoothed(torch.cat([a, b, a * a, b * b, a * b], dim=1)).chunk(5, dim=1)
    covariance = 2 * (ab - mean_a * mean_b) + _C2
    variance = (aa - mean_a**2) + (bb - mean_b**2) + _C2
    means = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    return (means * covariance / variance).mean()


def kl_to_normal(posterior: Posterior) -> Tensor:
    """Kullback-Leibler divergence to the standard normal, mean over elements.

    Source: Kingma and Welling 2014, appendix B.
    """
    log_variance = posterior.log_variance
    return 0.5 * (posterior.mean**2 + log_variance.exp() - 1 - log_variance).mean()


def _energy(x: Tensor) -> Tensor:
    across = x[..., :-1, 1:] - x[..., :-1, :-1]
    down = x[..., 1:, :-1] - x[..., :-1, :-1]
    return F.avg_pool2d((across**2 + down**2 + _FLAT).sqrt(), _CELL)


def _smoothed(x: Tensor) -> Tensor:
    offsets = torch.arange(_WINDOW, device=x.device, dtype=x.dtype) - _WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * _WINDOW_SIGMA**2))
    window = window / window.sum()
    channels = x.shape[1]
    rows = F.conv2d(x, window.view(1, 1, 1, -1).expand(channels, 1, 1, -1), groups=channels)
    return F.conv2d(rows, window.view(1, 1, -1, 1).expand(channels, 1, -1, 1), groups=channels)
