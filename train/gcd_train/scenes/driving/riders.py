"""People of a grown driving world, on foot and on two wheels; x ahead, y left, z up, on the ground at the origin."""

import numpy as np

from gcd_train.scenes.description import Colour, Part, Point
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.fleet import DARK, HEADLIGHT, TAIL, TYRE, Lamps, block, random_paint
from gcd_train.scenes.driving.vehicles import Assembly, varied

_SKIN: tuple[Colour, ...] = ((0.86, 0.68, 0.57), (0.72, 0.54, 0.44), (0.52, 0.36, 0.26), (0.34, 0.23, 0.17))
_CLOTHES: tuple[Colour, ...] = (
    (0.12, 0.14, 0.2), (0.2, 0.25, 0.4), (0.6, 0.1, 0.12), (0.75, 0.72, 0.66), (0.25, 0.3, 0.24), (0.85, 0.55, 0.12),
    (0.1, 0.1, 0.1), (0.5, 0.5, 0.52), (0.3, 0.45, 0.6), (0.55, 0.4, 0.3), (0.7, 0.4, 0.5), (0.9, 0.88, 0.85),
)  # fmt: skip


def _cloth(random: np.random.Generator) -> Colour:
    return varied(_CLOTHES[int(random.integers(len(_CLOTHES)))], random)


def grown_person(random: np.random.Generator, walks: bool) -> Assembly:
    """A grown-up or a child, walking or standing; some carry a bag."""
    height = float(random.uniform(1.52, 1.92) if random.random() < 0.88 else random.uniform(1.0, 1.35))
    stride = float(random.uniform(0.12, 0.24)) * height / 1.7 if walks else 0.0
    parts = _figure(random, height, Label.PERSON, stride)
    if random.random() < 0.3:
        parts.append(block((0.0, 0.3 * height / 1.7, 0.42 * height), (0.32, 0.12, 0.3), _cloth(random), Label.PERSON))
    return Assembly(parts=tuple(parts), length=0.6, width=0.62)


def _figure(random: np.random.Generator, height: float, label: Label, stride: float, lift: float = 0.0) -> list[Part]:
    k = height / 1.7
    hip, coat, legs = 0.48 * height, _cloth(random), _cloth(random)
    skin = _SKIN[int(random.integers(len(_SKIN)))]
    hair: Colour = varied(((0.1, 0.08, 0.07), (0.3, 0.2, 0.12), (0.55, 0.52, 0.5))[int(random.integers(3))], random)

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


def grown_cyclist(random: np.random.Generator) -> Assembly:
    """A person on a bicycle."""
    return Assembly(
        parts=(*_two_wheels(_cloth(random), 0.34, 0.05, Label.CYCLIST), *_rider(random, Label.CYCLIST)),
        length=1.85,
        width=0.65,
    )


def grown_motorcyclist(random: np.random.Generator, lamps: Lamps) -> Assembly:
    """A person on a motorcycle, with a helmet."""
    label = Label.MOTORCYCLIST
    helmet = block((0.02, 0, 1.62), (0.28, 0.26, 0.28), random_paint(random), label, gloss=0.6, shape="ball")
    parts = (*_motorcycle(random_paint(random), lamps, label), *_rider(random, label), helmet)
    return Assembly(parts=parts, length=2.15, width=0.8)


def _rider(random: np.random.Generator, label: Label) -> list[Part]:
    return _figure(random, 1.25, label, stride=0.1, lift=0.45)


def _two_wheels(paint: Colour, radius: float, wide: float, label: Label) -> list[Part]:
    reach = 0.53 if wide < 0.1 else 0.7
    return [
        *(block((x, 0, radius), (2 * radius, wide, 2 * radius), TYRE, label, shape="wheel") for x in (-reach, reach)),
        block((0, 0, 0.6), (0.95, 0.06, 0.1), paint, label),
        block((reach - 0.1, 0, 0.95), (0.05, 0.5, 0.05), DARK, label),
    ]


def left_bicycle(random: np.random.Generator) -> Assembly:
    """A bicycle nobody sits on."""
    saddle = block((-0.25, 0, 0.88), (0.25, 0.14, 0.07), DARK, Label.BICYCLE)
    parts = (*_two_wheels(_cloth(random), 0.34, 0.05, Label.BICYCLE), saddle)
    return Assembly(parts=parts, length=1.8, width=0.55)


def left_motorcycle(random: np.random.Generator) -> Assembly:
    """A motorcycle nobody sits on."""
    return Assembly(parts=_motorcycle(random_paint(random), Lamps(), Label.MOTORCYCLE), length=2.1, width=0.6)


def _motorcycle(paint: Colour, lamps: Lamps, label: Label) -> tuple[Part, ...]:
    return (
        *_two_wheels(paint, 0.31, 0.16, label),
        block((0.1, 0, 0.68), (0.75, 0.3, 0.34), paint, label, gloss=0.35, shape="taper"),
        block((-0.45, 0, 0.8), (0.7, 0.28, 0.12), DARK, label),
        block((0.74, 0, 0.86), (0.08, 0.2, 0.18), HEADLIGHT, label, gloss=0.6, lit=lamps.lit),
        block((-0.86, 0, 0.78), (0.06, 0.16, 0.08), TAIL, label, lit=lamps.lit or lamps.brakes),
    )
