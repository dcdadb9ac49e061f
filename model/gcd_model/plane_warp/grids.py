"""Where target pixels lie in the source picture, and the warp itself."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.frugal import frugal

NEAREST_M = 0.1
"""What lies nearer to the source camera than this, along its axis, is not seen by it."""
_NEUTRAL_M, _DECADES = 10.0, 1.0  # ground distance as log10(distance / 10 m), clipped to +-1


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Grids:
    """Where the pixels of T target pictures lie in the source picture, layer by layer.

    grid: float32 [T, L, H, W, 2], x and y in [-1, 1] from edge to edge (`grid_sample` without aligned corners).
    valid: bool [T, L, H, W]: the point lies in front of both cameras and inside the source picture.
    """

    grid: Tensor
    valid: Tensor

    def frames(self, numbers: Tensor) -> Self:
        """Some rows; numbers: integers [N]."""
        return replace(self, grid=self.grid[numbers], valid=self.valid[numbers])

    def to(self, device: torch.device | str) -> Self:
        """The same on a device."""
        return replace(self, grid=self.grid.to(device), valid=self.valid.to(device))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlaneWarps:
    """Grids of all layers, and the rays of the same pixels.

    grid, valid: as `Grids`. rays: float32 [T, 4, H, W], see `Planes.rays`.
    """

    grid: Tensor
    valid: Tensor
    rays: Tensor


class Planes(Protocol):
    """A world of planes with T target cameras and a source camera in it."""

    def grids(self, height: int, width: int, layers: Sequence[int]) -> Grids:
        """Some layers, for target pictures of height x width pixels; the source has the same shape at any size."""
        ...

    def rays(self, height: int, width: int) -> Tensor:
        """float32 [T, 4, H, W]: the unit ray of the target pixel in the planes' frame, and log10 of the distance to
        the ground over 10 m, clipped to [-1, 1] (1 above the horizon)."""
        ...


def pinhole_axes(slope: float, height: int, width: int) -> tuple[Tensor, Tensor]:
    """x [W] and y [H] of a centred pinhole's rays in its own axes, where z = 1; float64.

    slope: half the width over the focal length.
    """
    x = (torch.arange(width, dtype=torch.float64) + 0.5) * 2 / width - 1
    y = (torch.arange(height, dtype=torch.float64) + 0.5) * 2 / height - 1
    return x * slope, y * slope * height / width


def described(rays: Tensor, ground: Tensor) -> Tensor:
    """What `Planes.rays` gives. rays: [T, 3, H, W]; ground: [T, H, W], multiples at which they meet the ground."""
    length = torch.linalg.vector_norm(rays, dim=1)  # [T, H, W]
    decades = torch.log10(ground * length / _NEUTRAL_M).clamp(-_DECADES, _DECADES)
    return torch.cat([rays / length[:, None], decades[:, None]], dim=1).float()


def warp(source: Tensor, grids: Tensor, valid: Tensor) -> Tensor:
    """The source picture by several layers: [N, 3, H, W] -> [N, L, 3, H', W'], 0 (mid grey) where not valid.

    Args:
        source: in [-1, 1]. grids: [N, L, H', W', 2]. valid: [N, L, H', W'].
    """
    rows = grids.flatten(1, 2)  # [N, L*H', W', 2]: one call for all layers
    sampled = F.grid_sample(source.to(grids.dtype), rows, padding_mode="border", align_corners=False)
    layers = sampled.unflatten(2, grids.shape[1:3]).transpose(1, 2)
    return layers.mul_(valid[:, :, None]) if frugal(layers) else layers * valid[:, :, None]
