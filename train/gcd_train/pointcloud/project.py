"""Depth pictures projected into another camera's picture."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.pointcloud.options import SplatOptions
from gcd_train.pointcloud.pixel_map import Doubles, PixelMap
from gcd_train.pointcloud.tiles import Tiles, contributing


@dataclass(frozen=True, kw_only=True, slots=True)
class Hits:
    """Points of one view that fall into the picture.

    pixel: int64 [M], flat. depth: float32 [M], metres ahead of the target camera. tiles: parts of the view that were
    looked at. source: int64 [M], flat numbers of the pixels in them; None where M is all of them in order, and then
    depth is inf for those that do not fall into the picture. farthest: scalar, the largest finite depth, or 0.
    """

    pixel: Tensor
    depth: Tensor
    tiles: Tiles
    source: Tensor | None
    farthest: Tensor


def project(
    view: SceneView,
    world_from_camera: Doubles,
    lens: Intrinsics,
    options: SplatOptions,
    device: torch.device,
) -> Hits | None:
    """The pixels of a view where they fall in a camera's picture; None where it cannot see any of them.

    All others are left out, or stay, out of the way: see SplatOptions.compact.
    """
    pixels = PixelMap.between(view.world_from_camera, view.lens, world_from_camera, lens, options.pixel_centre)
    tiles = contributing(view.depth, pixels, lens, options)
    if not len(tiles):
        return None
    depth = to_device(tiles.cut(view.depth), device)  # [K, side, side]
    across, along = (to_device(line, device) for line in tiles.lines(pixels))
    x, y, ahead = (
        torch.addcmul(torch.full((), float(pixels.offset[axis]), device=device), depth, across[axis] + along[axis])
        for axis in range(3)
    )
    shift = 0.5 - options.pixel_centre
    column, row = x / ahead + (lens.cx + shift), y / ahead + (lens.cy + shift)
    inside = (depth > 0.0) & (depth <= options.farthest_m) & (ahead > options.nearest_m)
    inside &= _within(column, lens.width, options) & _within(row, lens.height, options)
    if options.compact or (options.compact is None and device.type == "cpu"):
        return _left_out(column, row, ahead, inside, lens, tiles)
    return _set_aside(column, row, ahead, inside, lens, tiles)


def to_device(array: NDArray[np.generic], device: torch.device) -> Tensor:
    """An array as a tensor; floating numbers become float32."""
    kind = np.float32 if np.issubdtype(array.dtype, np.floating) else array.dtype
    return torch.from_numpy(np.ascontiguousarray(array, kind)).to(device, non_blocking=True)


def where_true(flags: Tensor) -> Tensor:
    """Flat numbers of the true ones, int64; waits for the device."""
    if flags.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(flags.numpy()))  # five times as fast as torch's own
    return flags.flatten().nonzero()[:, 0]


def _within(place: Tensor, size: int, options: SplatOptions) -> Tensor:
    """Whether cutting off the digits behind the point gives one of a picture's pixels."""
    return ((place > -1.0) if options.published else (place >= 0.0)) & (place < size)


def _left_out(column: Tensor, row: Tensor, ahead: Tensor, inside: Tensor, lens: Intrinsics, tiles: Tiles) -> Hits:
    source = where_true(inside)
    column, row, depth = (each.flatten().index_select(0, source) for each in (column, row, ahead))
    farthest = depth.amax() if len(source) else depth.new_zeros(())
    return Hits(pixel=_flat(column, row, lens), depth=depth, tiles=tiles, source=source, farthest=farthest)


def _set_aside(column: Tensor, row: Tensor, ahead: Tensor, inside: Tensor, lens: Intrinsics, tiles: Tiles) -> Hits:
    aside = torch.arange(inside.numel(), device=inside.device) % (
        lens.width * lens.height
    )  # apart, or they would queue
    outside = ~inside  # filled in, not chosen between: a number as one of two choices would be copied to the device
    pixel = _flat(column.masked_fill(outside, 0.0), row.masked_fill(outside, 0.0), lens).flatten()
    return Hits(
        pixel=torch.where(inside.flatten(), pixel, aside),
        depth=ahead.masked_fill(outside, torch.inf).flatten(),
        tiles=tiles,
        source=None,
        farthest=ahead.masked_fill(outside, 0.0).amax(),
    )


def _flat(column: Tensor, row: Tensor, lens: Intrinsics) -> Tensor:
    return (row.to(torch.int32) * lens.width + column.to(torch.int32)).to(torch.int64)
