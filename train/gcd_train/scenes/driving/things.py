"""What stands beside roads: houses, trees, lamps, signals, shelters, hedges; x along the road, y to its left, z up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gcd_train.scenes.description import Colour, Paint, Part, Pattern, Point, mixed, pick
from gcd_train.scenes.driving.classes import Label

Pair = tuple[float, float]


@dataclass(frozen=True, slots=True)
class District:
    """The character of a neighbourhood: buildings' floors, width and distance, gaps, share of trees."""

    floors: tuple[int, int]
    width_m: Pair
    setback_m: Pair
    gap_m: Pair
    built: float
    trees_every_m: float
    gabled: float


DISTRICTS = {
    "city": District((3, 12), (10, 28), (0, 2), (0, 2), built=0.95, trees_every_m=22, gabled=0.1),
    "suburb": District((1, 3), (7, 13), (3, 9), (3, 12), built=0.85, trees_every_m=11, gabled=0.8),
    "business": District((1, 5), (18, 45), (4, 16), (4, 20), built=0.8, trees_every_m=18, gabled=0.05),
    "green": District((1, 3), (8, 16), (6, 20), (10, 50), built=0.35, trees_every_m=7, gabled=0.6),
}
_WALLS: tuple[Colour, ...] = (
    (0.72, 0.68, 0.6), (0.6, 0.36, 0.28), (0.78, 0.76, 0.72), (0.5, 0.5, 0.53), (0.66, 0.55, 0.42), (0.42, 0.28, 0.24),
    (0.82, 0.78, 0.62), (0.48, 0.56, 0.62), (0.36, 0.38, 0.42), (0.7, 0.6, 0.62), (0.58, 0.62, 0.5), (0.86, 0.85, 0.82),
)  # fmt: skip
_WARM: tuple[Colour, ...] = ((0.95, 0.78, 0.45), (0.9, 0.7, 0.36), (0.85, 0.86, 0.8), (0.95, 0.85, 0.6))
_MOST_WINDOWS = 6
_BOARDS: tuple[Colour, ...] = (
    (0.6, 0.1, 0.1), (0.1, 0.25, 0.5), (0.15, 0.4, 0.2), (0.2, 0.2, 0.2), (0.8, 0.6, 0.15),
)  # fmt: skip


def block(
    at: Point,
    size: Point,
    colour: Colour,
    label: Label,
    *,
    shape: str = "box",
    gloss: float = 0.0,
    pattern: Pattern = Pattern.PLAIN,
    lit: bool = False,
    yaw: float = 0.0,
) -> Part:
    """One piece of a thing, a vehicle or a person. lit: it shines."""
    paint = Paint(colour, pattern=Pattern.LIT if lit else pattern, gloss=gloss)
    return Part(shape, at, size, paint, label, yaw=yaw)


def tone(random: np.random.Generator, colour: Colour, spread: float = 0.15) -> Colour:
    """A colour a little lighter or darker, and a little off."""
    shade = random.uniform(1 - spread, 1 + spread)
    r, g, b = (float(np.clip(c * shade * random.uniform(0.95, 1.05), 0.02, 0.97)) for c in colour)
    return r, g, b


def building(width: float, depth: float, district: District, random: np.random.Generator) -> list[Part]:
    """One house: its body with windows, then its roof; along x by its width."""
    wall, label = tone(random, pick(random, _WALLS)), Label.BUILDING
    height = float(random.integers(district.floors[0], district.floors[1] + 1)) * 3.1 + 0.8
    body = block((0, 0, height / 2), (width, depth, height), wall, label, pattern=Pattern.WINDOWS)
    dark = tone(random, (0.36, 0.25, 0.22) if random.random() < 0.5 else (0.3, 0.31, 0.33))
    if random.random() < district.gabled:
        size = (width * 1.06, depth * 1.08, depth * random.uniform(0.3, 0.5))
        roof = block((0, 0, height + size[2] / 2), size, dark, label, shape="gable", pattern=Pattern.BRICK)
        return [body, roof]
    along = random.uniform(-0.2, 0.2) * width
    return [
        body,
        block((0, 0, height + 0.2), (width * 1.02, depth * 1.02, 0.4), dark, label),
        block((along, 0, height + 1.2), (3.5, 3.0, 2.0), tone(random, (0.55, 0.55, 0.56)), label),
    ]


def shop(width: float, front: float, lit: bool, random: np.random.Generator) -> list[Part]:
    """A shop window and its sign along the ground floor, or none; front: the house's, across the road."""
    if random.random() < 0.35:
        return []
    wide, label = width * random.uniform(0.5, 0.92), Label.BUILDING
    board = tone(random, pick(random, _BOARDS), 0.2)
    shines = lit and random.random() < 0.6
    glass: Colour = (0.95, 0.8, 0.55) if shines else (0.1, 0.12, 0.14)
    return [
        block((0, front, 1.45), (wide, 0.16, 2.1), glass, label, gloss=0.7, lit=shines),
        block((0, front, 2.85), (wide + 0.3, 0.4, 0.5), board, label),
    ]


def lit_windows(house: Sequence[Part], random: np.random.Generator) -> list[Part]:
    """Some windows of a house's two long sides, bright; they lie where the shader paints the windows of that wall."""
    wall = house[0]
    if wall.paint.pattern != Pattern.WINDOWS:
        return []
    r, g, b = (round(255 * channel) / 255 for channel in wall.paint.colour)
    wide, high = 2.2 + 2.0 * ((r * 37.0) % 1), 2.9 + 0.6 * ((g * 53.0) % 1)
    size = ((0.35 + 0.45 * ((b * 71.0) % 1)) * wide * 0.96, 0.06, 0.5 * high * 0.96)
    ahead = np.array([np.cos(wall.yaw), np.sin(wall.yaw)])
    parts: list[Part] = []
    for side in (-1.0, 1.0):
        face = np.array(wall.centre[:2]) + side * wall.size[1] / 2 * np.array([-ahead[1], ahead[0]])
        along = -side * ahead  # as the shader counts along a wall
        start = float(face @ along)
        columns = np.arange(np.ceil((start - wall.size[0] / 2) / wide), np.floor((start + wall.size[0] / 2) / wide))
        floors = np.arange(0, np.floor(wall.size[2] / high - 0.4))
        cells = [(float(c), float(f)) for c in columns for f in floors]
        count = min(_MOST_WINDOWS, len(cells) // 3)
        for index in random.choice(len(cells), count, replace=False) if count else []:
            column, floor = cells[int(index)]
            x, y = face + along * ((column + 0.5) * wide - start)
            warm, share = pick(random, _WARM), random.uniform(0.35, 0.8)
            at = (float(x), float(y), (floor + 0.55) * high)
            parts.append(block(at, size, mixed((0.0, 0.0, 0.0), share, warm), Label.BUILDING, lit=True, yaw=wall.yaw))
    return parts


def _leaf_colour(random: np.random.Generator) -> Colour:
    """Mostly green."""
    return tone(random, (0.26, 0.4, 0.16) if random.random() < 0.85 else (0.5, 0.42, 0.15), 0.25)


def _foliage(at: Point, size: Point, colour: Colour, shape: str = "ball", yaw: float = 0.0) -> Part:
    return block(at, size, colour, Label.VEGETATION, shape=shape, pattern=Pattern.LEAVES, yaw=yaw)


def tree(random: np.random.Generator) -> list[Part]:
    """A stem with two or three crowns."""
    height, spread = random.uniform(4.5, 10), random.uniform(2.4, 5.0)
    leaf, stem = _leaf_colour(random), height * random.uniform(0.3, 0.42)
    size = (0.3, 0.3, stem + 0.6)
    parts = [block((0, 0, stem / 2 + 0.3), size, (0.3, 0.22, 0.16), Label.VEGETATION, shape="post")]
    for _ in range(int(random.integers(2, 4))):
        x, y = (random.uniform(-0.22, 0.22) * spread for _ in range(2))
        crown = (height - stem) * random.uniform(0.75, 1.0)
        size = (spread * random.uniform(0.7, 1), spread * random.uniform(0.7, 1), crown)
        z = stem + crown / 2 + random.uniform(-0.2, 0.6)
        parts.append(_foliage((x, y, z), size, tone(random, leaf, 0.1)))
    return parts


def bush(random: np.random.Generator) -> list[Part]:
    """One low crown."""
    size = (random.uniform(1.2, 3.5), random.uniform(0.9, 1.5), random.uniform(0.8, 1.7))
    return [_foliage((0, 0, size[2] * 0.35), size, _leaf_colour(random))]


def conifer(random: np.random.Generator) -> list[Part]:
    """A fir."""
    high, wide = random.uniform(6, 12), random.uniform(2.4, 3.6)
    green = tone(random, (0.14, 0.28, 0.16), 0.2)
    parts = [block((0, 0, 0.7), (0.3, 0.3, 1.4), (0.28, 0.2, 0.14), Label.VEGETATION)]
    for tier, (low, share, tall) in enumerate(((0.1, 1.0, 0.55), (0.32, 0.78, 0.45), (0.55, 0.5, 0.45))):
        size = (wide * share, wide * share, high * tall)
        parts.append(_foliage((0, 0, high * (low + tall / 2)), size, green, "cone", 0.5 * tier))
    return parts


def hedge(random: np.random.Generator, length: float) -> list[Part]:
    """A clipped hedge along the road."""
    high = random.uniform(0.9, 1.9)
    size = (length, 0.8, high)
    return [_foliage((0, 0, high / 2 - 0.05), size, _leaf_colour(random), "taper" if high < 1.2 else "box")]


def fence(random: np.random.Generator, length: float) -> list[Part]:
    """Boards between posts, or a wall."""
    colour = tone(random, pick(random, ((0.5, 0.36, 0.24), (0.75, 0.75, 0.72), (0.35, 0.37, 0.38))), 0.2)
    high = random.uniform(0.9, 1.8)
    ends = np.arange(-length / 2, length / 2 + 0.01, length / 3)
    return [
        block((0, 0, high / 2 + 0.06), (length, 0.07, high - 0.12), colour, Label.FENCE),
        *(block((float(x), 0, high / 2), (0.1, 0.1, high), colour, Label.FENCE) for x in ends),
    ]


def street_lamp(height: float, side: float, grey: Colour, lit: bool) -> list[Part]:
    """A post on one side of the road (-1: right), its arm over the road."""
    reach, glass = 1.8, (1.0, 0.86, 0.62) if lit else (0.72, 0.72, 0.68)
    return [
        block((0, 0, height / 2), (0.16, 0.16, height), grey, Label.POLE, shape="post"),
        block((0, -side * reach / 2, height), (0.1, reach, 0.1), grey, Label.POLE),
        block((0, -side * reach, height - 0.07), (0.3, 0.7, 0.14), glass, Label.POLE, lit=lit),
    ]


def signal(green: bool, grey: Colour) -> list[Part]:
    """A traffic light that shows its face against x."""
    lamps: tuple[tuple[float, Colour, bool], ...] = (
        (3.55, (0.9, 0.06, 0.04), not green),
        (3.3, (0.9, 0.6, 0.05), False),
        (3.05, (0.06, 0.85, 0.35), green),
    )
    parts = [
        block((0, 0, 1.7), (0.13, 0.13, 3.4), grey, Label.POLE, shape="post"),
        block((0, 0, 3.3), (0.3, 0.34, 0.9), (0.06, 0.06, 0.06), Label.TRAFFIC_LIGHT),
    ]
    for z, (r, g, b), on in lamps:
        shown = (r, g, b) if on else (r * 0.2, g * 0.2, b * 0.2)
        parts.append(block((-0.16, 0, z), (0.05, 0.2, 0.2), shown, Label.TRAFFIC_LIGHT, lit=on))
    return parts


def sign(random: np.random.Generator, grey: Colour) -> list[Part]:
    """A traffic sign that shows its face against x."""
    face = pick(random, ((0.8, 0.05, 0.06), (0.05, 0.2, 0.65), (0.92, 0.78, 0.08)))
    size, high = random.uniform(0.5, 0.75), random.uniform(2.1, 2.6)
    return [
        block((0, 0, high / 2), (0.08, 0.08, high), grey, Label.POLE, shape="post"),
        block((-0.05, 0, high), (0.03, size, size), face, Label.TRAFFIC_SIGN),
        block((-0.07, 0, high), (0.02, size * 0.62, size * 0.62), (0.92, 0.92, 0.9), Label.TRAFFIC_SIGN),
    ]


def shelter(random: np.random.Generator, lit: bool) -> list[Part]:
    """A bus stop's shelter with a poster; it hides who waits behind it."""
    poster, label = tone(random, (0.75, 0.45, 0.3), 0.3), Label.STREET_FURNITURE
    return [
        block((0, 0.0, 2.35), (4.0, 1.5, 0.1), (0.25, 0.27, 0.28), label),
        block((0, 0.7, 1.25), (3.9, 0.06, 1.9), (0.35, 0.42, 0.45), label),
        block((-1.9, 0.0, 1.25), (0.12, 1.3, 2.0), poster, label, lit=lit),
        block((1.9, 0.65, 1.2), (0.08, 0.08, 2.3), (0.2, 0.2, 0.2), label),
        block((0.2, 0.4, 0.5), (2.2, 0.35, 0.08), (0.5, 0.36, 0.22), label),
    ]


def kiosk(random: np.random.Generator, lit: bool) -> list[Part]:
    """A round advertising column or a small stall."""
    label = Label.STREET_FURNITURE
    colour = tone(random, pick(random, ((0.6, 0.55, 0.45), (0.3, 0.45, 0.5), (0.7, 0.3, 0.25))), 0.2)
    if random.random() < 0.5:
        return [
            block((0, 0, 1.4), (1.2, 1.2, 2.8), colour, label, shape="post", lit=lit),
            block((0, 0, 2.95), (1.4, 1.4, 0.3), (0.2, 0.25, 0.22), label, shape="post"),
        ]
    return [
        block((0, 0, 1.2), (2.6, 1.6, 2.4), colour, label),
        block((0, 0, 2.5), (3.2, 2.1, 0.14), tone(random, (0.8, 0.8, 0.78)), label),
    ]


def planter(random: np.random.Generator) -> list[Part]:
    """A tub with a small bush."""
    grey = tone(random, (0.55, 0.53, 0.5))
    tub = block((0, 0, 0.35), (1.3, 1.0, 0.7), grey, Label.STREET_FURNITURE, shape="taper")
    return [tub, _foliage((0, 0, 0.95), (1.1, 0.9, 0.9), _leaf_colour(random))]
