"""From a scene's parts to one vertex buffer: everything is drawn in a single call."""

import math
from dataclasses import dataclass
from itertools import groupby, pairwise
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import DOMES, Colour, Floats, Part, Pattern, Scene, Sheet, rotations, upright
from gcd_train.scenes.primitives import shape

VERTEX = np.dtype(
    [
        ("position", "3f4"),
        ("normal", "3f4"),
        ("colour", "4u1"),  # and gloss
        ("accent", "4u1"),  # and grain, as `_grain` codes it
        ("tags", "4u1"),  # class, instance, body, pattern
    ]
)
Vertices = NDArray[np.void]


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """Vertices that are painted alike and follow each other: drawn by one call."""

    first: int
    count: int
    pattern: Pattern
    glossy: bool


def indexed(vertices: Vertices) -> tuple[Vertices, NDArray[np.int32]]:
    """Each vertex once, in the order of their first use, and which of them the triangles take: neighbours share."""
    raw = np.ascontiguousarray(vertices).view(np.dtype((np.void, VERTEX.itemsize)))
    _, first, which = np.unique(raw, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return vertices[first[order]], rank[which.reshape(-1)].astype(np.int32)


def runs_of(vertices: Vertices) -> list[Run]:
    """How to draw vertices in their order, triangles that are painted alike together."""
    pattern, gloss = vertices["tags"][::3, 3], vertices["colour"][::3, 3]
    paint = _paint(pattern, gloss)
    starts = [0, *(np.flatnonzero(np.diff(paint)) + 1).tolist(), len(paint)]
    return [
        Run(first=3 * a, count=3 * (b - a), pattern=Pattern(int(pattern[a])), glossy=bool(paint[a] & 1))
        for a, b in pairwise(starts)
        if b > a
    ]


def _paint(pattern: NDArray[np.uint8], gloss: NDArray[np.uint8]) -> NDArray[np.int64]:
    """What decides on a triangle's program: its pattern, and whether it shines (glass does without being told)."""
    return pattern.astype(np.int64) * 2 + ((gloss > 0) | (pattern == Pattern.WINDOWS))


def vertices_of(scene: Scene) -> Vertices:
    """All triangles of a scene, in their bodies' frames: structured [N], three in a row are a triangle.

    What is painted alike stands together, near things first; then the ground, and the sky last, so that few hidden
    pixels are shaded.
    """
    ordered = sorted(scene.parts, key=attrgetter("shape"))
    groups = [_of_parts(name, list(parts)) for name, parts in groupby(ordered, key=attrgetter("shape"))]
    standing = np.concatenate([np.empty(0, VERTEX), *groups]).reshape(-1, 3)
    lying = [_of_sheet(sheet).reshape(-1, 3) for sheet in reversed(scene.sheets)]
    is_sky = np.isin(standing["tags"][:, 0, 3], (Pattern.SKY, *DOMES))
    return np.concatenate([_nearest_first(standing[~is_sky]), *lying, standing[is_sky]]).reshape(-1)


def _nearest_first(triangles: Vertices) -> Vertices:
    """Triangles [N, 3] by their paint, then by their distance from the origin; what moves stays among the nearest."""
    place, tags = triangles["position"][:, 0], triangles["tags"][:, 0]
    away = np.where(tags[:, 2] > 0, 0.0, np.hypot(place[:, 0], place[:, 1]))
    return triangles[np.lexsort((away, _paint(tags[:, 3], triangles["colour"][:, 0, 3])))]


def _of_parts(name: str, parts: list[Part]) -> Vertices:
    corners, normals = (array.reshape(-1, 3) for array in shape(name))  # [V, 3]
    size = np.array([part.size for part in parts], np.float32)[:, None]
    centre = np.array([part.centre for part in parts], np.float32)[:, None]
    turn = _turns(np.array([part.turn for part in parts]), np.array([part.yaw for part in parts]))
    outward = normals / size
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    made = np.empty((len(parts), len(corners)), VERTEX)
    made["position"] = (corners * size) @ turn + centre
    made["normal"] = outward @ turn
    made["colour"] = np.array([_bytes(part.colour, part.gloss) for part in parts], np.uint8)[:, None]
    made["accent"] = np.array([_bytes(part.accent, _grain(part)) for part in parts], np.uint8)[:, None]
    made["tags"] = np.array([(p.label, p.instance, p.body, p.pattern) for p in parts], np.uint8)[:, None]
    return made.reshape(-1)


def _turns(quaternions: NDArray[np.float64], yaw: NDArray[np.float64]) -> Floats:
    """[P, 3, 3], to be multiplied from the right."""
    about_z = upright(np.stack([0 * yaw, 0 * yaw, 0 * yaw, yaw], -1))[..., :3]
    return np.swapaxes(about_z @ rotations(quaternions), -1, -2).astype(np.float32)


def _of_sheet(sheet: Sheet) -> Vertices:
    made = np.empty(sheet.corners.shape[0] * 3, VERTEX)
    made["position"] = sheet.corners.reshape(-1, 3)
    made["normal"] = (0.0, 0.0, 1.0)
    made["colour"] = _bytes(sheet.colour, sheet.gloss)
    made["accent"] = _bytes(sheet.accent, _grain(sheet))
    made["tags"] = (sheet.label, 0, 0, sheet.pattern)
    return made


def _bytes(colour: Colour, fourth: float) -> tuple[int, ...]:
    return tuple(round(255 * min(max(channel, 0.0), 1.0)) for channel in (*colour, fourth))


def _grain(surface: Part | Sheet) -> float:
    """The spacing on a scale of 0..1 from 0.02 m to 5.12 m, even in its logarithm."""
    return math.log2(max(surface.grain_m, 0.02) / 0.02) / 8
