"""From a scene's parts to one vertex buffer: everything is drawn in a single call."""

from itertools import groupby
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Floats, Part, Pattern, Scene, Sheet, rotations, upright
from gcd_train.scenes.primitives import shape

VERTEX = np.dtype(
    [("position", "3f4"), ("normal", "3f4"), ("colour", "4u1"), ("tags", "4u1")]  # tags: class, instance, body, pattern
)
Vertices = NDArray[np.void]


def vertices_of(scene: Scene) -> Vertices:
    """All triangles of a scene, in their bodies' frames: structured [N], three in a row are a triangle.

    Near things come first, the ground after them and the sky last, so that hidden pixels are never shaded.
    """
    ordered = sorted(scene.parts, key=attrgetter("shape"))
    groups = [_of_parts(name, list(parts)) for name, parts in groupby(ordered, key=attrgetter("shape"))]
    standing = np.concatenate(groups).reshape(-1, 3)
    lying = [_of_sheet(sheet).reshape(-1, 3) for sheet in reversed(scene.sheets)]
    is_sky = standing["tags"][:, 0, 3] == Pattern.SKY
    return np.concatenate([_nearest_first(standing[~is_sky]), *lying, standing[is_sky]]).reshape(-1)


def _nearest_first(triangles: Vertices) -> Vertices:
    """Triangles [N, 3] by their distance from the origin; what moves stays among the nearest."""
    place = triangles["position"][:, 0]
    moves = triangles["tags"][:, 0, 2] > 0
    return triangles[np.argsort(np.where(moves, 0.0, np.hypot(place[:, 0], place[:, 1])), kind="stable")]


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
    made["colour"] = np.array([_bytes(part) for part in parts], np.uint8)[:, None]
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
    made["colour"] = _bytes(sheet)
    made["tags"] = (sheet.label, 0, 0, sheet.pattern)
    return made


def _bytes(surface: Part | Sheet) -> tuple[int, ...]:
    return tuple(round(255 * min(max(channel, 0.0), 1.0)) for channel in (*surface.colour, surface.gloss))
