"""Unit shapes as triangles with normals; each fits a cube of side 1 about the origin."""

from functools import cache
from itertools import pairwise

import numpy as np

from gcd_train.scenes.description import Floats

Triangles = tuple[Floats, Floats]
"""Corners [N, 3, 3] and unit normals [N, 3, 3]."""


def _flat(corners: list[list[tuple[float, float, float]]]) -> Triangles:
    """Triangles with one normal a face, turned away from the origin (all shapes here are convex)."""
    points = np.asarray(corners, np.float32)
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[(normal * points.mean(1)).sum(-1) < 0] *= -1
    return points, np.repeat(normal[:, None], 3, axis=1)


def _quads(points: list[tuple[float, float, float]], faces: list[tuple[int, int, int, int]]) -> Triangles:
    return _flat([[points[i] for i in half] for a, b, c, d in faces for half in ((a, b, c), (a, c, d))])


def _hull(top: float, front: float = 0.0) -> Triangles:
    """A box whose upper face is `top` times as large in x and y, moved by `front` in x."""
    low = [(-0.5, -0.5, -0.5), (0.5, -0.5, -0.5), (0.5, 0.5, -0.5), (-0.5, 0.5, -0.5)]
    width = 0.5 - (0.5 - top / 2) * 0.55  # sides lean in less than front and back
    high = [
        (-top / 2 + front, -width, 0.5),
        (top / 2 + front, -width, 0.5),
        (top / 2 + front, width, 0.5),
        (-top / 2 + front, width, 0.5),
    ]
    faces = [(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    return _quads(low + high, faces)


def _gable() -> Triangles:
    """A roof: the ridge runs along x."""
    base = [(-0.5, -0.5, -0.5), (0.5, -0.5, -0.5), (0.5, 0.5, -0.5), (-0.5, 0.5, -0.5)]
    points = [*base, (-0.5, 0.0, 0.5), (0.5, 0.0, 0.5)]
    ends = [[points[i] for i in face] for face in ((0, 3, 4), (1, 2, 5))]
    sides = [[points[i] for i in face] for face in ((0, 1, 5), (0, 5, 4), (3, 2, 5), (3, 5, 4))]
    return _flat(ends + sides)


def _round(sides: int, axis: int) -> Triangles:
    """A closed cylinder along an axis, smooth around."""
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack([np.cos(angles), np.sin(angles)], -1) * 0.5
    corners: list[list[tuple[float, ...]]] = []
    normals: list[list[tuple[float, ...]]] = []
    for (ax, ay), (bx, by) in pairwise(ring.tolist()):
        low_a, low_b, high_a, high_b = (ax, ay, -0.5), (bx, by, -0.5), (ax, ay, 0.5), (bx, by, 0.5)
        na, nb = (2 * ax, 2 * ay, 0.0), (2 * bx, 2 * by, 0.0)
        corners += [[low_a, low_b, high_b], [low_a, high_b, high_a]]
        normals += [[na, nb, nb], [na, nb, na]]
        for z, up in ((0.5, 1.0), (-0.5, -1.0)):
            corners.append([(0.0, 0.0, z), (ax, ay, z), (bx, by, z)])
            normals.append([(0.0, 0.0, up)] * 3)
    order = {2: [0, 1, 2], 1: [0, 2, 1]}[axis]
    return np.asarray(corners, np.float32)[..., order], np.asarray(normals, np.float32)[..., order]


def _ball() -> Triangles:
    """An icosahedron split once: 80 triangles, smooth."""
    golden = (1 + 5**0.5) / 2
    points = [(a, b * golden, 0.0) for a in (-1, 1) for b in (-1, 1)]
    points = np.array([*points, *[(0.0, a, b) for a, b, _ in points], *[(b, 0.0, a) for a, b, _ in points]])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    edge = apart[apart > 1e-6].min() * 1.01
    near = apart < edge
    faces = [
        (i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]
    ]
    split: list[Floats] = []
    for i, j, k in faces:
        a, b, c = points[i], points[j], points[k]
        ab, bc, ca = ((p + q) / np.linalg.norm(p + q) for p, q in ((a, b), (b, c), (c, a)))
        split += [np.stack(t) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    normals = np.stack(split).astype(np.float32)
    return normals * np.float32(0.5), normals


def _outward(triangles: Triangles) -> Triangles:
    """The triangles wound so that, seen from outside, their corners run anticlockwise (the shapes are convex)."""
    corners, normals = triangles
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (face * corners.mean(1)).sum(-1) < 0
    corners[inward], normals[inward] = corners[inward][:, ::-1], normals[inward][:, ::-1]
    return corners, normals


@cache
def shape(name: str) -> Triangles:
    """Corners and normals of a unit shape, cached.

    box; taper, cabin, nose: a box with a smaller upper face; gable: a roof; post: a cylinder along z; wheel: one
    along y; ball; cone: a box that ends nearly in a point.
    """
    return _outward(_MAKERS[name]())


_MAKERS = {
    "box": lambda: _hull(1.0),
    "taper": lambda: _hull(0.8),
    "cabin": lambda: _hull(0.68, -0.04),
    "nose": lambda: _hull(0.9, -0.05),
    "cone": lambda: _hull(0.05),
    "gable": _gable,
    "post": lambda: _round(6, 2),
    "wheel": lambda: _round(10, 1),
    "ball": _ball,
}
SHAPES = tuple(_MAKERS)
