"""What stands on pavements: lamps, signals, signs, shelters, hedges; x along the road, y to its left, z up."""

import numpy as np

from gcd_train.scenes.description import Colour, Part, Pattern, Point
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.surroundings import foliage, leaf_colour, tone

_LAMP_LIGHT: Colour = (1.0, 0.86, 0.62)
_UNLIT: Colour = (0.72, 0.72, 0.68)
LAMP_REACH_M = 1.8


def _part(
    shape: str, centre: Point, size: Point, colour: Colour, label: Label, pattern: Pattern = Pattern.PLAIN
) -> Part:
    return Part(shape=shape, centre=centre, size=size, colour=colour, label=label, pattern=pattern)


def street_lamp(height: float, side: float, grey: Colour, lit: bool) -> list[Part]:
    """A post on one side of the road (-1: right), its arm over the road."""
    reach, head = LAMP_REACH_M, Pattern.LIT if lit else Pattern.PLAIN
    glass = _LAMP_LIGHT if lit else _UNLIT
    return [
        _part("post", (0, 0, height / 2), (0.16, 0.16, height), grey, Label.POLE),
        _part("box", (0, -side * reach / 2, height), (0.1, reach, 0.1), grey, Label.POLE),
        _part("box", (0, -side * reach, height - 0.07), (0.3, 0.7, 0.14), glass, Label.POLE, head),
    ]


def signal(green: bool, grey: Colour) -> list[Part]:
    """A traffic light that shows its face against x."""
    lamps: tuple[tuple[float, Colour, bool], ...] = (
        (3.55, (0.9, 0.06, 0.04), not green),
        (3.3, (0.9, 0.6, 0.05), False),
        (3.05, (0.06, 0.85, 0.35), green),
    )
    parts = [
        _part("post", (0, 0, 1.7), (0.13, 0.13, 3.4), grey, Label.POLE),
        _part("box", (0, 0, 3.3), (0.3, 0.34, 0.9), (0.06, 0.06, 0.06), Label.TRAFFIC_LIGHT),
    ]
    for z, colour, on in lamps:
        shown = colour if on else (colour[0] * 0.2, colour[1] * 0.2, colour[2] * 0.2)
        pattern = Pattern.LIT if on else Pattern.PLAIN
        parts.append(_part("box", (-0.16, 0, z), (0.05, 0.2, 0.2), shown, Label.TRAFFIC_LIGHT, pattern))
    return parts


def sign(random: np.random.Generator, grey: Colour) -> list[Part]:
    """A traffic sign that shows its face against x."""
    face: Colour = ((0.8, 0.05, 0.06), (0.05, 0.2, 0.65), (0.92, 0.78, 0.08))[int(random.integers(3))]
    size, high = float(random.uniform(0.5, 0.75)), float(random.uniform(2.1, 2.6))
    return [
        _part("post", (0, 0, high / 2), (0.08, 0.08, high), grey, Label.POLE),
        _part("box", (-0.05, 0, high), (0.03, size, size), face, Label.TRAFFIC_SIGN),
        _part("box", (-0.07, 0, high), (0.02, size * 0.62, size * 0.62), (0.92, 0.92, 0.9), Label.TRAFFIC_SIGN),
    ]


def shelter(random: np.random.Generator, lit: bool) -> list[Part]:
    """A bus stop's shelter with a poster; it hides who waits behind it."""
    glass: Colour = (0.35, 0.42, 0.45)
    poster = tone(random, (0.75, 0.45, 0.3), 0.3)
    label = Label.STREET_FURNITURE
    return [
        _part("box", (0, 0.0, 2.35), (4.0, 1.5, 0.1), (0.25, 0.27, 0.28), label),
        _part("box", (0, 0.7, 1.25), (3.9, 0.06, 1.9), glass, label),
        _part("box", (-1.9, 0.0, 1.25), (0.12, 1.3, 2.0), poster, label, Pattern.LIT if lit else Pattern.PLAIN),
        _part("box", (1.9, 0.65, 1.2), (0.08, 0.08, 2.3), (0.2, 0.2, 0.2), label),
        _part("box", (0.2, 0.4, 0.5), (2.2, 0.35, 0.08), (0.5, 0.36, 0.22), label),
    ]


def kiosk(random: np.random.Generator, lit: bool) -> list[Part]:
    """A round advertising column or a small stall."""
    label = Label.STREET_FURNITURE
    colour = tone(random, ((0.6, 0.55, 0.45), (0.3, 0.45, 0.5), (0.7, 0.3, 0.25))[int(random.integers(3))], 0.2)
    if random.random() < 0.5:
        return [
            _part("post", (0, 0, 1.4), (1.2, 1.2, 2.8), colour, label, Pattern.LIT if lit else Pattern.PLAIN),
            _part("post", (0, 0, 2.95), (1.4, 1.4, 0.3), (0.2, 0.25, 0.22), label),
        ]
    return [
        _part("box", (0, 0, 1.2), (2.6, 1.6, 2.4), colour, label),
        _part("box", (0, 0, 2.5), (3.2, 2.1, 0.14), tone(random, (0.8, 0.8, 0.78)), label),
    ]


def hedge(random: np.random.Generator, length: float) -> list[Part]:
    """A clipped hedge along the road."""
    high = float(random.uniform(0.9, 1.9))
    return [
        Part(shape="taper" if high < 1.2 else "box", centre=(0, 0, high / 2 - 0.05), size=(length, 0.8, high),
             colour=leaf_colour(random), label=Label.VEGETATION, pattern=Pattern.LEAVES)
    ]  # fmt: skip


def fence(random: np.random.Generator, length: float) -> list[Part]:
    """Boards between posts, or a wall."""
    colour = tone(random, ((0.5, 0.36, 0.24), (0.75, 0.75, 0.72), (0.35, 0.37, 0.38))[int(random.integers(3))], 0.2)
    high = float(random.uniform(0.9, 1.8))
    parts = [_part("box", (0, 0, high / 2 + 0.06), (length, 0.07, high - 0.12), colour, Label.FENCE)]
    ends = np.arange(-length / 2, length / 2 + 0.01, length / 3)
    return parts + [_part("box", (float(x), 0, high / 2), (0.1, 0.1, high), colour, Label.FENCE) for x in ends]


def planter(random: np.random.Generator) -> list[Part]:
    """A tub with a small bush."""
    tub = _part("taper", (0, 0, 0.35), (1.3, 1.0, 0.7), tone(random, (0.55, 0.53, 0.5)), Label.STREET_FURNITURE)
    return [tub, foliage((0, 0, 0.95), (1.1, 0.9, 0.9), leaf_colour(random))]


def conifer(random: np.random.Generator) -> list[Part]:
    """A fir."""
    high, wide = float(random.uniform(6, 12)), float(random.uniform(2.4, 3.6))
    green = tone(random, (0.14, 0.28, 0.16), 0.2)
    stem = _part("box", (0, 0, 0.7), (0.3, 0.3, 1.4), (0.28, 0.2, 0.14), Label.VEGETATION)
    tiers = ((0.1, 1.0, 0.55), (0.32, 0.78, 0.45), (0.55, 0.5, 0.45))
    return [stem] + [
        Part(shape="cone", centre=(0, 0, high * (low + tall / 2)), size=(wide * share, wide * share, high * tall),
             colour=green, yaw=0.5 * i, label=Label.VEGETATION, pattern=Pattern.LEAVES)
        for i, (low, share, tall) in enumerate(tiers)
    ]  # fmt: skip
