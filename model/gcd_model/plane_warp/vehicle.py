"""Planes of a road as a vehicle sees it: ground, infinity, pairs of side walls, front walls.

What lies below a wall is the ground. In float64 throughout: shipped weights were trained on exactly these numbers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.config import PlaneWarpConfig
from gcd_model.geometry import CameraMount
from gcd_model.plane_warp.grids import NEAREST_M, Grids, described, pinhole_axes

_INFINITY_M = 1e5


def trained_mount(config: PlaneWarpConfig) -> CameraMount:
    """The mount the network was trained with."""
    forward_m, left_m, height_m = config.position
    return CameraMount(height_m=height_m, forward_m=forward_m, left_m=left_m, hfov_deg=config.hfov_deg)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class VehiclePlanes:
    """See `Planes`; the frame is the vehicle's.

    mount: of the source camera. source_from_target: [T, 4, 4], metres.
    """

    config: PlaneWarpConfig
    mount: CameraMount
    source_from_target: Tensor

    def grids(self, height: int, width: int, layers: Sequence[int]) -> Grids:
        """See `Planes`."""
        start, rays = self._lines(height, width)
        reach = self._reach(start, rays, layers)  # [T, L, H, W]
        grid, ahead = _into_source(self.mount, start, rays, reach, height / width)
        valid = reach.isfinite() & ahead & (grid.abs() <= 1).all(dim=-1)
        return Grids(grid=grid.nan_to_num(nan=-2.0).clamp(-2.0, 2.0).float(), valid=valid)

    def rays(self, height: int, width: int) -> Tensor:
        """See `Planes`."""
        start, rays = self._lines(height, width)
        return described(rays, _meeting(0.0, start, rays, axis=2))

    def _lines(self, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Where the target cameras stand, [T, 3], and the rays of their pixels, [T, 3, H, W]; vehicle's frame."""
        pose = self.mount.vehicle_from_camera @ self.source_from_target.to("cpu", torch.float64)
        x, y = pinhole_axes(math.tan(math.radians(self.config.hfov_deg) / 2), height, width)
        down, right = torch.meshgrid(y, x, indexing="ij")
        own = torch.stack([right, down, torch.ones_like(right)])
        return pose[:, :3, 3], torch.einsum("tij,jhw->tihw", pose[:, :3, :3], own)

    def _reach(self, start: Tensor, rays: Tensor, layers: Sequence[int]) -> Tensor:
        """Multiples of the ray at which it meets each layer: [T, L, H, W]; infinite where it never does."""
        ground = _meeting(0.0, start, rays, axis=2)
        found = [self._upright(number, start, rays) if number else ground for number in layers]
        return torch.stack([torch.minimum(each, ground) for each in found], dim=1)

    def _upright(self, number: int, start: Tensor, rays: Tensor) -> Tensor:
        """The same for infinity or a wall alone, [T, H, W]."""
        sides = self.config.side_walls_m
        if number == 1:
            return torch.full_like(rays[:, 0], _INFINITY_M)
        if number < 2 + len(sides):
            distance = sides[number - 2]
            return torch.minimum(*(_meeting(y, start, rays, axis=1) for y in (distance, -distance)))
        return _meeting(self.config.front_walls_m[number - 2 - len(sides)], start, rays, axis=0)


def _meeting(at: float, start: Tensor, rays: Tensor, *, axis: int) -> Tensor:
    """Positive multiple of the ray at which a coordinate is `at`, [T, H, W]; infinite where it never is."""
    multiple = (at - start[:, axis, None, None]) / rays[:, axis]
    return torch.where(multiple > 0, multiple, torch.inf)


def _into_source(
    mount: CameraMount, start: Tensor, rays: Tensor, reach: Tensor, aspect: float
) -> tuple[Tensor, Tensor]:
    """Source picture coordinates [T, L, H, W, 2] of the points met, and whether they lie ahead [T, L, H, W]."""
    turn = mount.vehicle_from_camera[:3, :3].T  # camera from vehicle
    origin = (start - mount.vehicle_from_camera[:3, 3]) @ turn.T  # [T, 3], the target camera seen from the source
    across, below, ahead = torch.einsum("ij,tjhw->ithw", turn, rays)
    slope = math.tan(math.radians(mount.hfov_deg) / 2)
    x, y, z = (
        origin[:, axis, None, None, None] + reach * part[:, None] for axis, part in enumerate((across, below, ahead))
    )
    return torch.stack([x / (z * slope), y / (z * slope * aspect)], dim=-1), z > NEAREST_M
