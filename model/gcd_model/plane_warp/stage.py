"""Planes about the point that orbiting cameras look at: ground, infinity, upright planes through and near the centre.

The stage's frame stands on the ground below that point, with z up and x away from the source camera, whose azimuth is 0
by convention. Upright planes face half-way between source and target camera, so that both see them as squarely as can
be; what lies below one is the ground. A new path comes with every window of an orbit, so this is made for speed: a
plane maps one picture to the other by a homography, in float32 (a pixel's place is right to a thousandth of a pixel).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.config import PlaneWarpConfig
from gcd_model.geometry import LOOK_AT, CameraMount, Spherical
from gcd_model.plane_warp.grids import NEAREST_M, Grids, described, pinhole_axes

_IN_PLANE_M = 1e-6  # a camera this near to a plane sees its edge, which is nothing
_INFINITY = 1


def orbit_mount(config: PlaneWarpConfig, source: Spherical) -> CameraMount:
    """The source camera of an orbit in the stage's frame: it looks at the centre from its elevation and radius.

    Raises OptionError: it stands below the ground, or looks straight down.
    """
    elevation = math.radians(source.elevation_deg)
    return CameraMount(
        height_m=LOOK_AT[2] + source.radius_m * math.sin(elevation),
        forward_m=-source.radius_m * math.cos(elevation),
        tilt_deg=source.elevation_deg,
        hfov_deg=config.hfov_deg,
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class StagePlanes:
    """See `Planes`; the frame is the stage's.

    mount: of the source camera, see `orbit_mount`. source_from_target: [T, 4, 4], metres.
    azimuth_deg: [T], of the target cameras, source 0; None reads it off the poses, which cannot tell 180 from -180.
    """

    config: PlaneWarpConfig
    mount: CameraMount
    source_from_target: Tensor
    azimuth_deg: Tensor | None = None

    def grids(self, height: int, width: int, layers: Sequence[int]) -> Grids:
        """See `Planes`.

        With x = R d + t q the point met, seen from the source and scaled by q: d the target pixel's ray, R and t the
        target camera seen from the source, q the reciprocal of the multiple of d at which it meets the plane.
        """
        turn, shift = self._into_source(height / width)
        rows = self._rows()
        own, ground, met = (self._affine(each, height, width) for each in (turn, rows[:, :1], rows[:, list(layers)]))
        grid, valid = met.new_empty(*met.shape, 2), torch.empty_like(met, dtype=torch.bool)
        everywhere = torch.tensor([number == _INFINITY for number in layers])[:, None, None]
        for t in range(len(met)):  # frame by frame: what is worked on then stays in the processor's cache
            near = torch.maximum(met[t], ground[t])  # [L, H, W]
            x, y, z = (torch.add(own[t, i], near, alpha=shift[t][i]) for i in range(3))
            seen = z > NEAREST_M * near
            depth = torch.where(seen, z, torch.inf)
            grid[t, ..., 0], grid[t, ..., 1] = x.div_(depth), y.div_(depth)
            valid[t] = (torch.maximum(x.abs(), y.abs()) <= 1) & seen & ((near > 0) | everywhere)
        return Grids(grid=grid.clamp_(-2.0, 2.0), valid=valid)

    def rays(self, height: int, width: int) -> Tensor:
        """See `Planes`."""
        nearness = self._affine(self._rows()[:, :1], height, width)[:, 0]  # [T, H, W]
        ground = torch.where(nearness > 0, 1 / nearness, torch.inf)
        return described(self._affine(self._stage_from_target()[:, :3, :3], height, width), ground)

    def _stage_from_target(self) -> Tensor:
        return self.mount.vehicle_from_camera @ self.source_from_target.to("cpu", torch.float64)

    def _into_source(self, aspect: float) -> tuple[Tensor, list[list[float]]]:
        """R [T, 3, 3] and t, T times 3 numbers, scaled so that x / z and y / z are -1 and 1 at the picture's edges."""
        slope = math.tan(math.radians(self.mount.hfov_deg) / 2)
        pose = self.source_from_target.to("cpu", torch.float64)
        scale = pose.new_tensor([1 / slope, 1 / (slope * aspect), 1.0])
        return pose[:, :3, :3] * scale[:, None], (pose[:, :3, 3] * scale).tolist()

    def _rows(self) -> Tensor:
        """All layers as rows w [T, L, 3], in the target camera's axes: q = w . d; 0 for infinity."""
        pose = self._stage_from_target()
        turn, position = pose[:, :3, :3], pose[:, :3, 3]
        facing = self._facing(position)  # [T, 3]
        up = facing.new_tensor([0.0, 0.0, 1.0]).expand_as(facing)
        rows = [_reciprocal(up, 0.0, turn, position), torch.zeros_like(facing)]
        rows += [_reciprocal(facing, offset, turn, position) for offset in self.config.offsets_m]
        return torch.stack(rows, dim=1)

    def _facing(self, position: Tensor) -> Tensor:
        """The level direction away from the cameras, half-way between the two: [T, 3]. position: [T, 3]."""
        if self.azimuth_deg is None:
            azimuth = torch.atan2(-position[:, 1], -position[:, 0])
        else:
            azimuth = torch.deg2rad(self.azimuth_deg.to("cpu", torch.float64))
        return torch.stack([(azimuth / 2).cos(), (azimuth / 2).sin(), torch.zeros_like(azimuth)], dim=-1)

    def _affine(self, rows: Tensor, height: int, width: int) -> Tensor:
        """Rows [T, N, 3] times the rays (x, y, 1) of the target's pixels: float32 [T, N, H, W]."""
        x, y = pinhole_axes(math.tan(math.radians(self.config.hfov_deg) / 2), height, width)
        across = (rows[..., :1] * x).float()  # [T, N, W]
        along = (rows[..., 1:2] * y + rows[..., 2:]).float()  # [T, N, H]
        return along[..., :, None] + across[..., None, :]


def _reciprocal(normal: Tensor, offset: float, turn: Tensor, position: Tensor) -> Tensor:
    """One plane `normal . p = offset` seen from T cameras, [T, 3]; 0 where the camera stands in it."""
    away = offset - (normal * position).sum(dim=-1, keepdim=True)  # [T, 1]
    row = torch.einsum("tji,tj->ti", turn, normal)
    return torch.where(away.abs() > _IN_PLANE_M, row / away, 0.0)
