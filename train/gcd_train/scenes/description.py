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
    """How a surface is painted, in the shader.

    SKY: endless: no depth, painted by direction. HILLS, HOUSES, HALL, STUDIO: what is seen around a finite stage, on a
    dome with its true depth. WOOD to TERRAZZO: solid, in the frame of the body, between `colour` and `accent`, repeated
    every `grain_m`.
    """

    PLAIN = 0
    WINDOWS = 1
    SPECKLE = 2
    TILES = 3
    SKY = 4
    LEAVES = 5
    BRICK = 6
    LIT = 7
    HILLS = 8
    WOOD = 9
    MARBLE = 10
    CHECKER = 11
    STRIPES = 12
    CLOUDY = 13
    DOTS = 14
    PLANKS = 15
    TERRAZZO = 16
    HOUSES = 17
    HALL = 18
    STUDIO = 19


DOMES = (Pattern.HILLS, Pattern.HOUSES, Pattern.HALL, Pattern.STUDIO)
"""What is painted on a dome: drawn last, and casts no shadow."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Part:
    """One unit primitive, scaled, turned and put in its place within a body.

    shape: a name of `primitives.SHAPES`, which fit a cube of side 1 about the origin. centre, size: metres. turn: unit
    quaternion w, x, y, z, done before the turn about the vertical by yaw, in radians. colour: sRGB, 0..1. accent: the
    pattern's second colour. gloss: 0..1. grain_m: the pattern's spacing, 0.02 to 5 m. label: class id. instance:
    1..255, 0 for what is not counted. body: index of the body it rides on.
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
    accent: Colour = (0.5, 0.5, 0.5)
    grain_m: float = 0.5
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

    corners: [N, 3, 3] triangle corners, metres. The rest as in `Part`.
    """

    corners: Floats
    colour: Colour
    label: int
    pattern: Pattern = Pattern.PLAIN
    gloss: float = 0.0
    accent: Colour = (0.5, 0.5, 0.5)
    grain_m: float = 0.5


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
class Extent:
    """How far a scene reaches, metres; the defaults suit a street, `ORBIT` suits a stage that cameras stand around.

    near_m, far_m: what cameras see. shadow_radius_m: half the side of the square around the focus in which shadows
    fall, across the sunlight; shadow_depth_m: how far before and behind the focus, along it. shadow_pixels: side of the
    shadow map.
    """

    near_m: float = 0.3
    far_m: float = 900.0
    shadow_radius_m: float = 55.0
    shadow_depth_m: float = 150.0
    shadow_pixels: int = 1024


STREET = Extent()
ORBIT = Extent(near_m=0.2, far_m=120.0, shadow_radius_m=13.0, shadow_depth_m=30.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneObject:
    """What is known of a thing beyond its picture: as the metadata of Kubric-4D tells it.

    name: which asset it is. instance: 1..255, as its parts have it. body: index into `Scene.poses`. label: class id.
    size: its bounding box along its own axes, metres. middle: of that box, in its own frame, metres. dynamic: thrown or
    driven, not laid to rest. positions: [T, 3] of its own origin in the world, metres. quaternions: [T, 4], w, x, y, z,
    world_from_object. velocities: [T, 3], metres a second. angular_velocities: [T, 3] about the world's axes, radians a
    second.
    """

    name: str
    instance: int
    body: int
    label: int
    size: Point
    dynamic: bool
    mass_kg: float
    friction: float
    restitution: float
    positions: NDArray[np.float64]
    quaternions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    angular_velocities: NDArray[np.float64]
    middle: Point = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Scene:
    """One clip's world.

    parts, sheets: what there is. poses: [T, B, 3, 4], world_from_body of each body at each time step; body 0 stands at
    the origin (see `upright`). focus: [T, 3], the point around which shadows are cast. cameras: name ->
    world_from_camera [T, 4, 4] (x right, y down, z ahead). hfov_deg: of every camera. objects: what more is told of
    things, where a world knows more. facts: what the metadata says about the whole scene.
    """

    parts: tuple[Part, ...]
    sheets: tuple[Sheet, ...]
    poses: Floats
    focus: Floats
    cameras: dict[str, NDArray[np.float64]]
    hfov_deg: float
    light: Light
    facts: dict[str, float | str] = field(default_factory=dict[str, float | str])
    objects: tuple[SceneObject, ...] = ()
    extent: Extent = STREET

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
