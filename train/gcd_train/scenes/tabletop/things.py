"""What stands and lies on the table: the table itself, clutter, and loose things that the gripper can take or push.

Everything here is in metres; `Part` is used as in every world, but a capsule's third size is that of its cylinder
alone, as MuJoCo has it.
"""

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from gcd_train.scenes.description import Colour, Paint, Part, Pattern, Point, Quaternion, Thing, pick, shaded

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
class TableThing(Thing):
    """A thing, a link of the arm or a piece of clutter; the origin is the middle of all but links.

    grip_z: where on its own z axis fingers hold it, across its y axis. any_yaw: it may be grasped from any side.
    rolls: it is stopped from rolling for ever.
    """

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

    thing: TableThing
    place: Point
    yaw: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Setting:
    """What a scene begins with. arm: its MJCF, see `random_arm`. table: parts in the table's frame."""

    arm: str
    table: tuple[Part, ...]
    clutter: tuple[Placed, ...]
    things: tuple[Placed, ...]


def plain(colour: Colour, gloss: float = 0.1) -> Paint:
    """One colour without a pattern."""
    return Paint(colour, grain_m=0.05, gloss=gloss)


# table and clutter

TABLE_M = (0.66, 0.72)
"""Half length along x and half width along y of the table top; its surface is at z = 0."""
FLOOR_M = -0.76
WOODS: tuple[Colour, ...] = ((0.62, 0.43, 0.26), (0.78, 0.62, 0.42), (0.45, 0.29, 0.18), (0.83, 0.74, 0.60))
FLATS: tuple[Colour, ...] = ((0.86, 0.86, 0.84), (0.36, 0.38, 0.40), (0.55, 0.62, 0.60), (0.24, 0.30, 0.36))
_CLUTTER_SPOTS = ((0.45, 0.5), (0.48, 0.0), (0.45, -0.5), (-0.05, 0.58), (-0.05, -0.58), (-0.5, 0.52))
"""Along the edges of the table, out of the arm's way."""


def random_table(random: _Random) -> tuple[Part, ...]:
    """A table with four legs, or a closed bench; origin in the middle of its surface."""
    wooden = random.random() < 0.6
    colour = pick(random, WOODS if wooden else FLATS)
    dark, pattern = shaded(colour, 0.7), Pattern.PLANKS if wooden else Pattern.PLAIN
    paint = Paint(colour, dark, pattern, random.uniform(0.09, 0.2), random.uniform(0.05, 0.3))
    (x, y), half = TABLE_M, (-FLOOR_M - 0.04) / 2
    top = Part("box", (0.0, 0.0, -0.02), (2 * x, 2 * y, 0.04), paint, TabletopClass.TABLE)
    if random.random() < 0.4:
        size = (2 * (x - 0.05), 2 * (y - 0.05), 2 * half)
        return top, Part("box", (0.0, 0.0, -0.04 - half), size, plain(dark), TabletopClass.TABLE)
    at = [(a, b, -0.04 - half) for a in (0.07 - x, x - 0.07) for b in (0.07 - y, y - 0.07)]
    return top, *(Part("box", foot, (0.06, 0.06, 2 * half), plain(dark), TabletopClass.TABLE) for foot in at)


def random_clutter(random: _Random) -> tuple[Placed, ...]:
    """Two to five large things."""
    made: list[Placed] = []
    for index in random.choice(len(_CLUTTER_SPOTS), int(random.integers(2, 6)), replace=False):
        thing = _clutter_thing(random)
        x, y = _CLUTTER_SPOTS[int(index)]
        place = (x + random.uniform(-0.03, 0.03), y + random.uniform(-0.03, 0.03), thing.size[2] / 2)
        made.append(Placed(thing=thing, place=place, yaw=random.uniform(-0.4, 0.4)))
    return tuple(made)


def _clutter_thing(random: _Random) -> TableThing:
    kind = int(random.integers(4))
    red, green, blue = (random.uniform(0.15, most) for most in (0.9, 0.85, 0.85))
    colour = (red, green, blue)
    if kind == 1:
        return _books(random)
    if kind == 2:
        across, high = 2 * random.uniform(0.04, 0.07), 2 * random.uniform(0.05, 0.11)
        body = _clutter("cylinder", (across, across, high), plain(colour, 0.5))
        lid_size, lid_at = (across * 1.04, across * 1.04, 0.012), (0, 0, high / 2 - 0.006)
        return _still("tin", (body, _clutter("cylinder", lid_size, plain((0.75, 0.76, 0.78)), lid_at)), body.size)
    bounds = ((0.07, 0.10), (0.08, 0.13), (0.03, 0.06)) if kind == 0 else ((0.05, 0.09), (0.06, 0.11), (0.04, 0.12))
    x, y, z = (2 * random.uniform(low, high) for low, high in bounds)
    if kind == 0:  # an open crate: a floor and four walls
        plates: tuple[tuple[Point, Point], ...] = (
            ((x, y, 0.008), (0, 0, 0.004 - z / 2)),
            ((0.008, y, z), (0.004 - x / 2, 0, 0)),
            ((0.008, y, z), (x / 2 - 0.004, 0, 0)),
            ((x, 0.008, z), (0, 0.004 - y / 2, 0)),
            ((x, 0.008, z), (0, y / 2 - 0.004, 0)),
        )
        return _still("bin", tuple(_clutter("box", size, plain(colour, 0.3), at) for size, at in plates), (x, y, z))
    tape = _clutter("box", (x + 0.002, 0.03, z + 0.002), plain((0.85, 0.78, 0.62), 0.3))
    return _still("box", (_clutter("box", (x, y, z), plain((0.72, 0.56, 0.38))), tape), (x, y, z))


def _books(random: _Random) -> TableThing:
    """A pile of books, each turned a little by its size."""
    thick = random.uniform(0.010, 0.022, int(random.integers(2, 5)))
    low = -float(thick.sum())
    books: list[Part] = []
    for half in thick.tolist():
        size = (2 * random.uniform(0.06, 0.085), 2 * random.uniform(0.09, 0.12), 2 * half)
        colour = (random.uniform(0.1, 0.8), random.uniform(0.1, 0.6), random.uniform(0.1, 0.7))
        shift = (random.uniform(-0.01, 0.01), random.uniform(-0.01, 0.01), low + half)
        books.append(_clutter("box", size, plain(colour, 0.15), shift))
        low += 2 * half
    return _still("books", tuple(books), (0.19, 0.26, 2 * float(thick.sum())))


def _clutter(shape: str, size: Point, paint: Paint, centre: Point = (0, 0, 0)) -> Part:
    return Part(shape, centre, size, paint, TabletopClass.CLUTTER)


def _still(name: str, parts: tuple[Part, ...], size: Point) -> TableThing:
    return TableThing(name=f"clutter/{name}", parts=parts, size=size, mass_kg=1.0, friction=0.8, dynamic=False)


# loose things

_COLOURS: tuple[Colour, ...] = (
    (0.80, 0.16, 0.14), (0.92, 0.55, 0.12), (0.95, 0.80, 0.20), (0.22, 0.58, 0.27),
    (0.13, 0.45, 0.62), (0.20, 0.26, 0.60), (0.52, 0.24, 0.55), (0.90, 0.88, 0.84),
    (0.24, 0.24, 0.26), (0.86, 0.46, 0.52), (0.45, 0.70, 0.70), (0.62, 0.44, 0.28),
)  # fmt: skip
_PATTERNS = (Pattern.PLAIN, Pattern.PLAIN, Pattern.STRIPES, Pattern.CHECKER, Pattern.DOTS, Pattern.CLOUDY, Pattern.WOOD)


def _paints(random: _Random) -> tuple[Paint, Paint]:
    """Two paints of one thing: a patterned one, and its second colour alone."""
    colours: list[Colour] = []
    for index in random.choice(len(_COLOURS), 2, replace=False):
        red, green, blue = (min(1.0, part * random.uniform(0.85, 1.15)) for part in _COLOURS[int(index)])
        colours.append((red, green, blue))
    colour, accent = colours
    pattern = pick(random, _PATTERNS)
    grain_m, gloss = random.uniform(0.02, 0.06), random.uniform(0.0, 0.5)
    return Paint(colour, accent, pattern, grain_m, gloss), plain(accent, gloss)


def random_thing(random: _Random, widest: float) -> TableThing:
    """What a gripper that opens a little more than `widest` metres can hold, of a density between balsa and water."""
    thing = pick(random, _MAKERS)(random, widest)
    mass_kg = max(0.02, thing.mass_kg * random.uniform(250, 800))
    return replace(thing, mass_kg=mass_kg, friction=random.uniform(0.7 if thing.rolls else 0.6, 1.0))


# makers: of things without friction that weigh a kilogramme a cubic metre, roughly


def _block(random: _Random, widest: float) -> TableThing:
    """A block or a carton, at most `widest` across its y axis."""
    wide, deep = random.uniform(0.035, widest), random.uniform(0.04, 0.12)
    size = (deep, wide, random.uniform(0.04, 0.15))
    body, name = _part("box", size, _paints(random)[0]), "block" if size[2] < 0.08 else "carton"
    return _loose(name, (body,), size, deep * wide * size[2], grip_z=_below_top(size[2]))


def _can(random: _Random, widest: float) -> TableThing:
    radius, high = random.uniform(0.022, widest / 2), random.uniform(0.05, 0.13)
    paint, lid = _paints(random)
    parts = (_cylinder(paint, radius, high - 0.006, -0.003), _cylinder(lid, radius * 0.94, 0.008, high / 2 - 0.004))
    return _round("can", parts, radius, high)


def _bottle(random: _Random, widest: float) -> TableThing:
    radius, high = random.uniform(0.022, min(widest / 2, 0.034)), random.uniform(0.13, 0.155)
    paint, cap = _paints(random)
    parts = (
        _cylinder(paint, radius, 0.62 * high, -0.19 * high),
        _sphere(paint, radius * 0.985, 0.12 * high),
        _cylinder(cap, radius * 0.4, 0.38 * high, 0.31 * high),
    )
    return replace(_round("bottle", parts, radius, high), grip_z=0.12 * high - 0.010)


def _mug(random: _Random, widest: float) -> TableThing:
    """The handle points along x, so that the fingers come from the sides."""
    radius, high = random.uniform(0.42 * widest, widest / 2), random.uniform(0.07, 0.10)
    (paint, inside), reach = _paints(random), 0.026
    x = radius + reach / 2
    parts = (
        _cylinder(paint, radius, high),
        _cylinder(inside, radius * 0.85, 0.004, high / 2),
        _part("box", (reach, 0.01, 0.012), paint, (x, 0, 0.25 * high)),
        _part("box", (reach, 0.01, 0.012), paint, (x, 0, -0.25 * high)),
        _part("box", (0.01, 0.012, 2 * (0.25 * high + 0.006)), paint, (radius + reach, 0, 0)),
    )
    mug = _round("mug", parts, radius, high)
    return replace(mug, size=(2 * (radius + reach), 2 * radius, high), any_yaw=False)


def _ball(random: _Random, widest: float) -> TableThing:
    radius = random.uniform(0.025, widest / 2)
    ball = _sphere(_paints(random)[0], radius)
    return replace(_loose("ball", (ball,), ball.size, 4 * radius**3), any_yaw=True, rolls=True)


def _bar(random: _Random, widest: float) -> TableThing:
    """A thick stick that lies along x: a sausage, a marker, a roll."""
    radius, half = random.uniform(0.018, min(widest / 2, 0.03)), random.uniform(0.03, 0.07)
    lying: Quaternion = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
    stick = replace(_part("capsule", (2 * radius, 2 * radius, 2 * half), _paints(random)[0]), turn=lying)
    size = (2 * (half + radius), 2 * radius, 2 * radius)
    return replace(_loose("bar", (stick,), size, 6 * half * radius**2), rolls=True)


def _bridge(random: _Random, widest: float) -> TableThing:
    """A toy of three blocks: two feet and a beam."""
    wide, long, high = random.uniform(0.03, min(widest, 0.05)), random.uniform(0.09, 0.13), 0.075
    paint, other = _paints(random)
    foot = (0.03, wide, 2 * (high / 2 - 0.014))
    parts = (
        _part("box", (long, wide, 0.028), paint, (0, 0, high / 2 - 0.014)),
        *(_part("box", foot, other, (x, 0, -0.014)) for x in (0.015 - long / 2, long / 2 - 0.015)),
    )
    return _loose("bridge", parts, (long, wide, high), long * wide * 0.05, grip_z=high / 2 - 0.018)


_MAKERS = (_block, _block, _can, _bottle, _mug, _ball, _bar, _bridge)


def _part(shape: str, size: Point, paint: Paint, centre: Point = (0.0, 0.0, 0.0)) -> Part:
    return Part(shape, centre, size, paint, TabletopClass.OBJECT)


def _cylinder(paint: Paint, radius: float, high: float, z: float = 0.0) -> Part:
    return _part("cylinder", (2 * radius, 2 * radius, high), paint, (0, 0, z))


def _sphere(paint: Paint, radius: float, z: float = 0.0) -> Part:
    return _part("sphere", (2 * radius, 2 * radius, 2 * radius), paint, (0, 0, z))


def _below_top(high: float) -> float:
    """Grasp height about the middle: fingers reach 35 mm down from the top of what is tall, to the middle else."""
    return max(0.0, high / 2 - 0.035)


def _loose(name: str, parts: tuple[Part, ...], size: Point, volume: float, grip_z: float = 0.0) -> TableThing:
    return TableThing(name=name, parts=parts, size=size, mass_kg=volume, friction=0.0, grip_z=grip_z)


def _round(name: str, parts: tuple[Part, ...], radius: float, high: float) -> TableThing:
    thing = _loose(name, parts, (2 * radius, 2 * radius, high), math.pi * radius**2 * high, _below_top(high))
    return replace(thing, any_yaw=True)
