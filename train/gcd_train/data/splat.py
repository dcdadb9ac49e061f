"""Point clouds of several depth cameras as another camera sees them, unprojected and drawn in one go, in float32.

A pixel (u, v) at depth z falls at z (A (u, v, 1)) + b, with one matrix A and one vector b for the two cameras, so no
points in the world are ever stored. Tiles of a picture that the other camera cannot see are left out before that.

The published renderer needs float64, as its weights span hundreds of orders of magnitude. Only their ratios within a
pixel count, so the nearest depth of each pixel is found first, and weights are taken relative to it. A point's weight
in a neighbour is its own times a constant, so points are gathered at their own pixels and the neighbours are served
from pictures: the cost does not depend on how many points there are.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.data.encodings import Bytes, Doubles, Floats, Number
from gcd_train.data.sample import SceneView

Labels = NDArray[np.uint8] | NDArray[np.uint16]

NEAREST_M, FARTHEST_M = 0.1, 30_000.0
"""What is not beyond the one in front of the target camera is left out; a source depth beyond the other is unknown."""
_SIDE = 32  # pixels; larger tiles leave out less, smaller ones take longer to look at
_MARGIN = 1.0  # pixels beyond each edge, against rounding
# of the soft depth test: weight = exp(-k (2 d / d_max - 1)), d the depth, d_max the picture's largest; where d_max
# reaches _FAR_FROM_M, d is min(sqrt(depth), _FAR_LIMIT) and k another
_SHARPNESS, _FAR_FROM_M, _FAR_SHARPNESS, _FAR_LIMIT = 512.0, 64.0, 256.0, 32.0
_NEIGHBOUR_SHARE = 0.02  # of a point's weight, beside its own pixel
_FLOAT64_TRACE = 740.0  # a weight e^740 times smaller than the largest is the last that a float64 mean keeps
_PATIENCE = -math.log(4e-8)  # a point of less relative weight is left out before colours are gathered


def tangents(lens: Intrinsics, pixel_centre: float = 0.5) -> tuple[Doubles, Doubles]:
    """How far the rays of all columns go to the right, [W], and of all rows down, [H], for 1 ahead."""
    right = (np.arange(lens.width, dtype=np.float64) + pixel_centre - lens.cx) / lens.fx
    down = (np.arange(lens.height, dtype=np.float64) + pixel_centre - lens.cy) / lens.fy
    return right, down


def ray_lengths(lens: Intrinsics, *, published: bool = False) -> Floats:
    """Distance to the camera's centre over depth along the axis, for the middle of every pixel, [H, W].

    published: as released: tangents of angles that are evenly spaced from edge to edge instead. Exact in the centre and
    in the corners, up to 0.5 % off between (at 53 degrees).
    Source: Generative Camera Dolly, Kubric-4D; Kubric's depth is the distance.
    """
    right, down = tangents(lens)
    if published:
        across, along = math.radians(lens.hfov_deg) / 2, math.radians(lens.vfov_deg) / 2
        right = np.tan(np.linspace(-across, across, lens.width))
        down = np.tan(np.linspace(-along, along, lens.height))
    return np.sqrt(1.0 + right[None, :] ** 2 + down[:, None] ** 2).astype(np.float32)


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
    published: bool,
    device: torch.device,
) -> Hits | None:
    """The pixels of a view where they fall in a camera's picture; None where it cannot see any of them."""
    centre = 0.0 if published else 0.5
    pixels = PixelMap.between(view.world_from_camera, view.lens, world_from_camera, lens, centre)
    tiles = contributing(view.depth, pixels, lens)
    if not len(tiles.row):
        return None
    depth, (across, along) = tiles.cut(view.depth, device), tiles.lines(pixels, device)  # [K, side, side]
    x, y, ahead = (
        torch.addcmul(torch.full((), float(pixels.offset[axis]), device=device), depth, across[axis] + along[axis])
        for axis in range(3)
    )
    column, row = x / ahead + (lens.cx + 0.5 - centre), y / ahead + (lens.cy + 0.5 - centre)
    inside = (depth > 0.0) & (depth <= FARTHEST_M) & (ahead > NEAREST_M)
    for place, size in ((column, lens.width), (row, lens.height)):  # cutting off the digits gives one of the pixels
        inside &= ((place > -1.0) if published else (place >= 0.0)) & (place < size)
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


@dataclass(frozen=True, kw_only=True, slots=True)
class Splatted:
    """What a camera sees of the points. Tensors, on the device they were drawn on.

    colour: float32 [H, W, C] in 0..1, 0 where nothing is. covered: bool [H, W], where something is.
    depth: float32 [H, W], metres along the optical axis, of the point that weighs most; 0 where nothing is.
    labels: int32 [H, W], of the same point, 0 where nothing is or none were given.
    lit: bool [H, W, C / 3], where float64 would leave a trace of anything that is not black in three channels, however
    far behind; with `published` alone, else of no channels.
    """

    colour: Tensor
    covered: Tensor
    depth: Tensor
    labels: Tensor
    lit: Tensor

    @property
    def picture(self) -> Bytes:
        """The colour, u8 [H, W, C] in memory."""
        return (self.colour * 255).round().byte().cpu().numpy()


def splat(
    views: Sequence[SceneView],
    world_from_camera: Doubles,
    lens: Intrinsics,
    *,
    values: Sequence[Bytes] | None = None,
    labels: Sequence[Labels] | None = None,
    radius: int = 1,
    published: bool = False,
    device: str | None = None,
) -> Splatted:
    """Everything the views saw, as one camera sees it.

        colour = sum(w value) / sum(w),    w = exp(-k (2 d / d_max - 1))        over the points that show in a pixel

    Args:
        views: with depth; what is not known there is left out. Sizes and lenses may differ from view to view.
        world_from_camera: [4, 4] of the camera that looks. lens: its lens, and so the picture's size.
        values: u8 [H, W, C] for each view, to be averaged; by default its colours. Join several things along C.
        labels: [H, W] for each view: numbers that must not be averaged, such as ids.
        radius: each point also shows in the pixels from -(radius // 2) to (radius + 1) // 2 about its own, both ways:
            0 its own alone, 1 also right, below and below right, 2 all eight neighbours.
        published: pixels are whole numbers without the half that leads to their middles, in the source as in the
            target, and what lies up to a pixel beyond the left or upper edge falls on it. For comparing with the
            published clouds only: it shifts pictures that differ in size by part of a pixel.
        device: a torch device, by default the CPU.
    Source: Generative Camera Dolly, point renderer as released; relative weights are ours.
    """
    place = torch.device(device or "cpu")
    shown = [view.rgb for view in views] if values is None else list(values)
    projected = [project(view, world_from_camera, lens, published, place) for view in views]
    hits = {number: each for number, each in enumerate(projected) if each is not None}
    channels = shown[0].shape[2] if shown else 3
    canvas = _Canvas(list(hits.values()), lens, channels, lit=published, device=place)
    for number, each in hits.items():
        canvas.add(each, shown[number], None if labels is None else labels[number])
    offsets = range(-(radius // 2), (radius + 1) // 2 + 1)
    return canvas.shown([(down, right) for down in offsets for right in offsets])


class _Canvas:
    """Sums over the points that fell on each pixel, [..., H*W], with weights relative to its nearest point.

    nearest_m, label: depth and label of the nearest point; nearest: its d, inf where nothing fell. rate: scalar,
    weights fall by e in d = 1 / rate. weight: sum of weights, 1 and more where something fell. colour: [C, ...], sum of
    weights times values. lit: [G, ...], d of the nearest point that is not black in three channels, inf without one;
    G is 0 unless `lit`.
    """

    def __init__(
        self, hits: Sequence[Hits], lens: Intrinsics, channels: int, *, lit: bool, device: torch.device
    ) -> None:
        """An empty one, that knows which points are nearest."""
        self._shape, size = (lens.height, lens.width), lens.height * lens.width
        self._nearest_m = torch.full((size,), torch.inf, device=device)
        farthest = torch.full((), NEAREST_M, device=device)
        for each in hits:
            self._nearest_m.scatter_reduce_(0, each.pixel, each.depth, "amin")
            farthest = torch.maximum(farthest, each.depth.amax())
        self._is_far = bool(farthest >= _FAR_FROM_M)
        far_rate = 2.0 * _FAR_SHARPNESS / farthest.sqrt().clamp(max=_FAR_LIMIT)
        self._rate = far_rate if self._is_far else 2.0 * _SHARPNESS / farthest
        self._nearest = self._d(self._nearest_m).masked_fill(self._nearest_m.isinf(), torch.inf)
        self._weight, self._colour = (torch.zeros(*each, size, device=device) for each in ((), (channels,)))
        self._label = torch.zeros(size, dtype=torch.int32, device=device)
        self._lit = torch.full((-(-channels // 3) if lit else 0, size), torch.inf, device=device)

    def add(self, hits: Hits, values: Bytes, labels: Labels | None) -> None:
        """Weigh the points of a view, and gather what they show."""
        d = self._d(hits.depth)
        if len(self._lit):  # also of those that weigh next to nothing
            for nearest, part in zip(self._lit, hits.pick(values, hits.source).split(3, -1), strict=True):
                black = (part == 0).all(-1)
                nearest.scatter_reduce_(0, hits.pixel, d.masked_fill(black, torch.inf), "amin")
        behind = (d - self._nearest.index_select(0, hits.pixel)) * self._rate
        near = where_true(behind <= _PATIENCE)
        pixel, depth, kept, behind = (
            each.index_select(0, near) for each in (hits.pixel, hits.depth, hits.source, behind)
        )
        share = torch.exp(-behind)
        self._weight.scatter_add_(0, pixel, share)
        for sums, shown in zip(self._colour, hits.pick(values, kept).unbind(1), strict=True):
            sums.scatter_add_(0, pixel, shown * share)
        if labels is not None:
            label = hits.pick(labels[..., None].astype(np.int32), kept)[:, 0]
            others = depth != self._nearest_m.index_select(0, pixel)
            self._label.scatter_reduce_(0, pixel, label.masked_fill(others, 0), "amax")

    def shown(self, offsets: Sequence[tuple[int, int]]) -> Splatted:
        """Every pixel as the weighted mean of what shows in it, from pixels that are so many rows and columns away."""
        nearest, weight, colour, nearest_m, label, lit_d = (
            each.view(*each.shape[:-1], *self._shape)
            for each in (self._nearest, self._weight, self._colour, self._nearest_m, self._label, self._lit)
        )
        handicap = -math.log(_NEIGHBOUR_SHARE) / self._rate  # what a neighbour's point seems to lie further back
        behind = [handicap if at != (0, 0) else torch.zeros_like(handicap) for at in offsets]
        seeming = [_moved(nearest, at, torch.inf) + more for at, more in zip(offsets, behind, strict=True)]
        front = torch.stack(seeming).amin(dim=0)  # [H, W]
        covered = front < torch.inf
        front = front.masked_fill(~covered, 0.0)
        total, mean, lit = torch.zeros_like(weight), torch.zeros_like(colour), torch.full_like(lit_d, torch.inf)
        depth, labels = torch.zeros_like(nearest_m), torch.zeros_like(label)
        for at, more, d in zip(offsets, behind, seeming, strict=True):
            share = torch.exp((front - d) * self._rate)  # 0 where nothing fell
            total += share * _moved(weight, at, 0.0)
            mean += share * _moved(colour, at, 0.0)
            depth = torch.where(d == front, _moved(nearest_m, at, 0.0), depth)
            labels = torch.where(d == front, _moved(label, at, 0), labels)
            lit = torch.minimum(lit, _moved(lit_d, at, torch.inf) + more)
        return Splatted(
            colour=(mean / total.clamp(min=1e-30) / 255).permute(1, 2, 0),
            covered=covered,
            depth=depth,
            labels=labels,
            lit=((lit - front) * self._rate <= _FLOAT64_TRACE).permute(1, 2, 0),
        )

    def _d(self, depth: Tensor) -> Tensor:
        """What the depth test goes by."""
        return depth.sqrt().clamp(max=_FAR_LIMIT) if self._is_far else depth


def _moved(picture: Tensor, by: tuple[int, int], outside: float) -> Tensor:
    """A picture [..., H, W] moved down and right by whole pixels, with a constant where nothing comes from."""
    (down, right), (height, width) = by, picture.shape[-2:]
    wide = F.pad(picture, (max(right, 0), max(-right, 0), max(down, 0), max(-down, 0)), value=outside)
    top, left = max(-down, 0), max(-right, 0)
    return wide[..., top : top + height, left : left + width]
