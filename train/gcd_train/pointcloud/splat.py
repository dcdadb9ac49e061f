"""Point clouds of several depth cameras as another camera sees them, unprojected and drawn in one go, in float32.

The published renderer needs float64, as its weights span hundreds of orders of magnitude. Only their ratios within a
pixel count, so the nearest depth of each pixel is found first, and weights are taken relative to it. A point's weight
in a neighbour is its own times a constant, so points are gathered at their own pixels and the neighbours are served
from pictures: the cost does not depend on how many points there are.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError
from gcd_train.pointcloud.project import NEAREST_M, Doubles, Hits, SplatOptions, project, where_true

Bytes = NDArray[np.uint8]
Labels = NDArray[np.uint8] | NDArray[np.uint16]

# of the soft depth test: weight = exp(-k (2 d / d_max - 1)), d the depth, d_max the picture's largest; where d_max
# reaches _FAR_FROM_M, d is min(sqrt(depth), _FAR_LIMIT) and k another
_SHARPNESS, _FAR_FROM_M, _FAR_SHARPNESS, _FAR_LIMIT = 512.0, 64.0, 256.0, 32.0
_NEIGHBOUR_SHARE = 0.02  # of a point's weight, beside its own pixel
_FLOAT64_TRACE = 740.0  # a weight e^740 times smaller than the largest is the last that a float64 mean keeps
_PATIENCE = -math.log(4e-8)  # a point of less relative weight is left out before colours are gathered


@dataclass(frozen=True, kw_only=True, slots=True)
class Splatted:
    """What a camera sees of the points. Tensors, on the device they were drawn on.

    colour: float32 [H, W, C] in 0..1, 0 where nothing is. covered: bool [H, W], where something is.
    depth: float32 [H, W], metres along the optical axis, of the point that weighs most; 0 where nothing is.
    labels: int32 [H, W], of the same point, 0 where nothing is or none were given.
    lit: bool [H, W, C / 3], where float64 would leave a trace of anything that is not black in three channels, however
    far behind; with `options.published` alone, else of no channels.
    """

    colour: Tensor
    covered: Tensor
    depth: Tensor
    labels: Tensor
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
    Raises:
        DataError: a view whose parts are of different sizes, or values of different kinds.
    Source: Generative Camera Dolly, point renderer as released; relative weights are ours.
    """
    options, device = options or SplatOptions(), torch.device(device or "cpu")
    shown = [view.rgb for view in views] if values is None else list(values)
    channels = _require_fitting(views, shown, labels)
    projected = [project(view, world_from_camera, lens, options, device) for view in views]
    hits = {number: each for number, each in enumerate(projected) if each is not None}
    canvas = _Canvas(list(hits.values()), lens, channels, lit=options.published, device=device)
    for number, each in hits.items():
        canvas.add(each, shown[number], None if labels is None else labels[number])
    return canvas.shown([(down, right) for down in options.offsets for right in options.offsets])


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
