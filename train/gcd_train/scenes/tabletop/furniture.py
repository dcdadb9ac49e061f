"""What stands still: the table or bench, clutter on it, the room around it, and the light."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gcd_train.scenes.description import Colour, Light, Part, Pattern, Point, Sheet
from gcd_train.scenes.tabletop.things import Placed, TabletopClass, Thing, solid

UNITS_A_METRE = 10.0
TABLE_M = (0.66, 0.72)
"""Half length along x and half width along y of the table top; its surface is at z = 0."""
TABLE_Z_M = -0.12
"""Height of that surface in the world: arm and things are then in the middle of the pictures."""
FLOOR_M = -0.76
_WALL, _WALL_TOP = 36.0, 19.0  # units
_WOODS: tuple[Colour, ...] = ((0.62, 0.43, 0.26), (0.78, 0.62, 0.42), (0.45, 0.29, 0.18), (0.83, 0.74, 0.60))
_FLATS: tuple[Colour, ...] = ((0.86, 0.86, 0.84), (0.36, 0.38, 0.40), (0.55, 0.62, 0.60), (0.24, 0.30, 0.36))
_WALLS: tuple[Colour, ...] = ((0.85, 0.83, 0.78), (0.68, 0.74, 0.76), (0.78, 0.70, 0.62), (0.60, 0.64, 0.58))
_CLUTTER_SPOTS = ((0.45, 0.5), (0.48, 0.0), (0.45, -0.5), (-0.05, 0.58), (-0.05, -0.58), (-0.5, 0.52))
"""Along the edges of the table, out of the arm's way."""


def random_table(random: np.random.Generator) -> tuple[Part, ...]:
    """A table with four legs, or a closed bench; origin in the middle of its surface."""
    wooden = random.random() < 0.6
    colour = _pick(_WOODS if wooden else _FLATS, random)
    dark: Colour = (0.7 * colour[0], 0.7 * colour[1], 0.7 * colour[2])
    length, width = 2 * TABLE_M[0], 2 * TABLE_M[1]
    top = replace(
        solid(TabletopClass.TABLE, "box", (length, width, 0.04), (0.0, 0.0, -0.02), colour=colour),
        accent=dark,
        pattern=Pattern.PLANKS if wooden else Pattern.PLAIN,
        grain_m=float(random.uniform(0.09, 0.2)),
        gloss=float(random.uniform(0.05, 0.3)),
    )
    half = (-FLOOR_M - 0.04) / 2
    if random.random() < 0.4:
        size = (2 * (TABLE_M[0] - 0.05), 2 * (TABLE_M[1] - 0.05), 2 * half)
        return top, solid(TabletopClass.TABLE, "box", size, (0.0, 0.0, -0.04 - half), colour=dark)
    x, y = TABLE_M[0] - 0.07, TABLE_M[1] - 0.07
    legs = [
        solid(TabletopClass.TABLE, "box", (0.06, 0.06, 2 * half), (a, b, -0.04 - half), colour=dark)
        for a in (-x, x)
        for b in (-y, y)
    ]
    return top, *legs


def random_clutter(random: np.random.Generator) -> tuple[Placed, ...]:
    """Two to five large things."""
    chosen = random.choice(len(_CLUTTER_SPOTS), int(random.integers(2, 6)), replace=False)
    made: list[Placed] = []
    for index in chosen:
        thing = _clutter_thing(random)
        x, y = _CLUTTER_SPOTS[int(index)]
        place = (x + float(random.uniform(-0.03, 0.03)), y + float(random.uniform(-0.03, 0.03)), thing.size[2] / 2)
        made.append(Placed(thing=thing, place=place, yaw=float(random.uniform(-0.4, 0.4))))
    return tuple(made)


def _clutter_thing(random: np.random.Generator) -> Thing:
    kind = int(random.integers(4))
    red, green, blue = (float(random.uniform(0.15, most)) for most in (0.9, 0.85, 0.85))
    colour = (red, green, blue)
    if kind == 0:
        return _bin(colour, random)
    if kind == 1:
        return _books(random)
    if kind == 2:
        return _tin(colour, random)
    x, y, z = (2 * float(random.uniform(low, high)) for low, high in ((0.05, 0.09), (0.06, 0.11), (0.04, 0.12)))
    card = _clutter("box", (x, y, z), (0.72, 0.56, 0.38))
    tape = _clutter("box", (x + 0.002, 0.03, z + 0.002), (0.85, 0.78, 0.62), gloss=0.3)
    return _still("box", (card, tape), (x, y, z))


def _bin(colour: Colour, random: np.random.Generator) -> Thing:
    """An open crate: a floor and four walls."""
    x, y, z = (2 * float(random.uniform(low, high)) for low, high in ((0.07, 0.10), (0.08, 0.13), (0.03, 0.06)))
    plates: tuple[tuple[Point, Point], ...] = (
        ((x, y, 0.008), (0, 0, 0.004 - z / 2)),
        ((0.008, y, z), (-(x / 2 - 0.004), 0, 0)),
        ((0.008, y, z), (x / 2 - 0.004, 0, 0)),
        ((x, 0.008, z), (0, -(y / 2 - 0.004), 0)),
        ((x, 0.008, z), (0, y / 2 - 0.004, 0)),
    )
    return _still("bin", tuple(_clutter("box", size, colour, at, gloss=0.3) for size, at in plates), (x, y, z))


def _books(random: np.random.Generator) -> Thing:
    """A pile of books, each turned a little by its size."""
    thick = random.uniform(0.010, 0.022, int(random.integers(2, 5)))
    low = -float(thick.sum())
    books: list[Part] = []
    for half in thick.tolist():
        size = (2 * float(random.uniform(0.06, 0.085)), 2 * float(random.uniform(0.09, 0.12)), 2 * half)
        colour = (float(random.uniform(0.1, 0.8)), float(random.uniform(0.1, 0.6)), float(random.uniform(0.1, 0.7)))
        shift = (float(random.uniform(-0.01, 0.01)), float(random.uniform(-0.01, 0.01)), low + half)
        books.append(_clutter("box", size, colour, shift, gloss=0.15))
        low += 2 * half
    return _still("books", tuple(books), (0.19, 0.26, 2 * float(thick.sum())))


def _tin(colour: Colour, random: np.random.Generator) -> Thing:
    across, high = 2 * float(random.uniform(0.04, 0.07)), 2 * float(random.uniform(0.05, 0.11))
    body = _clutter("cylinder", (across, across, high), colour, gloss=0.5)
    lid = _clutter("cylinder", (across * 1.04, across * 1.04, 0.012), (0.75, 0.76, 0.78), (0, 0, high / 2 - 0.006))
    return _still("tin", (body, lid), (across, across, high))


def _clutter(shape: str, size: Point, colour: Colour, centre: Point = (0, 0, 0), gloss: float = 0.1) -> Part:
    return solid(TabletopClass.CLUTTER, shape, size, centre, colour=colour, gloss=gloss)


def _still(name: str, parts: tuple[Part, ...], size: Point) -> Thing:
    return Thing(name=name, parts=parts, size=size, mass_kg=1.0, friction=0.8)


def room(random: np.random.Generator) -> tuple[tuple[Part, ...], tuple[Sheet, ...]]:
    """Floor, four walls and the sky above them, in scene units; lower than the sun at the table."""
    low, colour = (FLOOR_M + TABLE_Z_M) * UNITS_A_METRE, _pick(_WALLS, random)
    middle, height = (low + _WALL_TOP) / 2, _WALL_TOP - low
    parts = [
        Part(
            shape="box",
            centre=(x * _WALL, y * _WALL, middle),
            size=(1.0 if x else 2 * _WALL, 1.0 if y else 2 * _WALL, height),
            colour=colour,
            accent=(0.9 * colour[0], 0.9 * colour[1], 0.92 * colour[2]),
            pattern=Pattern.CLOUDY,
            grain_m=5.0,
            label=TabletopClass.WALL,
        )
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    parts += _panels(random, low)
    size = (-5.5 * _WALL, 5.5 * _WALL, 5.5 * _WALL)  # its inside faces the cameras, hence the negative size
    parts.append(
        Part(shape="ball", centre=(0, 0, 0), size=size, colour=(1, 1, 1), pattern=Pattern.SKY, label=TabletopClass.SKY)
    )
    return tuple(parts), (_floor(random, low),)


def _panels(random: np.random.Generator, low: float) -> list[Part]:
    """Cupboards, pictures and doors along the walls, so that the background tells where it is."""
    made: list[Part] = []
    for side in range(4):
        for along in np.arange(-0.75, 0.76, 0.5) + random.uniform(-0.12, 0.12, 4):
            wide, deep, high = (float(random.uniform(*sides)) for sides in ((5, 11), (0.6, 4.5), (6, 22)))
            red, green, blue = (float(random.uniform(0.2, most)) for most in (0.85, 0.8, 0.8))
            lift, grey = 0.0 if deep > 1.5 else 8.0, 0.5 * (red + green)
            part = Part(
                shape="box",
                centre=(float(along) * _WALL, _WALL - 0.5 - deep / 2, low + lift + high / 2),
                size=(wide, deep, high),
                colour=((red + grey) / 2, (green + grey) / 2, (blue + grey) / 2),
                accent=(0.4, 0.35, 0.3),
                pattern=Pattern(int(random.choice([Pattern.PLAIN, Pattern.WOOD, Pattern.STRIPES]))),
                grain_m=2.0,
                label=TabletopClass.WALL,
            )
            made.append(part.placed(0.0, 0.0, 0.0, side * math.pi / 2))
    return made


def _floor(random: np.random.Generator, low: float) -> Sheet:
    a, b, c, d = ((x * _WALL, y * _WALL, low) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
    pattern = Pattern(int(random.choice([Pattern.PLANKS, Pattern.TERRAZZO, Pattern.CHECKER, Pattern.CLOUDY])))
    colour = _pick(_WOODS if pattern == Pattern.PLANKS else _FLATS, random)
    return Sheet(
        corners=np.array([(a, b, c), (a, c, d)], np.float32),
        colour=colour,
        accent=(0.8 * colour[0], 0.8 * colour[1], 0.8 * colour[2]),
        pattern=pattern,
        grain_m=3.0,
        gloss=0.1,
        label=TabletopClass.FLOOR,
    )


def random_light(random: np.random.Generator) -> Light:
    """A lamp high above, as parallel light, and the bright room around it."""
    height, round_ = float(random.uniform(0.85, 1.35)), float(random.uniform(0, 2 * math.pi))
    warm, strength = float(random.uniform(0.0, 0.3)), float(random.uniform(0.8, 1.5))
    fill = float(random.uniform(0.55, 0.85))
    return Light(
        sun_to=(math.cos(height) * math.cos(round_), math.cos(height) * math.sin(round_), math.sin(height)),
        sun=(strength, strength * (1 - 0.4 * warm), strength * (1 - 0.8 * warm)),
        sky=(fill, fill * (1 - 0.1 * warm), fill * (1 - 0.2 * warm)),
        ground=(0.45 * fill, 0.43 * fill, 0.40 * fill),
        horizon=(0.72, 0.72, 0.70),
        zenith=(0.80, 0.80, 0.79),
        fog_m=4000.0,
        cloud=0.0,
        exposure=float(random.uniform(1.1, 1.5)),
    )


def _pick(colours: Sequence[Colour], random: np.random.Generator) -> Colour:
    return colours[int(random.integers(len(colours)))]
