"""Warps along one camera path: computed when they are asked for, at the sizes they are asked for."""

from collections.abc import Sequence
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.config import ModelConfig, PlaneWarpConfig
from gcd_model.errors import OptionError, PoseError, ShapeError
from gcd_model.geometry import CameraMount, Trajectory
from gcd_model.plane_warp.grids import Grids, Planes, PlaneWarps, warp
from gcd_model.plane_warp.pictures import HALF, QUARTER, WarpPictures, channels_of
from gcd_model.plane_warp.stage import StagePlanes, orbit_mount
from gcd_model.plane_warp.vehicle import VehiclePlanes, trained_mount


def source_mount(config: PlaneWarpConfig, trajectory: Trajectory) -> CameraMount:
    """How the source camera stands above the planes if nobody says otherwise: on a vehicle as trained, on a stage where
    the path says.

    Raises:
        PoseError: the path does not say it. OptionError: see `orbit_mount`.
    """
    if config.frame == "vehicle":
        return trained_mount(config)
    if trajectory.source is None:
        raise PoseError(
            "to warp by planes one must know where the source camera stands: plan the path with `plan_view`, or set "
            "the path's `source`"
        )
    return orbit_mount(config, trajectory.source)


def plane_warp(
    config: PlaneWarpConfig, mount: CameraMount, source_from_target: Tensor, height: int, width: int
) -> PlaneWarps:
    """Follow every target pixel to all planes and from there into the source picture.

    Args:
        mount: of the source camera. source_from_target: [T, 4, 4], metres.
        height, width: H and W of the target picture in pixels; the source picture has the same shape, at any size.
    """
    planes = _planes(config, mount, source_from_target, None)
    grids = planes.grids(height, width, range(config.layers))
    return PlaneWarps(grid=grids.grid, valid=grids.valid, rays=planes.rays(height, width))


def _planes(
    config: PlaneWarpConfig, mount: CameraMount, source_from_target: Tensor, azimuth_deg: Tensor | None
) -> Planes:
    if config.frame == "vehicle":
        return VehiclePlanes(config=config, mount=mount, source_from_target=source_from_target)
    return StagePlanes(config=config, mount=mount, source_from_target=source_from_target, azimuth_deg=azimuth_deg)


class PathWarps:
    """All warps along one camera path; rows are frames of any clips that follow it.

    Each size is computed when it is first asked for, and kept.
    """

    def __init__(
        self,
        config: PlaneWarpConfig,
        mount: CameraMount | None,
        trajectory: Trajectory,
        height: int,
        width: int,
        *,
        down_factor: int = 8,
        frames: Sequence[int] | None = None,
    ) -> None:
        """mount: of the source camera, None for `source_mount`. height, width: of the pictures, pixels.

        down_factor: pixels per latent. frames: the only ones that will be asked for, None for all.
        Raises ShapeError for sizes that are no multiples; else as `source_mount`.
        """
        if height % down_factor or width % down_factor or down_factor % QUARTER:
            raise ShapeError(f"plane warps want sizes in multiples of {down_factor}, got {height}x{width}")
        self._config, self._size, self._down_factor = config, (height, width), down_factor
        mount = source_mount(config, trajectory) if mount is None else mount
        self._rows = None if frames is None else _row_numbers(frames, trajectory.frames)
        chosen = slice(None) if frames is None else list(frames)
        azimuth_deg = None if trajectory.delta is None else trajectory.delta[chosen, 0]
        self._planes = _planes(config, mount, trajectory.source_from_target[chosen], azimuth_deg)
        self._device = torch.device("cpu")
        self._full: Grids | None = None
        self._condition: tuple[Grids, Grids, Tensor] | None = None  # ground, distant layers, rays

    @property
    def device(self) -> torch.device:
        """Where the grids lie."""
        return self._device

    def to(self, device: torch.device | str) -> Self:
        """Move to a device, in place; returns itself."""
        self._device = torch.device(device)
        self._full = None if self._full is None else self._full.to(device)
        if self._condition is not None:
            ground, distant, rays = self._condition
            self._condition = ground.to(device), distant.to(device), rays.to(device)
        return self

    def pictures(self, source: Tensor, frame_numbers: Tensor) -> WarpPictures:
        """What the condition is made of. source: [N, 3, H, W] in [-1, 1]; frame_numbers: integers [N] below T."""
        rows, (ground, distant, rays) = self._rows_of(frame_numbers), self._conditions()
        half, quarter = F.avg_pool2d(source, HALF), F.avg_pool2d(source, QUARTER)
        return WarpPictures(
            half=half,
            ground=warp(half, ground.grid[rows], ground.valid[rows])[:, 0],
            distant=warp(quarter, distant.grid[rows], distant.valid[rows]),
            rays=rays[rows],
        )

    def channels(self, source: Tensor, frame_numbers: Tensor) -> Tensor:
        """Condition channels [N, C, h, w] of source frames [N, 3, H, W] in [-1, 1]; frame_numbers: integers [N]."""
        return channels_of(self.pictures(source, frame_numbers), self._down_factor)

    def layers(self, source: Tensor, frame_numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Full-size warps [N, L, 3, H, W] of the same frames, and where they are valid, bool [N, L, H, W]."""
        rows, full = self._rows_of(frame_numbers), self._full_size()
        valid = full.valid[rows]
        return warp(source, full.grid[rows], valid), valid

    def _rows_of(self, frame_numbers: Tensor) -> Tensor:
        if self._rows is None:
            return frame_numbers
        rows = self._rows[frame_numbers.cpu()]
        if bool((rows < 0).any()):
            raise ShapeError(f"these warps are for some frames of the path only, and {frame_numbers.tolist()} are not")
        return rows

    def _full_size(self) -> Grids:
        if self._full is None:
            with torch.inference_mode(False):  # they are kept, and may be wanted in training
                self._full = self._planes.grids(*self._size, range(self._config.layers)).to(self._device)
        return self._full

    def _conditions(self) -> tuple[Grids, Grids, Tensor]:
        if self._condition is None:
            with torch.inference_mode(False):  # they are kept, and may be wanted in training
                distant = range(1, 1 + self._config.distant)  # infinity first
                self._condition = (
                    self._planes.grids(*self._smaller(HALF), [0]).to(self._device),
                    self._planes.grids(*self._smaller(QUARTER), distant).to(self._device),
                    self._planes.rays(*self._smaller(self._down_factor)).to(self._device),
                )
        return self._condition

    def _smaller(self, factor: int) -> tuple[int, int]:
        return self._size[0] // factor, self._size[1] // factor


def clip_warps(
    config: ModelConfig, trajectory: Trajectory, mount: CameraMount | None = None, frames: Sequence[int] | None = None
) -> PathWarps:
    """The warps of one clip in the size the model was trained for.

    Args:
        mount: of the source camera, None for `source_mount`. frames: the only ones wanted, None for all.
    Raises:
        OptionError: the model does not warp; else as `PathWarps`.
    """
    if config.plane_warp is None:
        raise OptionError("this model does not warp by planes: it has no plane_warp")
    factor = config.vae.down_factor
    return PathWarps(
        config.plane_warp, mount, trajectory, config.height, config.width, down_factor=factor, frames=frames
    )


class PathWarpCache:
    """The warps of the last few camera paths: a node asks for the same ones again and again."""

    def __init__(self, config: PlaneWarpConfig, down_factor: int, kept: int = 4) -> None:
        """kept: how many paths are remembered; each takes some 30 MB at 192 x 128 pixels and 14 frames."""
        self._config, self._down_factor, self._room = config, down_factor, kept
        self._kept: dict[tuple[CameraMount, bytes, int, int, str], PathWarps] = {}

    def warps(
        self, mount: CameraMount | None, trajectory: Trajectory, height: int, width: int, device: torch.device
    ) -> PathWarps:
        """See `PathWarps`; the same object as long as it is remembered."""
        mount = source_mount(self._config, trajectory) if mount is None else mount
        key = (mount, _path_bytes(trajectory), height, width, str(device))
        made = self._kept.pop(key, None)
        if made is None:
            made = PathWarps(self._config, mount, trajectory, height, width, down_factor=self._down_factor).to(device)
        self._kept[key] = made  # newest last
        while len(self._kept) > self._room:
            del self._kept[next(iter(self._kept))]
        return made


def _path_bytes(trajectory: Trajectory) -> bytes:
    delta = trajectory.delta
    return trajectory.source_from_target.numpy().tobytes() + (b"" if delta is None else delta.numpy().tobytes())


def _row_numbers(frames: Sequence[int], length: int) -> Tensor:
    """Which row holds each of the path's frames, -1 for none: [T]."""
    rows = torch.full((length,), -1)
    rows[list(frames)] = torch.arange(len(frames))
    return rows
