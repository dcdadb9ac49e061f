"""Point clouds of several depth cameras as another camera sees them, unprojected and drawn in one go, in float32.

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
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError
from gcd_train.pointcloud.project import NEAREST_M, Doubles, Hits, SplatOptions, project, to_device, where_true

Bytes = NDArray[np.uint8]
Labels = NDArray[np.uint8] | NDArray[np.uint16]

# of the soft depth test: weight = exp(-k (2 d / d_max - 1)), d the depth, d_max the picture's largest; where d_max
# reaches _FAR_FROM_M, d is min(sqrt(depth), _FAR_LIMIT) and k another
_SHARPNESS, _FAR_FROM_M, _FAR_SHARPNESS, _FAR_LIMIT = 512.0, 64.0, 256.0, 32.0
_NEIGHBOUR_SHARE = 0.02  # of a point's weight, beside its own pixel
_FLOAT64_TRACE = 740.0  # a weight e^740 times smaller than the largest is the last that a float64 mean keeps


@dataclass(frozen=True, kw_only=True, slots=True)
class Splatted:
    """What a camera sees of the points. Tensors, on the device they were drawn on.

    colour: float32 [H, W, C] in 0..1, 0 where nothing is. covered: bool [H, W], where something is.
    depth: float32 [H, W], metres along the optical axis, of the point that weighs most; 0 where nothing is.
    labels: int32 [H, W], of the same point, 0 where nothing is; None if none were given.
    lit: bool [H, W, C / 3], where float64 would leave a trace of anything that is not black in three channels, however
    far behind; with `options.published` alone, else of no channels.
    """

    colour: Tensor
    covered: Tensor
    depth: Tensor
    labels: Tensor | None
    lit: Tensor


def splat(
    views: Sequence[SceneView],
    world_from_camera: Doubles,
    lens: Intrinsics,
    *,
    values: Sequence[Bytes] | None = None,
    labels: Sequence[Labels] | None = None,
    options: SplatOptions | None = None,
    device: str | torch.device | None = None,
) -> Splatted:
    """Everything the views saw, as one camera sees it.

        colour = sum(w value) / sum(w),    w = exp(-k (2 d / d_max - 1))        over the points that show in a pixel

    Args:
        views: with depth; what is not known there is left out. Sizes and lenses may differ from view to view.
        world_from_camera: [4, 4] of the camera that looks. lens: its lens, and so the picture's size.
        values: u8 [H, W, C] for each view, to be averaged; by default its colours. Join several things along C.
        labels: [H, W] for each view: numbers that must not be averaged, such as ids.
        options: see SplatOptions. device: a torch device, by default the CPU.
    Returns:
        The picture; on a GPU, without waiting for it.
    Raises:
        DataError: a view whose parts are of different sizes, or values of different kinds.
    Source: Generative Camera Dolly, point renderer as released; relative weights are ours.
    """
    options, device = options or SplatOptions(), torch.device(device or "cpu")
    shown = [view.rgb for view in views] if values is None else list(values)
    channels = _require_fitting(views, shown, labels)
    projected = [project(view, world_from_camera, lens, options, device) for view in views]
    hits = [(number, each) for number, each in enumerate(projected) if each is not None]
    canvas = _Canvas.of([each for _, each in hits], lens, channels, options, device)
    for number, each in hits:
        canvas.add(each, shown[number], None if labels is None else labels[number])
    picture = show(canvas.gathered(), options)
    return Splatted(
        colour=(picture.colour / 255).permute(1, 2, 0),
        covered=picture.covered,
        depth=picture.picked[0],
        labels=None if labels is None else picture.picked[1].to(torch.int32),
        lit=picture.lit.permute(1, 2, 0),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class Gathered:
    """What fell on each pixel, weights relative to the nearest point of that pixel.

    nearest: [H, W], d of the nearest point, inf where nothing fell. rate: scalar; weights fall by e in d = 1 / rate.
    weight: [H, W], sum of weights, 1 and more where something fell. colour: [C, H, W], sum of weights times values.
    picked: [L, H, W], numbers of the nearest point itself: its depth, its labels. lit: [G, H, W], d of the
    nearest point that is not black in three channels, inf where there is none; G is 0 where nobody asks.
    """

    nearest: Tensor
    rate: Tensor
    weight: Tensor
    colour: Tensor
    picked: Tensor
    lit: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class _Canvas:
    """Sums over the points that fell on each pixel, [..., H*W]; see Gathered. is_far: scalar, which rule holds for d.

    nearest_m: depth of the nearest point. lit: [G, H*W], see Gathered.
    """

    lens: Intrinsics
    options: SplatOptions
    is_far: Tensor
    rate: Tensor
    nearest_m: Tensor
    nearest: Tensor
    weight: Tensor
    colour: Tensor
    label: Tensor
    lit: Tensor

    @classmethod
    def of(
        cls, hits: Sequence[Hits], lens: Intrinsics, channels: int, options: SplatOptions, device: torch.device
    ) -> Self:
        """An empty one, that knows which points are nearest."""
        size = lens.width * lens.height
        nearest_m = torch.full((size,), torch.inf, device=device)
        farthest = torch.full((), NEAREST_M, device=device)
        for each in hits:
            nearest_m.scatter_reduce_(0, each.pixel, each.depth, "amin")
            farthest = torch.maximum(farthest, each.farthest)
        is_far = farthest >= _FAR_FROM_M
        far_rate = 2.0 * _FAR_SHARPNESS / farthest.sqrt().clamp(max=_FAR_LIMIT)
        return cls(
            lens=lens,
            options=options,
            is_far=is_far,
            rate=torch.where(is_far, far_rate, 2.0 * _SHARPNESS / farthest),
            nearest_m=nearest_m,
            nearest=_d(nearest_m, is_far).masked_fill(nearest_m.isinf(), torch.inf),
            weight=torch.zeros(size, device=device),
            colour=torch.zeros(channels, size, device=device),
            label=torch.zeros(size, dtype=torch.int32, device=device),
            lit=torch.full((-(-channels // 3) if options.published else 0, size), torch.inf, device=device),
        )

    def add(self, hits: Hits, values: Bytes, labels: Labels | None) -> None:
        """Weigh the points of a view, and gather what they show."""
        behind = (_d(hits.depth, self.is_far) - self.nearest.index_select(0, hits.pixel)) * self.rate
        pixel, depth, kept = hits.pixel, hits.depth, hits.source
        if len(self.lit):
            self._light(hits, values)
        if kept is None:
            behind = behind.masked_fill(depth.isinf(), torch.inf)
        else:
            near = where_true(behind <= self._patience)
            pixel, depth, kept, behind = (each.index_select(0, near) for each in (pixel, depth, kept, behind))
        share = torch.exp(-behind)
        self.weight.scatter_add_(0, pixel, share)
        for sums, shown in zip(self.colour, _picked(values, hits, kept, share.device).unbind(1), strict=True):
            sums.scatter_add_(0, pixel, shown * share)
        if labels is not None:
            label = _picked(labels[..., None].astype(np.int32), hits, kept, share.device)[:, 0]
            others = depth != self.nearest_m.index_select(0, pixel)
            self.label.scatter_reduce_(0, pixel, label.masked_fill(others, 0), "amax")

    def _light(self, hits: Hits, values: Bytes) -> None:
        """Note how far the nearest points are that are not black, also those that weigh next to nothing."""
        d = _d(hits.depth, self.is_far).masked_fill(hits.depth.isinf(), torch.inf)
        for sums, part in zip(self.lit, _picked(values, hits, hits.source, d.device).split(3, -1), strict=True):
            black = (part == 0).all(-1)
            sums.scatter_reduce_(0, hits.pixel, d.masked_fill(black, torch.inf), "amin")

    def gathered(self) -> Gathered:
        """The sums, as pictures."""
        shape = (self.lens.height, self.lens.width)
        return Gathered(
            nearest=self.nearest.view(shape),
            rate=self.rate,
            weight=self.weight.view(shape),
            colour=self.colour.view(-1, *shape),
            picked=torch.stack([self.nearest_m, self.label.float()]).view(-1, *shape),
            lit=self.lit.view(-1, *shape),
        )

    @property
    def _patience(self) -> float:
        negligible = self.options.negligible
        return -math.log(negligible) if negligible > 0.0 else math.inf


def _d(depth: Tensor, is_far: Tensor) -> Tensor:
    """What the depth test goes by."""
    return torch.where(is_far, depth.sqrt().clamp(max=_FAR_LIMIT), depth)


def _picked(picture: NDArray[np.generic], hits: Hits, kept: Tensor | None, device: torch.device) -> Tensor:
    """What points show, [M, C]."""
    cut = to_device(hits.tiles.cut(picture), device).flatten(0, 2)  # [K*side*side, C]
    return cut if kept is None else cut.index_select(0, kept)


def _require_fitting(views: Sequence[SceneView], values: Sequence[Bytes], labels: Sequence[Labels] | None) -> int:
    """How many channels the values have; 3 if there are none."""
    if len(values) != len(views) or (labels is not None and len(labels) != len(views)):
        raise DataError(f"{len(views)} views need as many values and labels, got {len(values)}")
    for number, (view, shown) in enumerate(zip(views, values, strict=True)):
        size = (view.lens.height, view.lens.width)
        sizes = [view.depth.shape, shown.shape[:2], *([] if labels is None else [labels[number].shape])]
        if any(each != size for each in sizes):
            raise DataError(
                f"view {number} must be {size[1]} x {size[0]} throughout as its lens says, got {sizes} (H, W)"
            )
        if shown.ndim != 3 or shown.dtype != np.uint8 or shown.shape[2] != values[0].shape[2]:
            raise DataError(f"values must be u8 [H, W, C] with the same C, got {shown.dtype} {list(shown.shape)}")
    return values[0].shape[2] if values else 3


@dataclass(frozen=True, kw_only=True, slots=True)
class Shown:
    """colour: [C, H, W], the mean of what shows. picked: [L, H, W], of the heaviest. covered: bool [H, W].

    lit: bool [G, H, W], where float64 would have a trace of what is not black.
    """

    colour: Tensor
    picked: Tensor
    covered: Tensor
    lit: Tensor


def show(gathered: Gathered, options: SplatOptions) -> Shown:
    """Every pixel as the weighted mean of what shows in it; 0 where nothing does."""
    handicap = -math.log(_NEIGHBOUR_SHARE) / gathered.rate  # what a neighbour's point seems to lie further back
    offsets = [(down, right) for down in options.offsets for right in options.offsets]
    moved = _Moved(gathered.nearest.shape, options)
    seeming = [moved(gathered.nearest, at, torch.inf) + (handicap if at != (0, 0) else 0.0) for at in offsets]
    front = torch.stack(seeming).amin(dim=0)  # [H, W]
    covered = front < torch.inf
    front = front.masked_fill(~covered, 0.0)
    weight, colour = torch.zeros_like(front), torch.zeros_like(gathered.colour)
    picked, lit = torch.zeros_like(gathered.picked), torch.full_like(gathered.lit, torch.inf)
    for at, depth in zip(offsets, seeming, strict=True):
        share = torch.exp((front - depth) * gathered.rate)  # 0 where nothing fell
        weight += share * moved(gathered.weight, at, 0.0)
        colour += share * moved(gathered.colour, at, 0.0)
        picked = torch.where(depth == front, moved(gathered.picked, at, 0.0), picked)
        lit = torch.minimum(lit, moved(gathered.lit, at, torch.inf) + (handicap if at != (0, 0) else 0.0))
    trace = (lit - front) * gathered.rate <= _FLOAT64_TRACE
    return Shown(colour=colour / weight.clamp(min=1e-30), picked=picked, covered=covered, lit=trace)


class _Moved:
    """Pictures [..., H, W] moved by whole pixels, with a constant where nothing comes from."""

    def __init__(self, size: torch.Size, options: SplatOptions) -> None:
        self._height, self._width = size
        self._before, self._after = -options.offsets[0], options.offsets[-1]

    def __call__(self, picture: Tensor, by: tuple[int, int], outside: float) -> Tensor:
        down, right = by
        edges = (self._after, self._before, self._after, self._before)
        wide = F.pad(picture, edges, value=outside)
        top, left = self._after - down, self._after - right
        return wide[..., top : top + self._height, left : left + self._width]
