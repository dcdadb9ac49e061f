"""From solids and MuJoCo geoms to parts that the renderer draws."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from gcd_train.scenes.description import Part, Point, Quaternion, rotations
from gcd_train.scenes.tabletop.things import Solid

_SHAPES = {"box": "box", "sphere": "sphere", "cylinder": "cylinder", "bead": "ball"}
_BEAD_M = 0.012
"""Spheres below this radius are drawn with few triangles."""


def parts_of(solid: Solid, scale: float, *, label: int, instance: int, body: int) -> Iterator[Part]:
    """The primitives of one solid within its body, in scene units; a capsule is a cylinder and two spheres."""
    along = rotations(np.asarray(solid.turn))[:, 2]
    pieces: list[tuple[str, Point, Point]] = []
    centre = np.asarray(solid.centre)
    if solid.kind == "capsule":
        radius, half = solid.size
        pieces.append(("cylinder", solid.centre, (2 * radius, 2 * radius, 2 * half)))
        for end in (centre - half * along, centre + half * along):
            x, y, z = end.tolist()
            pieces.append(("bead" if radius < _BEAD_M else "sphere", (x, y, z), (2 * radius, 2 * radius, 2 * radius)))
    else:
        pieces.append((solid.kind, solid.centre, _full_size(solid)))
    for kind, place, size in pieces:
        yield Part(
            shape=_SHAPES[kind],
            centre=_scaled(place, scale),
            size=_scaled(size, scale),
            turn=solid.turn,
            colour=solid.colour,
            accent=solid.accent,
            pattern=solid.pattern,
            grain_m=solid.grain_m * scale,
            gloss=solid.gloss,
            label=label,
            instance=instance,
            body=body,
        )


def solids_of_body(mujoco: Any, model: Any, body: int) -> list[Solid]:
    """The geoms of one body of a compiled model, as they are seen."""
    kinds = {
        int(mujoco.mjtGeom.mjGEOM_BOX): "box",
        int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
        int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
        int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    }
    first = int(model.body_geomadr[body])
    found: list[Solid] = []
    for geom in range(first, first + int(model.body_geomnum[body])):
        kind = kinds[int(model.geom_type[geom])]
        numbers = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2}[kind]
        found.append(
            Solid(
                kind=kind,
                size=tuple(model.geom_size[geom][:numbers].tolist()),
                centre=_point(model.geom_pos[geom]),
                turn=_quaternion(model.geom_quat[geom]),
                colour=_point(model.geom_rgba[geom][:3]),
                gloss=0.25,
            )
        )
    return found


def bounding_box(solids: list[Solid]) -> tuple[Point, Point]:
    """Middle and size of the box along the body's axes that holds all solids' own boxes, metres."""
    corners: list[np.ndarray[Any, Any]] = []
    for solid in solids:
        half = np.abs(rotations(np.asarray(solid.turn))) @ (np.asarray(_full_size(solid)) / 2)
        corners += [np.asarray(solid.centre) - half, np.asarray(solid.centre) + half]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return _point((low + high) / 2), _point(high - low)


def _full_size(solid: Solid) -> Point:
    if solid.kind == "box":
        x, y, z = solid.size
        return 2 * x, 2 * y, 2 * z
    radius = solid.size[0]
    half = {"sphere": radius, "cylinder": solid.size[-1], "capsule": solid.size[-1] + radius}[solid.kind]
    return 2 * radius, 2 * radius, 2 * half


def _scaled(point: Point, scale: float) -> Point:
    return point[0] * scale, point[1] * scale, point[2] * scale


def _point(row: Any) -> Point:
    x, y, z = row.tolist()
    return x, y, z


def _quaternion(row: Any) -> Quaternion:
    w, x, y, z = row.tolist()
    return w, x, y, z
