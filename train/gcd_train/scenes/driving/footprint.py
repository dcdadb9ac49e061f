"""What stands where on the ground: rectangles in any direction, and whether they touch.

A footprint is [..., 5]: x and y of its centre, yaw in radians, half its length along the yaw and half its width.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Part

Footprints = NDArray[np.float64]


def overlap(first: Footprints, second: Footprints, gap_m: float = 0.0) -> NDArray[np.bool_]:
    """Whether rectangles come closer than a gap (along one of their axes), [...]; sizes broadcast.

    Two convex shapes are apart if and only if an edge's normal separates them.
    """
    apart = second[..., :2] - first[..., :2]
    touching = np.ones(np.broadcast_shapes(first.shape[:-1], second.shape[:-1]), bool)
    for yaw in (first[..., 2], first[..., 2] + np.pi / 2, second[..., 2], second[..., 2] + np.pi / 2):
        distance = np.abs(apart[..., 0] * np.cos(yaw) + apart[..., 1] * np.sin(yaw))
        touching &= distance < _reach(first, yaw) + _reach(second, yaw) + gap_m
    return touching


def touches(first: Footprints, second: Footprints, gap_m: float = 0.0) -> bool:
    """Whether any two rectangles of a pair overlap; sizes broadcast. Only those near each other are looked at."""
    away = first[..., :2] - second[..., :2]
    radius = np.hypot(first[..., 3], first[..., 4]) + np.hypot(second[..., 3], second[..., 4]) + 2 * gap_m
    near = away[..., 0] ** 2 + away[..., 1] ** 2 < radius**2
    if not near.any():
        return False
    shape = (*near.shape, 5)
    return bool(overlap(np.broadcast_to(first, shape)[near], np.broadcast_to(second, shape)[near], gap_m).any())


def _reach(box: Footprints, yaw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Half the length of a rectangle's shadow on an axis."""
    turn = yaw - box[..., 2]
    return np.abs(np.cos(turn)) * box[..., 3] + np.abs(np.sin(turn)) * box[..., 4]


def footprint_of(parts: Sequence[Part]) -> Footprints:
    """A rectangle along the first part's yaw that holds all parts, [5]."""
    yaw = parts[0].yaw
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    centres = np.array([part.centre[:2] for part in parts])
    halves = np.array([_half_sizes(part, yaw) for part in parts])
    along, aside = centres @ ahead, centres @ left
    low = np.array([(along - halves[:, 0]).min(), (aside - halves[:, 1]).min()])
    high = np.array([(along + halves[:, 0]).max(), (aside + halves[:, 1]).max()])
    middle = (low + high) / 2
    x, y = ahead * middle[0] + left * middle[1]
    return np.array([x, y, yaw, (high[0] - low[0]) / 2, (high[1] - low[1]) / 2])


def _half_sizes(part: Part, yaw: float) -> tuple[float, float]:
    cos, sin = abs(np.cos(part.yaw - yaw)), abs(np.sin(part.yaw - yaw))
    a, b = abs(part.size[0]) / 2, abs(part.size[1]) / 2
    return float(cos * a + sin * b), float(sin * a + cos * b)


def holds_a_point(parts: Sequence[Part], points: NDArray[np.float64], margin_m: float) -> bool:
    """Whether a point [N, 3] lies within a margin of a part's bounding box; the parts stand upright."""
    hub = np.array(parts[0].centre)
    radius = max(float(np.linalg.norm(part.centre - hub) + np.linalg.norm(part.size) / 2) for part in parts)
    points = points[((points - hub) ** 2).sum(-1) < (radius + 2 * margin_m) ** 2]
    for part in parts if len(points) else ():
        away = points - part.centre
        cos, sin = np.cos(part.yaw), np.sin(part.yaw)
        local = np.stack([away[:, 0] * cos + away[:, 1] * sin, away[:, 1] * cos - away[:, 0] * sin, away[:, 2]], -1)
        reach = np.abs(part.size) / 2 + margin_m
        if bool((np.abs(local) < reach).all(-1).any()):
            return True
    return False
