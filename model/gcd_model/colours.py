"""What stands where, in colour: class maps, and pixels that nobody saw."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.config import SemanticClass

_PERIOD, _WIDTH, _AMBER = 6, 2, (245, 158, 11)


def palette(classes: tuple[SemanticClass, ...]) -> Tensor:
    """Colours by class id: uint8 [K, 3], RGB; `palette(classes)[class_map.long()]` paints a map."""
    return torch.tensor([entry.colour for entry in classes], dtype=torch.uint8)


def nearest_classes(pixels: Tensor, classes: tuple[SemanticClass, ...]) -> Tensor:
    """The class whose colour is nearest to each pixel; of equally near ones the first.

    Args:
        pixels: [T, 3, H, W], RGB in [0, 1].
    Returns:
        uint8 [T, H, W].
    """
    colours = palette(classes).to(pixels) / 255  # [K, 3]
    half_square = (colours**2).sum(dim=1) / 2
    # |p - c|^2 = |p|^2 - 2 (p . c - |c|^2 / 2): one product a pixel; frame by frame, to stay small
    frames = [torch.addmm(-half_square[:, None], colours, frame.flatten(1)) for frame in pixels]  # [K, H*W] each
    return torch.stack([frame.max(dim=0).indices for frame in frames]).to(torch.uint8).view(-1, *pixels.shape[-2:])


def hatched(pictures: NDArray[np.uint8], visibility: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pictures [..., H, W, 3] with thin amber diagonals over painted pixels; what was seen stays as it is.

    visibility: [..., H, W], 0 for painted.
    """
    rows, columns = np.indices(visibility.shape[-2:])
    lines = ((rows + columns) % _PERIOD < _WIDTH) & (visibility == 0)
    return np.where(lines[..., None], pictures // 2 + np.array(_AMBER, np.uint8) // 2, pictures)
