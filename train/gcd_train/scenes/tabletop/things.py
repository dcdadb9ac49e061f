"""What lies on the table: things the gripper can take or push, and clutter that stays."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gcd_train.scenes.description import Colour, Pattern, Point, Quaternion

UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Solid:
    """One MuJoCo geom and how it is painted.

    kind: box, sphere, cylinder or capsule. size: MuJoCo's half sizes, metres. centre, turn: within the thing.
    """

    kind: str
    size: tuple[float, ...]
    centre: Point = (0.0, 0.0, 0.0)
    turn: Quaternion = UPRIGHT
    colour: Colour
    accent: Colour = (0.5, 0.5, 0.5)
    pattern: Pattern = Pattern.PLAIN
    grain_m: float = 0.05
    gloss: float = 0.1


@dataclass(frozen=True, kw_only=True, slots=True)
class Thing:
    """Something made of solids; its origin is the middle of its bounding box.

    size: of the bounding box along its own axes, metres. grip_m: distance of the fingers that hold it, across its own y
    axis, 0 if it is not to be grasped. grip_z: where on its own z axis. any_yaw: it may be grasped from any side.
    rolls: it is stopped from rolling for ever.
    """

    name: str
    solids: tuple[Solid, ...]
    size: Point
    mass_kg: float
    friction: float
    grip_m: float = 0.0
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


def _paint(random: np.random.Generator) -> "_Paint":
    first, second = random.choice(len(_COLOURS), 2, replace=False)
    return _Paint(
        colour=_tinted(_COLOURS[int(first)], random),
        accent=_tinted(_COLOURS[int(second)], random),
        pattern=Pattern(int(_PATTERNS[int(random.integers(len(_PATTERNS)))])),
        grain_m=float(random.uniform(0.02, 0.06)),
        gloss=float(random.uniform(0.0, 0.5)),
    )


@dataclass(frozen=True, slots=True)
class _Paint:
    colour: Colour
    accent: Colour
    pattern: Pattern
    grain_m: float
    gloss: float

    def solid(self, kind: str, size: tuple[float, ...], centre: Point = (0, 0, 0), turn: Quaternion = UPRIGHT) -> Solid:
        return Solid(
            kind=kind,
            size=size,
            centre=centre,
            turn=turn,
            colour=self.colour,
            accent=self.accent,
            pattern=self.pattern,
            grain_m=self.grain_m,
            gloss=self.gloss,
        )

    def plain(self, kind: str, size: tuple[float, ...], centre: Point = (0, 0, 0), turn: Quaternion = UPRIGHT) -> Solid:
        """In the second colour."""
        return Solid(kind=kind, size=size, centre=centre, turn=turn, colour=self.accent, gloss=self.gloss)


def _tinted(colour: Colour, random: np.random.Generator) -> Colour:
    red, green, blue = (min(1.0, channel * float(random.uniform(0.85, 1.15))) for channel in colour)
    return red, green, blue


def _block(random: np.random.Generator, widest: float) -> Thing:
    """A block or a carton, at most `widest` across its y axis."""
    wide, deep = float(random.uniform(0.035, widest)), float(random.uniform(0.04, 0.12))
    high = float(random.uniform(0.04, 0.15))
    solid = _paint(random).solid("box", (deep / 2, wide / 2, high / 2))
    mass = _mass(deep * wide * high, random)
    return Thing(
        name="block" if high < 0.08 else "carton",
        solids=(solid,),
        size=(deep, wide, high),
        mass_kg=mass,
        friction=float(random.uniform(0.6, 1.0)),
        grip_m=wide,
        grip_z=_below_top(high),
    )


def _can(random: np.random.Generator, widest: float) -> Thing:
    radius, high = float(random.uniform(0.022, widest / 2)), float(random.uniform(0.05, 0.13))
    paint = _paint(random)
    rim = paint.plain("cylinder", (radius * 0.94, 0.004), (0, 0, high / 2 - 0.004))
    solids = (paint.solid("cylinder", (radius, high / 2 - 0.003), (0, 0, -0.003)), rim)
    return _round("can", solids, radius, high, random)


def _bottle(random: np.random.Generator, widest: float) -> Thing:
    radius, high = float(random.uniform(0.022, min(widest / 2, 0.034))), float(random.uniform(0.13, 0.155))
    paint = _paint(random)
    body = paint.solid("cylinder", (radius, 0.31 * high), (0, 0, -0.19 * high))
    shoulder = paint.solid("sphere", (radius * 0.985,), (0, 0, 0.12 * high))
    neck = paint.plain("cylinder", (radius * 0.4, 0.19 * high), (0, 0, 0.31 * high))
    bottle = _round("bottle", (body, shoulder, neck), radius, high, random)
    return replace(bottle, grip_z=0.12 * high - 0.010)


def _mug(random: np.random.Generator, widest: float) -> Thing:
    """The handle points along x, so that the fingers come from the sides."""
    radius, high = float(random.uniform(0.42 * widest, widest / 2)), float(random.uniform(0.07, 0.10))
    paint, reach = _paint(random), 0.026
    x = radius + reach / 2
    handle = (
        paint.solid("box", (reach / 2, 0.005, 0.006), (x, 0, 0.25 * high)),
        paint.solid("box", (reach / 2, 0.005, 0.006), (x, 0, -0.25 * high)),
        paint.solid("box", (0.005, 0.006, 0.25 * high + 0.006), (radius + reach, 0, 0)),
    )
    filled = paint.plain("cylinder", (radius * 0.85, 0.002), (0, 0, high / 2))
    thing = _round("mug", (paint.solid("cylinder", (radius, high / 2)), filled, *handle), radius, high, random)
    return replace(thing, size=(2 * (radius + reach), 2 * radius, high), any_yaw=False)


def _ball(random: np.random.Generator, widest: float) -> Thing:
    radius = float(random.uniform(0.025, widest / 2))
    return Thing(
        name="ball",
        solids=(_paint(random).solid("sphere", (radius,)),),
        size=(2 * radius, 2 * radius, 2 * radius),
        mass_kg=_mass(4 * radius**3, random),
        friction=float(random.uniform(0.7, 1.0)),
        grip_m=2 * radius,
        grip_z=0.0,
        any_yaw=True,
        rolls=True,
    )


def _bar(random: np.random.Generator, widest: float) -> Thing:
    """A thick stick that lies along x: a sausage, a marker, a roll."""
    radius, half = float(random.uniform(0.018, min(widest / 2, 0.03))), float(random.uniform(0.03, 0.07))
    lying: Quaternion = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
    paint = _paint(random)
    return Thing(
        name="bar",
        solids=(paint.solid("capsule", (radius, half), turn=lying),),
        size=(2 * (half + radius), 2 * radius, 2 * radius),
        mass_kg=_mass(6 * half * radius**2, random),
        friction=float(random.uniform(0.7, 1.0)),
        grip_m=2 * radius,
        grip_z=0.0,
        rolls=True,
    )


def _bridge(random: np.random.Generator, widest: float) -> Thing:
    """A toy of three blocks: two feet and a beam."""
    wide, long, high = float(random.uniform(0.03, min(widest, 0.05))), float(random.uniform(0.09, 0.13)), 0.075
    paint = _paint(random)
    beam = paint.solid("box", (long / 2, wide / 2, 0.014), (0, 0, high / 2 - 0.014))
    feet = [
        paint.plain("box", (0.015, wide / 2, high / 2 - 0.014), (x, 0, -0.014))
        for x in (0.015 - long / 2, long / 2 - 0.015)
    ]
    return Thing(
        name="bridge",
        solids=(beam, *feet),
        size=(long, wide, high),
        mass_kg=_mass(long * wide * 0.05, random),
        friction=float(random.uniform(0.6, 1.0)),
        grip_m=wide,
        grip_z=high / 2 - 0.018,
    )


def _round(name: str, solids: tuple[Solid, ...], radius: float, high: float, random: np.random.Generator) -> Thing:
    return Thing(
        name=name,
        solids=solids,
        size=(2 * radius, 2 * radius, high),
        mass_kg=_mass(math.pi * radius**2 * high, random),
        friction=float(random.uniform(0.6, 1.0)),
        grip_m=2 * radius,
        grip_z=_below_top(high),
        any_yaw=True,
    )


def _below_top(high: float) -> float:
    """Grasp height about the middle: fingers reach 35 mm down from the top of what is tall, to the middle else."""
    return max(0.0, high / 2 - 0.035)


def _mass(volume: float, random: np.random.Generator) -> float:
    """Between balsa and water."""
    return max(0.02, volume * float(random.uniform(250, 800)))


_MAKERS: tuple[Callable[[np.random.Generator, float], Thing], ...] = (
    _block,
    _block,
    _can,
    _bottle,
    _mug,
    _ball,
    _bar,
    _bridge,
)


def random_thing(random: np.random.Generator, widest: float) -> Thing:
    """A thing a gripper that opens a little more than `widest` metres can hold."""
    return _MAKERS[int(random.integers(len(_MAKERS)))](random, widest)
