"""The diffusion loss, and differences between pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.config import DRIVING_CLASSES
from gcd_model.vae import Posterior
from gcd_train.recipe import ClassWeightsName

_COLOUR_TOLERANCE = 0.02  # mean absolute difference over the channels of a picture in [-1, 1]


@dataclass(frozen=True, kw_only=True, slots=True)
class FocalBlend:
    """How the focal selection is mixed with what it leaves out.

    hardest: how much the mean of the hardest elements counts; the mean of all counts the rest.
    bias_before: share of the class weights that acts before the selection; the rest acts on all elements after it.
    """

    hardest: float
    bias_before: float


RELEASED_BLEND = FocalBlend(hardest=0.9, bias_before=0.5)
"""As the released model was trained: 0.9 of the hardest and 0.1 of all, class weights half before and half after."""
PLAIN_BLEND = FocalBlend(hardest=1.0, bias_before=1.0)
"""As the paper describes it: the mean of the hardest elements of the class-weighted error, and nothing else."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClassWeight:
    """Elements of a class count this much more. colour: 8-bit RGB of the class in a semantic picture."""

    colour: tuple[int, int, int]
    weight: float


def _weights(weight: float, *colours: tuple[int, int, int]) -> tuple[ClassWeight, ...]:
    return tuple(ClassWeight(colour=colour, weight=weight) for colour in colours)


PARALLEL_DOMAIN_WEIGHTS: tuple[ClassWeight, ...] = (
    *_weights(7.0, (220, 20, 180), (64, 64, 64), (128, 128, 128), (192, 192, 192), (220, 20, 60)),
    *_weights(3.0, (0, 60, 100), (0, 0, 142), (0, 0, 90), (32, 32, 32), (119, 11, 32), (0, 0, 230)),
    *_weights(3.0, (128, 230, 128), (0, 0, 70), (0, 64, 64)),
)
"""ParallelDomain-4D, semantic pictures: living beings and riders first, then vehicles; trains are left out."""

_PERSONS, _VEHICLES = ("person", "cyclist"), ("car", "truck", "own_car")
DRIVING_WEIGHTS: tuple[ClassWeight, ...] = (
    *_weights(7.0, *(kind.colour for kind in DRIVING_CLASSES if kind.name in _PERSONS)),
    *_weights(3.0, *(kind.colour for kind in DRIVING_CLASSES if kind.name in _VEHICLES)),
)
"""The same weights by name for the classes of our driving world."""

COLOUR_WEIGHTS: dict[ClassWeightsName, tuple[ClassWeight, ...]] = {
    "none": (),
    "parallel-domain": PARALLEL_DOMAIN_WEIGHTS,
    "driving": DRIVING_WEIGHTS,
}
"""By what a recipe calls them."""


def edm_weight(sigma: Tensor, limit: float | None = None) -> Tensor:
    """Weight of a noise level, (s^2 + 1) / s^2, at most `limit`: any shape to the same.

    Source: Karras et al. 2022, table 1, sigma_data 1. With a limit: Hang et al. 2023, min-SNR, in terms of x0.
    """
    weight = (sigma**2 + 1) / sigma**2
    return weight if limit is None else weight.clamp(max=limit)


def focal_fraction(step: int, *, final: float = 0.1, steps: int = 5000) -> float:
    """Share of a frame's elements that the focal loss keeps: from 1 at step 0 to `final`, linear over `steps`.

    step: updates of the optimiser so far.
    """
    done = min(max(step / steps, 0.0), 1.0)
    return (1 - done) + final * done


def focal_mean(values: Tensor, fraction: float, hardest: float = RELEASED_BLEND.hardest) -> Tensor:
    """Per frame, `hardest` times the mean of the largest elements, the mean of all for the rest: [N, ...] -> [N].

    The elements are those of one frame, channels included; floor(n * fraction) of n are kept. A fraction of 1 or
    more gives the plain mean.
    """
    rows = values.flatten(1)
    if fraction >= 1:
        return rows.mean(1)
    kept = max(int(rows.shape[1] * fraction), 1)
    largest = rows.topk(kept, dim=1, sorted=False).values
    return hardest * largest.mean(1) + (1 - hardest) * rows.mean(1)


def class_emphasis(pictures: Tensor, weights: Sequence[ClassWeight], size: tuple[int, int]) -> Tensor:
    """How much more each latent element counts: sum over classes of mask * (weight - 1), [N, 1, h, w].

    Args:
        pictures: [N, 3, H, W], semantic pictures in [-1, 1]; a class is where its colour is.
        size: (h, w) of the latents; masks are averaged over areas, so an element may belong to a class partly.
    """
    emphasis = torch.zeros_like(pictures[:, :1])
    for weight in weights:
        colour = pictures.new_tensor(weight.colour)[:, None, None] / 127.5 - 1
        mask = (pictures - colour).abs().mean(1, keepdim=True) < _COLOUR_TOLERANCE
        emphasis = emphasis + mask * (weight.weight - 1)
    return F.interpolate(emphasis, size=size, mode="area")


def frame_losses(
    denoised: Tensor,
    target: Tensor,
    *,
    fraction: float,
    emphasis: Tensor | None = None,
    channel_weights: Tensor | None = None,
    blend: FocalBlend = RELEASED_BLEND,
) -> Tensor:
    """Squared error of each frame before the weight of its noise level: [N].

        all = raw + b bias;  loss = focal(all) + (1 - b) mean(bias);  bias = raw * emphasis;  b = blend.bias_before

    Args:
        denoised, target: [N, C, h, w]. fraction, blend: see `focal_mean`.
        emphasis: [N, 1, h, w] of `class_emphasis`.
        channel_weights: [C], multiplies the squared error (ours, for latents whose channels matter unequally).
    """
    raw = (denoised - target) ** 2
    if channel_weights is not None:
        raw = raw * channel_weights[:, None, None]
    if emphasis is None:
        return focal_mean(raw, fraction, blend.hardest)
    bias = raw * emphasis
    chosen = focal_mean(raw + blend.bias_before * bias, fraction, blend.hardest)
    return chosen + (1 - blend.bias_before) * bias.flatten(1).mean(1)


_C1, _C2 = 0.01**2, 0.03**2
_WINDOW, _WINDOW_SIGMA = 7, 1.5


def gradient_l1(pictures: Tensor, targets: Tensor) -> Tensor:
    """Mean absolute difference of horizontal and vertical pixel differences, [N, C, H, W] each -> scalar."""
    difference = pictures - targets
    across = (difference[..., 1:] - difference[..., :-1]).abs().mean()
    down = (difference[..., 1:, :] - difference[..., :-1, :]).abs().mean()
    return across + down


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


def _smoothed(x: Tensor) -> Tensor:
    offsets = torch.arange(_WINDOW, device=x.device, dtype=x.dtype) - _WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * _WINDOW_SIGMA**2))
    window = window / window.sum()
    channels = x.shape[1]
    rows = F.conv2d(x, window.view(1, 1, 1, -1).expand(channels, 1, 1, -1), groups=channels)
    return F.conv2d(rows, window.view(1, 1, -1, 1).expand(channels, 1, -1, 1), groups=channels)
