"""What a scene is, before anybody draws it: parts with a place, bodies that move, light, and cameras.

World: right-handed, z up, metres. Every world (driving, drop, tabletop) ends in a `Scene`; the renderer and the
writers know nothing else.
"""

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Colour = tuple[float, float, float]
Point = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

STATIC = 0
"""The body that never moves: the world itself."""


class Pattern(IntEnum):
    """How a surface is painted, in the shader."""

    PLAIN = 0
    WINDOWS = 1
    SPECKLE = 2
    TILES = 3
    SKY = 4
    LEAVES = 5
    BRICK = 6
    LIT = 7


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """One unit primitive, scaled, turned and put in its place within a body.

    shape: a name of `primitives.SHAPES`, which fit a cube of side 1 about the origin. centre, size: metres. turn: unit
    quaternion w, x, y, z, done before the turn about the vertical by yaw, in radians. colour: sRGB, 0..1. gloss:
    0..1. label: class id. instance: 1..255, 0 for what is not counted. body: index of the body it rides on.
    """

    shape: str
    centre: Point
    size: Point
    colour: Colour
    label: int
    yaw: float = 0.0
    turn: Quaternion = (1.0, 0.0, 0.0, 0.0)
    gloss: float = 0.0
    pattern: Pattern = Pattern.PLAIN
    instance: int = 0
    body: int = STATIC

    def placed(self, x: float, y: float, z: float, yaw: float) -> "Part":
        """The part after its assembly was turned by `yaw` and then moved."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        a, b, c = self.centre
        return replace(self, centre=(x + cos * a - sin * b, y + sin * a + cos * b, z + c), yaw=self.yaw + yaw)

    def of(self, *, instance: int, body: int = STATIC) -> "Part":
        """The part as belonging to an instance and a body."""
        return replace(self, instance=instance, body=body)


@dataclass(frozen=True, kw_only=True, slots=True)
class Sheet:
    """Flat ground that is painted alike: triangles that face up.

    corners: [N, 3, 3] triangle corners, metres.
    """

    corners: Floats
    colour: Colour
    label: int
    pattern: Pattern = Pattern.PLAIN
    gloss: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Light:
    """sun_to: unit vector towards the sun. sun, sky, ground: linear RGB strengths. fog_m: distance of half fog.

    horizon, zenith: colours of the sky, linear. cloud: 0..1.
    """

    sun_to: Point
    sun: Colour
    sky: Colour
    ground: Colour
    horizon: Colour
    zenith: Colour
    fog_m: float
    cloud: float
    exposure: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Scene:
    """One clip's world.

    parts, sheets: what there is. poses: [T, B, 3, 4], world_from_body of each body at each time step; body 0 stands at
    the origin (see `upright`). focus: [T, 3], the point around which shadows are cast. cameras: name ->
    world_from_camera [T, 4, 4] (x right, y down, z ahead). hfov_deg: of every camera.
    """

    parts: tuple[Part, ...]
    sheets: tuple[Sheet, ...]
    poses: Floats
    focus: Floats
    cameras: dict[str, NDArray[np.float64]]
    hfov_deg: float
    light: Light
    facts: dict[str, float | str] = field(default_factory=dict[str, float | str])

    @property
    def frames(self) -> int:
        """T."""
        return self.poses.shape[0]


def upright(rows: NDArray[Any]) -> NDArray[Any]:
    """Bodies that only turn about the vertical: x, y, z, yaw [..., 4] as world_from_body [..., 3, 4]."""
    poses = np.zeros((*rows.shape[:-1], 3, 4), rows.dtype)
    cos, sin = np.cos(rows[..., 3]), np.sin(rows[..., 3])
    poses[..., 0, 0], poses[..., 0, 1], poses[..., 1, 0], poses[..., 1, 1] = cos, -sin, sin, cos
    poses[..., 2, 2] = 1
    poses[..., 3] = rows[..., :3]
    return poses


def rotations(quaternions: NDArray[Any]) -> NDArray[Any]:
    """Unit quaternions w, x, y, z [..., 4] as rotation matrices [..., 3, 3]."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)
