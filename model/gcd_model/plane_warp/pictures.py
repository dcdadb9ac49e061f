"""What the U-Net is shown of the warps: small pictures of the source, and rays."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

HALF, QUARTER = 2, 4
"""How much smaller than the source its pictures are."""
_LEFT = 1  # among the numbers of a ray


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class WarpPictures:
    """N frames as the U-Net's condition takes them; pictures in [-1, 1], 0 (mid grey) where nothing is known.

    half: [N, 3, H/2, W/2], the source itself. ground: the same size, warped by the ground.
    distant: [N, Q, 3, H/4, W/4], warped by infinity, then by side walls (vehicle) or upright planes (stage).
    rays: [N, 4, h, w] on the latent grid, see `Planes.rays`.
    """

    half: Tensor
    ground: Tensor
    distant: Tensor
    rays: Tensor


def channels_of(pictures: WarpPictures, down_factor: int) -> Tensor:
    """The condition channels [N, C, h, w]; see `config.warp_channels` for C. down_factor: pixels per latent."""
    return torch.cat(
        [
            F.pixel_unshuffle(pictures.half, down_factor // HALF),
            F.pixel_unshuffle(pictures.ground, down_factor // HALF),
            F.pixel_unshuffle(pictures.distant.flatten(1, 2), down_factor // QUARTER),
            pictures.rays,
        ],
        dim=1,
    )


def mirrored(pictures: WarpPictures) -> WarpPictures:
    """The same of the world seen in a mirror: left is right. Exact where the camera stands in the middle."""
    flip = pictures.rays.new_ones(4)
    flip[_LEFT] = -1
    return WarpPictures(
        half=pictures.half.flip(-1),
        ground=pictures.ground.flip(-1),
        distant=pictures.distant.flip(-1),
        rays=pictures.rays.flip(-1) * flip[:, None, None],
    )
