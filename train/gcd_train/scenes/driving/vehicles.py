"""Vehicles, people and cyclists as assemblies of parts: x ahead, y left, z up, on the ground at the origin."""

from dataclasses import dataclass

import numpy as np

from gcd_train.scenes.description import Colour, Part, Pattern, Point
from gcd_train.scenes.driving.classes import Label

_GLASS: Colour = (0.08, 0.1, 0.13)
_TYRE: Colour = (0.06, 0.06, 0.065)
_PAINTS: tuple[Colour, ...] = (
    (0.92, 0.92, 0.92),
    (0.75, 0.76, 0.78),
    (0.45, 0.46, 0.48),
    (0.1, 0.1, 0.11),
    (0.08, 0.14, 0.35),
    (0.65, 0.08, 0.07),
    (0.2, 0.35, 0.6),
    (0.55, 0.5, 0.42),
    (0.1, 0.3, 0.18),
    (0.85, 0.6, 0.1),
    (0.4, 0.12, 0.1),
    (0.35, 0.5, 0.5),
)
OWN_PAINT: Colour = (0.16, 0.24, 0.36)
"""The ego car's livery never changes: its own camera cannot see it, so nothing could tell another one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Assembly:
    """Parts that move together. length, width: metres on the ground."""

    parts: tuple[Part, ...]
    length: float
    width: float


@dataclass(frozen=True, kw_only=True, slots=True)
class _Body:
    """Proportions of a car. Metres; cabin: (start, end) as shares of the length from the rear."""

    length: float
    width: float
    height: float
    belt: float
    cabin: tuple[float, float]


_CARS = (
    _Body(length=4.5, width=1.8, height=1.45, belt=0.88, cabin=(0.08, 0.72)),  # saloon
    _Body(length=3.9, width=1.72, height=1.5, belt=0.92, cabin=(0.0, 0.7)),  # small car
    _Body(length=4.7, width=1.9, height=1.72, belt=1.05, cabin=(0.0, 0.72)),  # off-road
    _Body(length=4.6, width=1.82, height=1.48, belt=0.9, cabin=(0.0, 0.7)),  # estate
    _Body(length=5.0, width=1.95, height=2.0, belt=1.1, cabin=(0.0, 0.85)),  # van
    _Body(length=5.3, width=1.95, height=1.85, belt=1.05, cabin=(0.38, 0.72)),  # pick-up
)


def random_car(random: np.random.Generator) -> Assembly:
    """One of several body styles in one of many paints."""
    body = _CARS[int(random.choice(len(_CARS), p=[0.3, 0.2, 0.18, 0.12, 0.12, 0.08]))]
    paint = _PAINTS[int(random.integers(len(_PAINTS)))]
    return _car(body, varied(paint, random), Label.CAR)


def own_car() -> Assembly:
    """The ego car; its nose ends just behind the forward camera, which therefore never sees it."""
    car = _car(_CARS[1], OWN_PAINT, Label.OWN_CAR)
    return Assembly(parts=tuple(p.placed(-0.45, 0.0, 0.0, 0.0) for p in car.parts), length=car.length, width=car.width)


def varied(colour: Colour, random: np.random.Generator) -> Colour:
    """A colour a little lighter or darker, and a little off."""
    r, g, b = (float(np.clip(c * random.uniform(0.85, 1.12), 0.02, 0.98)) for c in colour)
    return r, g, b


def _car(body: _Body, paint: Colour, label: Label) -> Assembly:
    length, width = body.length, body.width
    start, end = (share * length - length / 2 for share in body.cabin)
    cabin_x, cabin_m, cabin_z = (start + end) / 2, end - start, (body.belt + body.height) / 2
    roof_m = cabin_m * 0.66

    def part(shape: str, at: Point, size: Point, colour: Colour, gloss: float = 0.5) -> Part:
        return Part(shape=shape, centre=at, size=size, colour=colour, gloss=gloss, label=label)

    low = 0.28
    parts = [
        part("box", (0, 0, (low + body.belt) / 2), (length, width, body.belt - low), paint),
        part("cabin", (cabin_x, 0, cabin_z), (cabin_m, width * 0.94, body.height - body.belt), _GLASS, 0.8),
        part("box", (cabin_x - 0.04 * cabin_m, 0, body.height), (roof_m, width * 0.7, 0.06), paint),
        part("box", (length / 2, 0, 0.45), (0.08, width * 0.9, 0.24), (0.12, 0.12, 0.13), 0.1),
        part("box", (-length / 2, 0, 0.45), (0.08, width * 0.9, 0.24), (0.12, 0.12, 0.13), 0.1),
    ]
    for y in (-width * 0.36, width * 0.36):
        parts.append(part("box", (length / 2, y, 0.7), (0.1, 0.34, 0.14), (0.9, 0.9, 0.82), 0.6))
        parts.append(part("box", (-length / 2, y, 0.74), (0.1, 0.32, 0.15), (0.6, 0.03, 0.03), 0.6))
    return Assembly(parts=(*parts, *_wheels(length * 0.31, width, 0.33, label)), length=length, width=width)


def _wheels(axle: float, width: float, radius: float, label: Label) -> list[Part]:
    size = (2 * radius, 0.24, 2 * radius)
    return [
        Part(shape="wheel", centre=(x, y, radius), size=size, colour=_TYRE, label=label)
        for x in (-axle, axle)
        for y in (-width / 2 + 0.1, width / 2 - 0.1)
    ]


def random_truck(random: np.random.Generator) -> Assembly:
    """A box truck, a lorry with trailer, or a bus."""
    kind = random.choice(["box", "lorry", "bus"], p=[0.5, 0.2, 0.3])
    paint = varied(_PAINTS[int(random.integers(len(_PAINTS)))], random)
    if kind == "bus":
        return _bus(paint, float(random.uniform(9, 12)))
    length = float(random.uniform(6, 8.5) if kind == "box" else random.uniform(11, 13.5))
    white = float(random.uniform(0.6, 0.95))
    cargo = (white, white, white) if random.random() < 0.6 else varied(paint, random)
    return _lorry(paint, cargo, length, float(random.uniform(2.7, 3.6)))


def _lorry(paint: Colour, cargo: Colour, length: float, height: float) -> Assembly:
    def part(shape: str, at: Point, size: Point, colour: Colour, gloss: float = 0.3) -> Part:
        return Part(shape=shape, centre=at, size=size, colour=colour, gloss=gloss, label=Label.TRUCK)

    front, box_m = length / 2, length - 2.3
    parts = [
        part("box", (front - 0.95, 0, 1.35), (1.9, 2.3, 1.9), paint),
        part("box", (front - 0.02, 0, 1.85), (0.1, 2.1, 0.75), _GLASS, 0.8),
        part("box", (-front + box_m / 2, 0, (height + 0.9) / 2), (box_m, 2.45, height - 0.9), cargo),
        part("box", (0, 0, 0.7), (length * 0.96, 1.0, 0.4), (0.1, 0.1, 0.1)),
        part("box", (-front, 0, 0.75), (0.1, 2.2, 0.2), (0.5, 0.05, 0.05)),
    ]
    axles = (front - 1.2, -front + 1.4, -front + 2.6)
    wheels = [
        Part(shape="wheel", centre=(x, y, 0.5), size=(1.0, 0.4, 1.0), colour=_TYRE, label=Label.TRUCK)
        for x in axles
        for y in (-1.0, 1.0)
    ]
    return Assembly(parts=(*parts, *wheels), length=length, width=2.45)


def _bus(paint: Colour, length: float) -> Assembly:
    def part(at: Point, size: Point, colour: Colour, gloss: float = 0.4) -> Part:
        return Part(shape="box", centre=at, size=size, colour=colour, gloss=gloss, label=Label.TRUCK)

    parts = [
        part((0, 0, 0.95), (length, 2.5, 1.3), paint),
        part((0, 0, 2.05), (length * 0.995, 2.46, 0.95), _GLASS, 0.8),
        part((0, 0, 2.75), (length, 2.5, 0.5), paint),
    ]
    return Assembly(parts=(*parts, *_wheels(length * 0.3, 2.5, 0.48, Label.TRUCK)), length=length, width=2.5)


def random_person(random: np.random.Generator) -> Assembly:
    """A standing or walking person."""
    height = float(random.uniform(1.55, 1.9))
    coat, legs = (varied(_PAINTS[int(random.integers(len(_PAINTS)))], random) for _ in range(2))
    return Assembly(
        parts=_figure(height, coat, legs, Label.PERSON, stride=float(random.uniform(0, 0.28))), length=0.5, width=0.5
    )


def _figure(
    height: float, coat: Colour, legs: Colour, label: Label, *, stride: float, lift: float = 0.0
) -> tuple[Part, ...]:
    def part(shape: str, at: Point, size: Point, colour: Colour) -> Part:
        return Part(shape=shape, centre=(at[0], at[1], at[2] + lift), size=size, colour=colour, label=label)

    hip = height * 0.48
    return (
        part("box", (stride, 0.1, hip / 2), (0.17, 0.15, hip), legs),
        part("box", (-stride, -0.1, hip / 2), (0.17, 0.15, hip), legs),
        part("taper", (0, 0, hip + height * 0.18), (0.28, 0.46, height * 0.36), coat),
        part("ball", (0, 0, height - 0.13), (0.23, 0.22, 0.27), (0.72, 0.54, 0.44)),
    )


def random_cyclist(random: np.random.Generator) -> Assembly:
    """A person on a bicycle."""
    coat, legs = (varied(_PAINTS[int(random.integers(len(_PAINTS)))], random) for _ in range(2))
    wheels = [
        Part(shape="wheel", centre=(x, 0, 0.34), size=(0.68, 0.06, 0.68), colour=_TYRE, label=Label.CYCLIST)
        for x in (-0.52, 0.52)
    ]
    frame = Part(shape="box", centre=(0, 0, 0.62), size=(0.95, 0.06, 0.12), colour=coat, label=Label.CYCLIST)
    rider = _figure(1.25, coat, legs, Label.CYCLIST, stride=0.1, lift=0.5)
    return Assembly(parts=(*wheels, frame, *rider), length=1.8, width=0.6)


def sky_dome() -> Part:
    """A dome far away; the shader paints it. Its inside must face the camera, hence the negative size."""
    size = (-1600.0, 1600.0, 1600.0)
    return Part(shape="ball", centre=(0, 0, 0), size=size, colour=(0.5, 0.6, 0.8), label=Label.SKY, pattern=Pattern.SKY)
