"""Brightness compared pixel by pixel: PSNR, spread over draws, sharpness and flicker."""

import torch
from kornia.filters import spatial_gradient
from torch import Tensor

from gcd_model.errors import ShapeError
from gcd_train.metrics.shapes import require_mask, require_same_shape

_SMALLEST_ERROR = 1e-10  # equal pictures score 100 dB, so that means stay finite


def psnr(views: Tensor, targets: Tensor) -> Tensor:
    """Peak signal-to-noise ratio of each frame over all its pixels and colours, dB: [T]. Equal frames score 100."""
    require_same_shape(views, targets)
    return _to_db(((views - targets) ** 2).mean(dim=(1, 2, 3)))


def masked_psnr(views: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    """`psnr` with the squared error averaged over the pixels of a mask and all colours, dB: [T]; NaN where it is empty.

    Args:
        mask: bool [T, H, W].
    """
    require_same_shape(views, targets)
    return _to_db(masked_mean(((views - targets) ** 2).mean(dim=1), mask))


def diversity(draws: Tensor, mask: Tensor | None = None) -> Tensor:
    """How far apart several draws of one view are: population standard deviation over draws, mean over the frame: [T].

    Args:
        draws: [S, T, 3, H, W]. mask: bool [T, H, W], the pixels that count; NaN where it is empty. None for all.
    Raises:
        ShapeError: there are fewer than two draws.
    """
    if draws.ndim != 5 or len(draws) < 2:
        raise ShapeError(f"diversity wants two draws or more, [S, T, 3, H, W], got {list(draws.shape)}")
    spread = draws.std(dim=0, correction=0).mean(dim=1)  # [T, H, W]
    return spread.mean(dim=(1, 2)) if mask is None else masked_mean(spread, mask)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean over a mask's pixels of each frame: values and mask [T, H, W] -> [T]; NaN where the mask is empty."""
    require_mask(mask, *values.shape)
    return torch.where(mask, values, 0.0).sum(dim=(1, 2)) / mask.sum(dim=(1, 2))


def gradient_magnitude(pictures: Tensor) -> Tensor:
    """Mean of `gradient_map` over each frame: [T].

    A view's over its target's is the gradient energy: 1 is as sharp as the target, below is blurred, above is noisy.
    """
    return gradient_map(pictures).mean(dim=(1, 2))


def gradient_map(pictures: Tensor) -> Tensor:
    """Length of the Sobel gradient at each pixel, mean over colours, in brightness per pixel: [T, H, W]."""
    gradient = spatial_gradient(pictures, mode="sobel", order=1, normalized=True)  # [T, 3, 2, H, W]
    across, down = gradient.unbind(dim=2)
    return torch.hypot(across, down).mean(dim=1)  # a norm over two of five dimensions takes ten times as long


def frame_change(pictures: Tensor) -> Tensor:
    """Mean absolute difference between each frame and the next: [T-1].

    A view's over its target's is the flicker: above 1 the view changes more than the scene does.
    """
    return (pictures[1:] - pictures[:-1]).abs().mean(dim=(1, 2, 3))


def _to_db(error: Tensor) -> Tensor:
    """Mean squared error of pictures in [0, 1] as a signal-to-noise ratio; NaN stays NaN."""
    return -10.0 * torch.log10(error.clamp(min=_SMALLEST_ERROR))
