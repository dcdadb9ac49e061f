"""Structural similarity as scikit-image defines it by default, which is what results in print are measured with.

Source: Wang et al. 2004, Eq. 13, with K1 = 0.01, K2 = 0.03 and a data range of 1, but with windows of 7 x 7 pixels of
equal weight and sample covariances (N - 1); the outer 3 pixels, where no whole window fits, are left out. Differences
of nearly equal squares are taken, so the work is done in float64.
"""

import torch
from torch import Tensor

from gcd_model.errors import ShapeError
from gcd_train.metrics.pictures import masked_mean
from gcd_train.metrics.shapes import require_same_shape

_WINDOW = 7
_BORDER = _WINDOW // 2
_PIXELS = _WINDOW**2
_SAMPLE = _PIXELS / (_PIXELS - 1)
_C1, _C2 = 0.01**2, 0.03**2


def ssim(views: Tensor, targets: Tensor) -> Tensor:
    """Structural similarity of each frame, mean over pixels and colours: [T], at most 1.

    Raises:
        ShapeError: shapes differ, or a picture is smaller than the window of 7 pixels.
    """
    return ssim_map(views, targets).mean(dim=(1, 2)).to(views.dtype)


def masked_ssim(views: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    """Structural similarity of each frame over the pixels of a mask that lie well inside it: [T]; NaN for none.

    Args:
        mask: bool [T, H, W]; see `window_mask` for what is left of it.
    Raises:
        ShapeError: as in `ssim`.
    """
    return masked_mean(ssim_map(views, targets), window_mask(mask)).to(views.dtype)


def ssim_map(views: Tensor, targets: Tensor) -> Tensor:
    """Structural similarity around each pixel that has a whole window, mean over colours: float64 [T, H-6, W-6].

    Raises:
        ShapeError: as in `ssim`.
    """
    require_same_shape(views, targets)
    if min(views.shape[-2:]) < _WINDOW:
        raise ShapeError(f"SSIM wants pictures of at least {_WINDOW} pixels a side, got {list(views.shape[-2:])}")
    return torch.stack([_likeness(*both) for both in zip(views.double(), targets.double(), strict=True)])


def window_mask(mask: Tensor) -> Tensor:
    """The pixels of `ssim_map` that count for a mask: bool [T, H, W] -> [T, H-6, W-6].

    The mask is eroded three times by a cross, so that windows lie mostly inside it.
    """
    for _ in range(_BORDER):
        middle, beside = mask[..., 1:-1, 1:-1], mask[..., 1:-1, :-2] & mask[..., 1:-1, 2:]
        mask = middle & beside & mask[..., :-2, 1:-1] & mask[..., 2:, 1:-1]
    return mask


def _likeness(view: Tensor, target: Tensor) -> Tensor:
    """`ssim_map` of one frame, [3, H, W] each; of a whole clip at once it takes half as long again."""
    mean_a, mean_b = _window_mean(view), _window_mean(target)
    both = mean_a * mean_b
    squares = mean_a**2 + mean_b**2
    covariance = _SAMPLE * (_window_mean(view * target) - both)
    variances = _SAMPLE * (_window_mean(view * view + target * target) - squares)
    likeness = (2 * both + _C1) * (2 * covariance + _C2) / ((squares + _C1) * (variances + _C2))
    return likeness.mean(dim=0)


def _window_mean(values: Tensor) -> Tensor:
    """Mean of each whole window: [C, H, W] -> [C, H-6, W-6]."""
    return _window_sum(_window_sum(values, -1), -2) / _PIXELS


def _window_sum(values: Tensor, axis: int) -> Tensor:
    """Sums of seven neighbours along an axis, as 4 + 2 + 1: half the additions of one after the other."""
    long = values.shape[axis]
    pairs = values.narrow(axis, 0, long - 1) + values.narrow(axis, 1, long - 1)
    fours = pairs.narrow(axis, 0, long - 3) + pairs.narrow(axis, 2, long - 3)
    count = long - _WINDOW + 1
    return fours.narrow(axis, 0, count) + pairs.narrow(axis, 4, count) + values.narrow(axis, 6, count)
