"""What a tabletop scene is made of: classes, things of parts, and the loose ones that the gripper can take or push.

Everything here is in metres; `Part` is used as in every world, but a capsule's third size is that of its cylinder
alone, as MuJoCo has it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from gcd_train.scenes.description import Colour, Part, Pattern, Point, Quaternion

_Random = np.random.Generator


class TabletopClass(IntEnum):
    """What a pixel shows. Everything that carries the arm is ROBOT_ARM; palm and fingers are GRIPPER."""

    SKY = 0
    FLOOR = 1
    WALL = 2
    TABLE = 3
    ROBOT_ARM = 4
    GRIPPER = 5
    OBJECT = 6
    CLUTTER = 7


@dataclass(frozen=True, kw_only=True, slots=True)
class Thing:
    """Something made of parts, in its own frame.

    size, middle: of the bounding box along its own axes, metres; `middle` is the origin but for links of the arm.
    grip_z: where on its own z axis fingers hold it, across its y axis. any_yaw: it may be grasped from any side.
    rolls: it is stopped from rolling for ever.
    """

    name: str
    parts: tuple[Part, ...]
    size: Point
    mass_kg: float
    friction: float
    middle: Point = (0.0, 0.0, 0.0)
    grip_z: float = 0.0
    any_yaw: bool = False
    rolls: bool = False

    @property
    def radius_m(self) -> float:
        """Of the circle about its footprint."""
        return math.hypot(self.size[0], self.size[1]) / 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Placed:
    """A thing and where it stands: origin x, y, z in metres and its turn about the vertical, radians."""

    thing: Thing
    place: Point
    yaw: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Setting:
    """What a scene begins with. arm: its MJCF, see `random_arm`. table: parts in the table's frame."""

    arm: str
    table: tuple[Part, ...]
    clutter: tuple[Placed, ...]
    things: tuple[Placed, ...]


def solid(
    label: TabletopClass,
    shape: str,
    size: Point,
    centre: Point = (0.0, 0.0, 0.0),
    *,
    colour: Colour,
    gloss: float = 0.1,
) -> Part:
    """A part of one plain colour."""
    return Part(shape=shape, centre=centre, size=size, colour=colour, gloss=gloss, grain_m=0.05, label=label)


def shaped(paint: Part, shape: str, size: Point, centre: Point = (0.0, 0.0, 0.0)) -> Part:
    """Another part that is painted as `paint` is."""
    return replace(paint, shape=shape, size=size, centre=centre)


_COLOURS: tuple[Colour, ...] = (
    (0.80, 0.16, 0.14),
    (0.92, 0.55, 0.12),
    (0.95, 0.80, 0.20),
    (0.22, 0.58, 0.27),
    (0.13, 0.45, 0.62),
    (0.20, 0.26, 0.60),
    (0.52, 0.24, 0.55),
    (0.90, 0.88, 0.84),
    (0.24, 0.24, 0.26),
    (0.86, 0.46, 0.52),
    (0.45, 0.70, 0.70),
    (0.62, 0.44, 0.28),
)
_PATTERNS = (Pattern.PLAIN, Pattern.PLAIN, Pattern.STRIPES, Pattern.CHECKER, Pattern.DOTS, Pattern.CLOUDY, Pattern.WOOD)


def _paints(random: _Random) -> tuple[Part, Part]:
    """Two paints of one thing, to be given to `shaped`: a patterned one, and its second colour alone."""
    first, second = random.choice(len(_COLOURS), 2, replace=False)
    colour, accent = _tinted(_COLOURS[int(first)], random), _tinted(_COLOURS[int(second)], random)
    pattern = _PATTERNS[int(random.integers(len(_PATTERNS)))]
    grain_m, gloss = float(random.uniform(0.02, 0.06)), float(random.uniform(0.0, 0.5))
    plain = solid(TabletopClass.OBJECT, "box", (1.0, 1.0, 1.0), colour=accent, gloss=gloss)
    return replace(plain, colour=colour, accent=accent, pattern=pattern, grain_m=grain_m), plain


def _tinted(colour: Colour, random: _Random) -> Colour:
    red, green, blue = (min(1.0, channel * float(random.uniform(0.85, 1.15))) for channel in colour)
    return red, green, blue


def random_thing(random: _Random, widest: float) -> Thing:
    """A thing a gripper that opens a little more than `widest` metres can hold."""
    return _MAKERS[int(random.integers(len(_MAKERS)))](random, widest)


def _block(random: _Random, widest: float) -> Thing:
    """A block or a carton, at most `widest` across its y axis."""
    wide, deep = float(random.uniform(0.035, widest)), float(random.uniform(0.04, 0.12))
    size = (deep, wide, float(random.uniform(0.04, 0.15)))
    paint, _ = _paints(random)
    name = "block" if size[2] < 0.08 else "carton"
    return _loose(name, (shaped(paint, "box", size),), size, deep * wide * size[2], random, grip_z=_below_top(size[2]))


def _can(random: _Random, widest: float) -> Thing:
    radius, high = float(random.uniform(0.022, widest / 2)), float(random.uniform(0.05, 0.13))
    paint, plain = _paints(random)
    body = _cylinder(paint, radius, high - 0.006, -0.003)
    return _round("can", (body, _cylinder(plain, radius * 0.94, 0.008, high / 2 - 0.004)), radius, high, random)


def _bottle(random: _Random, widest: float) -> Thing:
    radius, high = float(random.uniform(0.022, min(widest / 2, 0.034))), float(random.uniform(0.13, 0.155))
    paint, plain = _paints(random)
    body = _cylinder(paint, radius, 0.62 * high, -0.19 * high)
    shoulder = _sphere(paint, radius * 0.985, 0.12 * high)
    neck = _cylinder(plain, radius * 0.4, 0.38 * high, 0.31 * high)
    bottle = _round("bottle", (body, shoulder, neck), radius, high, random)
    return replace(bottle, grip_z=0.12 * high - 0.010)


def _mug(random: _Random, widest: float) -> Thing:
    """The handle points along x, so that the fingers come from the sides."""
    radius, high = float(random.uniform(0.42 * widest, widest / 2)), float(random.uniform(0.07, 0.10))
    (paint, plain), reach = _paints(random), 0.026
    x = radius + reach / 2
    handle = (
        shaped(paint, "box", (reach, 0.01, 0.012), (x, 0, 0.25 * high)),
        shaped(paint, "box", (reach, 0.01, 0.012), (x, 0, -0.25 * high)),
        shaped(paint, "box", (0.01, 0.012, 2 * (0.25 * high + 0.006)), (radius + reach, 0, 0)),
    )
    parts = (_cylinder(paint, radius, high), _cylinder(plain, radius * 0.85, 0.004, high / 2), *handle)
    mug = _round("mug", parts, radius, high, random)
    return replace(mug, size=(2 * (radius + reach), 2 * radius, high), any_yaw=False)


def _ball(random: _Random, widest: float) -> Thing:
    radius = float(random.uniform(0.025, widest / 2))
    ball = _sphere(_paints(random)[0], radius)
    return _loose("ball", (ball,), ball.size, 4 * radius**3, random, any_yaw=True, rolls=True)


def _bar(random: _Random, widest: float) -> Thing:
    """A thick stick that lies along x: a sausage, a marker, a roll."""
    radius, half = float(random.uniform(0.018, min(widest / 2, 0.03))), float(random.uniform(0.03, 0.07))
    lying: Quaternion = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
    stick = replace(shaped(_paints(random)[0], "capsule", (2 * radius, 2 * radius, 2 * half)), turn=lying)
    size = (2 * (half + radius), 2 * radius, 2 * radius)
    return _loose("bar", (stick,), size, 6 * half * radius**2, random, rolls=True)


def _bridge(random: _Random, widest: float) -> Thing:
    """A toy of three blocks: two feet and a beam."""
    wide, long, high = float(random.uniform(0.03, min(widest, 0.05))), float(random.uniform(0.09, 0.13)), 0.075
    paint, plain = _paints(random)
    beam = shaped(paint, "box", (long, wide, 0.028), (0, 0, high / 2 - 0.014))
    feet = [
        shaped(plain, "box", (0.03, wide, 2 * (high / 2 - 0.014)), (x, 0, -0.014))
        for x in (0.015 - long / 2, long / 2 - 0.015)
    ]
    size = (long, wide, high)
    return _loose("bridge", (beam, *feet), size, long * wide * 0.05, random, grip_z=high / 2 - 0.018)


_MAKERS: tuple[Callable[[_Random, float], Thing], ...] = (_block, _block, _can, _bottle, _mug, _ball, _bar, _bridge)


def _cylinder(paint: Part, radius: float, high: float, z: float = 0.0) -> Part:
    return shaped(paint, "cylinder", (2 * radius, 2 * radius, high), (0, 0, z))


def _sphere(paint: Part, radius: float, z: float = 0.0) -> Part:
    return shaped(paint, "sphere", (2 * radius, 2 * radius, 2 * radius), (0, 0, z))


def _below_top(high: float) -> float:
    """Grasp height about the middle: fingers reach 35 mm down from the top of what is tall, to the middle else."""
    return max(0.0, high / 2 - 0.035)


def _round(name: str, parts: tuple[Part, ...], radius: float, high: float, random: _Random) -> Thing:
    size, volume = (2 * radius, 2 * radius, high), math.pi * radius**2 * high
    return _loose(name, parts, size, volume, random, grip_z=_below_top(high), any_yaw=True)


def _loose(
    name: str,
    parts: tuple[Part, ...],
    size: Point,
    volume: float,
    random: _Random,
    *,
    grip_z: float = 0.0,
    any_yaw: bool = False,
    rolls: bool = False,
) -> Thing:
    """A thing with a density between balsa and water. volume: m3, roughly."""
    return Thing(
        name=name,
        parts=parts,
        size=size,
        mass_kg=max(0.02, volume * float(random.uniform(250, 800))),
        friction=float(random.uniform(0.7 if rolls else 0.6, 1.0)),
        grip_z=grip_z,
        any_yaw=any_yaw,
        rolls=rolls,
    )
