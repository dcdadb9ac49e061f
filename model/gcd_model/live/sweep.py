"""What the camera's own motion tells of depth: how well each depth explains an earlier frame.

For every pixel and every bin of depth the earlier picture is looked up where that point would have been; at the right
depth the colours agree. What moves by itself agrees nowhere, and so does what the earlier frame did not see.
Source: the cost volume of Watson et al. 2021 (ManyDepth), with colours instead of features.
"""

from collections import deque
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_model.live.config import SKY_M, DepthConfig

SWEEP_SCALE = 2
"""Costs are worked out at half the size."""
_FRAMES = 6
"""So many earlier frames are kept."""
LONGEST = 0.3
"""Of the median depth: how far away an earlier camera may have been."""
_CONTRAST, _UNSEEN = 4.0, 1.0
_BEHIND_M = 0.02


@dataclass(frozen=True, kw_only=True, slots=True)
class Reference:
    """An earlier frame of the same camera.

    picture: [3, H, W] in [-1, 1]. reference_from_camera: float64 [4, 4], metres.
    """

    picture: Tensor
    reference_from_camera: Tensor


def sweep_channels(config: DepthConfig) -> int:
    """A cost for every bin, the sky's among them, and whether there is a reference at all."""
    return config.bins + 1


def sweep_costs(picture: Tensor, lens: Intrinsics, reference: Reference | None, config: DepthConfig) -> Tensor:
    """Differences of colour by depth: [bins + 1, H/2, W/2]; all zero without a reference.

    picture: [3, H, W] in [-1, 1].
    """
    height, width = lens.height // SWEEP_SCALE, lens.width // SWEEP_SCALE
    if reference is None:
        return picture.new_zeros(sweep_channels(config), height, width)
    here, there = (F.avg_pool2d(each, SWEEP_SCALE) for each in (picture, reference.picture.to(picture)))
    move = reference.reference_from_camera.to(picture.device)
    turn, step = move[:3, :3].float(), move[:3, 3].float()
    x = ((torch.arange(width, device=picture.device) + 0.5) * SWEEP_SCALE - lens.cx) / lens.fx
    y = ((torch.arange(height, device=picture.device) + 0.5) * SWEEP_SCALE - lens.cy) / lens.fy
    u, v = torch.meshgrid(x.float(), y.float(), indexing="xy")
    turned = turn @ torch.stack([u, v, torch.ones_like(u)]).flatten(1)  # [3, h*w], of points 1 m ahead
    points = turned + step[:, None] * _inverse_depths(config).to(picture.device)[:, None, None]  # [bins, 3, h*w]
    ahead = points[:, 2] > _BEHIND_M
    z = points[:, 2].clamp(min=_BEHIND_M)
    place = torch.stack(
        [
            (points[:, 0] / z * lens.fx + lens.cx) * (2 / lens.width) - 1,
            (points[:, 1] / z * lens.fy + lens.cy) * (2 / lens.height) - 1,
        ],
        dim=-1,
    )  # [bins, h*w, 2]
    inside = ahead & (place.abs() <= 1).all(dim=-1)
    looked_up = F.grid_sample(there[None], place[None], mode="bilinear", padding_mode="border", align_corners=False)
    difference = (looked_up[0] - here.flatten(1)[:, None]).abs().mean(dim=0) * _CONTRAST  # [bins, h*w]
    costs = torch.where(inside, difference, _UNSEEN)
    return torch.cat([costs, torch.ones_like(costs[:1])]).view(-1, height, width)


def _inverse_depths(config: DepthConfig) -> Tensor:
    """Of the bins' centres, 1 / m; 0 for the sky: [bins]."""
    steps = (torch.arange(config.bins - 1) + 0.5) / (config.bins - 1)
    return torch.cat([(config.nearest_m / config.farthest_m) ** steps / config.nearest_m, torch.zeros(1)])


class References:
    """The last frames of a camera, of which one is chosen to compare the next one with."""

    def __init__(self) -> None:
        self._frames: deque[tuple[Tensor, Tensor]] = deque(maxlen=_FRAMES)
        self._median_m = 0.0

    def reset(self) -> None:
        """Forget them."""
        self._frames.clear()

    def add(self, picture: Tensor, world_from_camera: Tensor, metres: Tensor) -> None:
        """picture: [3, H, W]. metres: [H, W]; 0 for holes."""
        self._frames.append((picture, world_from_camera))
        near = metres[(metres > 0) & (metres < SKY_M)]
        self._median_m = float(near.median()) if near.numel() else 0.0

    def chosen(self, world_from_camera: Tensor) -> Reference | None:
        """The oldest one from which the scene does not look too different, or None."""
        for picture, pose in self._frames:
            move = invert_rigid(pose) @ world_from_camera
            if float(move[:3, 3].norm()) <= LONGEST * self._median_m:
                return Reference(picture=picture, reference_from_camera=move)
        return None
