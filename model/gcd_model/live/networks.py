"""The live model's weights in one module, and what a visibility is."""

import torch
from torch import Tensor, nn

from gcd_model.live.config import LiveConfig
from gcd_model.live.depth_net import DepthNet
from gcd_model.live.familiarity import Familiarity
from gcd_model.live.paint_net import PaintNet

PAINTED, SEEN_BEFORE, SEEN_NOW = 0, 1, 2
"""Visibility of a pixel."""
COVERED = 0.5
"""A pixel that points cover by less than this share counts as painted, whatever the network says."""
_MOVABLE = ("car", "truck", "cyclist", "person", "own_car", "robot", "object")


def movable_classes(config: LiveConfig) -> Tensor:
    """Classes of which nothing that was painted is carried to the next frame: nobody knows where it goes. bool [K]."""
    return torch.tensor([entry.name in _MOVABLE for entry in config.classes])


class LiveNetworks(nn.Module):
    """All weights of the live model."""

    def __init__(self, config: LiveConfig) -> None:
        super().__init__()
        self.config = config
        self.depth = DepthNet(config.depth, len(config.classes))
        self.paint = PaintNet(config.paint, len(config.classes))
        self.familiarity = Familiarity(config.depth.widths[0])
