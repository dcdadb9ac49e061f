"""Who drives, rides and walks in the driving world: x ahead, y left, z up, on the ground at the origin.

`near` asks for what only a close look shows.
"""

from dataclasses import dataclass, replace

import numpy as np

from gcd_train.scenes.description import Colour, Part, Point, pick, pick_by_share
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.things import block

OWN_PAINT: Colour = (0.16, 0.24, 0.36)
"""The ego car's livery never changes: its own camera cannot see it, so nothing could tell another one."""
_OWN_BACK_M = 0.56
_GLASS: Colour = (0.07, 0.09, 0.12)
_TYRE: Colour = (0.055, 0.055, 0.06)
_DARK: Colour = (0.1, 0.1, 0.11)
_RIM: Colour = (0.62, 0.63, 0.65)
_HEADLIGHT: Colour = (0.93, 0.93, 0.88)
_TAIL: Colour = (0.55, 0.03, 0.03)
_PAINTS: tuple[tuple[Colour, float], ...] = (
    ((0.93, 0.93, 0.92), 0.2), ((0.72, 0.73, 0.75), 0.16), ((0.42, 0.43, 0.45), 0.15), ((0.07, 0.07, 0.08), 0.16),
    ((0.07, 0.13, 0.36), 0.08), ((0.62, 0.06, 0.06), 0.08), ((0.18, 0.34, 0.6), 0.05), ((0.52, 0.46, 0.38), 0.04),
    ((0.08, 0.27, 0.17), 0.03), ((0.86, 0.6, 0.08), 0.02), ((0.38, 0.1, 0.09), 0.02), ((0.33, 0.5, 0.5), 0.01),
)  # fmt: skip
_LIVERIES: tuple[Colour, ...] = (
    (0.75, 0.1, 0.08), (0.9, 0.75, 0.1), (0.1, 0.3, 0.6), (0.85, 0.86, 0.88), (0.1, 0.45, 0.3),
)  # fmt: skip
_SKIN: tuple[Colour, ...] = ((0.86, 0.68, 0.57), (0.72, 0.54, 0.44), (0.52, 0.36, 0.26), (0.34, 0.23, 0.17))
_CLOTHES: tuple[Colour, ...] = (
    (0.12, 0.14, 0.2), (0.2, 0.25, 0.4), (0.6, 0.1, 0.12), (0.75, 0.72, 0.66), (0.25, 0.3, 0.24), (0.85, 0.55, 0.12),
    (0.1, 0.1, 0.1), (0.5, 0.5, 0.52), (0.3, 0.45, 0.6), (0.55, 0.4, 0.3), (0.7, 0.4, 0.5), (0.9, 0.88, 0.85),
)  # fmt: skip
_HAIR: tuple[Colour, ...] = ((0.1, 0.08, 0.07), (0.3, 0.2, 0.12), (0.55, 0.52, 0.5))


@dataclass(frozen=True, kw_only=True, slots=True)
class Assembly:
    """Parts that move together. length, width: metres on the ground."""

    parts: tuple[Part, ...]
    length: float
    width: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Lamps:
    """lit: headlights and tail lights shine. brakes: the tail lights shine brightly."""

    lit: bool = False
    brakes: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class _Style:
    """Proportions, metres. cabin: (rear end, front end) at the belt, shares of the length from the rear.

    glass: the shape of the cabin. bed: the pick-up's open load begins at the rear and ends at the cabin.
    wheel: radius. closed: share of the length, from the rear, that has no windows.
    """

    length: float
    width: float
    height: float
    belt: float
    cabin: tuple[float, float]
    glass: str = "taper"
    wheel: float = 0.33
    bed: bool = False
    closed: float = 0.0


_CARS: tuple[tuple[_Style, float], ...] = (
    (_Style(length=4.6, width=1.82, height=1.45, belt=0.92, cabin=(0.12, 0.72), glass="cabin"), 0.24),  # saloon
    (_Style(length=4.0, width=1.75, height=1.49, belt=0.93, cabin=(0.01, 0.73)), 0.2),  # hatchback
    (_Style(length=3.55, width=1.66, height=1.53, belt=0.95, cabin=(0.0, 0.8)), 0.08),  # city car
    (_Style(length=4.75, width=1.84, height=1.48, belt=0.93, cabin=(0.0, 0.7)), 0.11),  # estate
    (_Style(length=4.7, width=1.92, height=1.74, belt=1.08, cabin=(0.0, 0.72), wheel=0.38), 0.17),  # off-road
    (_Style(length=4.85, width=1.92, height=1.8, belt=1.05, cabin=(0.0, 0.84)), 0.07),  # people carrier
    (_Style(length=5.4, width=2.0, height=2.3, belt=1.18, cabin=(0.0, 0.86), closed=0.62), 0.08),  # van
    (_Style(length=5.35, width=1.95, height=1.82, belt=1.08, cabin=(0.36, 0.74), glass="cabin", wheel=0.39, bed=True),
     0.05),  # pick-up
)  # fmt: skip


def random_car(random: np.random.Generator, lamps: Lamps, near: bool) -> Assembly:
    """One of eight body styles in one of many paints."""
    return _car(pick_by_share(random, _CARS), random_paint(random), lamps, near)


def own_car() -> Assembly:
    """The ego car, always the same; its nose ends just behind the forward camera, which therefore never sees it."""
    car = _car(_CARS[1][0], OWN_PAINT, Lamps(), near=True)
    parts = tuple(replace(part.placed(-_OWN_BACK_M, 0.0, 0.0, 0.0), label=Label.OWN_CAR) for part in car.parts)
    return Assembly(parts=parts, length=car.length + 2 * _OWN_BACK_M, width=car.width)


def random_paint(random: np.random.Generator) -> Colour:
    """A vehicle's colour, as often as it is seen."""
    return varied(pick_by_share(random, _PAINTS), random)


def varied(colour: Colour, random: np.random.Generator) -> Colour:
    """A colour a little lighter or darker, and a little off."""
    r, g, b = (float(np.clip(c * random.uniform(0.85, 1.12), 0.02, 0.98)) for c in colour)
    return r, g, b


def _car(style: _Style, paint: Colour, lamps: Lamps, near: bool) -> Assembly:
    length, width, belt, label = style.length, style.width, style.belt, Label.CAR
    sill, front = 0.6 * belt, length / 2
    start, end = (share * length - length / 2 for share in style.cabin)
    middle, long, high = (start + end) / 2, end - start, style.height - belt
    z, leans = (belt + style.height) / 2, style.glass == "cabin"
    roof = (long * (0.72 if style.glass == "taper" else 0.62), width * 0.76, 0.05)
    parts = [
        block((0, 0, (0.2 + sill) / 2), (length, width, sill - 0.2), paint, label, gloss=0.35),
        block((0, 0, (sill + belt) / 2), (length * 0.985, width, belt - sill), paint, label, gloss=0.35, shape="nose"),
        block((middle, 0, z), (long, width * 0.95, high), _GLASS, label, gloss=0.45, shape=style.glass),
        block((middle + (-0.04 * long if leans else 0.0), 0, style.height), roof, paint, label, gloss=0.35),
    ]
    if style.closed:  # a van's load room has no windows
        room = style.closed * length
        parts.append(block((start + room / 2, 0, z), (room, width * 0.97, high + 0.02), paint, label, gloss=0.4))
    if style.bed:
        load = start + length / 2 - 0.15
        parts.append(block((start - load / 2, 0, belt - 0.02), (load, width * 0.82, 0.05), _DARK, label))
    parts += _lights(length, width, 0.68 * belt, lamps, label, near)
    parts += _wheels((-0.3 * length, 0.31 * length), width, style.wheel, label, near)
    if near:  # grille, bumpers, plate and mirrors
        mirror = style.cabin[1] * length - front - 0.3
        parts += [
            block((front + 0.01, 0, 0.62 * belt), (0.05, width * 0.42, 0.16), _DARK, label),
            block((front, 0, 0.3), (0.1, width * 0.96, 0.2), _DARK, label),
            block((-front, 0, 0.3), (0.1, width * 0.96, 0.2), _DARK, label),
            block((-front - 0.02, 0, 0.6 * belt), (0.05, 0.5, 0.11), (0.85, 0.85, 0.8), label),
            block((mirror, 0, belt + 0.1), (0.12, width + 0.08, 0.12), paint, label, gloss=0.35),
        ]
    return Assembly(parts=tuple(parts), length=length + 0.1, width=width + 0.1)


def _lights(length: float, width: float, z: float, lamps: Lamps, label: Label, near: bool) -> list[Part]:
    """Two in front, two behind; far away only those that shine."""
    if not (near or lamps.lit or lamps.brakes):
        return []
    tail: Colour = (0.95, 0.05, 0.04) if lamps.brakes else (0.5, 0.02, 0.02) if lamps.lit else _TAIL
    red = lamps.lit or lamps.brakes
    parts: list[Part] = []
    for y in (-width * 0.37, width * 0.37):
        parts.append(block((length / 2, y, z), (0.07, 0.34, 0.14), _HEADLIGHT, label, gloss=0.6, lit=lamps.lit))
        parts.append(block((-length / 2, y, z + 0.06), (0.07, 0.3, 0.17), tail, label, gloss=0.6, lit=red))
    return parts


def _wheels(axles: tuple[float, ...], width: float, radius: float, label: Label, near: bool) -> list[Part]:
    """Round wheels with rims, or far away one dark block an axle."""
    if not near:
        return [block((x, 0, radius), (1.7 * radius, width + 0.02, 1.9 * radius), _TYRE, label) for x in axles]
    parts: list[Part] = []
    for x in axles:
        for y in (-width / 2 + 0.1, width / 2 - 0.1):
            parts.append(block((x, y, radius), (2 * radius, 0.23, 2 * radius), _TYRE, label, shape="wheel"))
        parts.append(block((x, 0, radius), (radius, width + 0.06, radius), _RIM, label, gloss=0.35, shape="wheel"))
    return parts


def random_truck(random: np.random.Generator, lamps: Lamps, near: bool) -> Assembly:
    """A box truck, a tipper or a lorry with a long trailer."""
    kind = str(random.choice(["box", "tipper", "trailer"], p=[0.55, 0.2, 0.25]))
    length = float(random.uniform(11, 13.5) if kind == "trailer" else random.uniform(6, 8.5))
    height = 2.5 if kind == "tipper" else random.uniform(2.8, 3.6)
    white = random.uniform(0.6, 0.92)
    cargo: Colour = (white, white, white) if random.random() < 0.55 else random_paint(random)
    front, load, label = length / 2, length - 2.35, Label.TRUCK
    paint = random_paint(random)
    parts = [
        block((front - 1.0, 0, 1.4), (2.0, 2.35, 2.0), paint, label, gloss=0.4, shape="nose"),
        block((front - 0.09, 0, 1.85), (0.12, 2.05, 0.72), _GLASS, label, gloss=0.45),
        block((-front + load / 2, 0, (height + 1.0) / 2), (load, 2.46, height - 1.0), cargo, label, gloss=0.2),
        block((0, 0, 0.75), (length * 0.97, 1.1, 0.4), _DARK, label),
        *_lights(length, 2.35, 0.78, lamps, label, near),
        *_wheels((front - 1.2, -front + 1.3, -front + 2.5), 2.42, 0.5, label, near),
    ]
    if kind == "tipper":
        heap: Colour = (0.45, 0.37, 0.28)
        parts.append(block((-front + load / 2, 0, height + 0.1), (load * 0.85, 2.1, 0.5), heap, label, shape="taper"))
    elif near:
        parts.append(block((-front - 0.01, 0, (height + 1.0) / 2), (0.04, 0.05, height - 1.2), _DARK, label))
        stripe = random_paint(random)
        parts.append(block((-front + load / 2, 0, 1.35), (load * 0.9, 2.49, 0.35), stripe, label))
    return Assembly(parts=tuple(parts), length=length + 0.1, width=2.52)


def random_bus(random: np.random.Generator, lamps: Lamps, near: bool) -> Assembly:
    """A city bus or a coach."""
    length, label = random.uniform(9.5, 12.2), Label.BUS
    paint = varied(pick(random, _LIVERIES), random)
    band: Colour = (0.9, 0.9, 0.88)
    parts = [
        block((0, 0, 0.95), (length, 2.5, 1.25), paint, label, gloss=0.4),
        block((0, 0, 2.02), (length * 0.995, 2.46, 0.9), _GLASS, label, gloss=0.45),
        block((0, 0, 2.72), (length, 2.5, 0.5), band if random.random() < 0.5 else paint, label, gloss=0.4),
        block((-1.0, 0, 3.05), (length * 0.5, 1.6, 0.22), _DARK, label),
        *_lights(length, 2.5, 0.75, lamps, label, near),
        *_wheels((-0.28 * length, 0.31 * length), 2.46, 0.49, label, near),
    ]
    if near:
        posts = np.linspace(-0.46, 0.46, 7) * length
        parts += [block((float(x), 0, 2.02), (0.1, 2.5, 0.9), paint, label) for x in posts]
        parts.append(block((length / 2, 0, 2.7), (0.05, 1.5, 0.28), (0.95, 0.62, 0.1), label, lit=True))
    return Assembly(parts=tuple(parts), length=length + 0.1, width=2.55)


def _cloth(random: np.random.Generator) -> Colour:
    return varied(pick(random, _CLOTHES), random)


def random_person(random: np.random.Generator, walks: bool) -> Assembly:
    """A grown-up or a child, walking or standing; some carry a bag."""
    height = float(random.uniform(1.52, 1.92) if random.random() < 0.88 else random.uniform(1.0, 1.35))
    stride = random.uniform(0.12, 0.24) * height / 1.7 if walks else 0.0
    parts = _figure(random, height, Label.PERSON, stride)
    if random.random() < 0.3:
        parts.append(block((0.0, 0.3 * height / 1.7, 0.42 * height), (0.32, 0.12, 0.3), _cloth(random), Label.PERSON))
    return Assembly(parts=tuple(parts), length=0.6, width=0.62)


def _figure(random: np.random.Generator, height: float, label: Label, stride: float, lift: float = 0.0) -> list[Part]:
    k = height / 1.7
    hip, coat, legs = 0.48 * height, _cloth(random), _cloth(random)
    skin, hair = pick(random, _SKIN), varied(pick(random, _HAIR), random)

    def limb(at: Point, size: Point, colour: Colour, shape: str = "box") -> Part:
        return block((at[0], at[1], at[2] + lift), size, colour, label, shape=shape)

    return [
        limb((stride, 0.09 * k, hip / 2), (0.16 * k, 0.14 * k, hip), legs),
        limb((-stride, -0.09 * k, hip / 2), (0.16 * k, 0.14 * k, hip), legs),
        limb((0, 0, hip + 0.17 * height), (0.26 * k, 0.42 * k, 0.36 * height), coat, "nose"),
        limb((0.7 * stride, -0.25 * k, hip + 0.14 * height), (0.11 * k, 0.1 * k, 0.34 * height), coat),
        limb((-0.7 * stride, 0.25 * k, hip + 0.14 * height), (0.11 * k, 0.1 * k, 0.34 * height), coat),
        limb((0.01, 0, height - 0.13 * k), (0.2 * k, 0.18 * k, 0.25 * k), skin, "taper"),
        limb((-0.02, 0, height - 0.03 * k), (0.2 * k, 0.2 * k, 0.1 * k), hair),
    ]


def random_cyclist(random: np.random.Generator) -> Assembly:
    """A person on a bicycle."""
    parts = (*_two_wheels(_cloth(random), 0.34, 0.05, Label.CYCLIST), *_figure(random, 1.25, Label.CYCLIST, 0.1, 0.45))
    return Assembly(parts=parts, length=1.85, width=0.65)


def random_motorcyclist(random: np.random.Generator, lamps: Lamps) -> Assembly:
    """A person on a motorcycle, with a helmet."""
    label = Label.MOTORCYCLIST
    helmet = block((0.02, 0, 1.62), (0.28, 0.26, 0.28), random_paint(random), label, gloss=0.6, shape="ball")
    parts = (*_motorcycle(random_paint(random), lamps, label), *_figure(random, 1.25, label, 0.1, 0.45), helmet)
    return Assembly(parts=parts, length=2.15, width=0.8)


def left_two_wheeler(random: np.random.Generator, heavy: bool) -> Assembly:
    """A motorcycle or a bicycle nobody sits on."""
    if heavy:
        return Assembly(parts=_motorcycle(random_paint(random), Lamps(), Label.MOTORCYCLE), length=2.1, width=0.6)
    saddle = block((-0.25, 0, 0.88), (0.25, 0.14, 0.07), _DARK, Label.BICYCLE)
    parts = (*_two_wheels(_cloth(random), 0.34, 0.05, Label.BICYCLE), saddle)
    return Assembly(parts=parts, length=1.8, width=0.55)


def _two_wheels(paint: Colour, radius: float, wide: float, label: Label) -> list[Part]:
    reach = 0.53 if wide < 0.1 else 0.7
    return [
        *(block((x, 0, radius), (2 * radius, wide, 2 * radius), _TYRE, label, shape="wheel") for x in (-reach, reach)),
        block((0, 0, 0.6), (0.95, 0.06, 0.1), paint, label),
        block((reach - 0.1, 0, 0.95), (0.05, 0.5, 0.05), _DARK, label),
    ]


def _motorcycle(paint: Colour, lamps: Lamps, label: Label) -> tuple[Part, ...]:
    return (
        *_two_wheels(paint, 0.31, 0.16, label),
        block((0.1, 0, 0.68), (0.75, 0.3, 0.34), paint, label, gloss=0.35, shape="taper"),
        block((-0.45, 0, 0.8), (0.7, 0.28, 0.12), _DARK, label),
        block((0.74, 0, 0.86), (0.08, 0.2, 0.18), _HEADLIGHT, label, gloss=0.6, lit=lamps.lit),
        block((-0.86, 0, 0.78), (0.06, 0.16, 0.08), _TAIL, label, lit=lamps.lit or lamps.brakes),
    )
