"""What a scene is, before anybody draws it: parts with a place, bodies that move, light, and cameras.

World: right-handed, z up, metres. Every world (driving, drop, tabletop) ends in a `Scene`; the renderer and the
writers know nothing else.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
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


@dataclass(frozen=True, slots=True)
class Paint:
    """How a surface looks.

    colour: sRGB, 0..1. accent: the pattern's second colour. grain_m: the pattern's spacing, 0.02 to 5 m. gloss: 0..1.
    """

    colour: Colour
    accent: Colour = (0.5, 0.5, 0.5)
    pattern: Pattern = Pattern.PLAIN
    grain_m: float = 0.5
    gloss: float = 0.0


@dataclass(frozen=True, slots=True)
class Part:
    """One unit primitive, scaled, turned and put in its place within a body.

    shape: a name of `triangles.SHAPES`, which fit a cube of side 1 about the origin. centre, size: metres. label:
    class id. turn: unit quaternion w, x, y, z, done before the turn about the vertical by yaw, in radians. instance:
    1..255, 0 for what is not counted. body: index of the body it rides on.
    """

    shape: str
    centre: Point
    size: Point
    paint: Paint
    label: int
    turn: Quaternion = (1.0, 0.0, 0.0, 0.0)
    yaw: float = 0.0
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


@dataclass(frozen=True, slots=True)
class Sheet:
    """Flat ground that is painted alike. corners: of triangles that face up, [N, 3, 3], metres."""

    corners: Floats
    paint: Paint
    label: int


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
class Thing:
    """Something made of parts, in its own frame, metres, before it has a place.

    size, middle: of its bounding box along its own axes. dynamic: thrown or driven, not laid to rest.
    """

    name: str
    parts: tuple[Part, ...]
    size: Point
    mass_kg: float
    friction: float
    restitution: float = 0.0
    dynamic: bool = True
    middle: Point = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """The motion of N things in T time steps; of one thing without the N.

    positions: of their origins, [T, N, 3], metres. quaternions: [T, N, 4], w, x, y, z, world_from_thing. velocities:
    [T, N, 3], metres a second. angular_velocities: [T, N, 3] about the world's axes, radians a second.
    """

    positions: Doubles
    quaternions: Doubles
    velocities: Doubles
    angular_velocities: Doubles


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneObject(Thing, Tracks):
    """What is known of a thing in a scene beyond its picture: as the metadata of Kubric-4D tells it.

    instance: 1..255, as its parts have it. body: index into `Scene.poses`. label: class id.
    """

    instance: int
    body: int
    label: int

    @classmethod
    def of(cls, thing: Thing, tracks: Tracks, number: int, *, instance: int, body: int, label: int) -> Self:
        """A thing whose motion is number so-and-so of the tracks."""
        known = {each.name: getattr(thing, each.name) for each in fields(Thing)}
        motion = {each.name: getattr(tracks, each.name)[:, number] for each in fields(Tracks)}
        return cls(**known, **motion, instance=instance, body=body, label=label)


@dataclass(frozen=True, kw_only=True, slots=True)
class Staging:
    """What the renderer needs of a scene beside what there is.

    poses: [T, B, 3, 4], world_from_body of each body at each time step; body 0 stands at the origin (see `upright`).
    focus: [T, 3], the point around which shadows are cast. hfov_deg: of every camera.
    """

    poses: Floats
    focus: Floats
    hfov_deg: float
    light: Light
    extent: Extent = STREET

    @property
    def frames(self) -> int:
        """T."""
        return self.poses.shape[0]


@dataclass(frozen=True, kw_only=True, slots=True)
class Scene(Staging):
    """One clip's world.

    parts, sheets: what there is. cameras: name -> world_from_camera [T, 4, 4] (x right, y down, z ahead). objects: what
    more is told of things, where a world knows more. facts: what the metadata says about the whole scene.
    """

    parts: tuple[Part, ...]
    sheets: tuple[Sheet, ...]
    cameras: dict[str, Doubles]
    facts: dict[str, float | str] = field(default_factory=dict[str, float | str])
    objects: tuple[SceneObject, ...] = ()

    def clear_of_things(self, eyes: Doubles, steps: Sequence[int]) -> bool:
        """Whether cameras at `eyes` [C, S, 3] at time steps [S] keep a unit away from the sphere about any thing.

        Nearer, one thing would fill the picture.
        """
        times = list(steps)
        for thing in self.objects:
            middle = thing.positions[times] + rotations(thing.quaternions[times]) @ np.array(thing.middle)
            reach = np.linalg.norm(thing.size) / 2 + 1.0
            if bool((np.linalg.norm(eyes - middle, axis=-1) < reach).any()):
                return False
        return True


def upright(rows: NDArray[Any]) -> NDArray[Any]:
    """Bodies that only turn about the vertical: x, y, z, yaw [..., 4] as world_from_body [..., 3, 4]."""
    poses = np.zeros((*rows.shape[:-1], 3, 4), rows.dtype)
    cos, sin = np.cos(rows[..., 3]), np.sin(rows[..., 3])
    poses[..., 0, 0], poses[..., 0, 1], poses[..., 1, 0], poses[..., 1, 1] = cos, -sin, sin, cos
    poses[..., 2, 2] = 1
    poses[..., 3] = rows[..., :3]
    return poses


def rigid(rows: NDArray[Any]) -> Doubles:
    """The same of rows [T, 4] as rigid transforms [T, 4, 4]."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = upright(rows)
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


def moved(a_from_b: NDArray[Any], points: NDArray[Any]) -> NDArray[Any]:
    """Points [..., 3] of one frame in another, by a rigid transform [4, 4]."""
    return points @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def with_world(turns: Doubles, positions: Doubles) -> Floats:
    """world_from_body [T, 1 + B, 3, 4]: the world itself, then bodies by rotation [T, B, 3, 3] and origin [T, B, 3]."""
    moving = np.concatenate([turns, positions[..., None]], -1)
    still = np.broadcast_to(np.eye(4)[:3], (len(moving), 1, 3, 4))
    return np.concatenate([still, moving], 1).astype(np.float32)


def yawed(quaternions: NDArray[Any], yaw: float) -> NDArray[Any]:
    """Unit quaternions w, x, y, z [..., 4] after one more turn about the vertical, radians."""
    c, s = math.cos(yaw / 2), math.sin(yaw / 2)
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)


def towards(height: float, azimuth: float) -> Point:
    """The unit vector at a height above the horizon and an angle about the vertical, radians."""
    return math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)


def square(half_m: float, z: float) -> Floats:
    """A level square about the origin, as corners of two triangles [2, 3, 3]."""
    a, b, c, d = ((x * half_m, y * half_m, z) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
    return np.array([(a, b, c), (a, c, d)], np.float32)


def pick(random: np.random.Generator, choices: Sequence[T]) -> T:
    """Any of them, equally often."""
    return choices[int(random.integers(len(choices)))]


def pick_by_share(random: np.random.Generator, choices: Sequence[tuple[T, float]]) -> T:
    """Any of them, each as often as its share says; the shares add up to 1."""
    return choices[int(random.choice(len(choices), p=[share for _, share in choices]))][0]


def shaded(colour: Colour, factor: float) -> Colour:
    """The colour, darker or brighter."""
    r, g, b = (min(max(channel * factor, 0.0), 1.0) for channel in colour)
    return r, g, b


def mixed(colour: Colour, share: float, other: Colour) -> Colour:
    """The colour, by a share of the way to another one."""
    r, g, b = (c + (o - c) * share for c, o in zip(colour, other, strict=True))
    return r, g, b
