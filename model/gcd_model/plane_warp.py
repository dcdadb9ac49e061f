"""The source as the target camera would see it if the world were made of known planes. Ours, not the paper's.

A vehicle knows how its camera is mounted, so it knows where in the source picture a point of the ground, of a wall
beside the road or of a wall across it would be. No depth is estimated: each plane gives one layer, and networks choose.
Layers in order: ground, infinity, pairs of side walls, front walls; what lies below a wall is the ground.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.config import PlaneWarpConfig
from gcd_model.errors import ShapeError
from gcd_model.geometry import CameraMount, Trajectory

_NEAREST_M = 0.1  # in front of the source camera, along its axis
_INFINITY_M = 1e5
_NEUTRAL_M, _DECADES = 10.0, 1.0  # ground distance as log10(distance / 10 m), clipped to +-1
_HALF, _QUARTER = 2, 4


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlaneWarps:
    """Where the pixels of T target pictures lie in the source picture, layer by layer.

    grid: float32 [T, L, H, W, 2], x and y in [-1, 1] from edge to edge (`grid_sample` without aligned corners).
    valid: bool [T, L, H, W]: the point lies in front of both cameras and inside the source picture.
    rays: float32 [T, 4, H, W]: the unit ray of the target pixel in the vehicle's frame, and log10 of the distance to
        the ground over 10 m, clipped to [-1, 1] (1 above the horizon).
    """

    grid: Tensor
    valid: Tensor
    rays: Tensor

    def frames(self, numbers: Tensor) -> Self:
        """The rows of these frames; numbers: integers [N]."""
        return replace(self, grid=self.grid[numbers], valid=self.valid[numbers], rays=self.rays[numbers])

    def layers(self, numbers: Sequence[int]) -> Self:
        """Only these layers."""
        chosen = list(numbers)
        return replace(self, grid=self.grid[:, chosen].contiguous(), valid=self.valid[:, chosen].contiguous())

    def to(self, device: torch.device | str) -> Self:
        """The same on a device."""
        return replace(self, grid=self.grid.to(device), valid=self.valid.to(device), rays=self.rays.to(device))


def trained_mount(config: PlaneWarpConfig) -> CameraMount:
    """The mount the network was trained with."""
    forward_m, left_m, height_m = config.position
    return CameraMount(height_m=height_m, forward_m=forward_m, left_m=left_m, hfov_deg=config.hfov_deg)


def plane_warp(
    config: PlaneWarpConfig, mount: CameraMount, source_from_target: Tensor, height: int, width: int
) -> PlaneWarps:
    """Follow every target pixel to the planes and from there into the source picture.

    Args:
        mount: of the source camera. source_from_target: [T, 4, 4], metres.
        height, width: H and W of the target picture in pixels; the source picture has the same shape, at any size.
    """
    vehicle_from_target = mount.vehicle_from_camera @ source_from_target.to("cpu", torch.float64)
    start = vehicle_from_target[:, :3, 3]  # [T, 3]
    slope = math.tan(math.radians(config.hfov_deg) / 2)
    rays = torch.einsum("tij,jhw->tihw", vehicle_from_target[:, :3, :3], _pinhole_rays(slope, height, width))
    reach = _reach(config, start, rays)  # [T, L, H, W]
    grid, ahead = _into_source(mount, start, rays, reach, height / width)
    valid = reach.isfinite() & ahead & (grid.abs() <= 1).all(dim=-1)
    grid = grid.nan_to_num(nan=-2.0).clamp(-2.0, 2.0)
    return PlaneWarps(grid=grid.float(), valid=valid, rays=_described(rays, reach[:, 0]))


def _pinhole_rays(slope: float, height: int, width: int) -> Tensor:
    """Rays of a centred pinhole in its own axes, z = 1: float64 [3, H, W]. slope: half width over focal length."""
    x = (torch.arange(width, dtype=torch.float64) + 0.5) * 2 / width - 1
    y = (torch.arange(height, dtype=torch.float64) + 0.5) * 2 / height - 1
    down, right = torch.meshgrid(y * slope * height / width, x * slope, indexing="ij")
    return torch.stack([right, down, torch.ones_like(right)])


def _reach(config: PlaneWarpConfig, start: Tensor, rays: Tensor) -> Tensor:
    """Multiples of the ray at which it meets each layer: [T, L, H, W]; infinite where it never does."""
    ground = _meeting(0.0, start, rays, axis=2)
    walls = [torch.full_like(ground, _INFINITY_M)]
    for distance in config.side_walls_m:
        walls.append(torch.minimum(*(_meeting(y, start, rays, axis=1) for y in (distance, -distance))))
    walls += [_meeting(x, start, rays, axis=0) for x in config.front_walls_m]
    return torch.stack([ground, *(torch.minimum(wall, ground) for wall in walls)], dim=1)


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
    return torch.stack([x / (z * slope), y / (z * slope * aspect)], dim=-1), z > _NEAREST_M


def _described(rays: Tensor, ground: Tensor) -> Tensor:
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
    return sampled.unflatten(2, grids.shape[1:3]).transpose(1, 2) * valid[:, :, None]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ConditionWarps:
    """Warps at the sizes the condition channels need.

    half: ground. quarter: infinity and side walls. rays: [T, 4, h, w] on the latent grid.
    """

    half: PlaneWarps
    quarter: PlaneWarps
    rays: Tensor

    def frames(self, numbers: Tensor) -> Self:
        """The rows of these frames; numbers: integers [N]."""
        half, quarter = self.half.frames(numbers), self.quarter.frames(numbers)
        return replace(self, half=half, quarter=quarter, rays=self.rays[numbers])

    def to(self, device: torch.device | str) -> Self:
        """The same on a device."""
        return replace(self, half=self.half.to(device), quarter=self.quarter.to(device), rays=self.rays.to(device))


def condition_warps(
    config: PlaneWarpConfig, mount: CameraMount, trajectory: Trajectory, height: int, width: int, down_factor: int
) -> ConditionWarps:
    """Warps for pictures of height x width pixels and latents `down_factor` times coarser. Raises ShapeError."""
    if height % down_factor or width % down_factor or down_factor % _QUARTER:
        raise ShapeError(f"plane warps want sizes in multiples of {down_factor}, got {height}x{width}")

    def at(factor: int) -> PlaneWarps:
        return plane_warp(config, mount, trajectory.source_from_target, height // factor, width // factor)

    sides = range(1, 2 + len(config.side_walls_m))  # infinity first
    return ConditionWarps(half=at(_HALF).layers([0]), quarter=at(_QUARTER).layers(sides), rays=at(down_factor).rays)


def condition_channels(source: Tensor, warps: ConditionWarps) -> Tensor:
    """What the U-Net is told of the planes, [N, C, h, w]; see `config.warp_channels` for C.

    Args:
        source: [N, 3, H, W] in [-1, 1]. warps: one row for each of the N frames.
    """
    half, quarter = F.avg_pool2d(source, _HALF), F.avg_pool2d(source, _QUARTER)
    down_factor = source.shape[-1] // warps.rays.shape[-1]
    ground = warp(half, warps.half.grid, warps.half.valid).flatten(1, 2)
    distant = warp(quarter, warps.quarter.grid, warps.quarter.valid).flatten(1, 2)
    return torch.cat(
        [
            F.pixel_unshuffle(half, down_factor // _HALF),
            F.pixel_unshuffle(ground, down_factor // _HALF),
            F.pixel_unshuffle(distant, down_factor // _QUARTER),
            warps.rays,
        ],
        dim=1,
    )


class PathWarps:
    """All warps along one camera path, computed once; rows are frames of any clips that follow it."""

    def __init__(
        self,
        config: PlaneWarpConfig,
        mount: CameraMount,
        trajectory: Trajectory,
        height: int,
        width: int,
        *,
        down_factor: int = 8,
    ) -> None:
        """height, width: of the pictures, pixels. down_factor: pixels per latent. Raises ShapeError."""
        self._condition = condition_warps(config, mount, trajectory, height, width, down_factor)
        self._full = plane_warp(config, mount, trajectory.source_from_target, height, width)

    @property
    def device(self) -> torch.device:
        """Where the grids lie."""
        return self._full.grid.device

    def to(self, device: torch.device | str) -> Self:
        """Move to a device, in place; returns itself."""
        self._condition, self._full = self._condition.to(device), self._full.to(device)
        return self

    def channels(self, source: Tensor, frame_numbers: Tensor) -> Tensor:
        """Condition channels [N, C, h, w] of source frames [N, 3, H, W] in [-1, 1]; frame_numbers: integers [N]."""
        return condition_channels(source, self._condition.frames(frame_numbers))

    def layers(self, source: Tensor, frame_numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Full-size warps [N, L, 3, H, W] of the same frames, and where they are valid, bool [N, L, H, W]."""
        rows = self._full.frames(frame_numbers)
        return warp(source, rows.grid, rows.valid), rows.valid


class PathWarpCache:
    """The warps of the last few camera paths: a node asks for the same ones again and again."""

    def __init__(self, config: PlaneWarpConfig, down_factor: int, kept: int = 4) -> None:
        """kept: how many paths are remembered; each takes some 30 MB at 192 x 128 pixels and 14 frames."""
        self._config, self._down_factor, self._room = config, down_factor, kept
        self._kept: dict[tuple[CameraMount, bytes, int, int, str], PathWarps] = {}

    def warps(
        self, mount: CameraMount, trajectory: Trajectory, height: int, width: int, device: torch.device
    ) -> PathWarps:
        """See `PathWarps`; the same object as long as it is remembered."""
        poses = trajectory.source_from_target.numpy().tobytes()
        key = (mount, poses, height, width, str(device))
        made = self._kept.pop(key, None)
        if made is None:
            made = PathWarps(self._config, mount, trajectory, height, width, down_factor=self._down_factor).to(device)
        self._kept[key] = made  # newest last
        while len(self._kept) > self._room:
            del self._kept[next(iter(self._kept))]
        return made
