"""From what fell on each pixel to the picture, where points also show in pixels beside their own.

A point's weight in a neighbour is its own weight times a constant, so points are gathered at their own pixels and the
neighbours are served from pictures: the cost does not depend on how many points there are.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_train.pointcloud.options import SplatOptions

_FLOAT64_TRACE = 740.0
"""A weight e^740 times smaller than the largest is the last that keeps a float64 mean from being 0."""


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
    handicap = -math.log(options.neighbour_share) / gathered.rate  # what a neighbour's point seems to lie further back
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
