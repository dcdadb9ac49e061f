"""A scene's triangles: unit shapes, and a scene ready to draw with where its bodies are.

A scene folder keeps one as a file, so that a target view can be drawn exactly along any path, without simulating
anything again.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from itertools import groupby, pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.small_files import decode_json
from gcd_train.data.files import read_npz
from gcd_train.errors import DataError
from gcd_train.scenes.description import (
    DOMES,
    Extent,
    Floats,
    Light,
    Paint,
    Part,
    Pattern,
    Scene,
    Staging,
    rotations,
    upright,
)

VERTEX = np.dtype(
    [
        ("position", "3f4"),
        ("normal", "3f4"),
        ("colour", "4u1"),  # and gloss
        ("accent", "4u1"),  # and grain, on a scale of 0..1 from 0.02 m to 5.12 m, even in its logarithm
        ("tags", "4u1"),  # class, instance, body, pattern
    ]
)
Vertices = NDArray[np.void]

_FORMAT = 2


class _Facts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    format: int
    hfov_deg: float
    light: Light
    extent: Extent


@dataclass(frozen=True, kw_only=True, slots=True)
class FrozenScene(Staging):
    """What the renderer needs. vertices: [N] of `VERTEX`, three in a row are a triangle, in their bodies' frames."""

    vertices: Vertices

    def save(self, file: BinaryIO) -> None:
        """Write it as a compressed npz."""
        facts = _Facts(format=_FORMAT, hfov_deg=self.hfov_deg, light=self.light, extent=self.extent)
        encoded = np.frombuffer(msgspec.json.encode(facts), np.uint8)
        raw = self.vertices.view(np.uint8).reshape(-1, VERTEX.itemsize)
        np.savez_compressed(file, vertices=raw, poses=self.poses, focus=self.focus, facts=encoded)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote. Raises DataError if the file is missing, damaged or of another version."""
        try:
            arrays: dict[str, Any] = read_npz(path)
            facts = decode_json(arrays["facts"].tobytes(), _Facts)
            if facts.format != _FORMAT:
                raise ValueError(f"its format is {facts.format}, this version reads {_FORMAT}")
            return cls(
                vertices=arrays["vertices"].reshape(-1).view(VERTEX),
                poses=arrays["poses"].astype(np.float32),
                focus=arrays["focus"].astype(np.float32),
                hfov_deg=facts.hfov_deg,
                light=facts.light,
                extent=facts.extent,
            )
        except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
            raise DataError(f"{path} is no drawable scene ({error}); generate the scene again") from error


def freeze(scene: Scene) -> FrozenScene:
    """A scene's triangles and motion, without its cameras."""
    staging = {each.name: getattr(scene, each.name) for each in fields(Staging)}
    return FrozenScene(vertices=vertices_of(scene), **staging)


def vertices_of(scene: Scene) -> Vertices:
    """All triangles of a scene, in their bodies' frames: structured [N], three in a row are a triangle.

    What is painted alike stands together, near things first and what moves among the nearest; then the ground, and the
    sky last, so that few hidden pixels are shaded.
    """
    ordered = sorted(scene.parts, key=attrgetter("shape"))
    groups = [_of_parts(name, list(parts)) for name, parts in groupby(ordered, key=attrgetter("shape"))]
    parts = np.concatenate([np.empty(0, VERTEX), *groups]).reshape(-1, 3)
    is_sky = np.isin(parts["tags"][:, 0, 3], (Pattern.SKY, *DOMES))
    standing = parts[~is_sky]
    place, tags = standing["position"][:, 0], standing["tags"][:, 0]
    away = np.where(tags[:, 2] > 0, 0.0, np.hypot(place[:, 0], place[:, 1]))
    standing = standing[np.lexsort((away, _paint(tags[:, 3], standing["colour"][:, 0, 3])))]
    lying = [np.empty((len(sheet.corners), 3), VERTEX) for sheet in scene.sheets]
    for made, sheet in zip(lying, scene.sheets, strict=True):
        made["position"], made["normal"] = sheet.corners, (0.0, 0.0, 1.0)
        made["colour"], made["accent"] = _bytes(sheet.paint)
        made["tags"] = (sheet.label, 0, 0, sheet.paint.pattern)
    return np.concatenate([standing, *reversed(lying), parts[is_sky]]).reshape(-1)


def _paint(pattern: NDArray[np.uint8], gloss: NDArray[np.uint8]) -> NDArray[np.int64]:
    """What decides on a triangle's program: its pattern, and whether it shines (windows always do)."""
    return pattern.astype(np.int64) * 2 + ((gloss > 0) | (pattern == Pattern.WINDOWS))


def _of_parts(name: str, parts: list[Part]) -> Vertices:
    corners, normals = (array.reshape(-1, 3) for array in shape(name))  # [V, 3]
    size = np.array([part.size for part in parts], np.float32)[:, None]
    centre = np.array([part.centre for part in parts], np.float32)[:, None]
    yaw = np.array([part.yaw for part in parts])
    about_z = upright(np.stack([0 * yaw, 0 * yaw, 0 * yaw, yaw], -1))[..., :3]
    turn = about_z @ rotations(np.array([part.turn for part in parts]))
    turn = np.swapaxes(turn, -1, -2).astype(np.float32)  # multiplied from the right
    outward = normals / size
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    made = np.empty((len(parts), len(corners)), VERTEX)
    made["position"] = (corners * size) @ turn + centre
    made["normal"] = outward @ turn
    paints = np.array([_bytes(part.paint) for part in parts], np.uint8)  # [P, 2, 4]
    made["colour"], made["accent"] = paints[:, :1], paints[:, 1:]
    made["tags"] = np.array([(p.label, p.instance, p.body, p.paint.pattern) for p in parts], np.uint8)[:, None]
    return made.reshape(-1)


def _bytes(paint: Paint) -> list[tuple[int, ...]]:
    """Colour and gloss, accent and grain."""
    rows = (*paint.colour, paint.gloss), (*paint.accent, math.log2(max(paint.grain_m, 0.02) / 0.02) / 8)
    return [tuple(round(255 * min(max(channel, 0.0), 1.0)) for channel in row) for row in rows]


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """Vertices that are painted alike and follow each other: drawn by one program."""

    first: int
    count: int
    pattern: Pattern
    glossy: bool


def runs_of(vertices: Vertices) -> list[Run]:
    """How to draw vertices in their order, triangles that are painted alike together."""
    pattern = vertices["tags"][::3, 3]
    paint = _paint(pattern, vertices["colour"][::3, 3])
    starts = [0, *(np.flatnonzero(np.diff(paint)) + 1).tolist(), len(paint)]
    return [
        Run(first=3 * a, count=3 * (b - a), pattern=Pattern(int(pattern[a])), glossy=bool(paint[a] & 1))
        for a, b in pairwise(starts)
        if b > a
    ]


def indexed(vertices: Vertices) -> tuple[Vertices, NDArray[np.int32]]:
    """Each vertex once, in the order of their first use, and which of them the triangles take: neighbours share."""
    raw = np.ascontiguousarray(vertices).view(np.dtype((np.void, VERTEX.itemsize)))
    _, first, which = np.unique(raw, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    return vertices[first[order]], rank[which.reshape(-1)]


# unit shapes, each within a cube of side 1 about the origin

Triangles = tuple[Floats, Floats]
"""Corners [N, 3, 3] and unit normals [N, 3, 3]."""


def _flat(corners: Any) -> Triangles:
    """Triangles [N, 3, 3] with one normal a face, turned away from the origin (the shapes are convex)."""
    points = np.asarray(corners, np.float32)
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal[(normal * points.mean(1)).sum(-1) < 0] *= -1
    return points, np.repeat(normal[:, None], 3, axis=1)


_SQUARE = ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))


def _faceted(upper: list[tuple[float, float]], faces: Sequence[tuple[int, ...]]) -> Triangles:
    """Flat faces between the corners of the lower square and those above them, by the corners' numbers."""
    corners = [*((x, y, -0.5) for x, y in _SQUARE), *((x, y, 0.5) for x, y in upper)]
    return _flat([[corners[i] for i in (face[0], *pair)] for face in faces for pair in pairwise(face[1:])])


def _hull(top: float, front: float = 0.0) -> Triangles:
    """A box whose upper face is `top` times as large in x and y, moved by `front` in x."""
    width = 1.0 - (1.0 - top) * 0.55  # sides lean in less than front and back
    upper = [(x * top + front, y * width) for x, y in _SQUARE]
    return _faceted(upper, [(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)])


def _icosahedron() -> Floats:
    """Its 20 faces, corners [20, 3, 3] at distance 1."""
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
    return points[np.array(faces)]


def _ball(splits: int) -> Triangles:
    """An icosahedron, every triangle split in four so many times, smooth."""
    corners = _icosahedron()
    for _ in range(splits):
        a, b, c = np.moveaxis(corners, 1, 0)
        ab, bc, ca = ((p + q) / np.linalg.norm(p + q, axis=-1, keepdims=True) for p, q in ((a, b), (b, c), (c, a)))
        quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        corners = np.stack([np.stack(triangle, 1) for triangle in quarters], 1).reshape(-1, 3, 3)
    normals = corners.astype(np.float32)
    return normals * np.float32(0.5), normals


Profile = Sequence[tuple[float, float]]
"""Distance from the axis and height, in order: walking along it, the outside is on the right hand."""
_SHARP_DEG = 35.0


def _revolved(profile: Profile, *, closed: bool = False) -> Triangles:
    """A profile turned about z; smooth around, and along the profile wherever it bends little. May be concave."""
    line = np.array([*profile, profile[0]] if closed else profile)  # [K + 1, 2]
    step = np.diff(line, axis=0)
    out = np.stack([step[:, 1], -step[:, 0]], -1) / np.linalg.norm(step, axis=1, keepdims=True)  # [K, 2]
    before, after = np.roll(out, 1, 0), np.roll(out, -1, 0)
    if not closed:
        before[0], after[-1] = out[0], out[-1]
    corners = _ring_triangles(_turned(line[:-1]), _turned(line[1:]))
    normals = _ring_triangles(_turned(_bent(out, before)), _turned(_bent(out, after)))
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    return corners[area > 1e-9], normals[area > 1e-9]  # fields that end on the axis are triangles already


def _turned(flat: NDArray[Any], sides: int = 28) -> NDArray[Any]:
    """Radius and height [K, 2] at every angle around: [K, sides + 1, 3]."""
    angles = np.linspace(0, 2 * np.pi, sides + 1)
    return np.stack([flat[:, :1] * np.cos(angles), flat[:, :1] * np.sin(angles), flat[:, 1:] + 0 * angles], -1)


def _bent(own: NDArray[Any], other: NDArray[Any]) -> NDArray[Any]:
    """Normals [K, 2] where a piece meets another: between the two, or the piece's own at a sharp edge."""
    smooth = (own * other).sum(-1, keepdims=True) > math.cos(math.radians(_SHARP_DEG))
    between = np.where(smooth, own + other, own)
    return between / np.linalg.norm(between, axis=-1, keepdims=True)


def _ring_triangles(start: NDArray[Any], end: NDArray[Any]) -> Floats:
    """Two triangles for each field of a band, [N, 3, 3], anticlockwise seen from outside."""
    a, b, c, d = start[:, :-1], start[:, 1:], end[:, 1:], end[:, :-1]
    halves = [np.stack(corners, 2).reshape(-1, 3, 3) for corners in ((a, b, c), (a, c, d))]
    return np.concatenate(halves).astype(np.float32)


def _cylinder(sides: int) -> Triangles:
    """A closed cylinder along z, smooth around."""
    low, high, out = _turned(np.array([(0.5, -0.5), (0.5, 0.5), (1.0, 0.0)]), sides)
    corners, normals = [_ring_triangles(low[None], high[None])], [_ring_triangles(out[None], out[None])]
    for rim, z in ((high, 1.0), (low, -1.0)):
        corners.append(np.stack([np.broadcast_to((0, 0, z / 2), (sides, 3)), rim[:-1], rim[1:]], 1).astype(np.float32))
        normals.append(np.broadcast_to(np.array((0, 0, z), np.float32), (sides, 3, 3)))
    around, about = (np.concatenate(a).reshape(4, sides, 3, 3).swapaxes(0, 1) for a in (corners, normals))
    return around.reshape(-1, 3, 3), about.reshape(-1, 3, 3)


def _arc(centre: tuple[float, float], radius: float, start_deg: float, end_deg: float, pieces: int) -> Profile:
    angles = np.radians(np.linspace(start_deg, end_deg, pieces + 1))
    return [(max(centre[0] + radius * float(np.cos(a)), 0.0), centre[1] + radius * float(np.sin(a))) for a in angles]


@cache
def shape(name: str) -> Triangles:
    """Corners and normals of a unit shape, cached.

    box; taper, cabin, nose: a box with a smaller upper face; gable: a roof; post: a cylinder along z; wheel: one
    along y; ball; cone: a box that ends nearly in a point. Finer: sphere, cylinder, round_cone, capsule (0.5 wide, so
    size (2 r, 2 r, length) wants a length of 4 r for round ends), icosahedron. Convex too: barrel. Concave:
    torus (0.28 thick), tube, bottle (0.36 wide), bowl (0.48 high), vase (0.58 wide), spool, pot.
    """
    closed = name in ("torus", "tube")
    corners, normals = _MADE[name]() if name in _MADE else _revolved(_PROFILES[name], closed=closed)
    if name in CONVEX:  # wound so that, seen from outside, the corners of triangles run anticlockwise
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        inward = (face * corners.mean(1)).sum(-1) < 0
        corners[inward], normals[inward] = corners[inward][:, ::-1], normals[inward][:, ::-1]
    return corners, normals


_MADE: dict[str, Callable[[], Triangles]] = {
    "box": lambda: _hull(1.0),
    "taper": lambda: _hull(0.8),
    "cabin": lambda: _hull(0.68, -0.04),
    "nose": lambda: _hull(0.9, -0.05),
    "cone": lambda: _hull(0.05),
    "gable": lambda: _faceted([(-0.5, 0.0), (0.5, 0.0)], [(0, 3, 4), (1, 2, 5), (0, 1, 5, 4), (3, 2, 5, 4)]),
    "post": lambda: _cylinder(6),
    "wheel": lambda: (_cylinder(10)[0][..., [0, 2, 1]], _cylinder(10)[1][..., [0, 2, 1]]),
    "cylinder": lambda: _cylinder(28),
    "ball": lambda: _ball(1),
    "sphere": lambda: _ball(3),
    "icosahedron": lambda: _flat(_icosahedron() * 0.5),
}
_PROFILES: dict[str, Profile] = {
    "capsule": [*_arc((0, -0.25), 0.25, -90, 0, 7), *_arc((0, 0.25), 0.25, 0, 90, 7)],
    "round_cone": [(0.0, -0.5), (0.47, -0.5), (0.5, -0.48), (0.015, 0.49), (0.0, 0.5)],
    "barrel": [(0.0, -0.5), (0.33, -0.5), (0.39, -0.28), (0.41, 0.0), (0.39, 0.28), (0.33, 0.5), (0.0, 0.5)],
    "torus": _arc((0.36, 0), 0.14, 0, 360, 16)[:-1],
    "tube": [(0.34, -0.5), (0.5, -0.5), (0.5, 0.5), (0.34, 0.5)],
    "bottle": [
        *((0.0, -0.47), (0.1, -0.5), (0.16, -0.5), (0.18, -0.47), (0.18, 0.05), (0.165, 0.14), (0.12, 0.22)),
        *((0.075, 0.29), (0.06, 0.36), (0.06, 0.44), (0.075, 0.44), (0.075, 0.5), (0.0, 0.5)),
    ],
    "bowl": [
        *((0.0, -0.24), (0.2, -0.24), (0.22, -0.2), (0.36, -0.12), (0.46, 0.05), (0.5, 0.24)),
        *((0.465, 0.24), (0.42, 0.06), (0.33, -0.07), (0.2, -0.15), (0.0, -0.17)),
    ],
    "vase": [
        *((0.0, -0.5), (0.17, -0.5), (0.24, -0.4), (0.29, -0.24), (0.29, -0.08), (0.23, 0.1), (0.14, 0.25)),
        *((0.12, 0.35), (0.15, 0.44), (0.21, 0.5), (0.18, 0.49), (0.12, 0.44), (0.09, 0.34), (0.09, 0.2), (0.0, 0.1)),
    ],
    "spool": [
        *((0.0, -0.5), (0.4, -0.5), (0.42, -0.48), (0.42, -0.36), (0.4, -0.34), (0.2, -0.28), (0.17, 0.0)),
        *((0.2, 0.28), (0.4, 0.34), (0.42, 0.36), (0.42, 0.48), (0.4, 0.5), (0.0, 0.5)),
    ],
    "pot": [(0.0, -0.5), (0.34, -0.5), (0.46, 0.36), (0.5, 0.36), (0.5, 0.5), (0.42, 0.5), (0.3, -0.4), (0.0, -0.4)],
}
SHAPES = (*_MADE, *_PROFILES)
CONVEX = frozenset({*_MADE, "capsule", "round_cone", "barrel"})
