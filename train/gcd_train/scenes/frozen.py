"""A scene ready to draw: its triangles and where their bodies are.

A scene folder keeps one as a file, so that a target view can be drawn exactly along any path, without simulating
anything again.
"""

import math
from dataclasses import dataclass, fields
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
    Light,
    Paint,
    Part,
    Pattern,
    Scene,
    Staging,
    rotations,
    upright,
)
from gcd_train.scenes.primitives import shape

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
