"""How near views are to what the camera would have seen, as numbers.

Pictures are float [T, 3, H, W] in [0, 1]; class maps are uint8 [..., H, W], each value a class's id.
"""

import torch
import torch.nn.functional as F
from kornia.filters import spatial_gradient
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor

from gcd_model.errors import ShapeError

_SMALLEST_ERROR = 1e-10  # equal pictures score 100 dB, so that means stay finite
_SSIM_WINDOW = 11


def psnr(views: Tensor, targets: Tensor) -> Tensor:
    """Peak signal-to-noise ratio of each frame over all its pixels and colours, dB: [T]. Equal frames score 100."""
    _require_same_shape(views, targets)
    error = ((views - targets) ** 2).mean(dim=(1, 2, 3))
    return -10.0 * torch.log10(error.clamp(min=_SMALLEST_ERROR))


def ssim(views: Tensor, targets: Tensor) -> Tensor:
    """Structural similarity of each frame, mean over colours: [T], at most 1.

    Source: Wang et al. 2004: a Gaussian window of 11 x 11 pixels with standard deviation 1.5, K1 = 0.01, K2 = 0.03,
    population variances, only windows that lie wholly in the picture; as kornia computes it.
    Raises:
        ShapeError: shapes differ, or a picture is smaller than the window.
    """
    _require_same_shape(views, targets)
    if min(views.shape[-2:]) < _SSIM_WINDOW:
        raise ShapeError(f"SSIM wants pictures of at least {_SSIM_WINDOW} pixels a side, got {list(views.shape[-2:])}")
    return kornia_ssim(views, targets, _SSIM_WINDOW, padding="valid").mean(dim=(1, 2, 3))


def gradient_magnitude(pictures: Tensor) -> Tensor:
    """Mean length of the Sobel gradient of each frame, colours apart, in brightness per pixel: [T].

    A view's over its target's is the gradient energy: 1 is as sharp as the target, below is blurred, above is noisy.
    """
    gradient = spatial_gradient(pictures, mode="sobel", order=1, normalized=True)  # [T, 3, 2, H, W]
    across, down = gradient.unbind(dim=2)
    return torch.hypot(across, down).mean(dim=(1, 2, 3))  # a norm over two of five dimensions takes ten times as long


def frame_change(pictures: Tensor) -> Tensor:
    """Mean absolute difference between each frame and the next: [T-1].

    A view's over its target's is the flicker: above 1 the view changes more than the scene does.
    """
    return (pictures[1:] - pictures[:-1]).abs().mean(dim=(1, 2, 3))


def majority_classes(classes: Tensor, height: int, width: int, count: int) -> Tensor:
    """Class maps at a coarser grid: the commonest class of each cell, the lowest id where two are as common.

    Args:
        classes: uint8 [..., H, W], ids below `count`. height, width: of the grid; they divide H and W.
    Returns:
        uint8 [..., height, width].
    """
    *leading, rows, columns = classes.shape
    if rows % height or columns % width:
        raise ShapeError(f"a grid must divide the class map: wanted {height}x{width} from {rows}x{columns}")
    flat = classes.reshape(-1, rows, columns)
    cell = (rows // height, columns // width)
    shares = [F.avg_pool2d((flat == label).float(), cell) for label in range(count)]
    return torch.stack(shares).argmax(dim=0).to(torch.uint8).reshape(*leading, height, width)


def confusion_matrix(predicted: Tensor, target: Tensor, count: int) -> Tensor:
    """Pixels of each target class (rows) by predicted class (columns): int64 [count, count].

    Matrices of several pictures add up. Raises ShapeError where shapes differ or an id is `count` or more.
    """
    _require_same_shape(predicted, target)
    if predicted.numel() and int(torch.maximum(predicted.max(), target.max())) >= count:
        raise ShapeError(f"class ids must be below {count}; are the two ontologies the same?")
    pairs = target.long().flatten() * count + predicted.long().flatten()
    return torch.bincount(pairs, minlength=count * count).view(count, count)


def class_iou(confusion: Tensor) -> Tensor:
    """Intersection over union of each class, float64 [K]; NaN for one that is neither predicted nor there."""
    both = confusion.diagonal().double()
    return both / (confusion.sum(dim=0) + confusion.sum(dim=1) - both)


def mean_iou(confusion: Tensor) -> float:
    """Mean over the classes that are predicted or there; NaN if none is."""
    return float(class_iou(confusion).nanmean())


def pixel_accuracy(confusion: Tensor) -> float:
    """Share of pixels whose class is right; NaN for no pixels."""
    return float(confusion.diagonal().sum().double() / confusion.sum())


def _require_same_shape(first: Tensor, second: Tensor) -> None:
    if first.shape != second.shape:
        raise ShapeError(f"view and target must have one shape, got {list(first.shape)} and {list(second.shape)}")
