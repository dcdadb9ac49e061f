"""Which parts of a depth picture another camera may see, told before any pixel is projected."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.pointcloud.options import SplatOptions
from gcd_train.pointcloud.pixel_map import Doubles, PixelMap

_SIDE = 32  # pixels; larger tiles leave out less, smaller ones take longer to look at
_MARGIN = 1.0  # pixels beyond each edge, against rounding

Number = TypeVar("Number", bound=np.generic)


@dataclass(frozen=True, kw_only=True, slots=True)
class Tiles:
    """Some of the square tiles of a picture, by row and column of tiles: int64 [K] each."""

    row: NDArray[np.intp]
    column: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.row)

    def cut(self, picture: NDArray[Number]) -> NDArray[Number]:
        """These tiles of a picture [H, W, ...], as [K, side, side, ...]; 0 beyond its edges."""
        return _tiled(picture)[self.row, :, self.column]

    def lines(self, pixels: PixelMap) -> tuple[Doubles, Doubles]:
        """The map's columns and rows in these tiles: across [3, K, 1, side] and along [3, K, side, 1]."""
        across, along = _tiled_line(pixels.across)[self.column], _tiled_line(pixels.along)[self.row]  # [K, side, 3]
        return across.transpose(2, 0, 1)[:, :, None, :], along.transpose(2, 0, 1)[..., None]


def contributing(depth: NDArray[np.float32], pixels: PixelMap, lens: Intrinsics, options: SplatOptions) -> Tiles:
    """The tiles that may reach into the target's picture: all that do, and few that do not.

    Where the two cameras' fields of view do not meet, there are none, and the depth is not even looked at.

    depth: f32 [H, W] of the source, metres. pixels: from there to the target. lens: of the target.
    """
    frustum = _Frustum(pixels=pixels, lens=lens, options=options)
    none, all_depths = np.zeros((1, 1)), np.full((1, 1), options.farthest_m)
    if frustum.misses(pixels.across[None], pixels.along[None], none, all_depths).all():
        return Tiles(row=np.zeros(0, np.intp), column=np.zeros(0, np.intp))
    tiled = _tiled(depth)
    # One axis after the other, the long one last: six times as fast as both at once.
    low, high = tiled.min(axis=1).min(axis=-1), tiled.max(axis=1).max(axis=-1)
    low, high = np.maximum(low, 0.0), np.minimum(high, options.farthest_m)
    missed = frustum.misses(_tiled_line(pixels.across), _tiled_line(pixels.along), low, high)
    row, column = np.nonzero(~(missed | (high <= 0.0)))
    return Tiles(row=row, column=column)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Frustum:
    """What the target camera sees."""

    pixels: PixelMap
    lens: Intrinsics
    options: SplatOptions

    def misses(
        self, across: Doubles, along: Doubles, low: NDArray[np.floating], high: NDArray[np.floating]
    ) -> NDArray[np.bool_]:
        """Which tiles are wholly beyond one of its sides: bool [rows, columns].

        across: [columns, side, 3], along: [rows, side, 3]; low, high: [rows, columns], the depths in each tile. A
        tile's points lie between eight corners. Whatever is not a number is never beyond anything.
        """
        ray = along[:, None, [0, -1], None] + across[None, :, None, [0, -1]]  # [rows, columns, 2, 2, 3]
        depths = np.stack([low, high], axis=-1)[..., None, None, None]  # [rows, columns, 2, 1, 1, 1]
        with np.errstate(invalid="ignore"):  # of depths that are no numbers
            x, y, ahead = np.moveaxis(depths * ray[:, :, None] + self.pixels.offset, -1, 0)  # [rows, columns, 2, 2, 2]
        beyond = [ahead <= self.options.nearest_m]
        for place, centre, size in ((x, self.lens.cx, self.lens.width), (y, self.lens.cy, self.lens.height)):
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
