"""A class map beside the picture, read off the U-Net's last features. Ours, not the paper's.

One network, one evaluation: the features that become a clean picture also say what stands where. A model that paints
its picture in class colours instead has no head: its map is read off the colours.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.config import ClassHeadConfig, SemanticClass
from gcd_model.frugal import silu

__all__ = ["ClassHead", "ClassHeadConfig", "SemanticClass", "class_map", "nearest_classes", "palette"]


class ClassHead(nn.Module):
    """Features of the U-Net to class logits on a finer grid."""

    def __init__(self, config: ClassHeadConfig, in_channels: int) -> None:
        super().__init__()
        width, groups = config.width, config.norm_groups
        self.upscale = config.upscale
        self.norm_in = nn.GroupNorm(groups, in_channels)
        self.conv_in = nn.Conv2d(in_channels, width, 3, padding=1)
        self.norm_out = nn.GroupNorm(groups, width)
        self.conv_out = nn.Conv2d(width, width, 3, padding=1)
        self.logits = nn.Conv2d(width, len(config.classes) * config.upscale**2, 1)

    def forward(self, features: Tensor) -> Tensor:
        """features: [N, C, h, w], from `VideoUNet.features` -> logits [N, K, h * upscale, w * upscale]."""
        x = self.conv_in(silu(self.norm_in(features)))
        x = self.conv_out(silu(self.norm_out(x)))
        return F.pixel_shuffle(self.logits(silu(x)), self.upscale)


def class_map(logits: Tensor, height: int, width: int) -> Tensor:
    """The likeliest class of each pixel: logits [N, K, h, w] -> uint8 [N, height, width]."""
    full = F.interpolate(logits.float(), size=(height, width), mode="bilinear", align_corners=False)
    return full.max(dim=1).indices.to(torch.uint8)  # several times faster than argmax across the stride


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
