"""Flat shapes along a road: strips between two lateral places, and quads laid end to end."""

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Floats
from gcd_train.scenes.driving.road import Road

Span = tuple[float, float]
_NEAR_STEP_M, _FAR_STEP_M, _NEAR_M = 5.0, 10.0, (-60.0, 180.0)


def whole(road: Road) -> list[Span]:
    """The road's whole length."""
    return [(road.start_m, road.end_m)]


def free_spans(road: Road, margin_m: float, begin_m: float | None = None, end_m: float | None = None) -> list[Span]:
    """The stretches between the junctions, each junction widened by a margin on both sides."""
    start = road.start_m if begin_m is None else begin_m
    end = road.end_m if end_m is None else end_m
    spans: list[Span] = []
    for crossing in sorted(road.crossings, key=lambda each: each.at_m):
        spans.append((start, min(end, crossing.at_m - crossing.half_m - margin_m)))
        start = max(start, crossing.at_m + crossing.half_m + margin_m)
    return [span for span in [*spans, (start, end)] if span[1] > span[0]]


def ribbon(
    road: Road, right: float, left: float, z: float | tuple[float, float], spans: list[Span] | None = None
) -> Floats:
    """A strip along the road between two lateral places, triangles [N, 3, 3].

    z: its height, or those of its right and of its left edge.
    """
    heights = z if isinstance(z, tuple) else (z, z)
    pieces = [_strip(road, right, left, heights, span) for span in (whole(road) if spans is None else spans)]
    return np.concatenate([np.zeros((0, 3, 3), np.float32), *pieces])


def _strip(road: Road, right: float, left: float, heights: tuple[float, float], span: Span) -> Floats:
    s = _knots(span)
    low, high = (_lifted(road.places(s, y), z) for y, z in ((right, heights[0]), (left, heights[1])))
    return quads(low[:-1], low[1:], high[1:], high[:-1])


def _knots(span: Span) -> NDArray[np.float64]:
    near = np.arange(*_NEAR_M, _NEAR_STEP_M)
    far = np.concatenate([np.arange(-300.0, _NEAR_M[0], _FAR_STEP_M), np.arange(_NEAR_M[1], 500.0, _FAR_STEP_M)])
    knots = np.concatenate([far, near])
    inside = knots[(knots > span[0] + 0.3) & (knots < span[1] - 0.3)]
    return np.sort(np.concatenate([[span[0]], inside, [span[1]]]))


def patches(road: Road, rows: NDArray[np.float64], z: float) -> Floats:
    """Small pieces on the road: rows [N, 4] of first and last s, right and left lateral place."""
    if len(rows) == 0:
        return np.zeros((0, 3, 3), np.float32)
    s0, s1, right, left = rows.T
    ends = ((s0, right), (s1, right), (s1, left), (s0, left))
    a, b, c, d = (_lifted(road.places(s, y), z) for s, y in ends)
    return quads(a, b, c, d)


def fan(centre: NDArray[np.float64], rim: NDArray[np.float64]) -> Floats:
    """Triangles from a point [3] to the pieces of an open rim [N, 3]."""
    hub = np.broadcast_to(centre, (len(rim) - 1, 3))
    return np.stack([hub, rim[:-1], rim[1:]], 1).astype(np.float32)


def quads(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], d: NDArray[np.float64]) -> Floats:
    """Two triangles for every four corners [N, 3], in order around."""
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.float32)


def _lifted(places: NDArray[np.float64], z: float) -> NDArray[np.float64]:
    return np.concatenate([places[..., :2], np.full((*places.shape[:-1], 1), z)], -1)
