"""From the pixels of depth cameras to points, and to the pixels of another camera.

A pixel (u, v) at depth z falls at z (A (u, v, 1)) + b, with one matrix A and one vector b for the two cameras, so no
points in the world are ever stored. Tiles of a picture that the other camera cannot see are left out before that.
"""

import math
from dataclasses import dataclass
from typing import Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Number = TypeVar("Number", bound=np.generic)

NEAREST_M, FARTHEST_M = 0.1, 30_000.0
"""What is not beyond the one in front of the target camera is left out; a source depth beyond the other is unknown."""
_SIDE = 32  # pixels; larger tiles leave out less, smaller ones take longer to look at
_MARGIN = 1.0  # pixels beyond each edge, against rounding


@dataclass(frozen=True, kw_only=True, slots=True)
class SplatOptions:
    """How points become a picture. The defaults weigh as published, on exact pinhole geometry.

    radius: each point also shows in the pixels from -(radius // 2) to (radius + 1) // 2 about its own, both ways: 0 its
        own alone, 1 also right, below and below right, 2 all eight neighbours.
    published: pixels are whole numbers without the half that leads to their middles, in the source as in the target,
        and what lies up to a pixel beyond the left or upper edge falls on it. For comparing with the published clouds
        only: it shifts pictures that differ in size by part of a pixel.
    Source: Generative Camera Dolly, point renderer as released.
    """

    radius: int = 1
    published: bool = False

    @property
    def pixel_centre(self) -> float:
        """What leads from a pixel's number to where its ray goes, pixels."""
        return 0.0 if self.published else 0.5

    @property
    def offsets(self) -> range:
        """The pixels a point shows in, counted from its own, in either direction."""
        return range(-(self.radius // 2), (self.radius + 1) // 2 + 1)


def planar_from_distance(distance: Floats, lens: Intrinsics, *, published: bool = False) -> Floats:
    """Depth along the optical axis from the distance to the camera's centre.

        z = distance / |((u - cx) / fx, (v - cy) / fy, 1)|        through the middles of the pixels

    Args:
        distance: f32 [H, W], metres. lens: of the same picture, pixels.
        published: as released: tangents of angles that are evenly spaced from edge to edge instead. Exact in the centre
            and in the corners, up to 0.5 % off between (at 53 degrees).
    Returns:
        f32 [H, W], metres; whatever is not known stays as it is.
    Raises:
        DataError: the lens is another picture's.
    Source: Generative Camera Dolly, Kubric-4D; Kubric's depth is the distance.
    """
    _require_size(distance, lens)
    right, down = _tangents_of_even_angles(lens) if published else tangents(lens, 0.5)
    lengths = np.sqrt(1.0 + right[None, :] ** 2 + down[:, None] ** 2)  # [H, W]
    return distance / lengths.astype(np.float32)


def unproject(view: SceneView, *, published: bool = False) -> Floats:
    """The points a view sees.

    Args:
        view: with its depth. published: whole pixel numbers, without the half that leads to their middles.
    Returns:
        f32 [H, W, 3] in the world, metres; NaN where the depth is 0, not finite or absurd.
    Raises:
        DataError: depth and lens are of different sizes.
    """
    _require_size(view.depth, view.lens)
    right, down = tangents(view.lens, 0.0 if published else 0.5)
    known = np.where((view.depth > 0.0) & (view.depth <= FARTHEST_M), view.depth, np.nan)
    turn, position = view.world_from_camera[:3, :3], view.world_from_camera[:3, 3]
    rays = turn[:, 0] * right[None, :, None] + turn[:, 1] * down[:, None, None] + turn[:, 2]  # [H, W, 3]
    return (known[..., None] * rays + position).astype(np.float32)


def tangents(lens: Intrinsics, pixel_centre: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far the rays of all columns go to the right, [W], and of all rows down, [H], for 1 ahead."""
    right = (np.arange(lens.width, dtype=np.float64) + pixel_centre - lens.cx) / lens.fx
    down = (np.arange(lens.height, dtype=np.float64) + pixel_centre - lens.cy) / lens.fy
    return right, down


def _tangents_of_even_angles(lens: Intrinsics) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    across, along = math.radians(lens.hfov_deg) / 2, math.radians(lens.vfov_deg) / 2
    right = np.linspace(-across, across, lens.width, dtype=np.float64)
    down = np.linspace(-along, along, lens.height, dtype=np.float64)
    return np.tan(right), np.tan(down)


def _require_size(depth: Floats, lens: Intrinsics) -> None:
    if depth.shape != (lens.height, lens.width):
        raise DataError(
            f"a depth picture must be of its lens's size, {lens.width} x {lens.height}, got {list(depth.shape)[::-1]}; "
            "resize the lens with the picture"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class PixelMap:
    """The map between two cameras.

        (x, y, ahead) = z (across[u] + along[v]) + offset,    target pixel = (x / ahead + cx, y / ahead + cy)

    across: [W, 3] and along: [H, 3], of the source's columns and rows. offset: [3], the source's camera itself.
    float64; x and y are counted from the target's principal point, where float32 will be finest.
    """

    across: Doubles
    along: Doubles
    offset: Doubles

    @classmethod
    def between(
        cls,
        world_from_source: Doubles,
        source: Intrinsics,
        world_from_target: Doubles,
        target: Intrinsics,
        pixel_centre: float,
    ) -> Self:
        """From a camera with the lens `source` to one with the lens `target`; poses are [4, 4], metres."""
        target_from_source = np.linalg.inv(world_from_target) @ world_from_source
        pixels_from_source = np.diag([target.fx, target.fy, 1.0]) @ target_from_source[:3]
        right, down = tangents(source, pixel_centre)
        return cls(
            across=right[:, None] * pixels_from_source[:, 0],
            along=down[:, None] * pixels_from_source[:, 1] + pixels_from_source[:, 2],
            offset=pixels_from_source[:, 3],
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Tiles:
    """Some of the square tiles of a picture, by row and column of tiles: int64 [K] each."""

    row: NDArray[np.intp]
    column: NDArray[np.intp]

    def cut(self, picture: NDArray[Number], device: torch.device) -> Tensor:
        """These tiles of a picture [H, W, ...], as [K, side, side, ...]; 0 beyond its edges."""
        return _to_device(_tiled(picture)[self.row, :, self.column], device)

    def lines(self, pixels: PixelMap, device: torch.device) -> tuple[Tensor, Tensor]:
        """The map's columns and rows in these tiles: across [3, K, 1, side] and along [3, K, side, 1]."""
        across, along = _tiled_line(pixels.across)[self.column], _tiled_line(pixels.along)[self.row]  # [K, side, 3]
        lines = across.transpose(2, 0, 1)[:, :, None, :], along.transpose(2, 0, 1)[..., None]
        return _to_device(lines[0], device), _to_device(lines[1], device)


def contributing(depth: NDArray[np.float32], pixels: PixelMap, lens: Intrinsics) -> Tiles:
    """The tiles that may reach into the target's picture: all that do, and few that do not.

    Where the two cameras' fields of view do not meet, there are none, and the depth is not even looked at.

    depth: f32 [H, W] of the source, metres. pixels: from there to the target. lens: of the target.
    """
    none, all_depths = np.zeros((1, 1)), np.full((1, 1), FARTHEST_M)
    if _outside(pixels, lens, pixels.across[None], pixels.along[None], none, all_depths).all():
        return Tiles(row=np.zeros(0, np.intp), column=np.zeros(0, np.intp))
    tiled = _tiled(depth)
    # One axis after the other, the long one last: six times as fast as both at once.
    low, high = tiled.min(axis=1).min(axis=-1), tiled.max(axis=1).max(axis=-1)
    low, high = np.maximum(low, 0.0), np.minimum(high, FARTHEST_M)
    missed = _outside(pixels, lens, _tiled_line(pixels.across), _tiled_line(pixels.along), low, high)
    row, column = np.nonzero(~(missed | (high <= 0.0)))
    return Tiles(row=row, column=column)


def _outside(
    pixels: PixelMap,
    lens: Intrinsics,
    across: Doubles,
    along: Doubles,
    low: NDArray[np.floating],
    high: NDArray[np.floating],
) -> NDArray[np.bool_]:
    """Which tiles are wholly beyond one side of what the target camera sees: bool [rows, columns].

    across: [columns, side, 3], along: [rows, side, 3]; low, high: [rows, columns], the depths in each tile. A tile's
    points lie between eight corners. Whatever is not a number is never beyond anything.
    """
    ray = along[:, None, [0, -1], None] + across[None, :, None, [0, -1]]  # [rows, columns, 2, 2, 3]
    depths = np.stack([low, high], axis=-1)[..., None, None, None]  # [rows, columns, 2, 1, 1, 1]
    with np.errstate(invalid="ignore"):  # of depths that are no numbers
        x, y, ahead = np.moveaxis(depths * ray[:, :, None] + pixels.offset, -1, 0)  # [rows, columns, 2, 2, 2]
    beyond = [ahead <= NEAREST_M]
    for place, centre, size in ((x, lens.cx, lens.width), (y, lens.cy, lens.height)):
        beyond += [place + (centre + 1.0 + _MARGIN) * ahead < 0.0, place + (centre - size - _MARGIN) * ahead > 0.0]
    return np.any([side.all(axis=(2, 3, 4)) for side in beyond], axis=0)


def _tiled(picture: NDArray[Number]) -> NDArray[Number]:
    """[H, W, ...] as [rows, side, columns, side, ...], filled up with 0."""
    height, width = picture.shape[:2]
    rest = [(0, -height % _SIDE), (0, -width % _SIDE)] + [(0, 0)] * (picture.ndim - 2)
    filled = np.pad(picture, rest) if rest[0][1] or rest[1][1] else picture
    shape = (filled.shape[0] // _SIDE, _SIDE, filled.shape[1] // _SIDE, _SIDE, *picture.shape[2:])
    return filled.reshape(shape)


def _tiled_line(line: Doubles) -> Doubles:
    """[N, 3] as [tiles, side, 3], the last one repeated."""
    return np.pad(line, [(0, -len(line) % _SIDE), (0, 0)], mode="edge").reshape(-1, _SIDE, 3)


@dataclass(frozen=True, kw_only=True, slots=True)
class Hits:
    """Points of one view that fall into the picture.

    pixel: int64 [M], flat. depth: float32 [M], metres ahead of the target camera. tiles: parts of the view that were
    looked at. source: int64 [M], flat numbers of the pixels in them.
    """

    pixel: Tensor
    depth: Tensor
    tiles: Tiles
    source: Tensor

    def pick(self, picture: NDArray[np.generic], source: Tensor) -> Tensor:
        """What points of these source numbers show of a picture [H, W, C] of the view: [M, C]."""
        return self.tiles.cut(picture, source.device).flatten(0, 2).index_select(0, source)


def project(
    view: SceneView,
    world_from_camera: Doubles,
    lens: Intrinsics,
    options: SplatOptions,
    device: torch.device,
) -> Hits | None:
    """The pixels of a view where they fall in a camera's picture; None where it cannot see any of them."""
    pixels = PixelMap.between(view.world_from_camera, view.lens, world_from_camera, lens, options.pixel_centre)
    tiles = contributing(view.depth, pixels, lens)
    if not len(tiles.row):
        return None
    depth, (across, along) = tiles.cut(view.depth, device), tiles.lines(pixels, device)  # [K, side, side]
    x, y, ahead = (
        torch.addcmul(torch.full((), float(pixels.offset[axis]), device=device), depth, across[axis] + along[axis])
        for axis in range(3)
    )
    shift = 0.5 - options.pixel_centre
    column, row = x / ahead + (lens.cx + shift), y / ahead + (lens.cy + shift)
    inside = (depth > 0.0) & (depth <= FARTHEST_M) & (ahead > NEAREST_M)
    for place, size in ((column, lens.width), (row, lens.height)):  # cutting off the digits gives one of the pixels
        inside &= ((place > -1.0) if options.published else (place >= 0.0)) & (place < size)
    source = where_true(inside)
    if not len(source):
        return None
    column, row, ahead = (each.flatten().index_select(0, source) for each in (column, row, ahead))
    pixel = (row.to(torch.int32) * lens.width + column.to(torch.int32)).to(torch.int64)
    return Hits(pixel=pixel, depth=ahead, tiles=tiles, source=source)


def where_true(flags: Tensor) -> Tensor:
    """Flat numbers of the true ones, int64."""
    if flags.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(flags.numpy()))  # five times as fast as torch's own
    return flags.flatten().nonzero()[:, 0]


def _to_device(array: NDArray[np.generic], device: torch.device) -> Tensor:
    """An array as a tensor; floating numbers become float32."""
    kind = np.float32 if np.issubdtype(array.dtype, np.floating) else array.dtype
    return torch.from_numpy(np.ascontiguousarray(array, kind)).to(device)
