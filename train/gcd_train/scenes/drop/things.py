"""The things that are dropped: plain solids, turned pieces and small assemblies, in paints of many families.

Every maker gives parts for a longest side of 1 or nearly so; `random_thing` scales them to what was asked.
"""

import colorsys
import math
from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import (
    Colour,
    Floats,
    Paint,
    Part,
    Pattern,
    Point,
    Quaternion,
    Thing,
    pick,
    pick_by_share,
    rotations,
    shaded,
    yawed,
)
from gcd_train.scenes.triangles import shape


class DropLabel(IntEnum):
    """What a pixel shows."""

    BACKGROUND = 0
    OBJECT = 1


_Random = np.random.Generator
_Maker = Callable[[_Random, Paint, Paint], list[Part]]
_ALONG_X: Quaternion = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
_ALONG_Y: Quaternion = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
_FILLED = 0.3
"""Share of its bounding cube that a thing fills, for its mass."""
_MEAN_SIDE_M = 1.875
"""Kubric-4D's mean longest side: a thing of this size has its material's density."""
_WOODS: tuple[tuple[Colour, Colour], ...] = (
    ((0.78, 0.58, 0.36), (0.5, 0.31, 0.16)),
    ((0.62, 0.41, 0.24), (0.36, 0.2, 0.1)),
    ((0.86, 0.72, 0.52), (0.68, 0.5, 0.3)),
    ((0.45, 0.27, 0.18), (0.22, 0.12, 0.08)),
)
_STONES: tuple[tuple[Colour, Colour], ...] = (
    ((0.9, 0.89, 0.87), (0.45, 0.46, 0.5)),
    ((0.24, 0.27, 0.28), (0.7, 0.7, 0.66)),
    ((0.55, 0.66, 0.58), (0.2, 0.32, 0.27)),
    ((0.8, 0.66, 0.58), (0.5, 0.28, 0.22)),
)
_FAMILIES = (
    (Pattern.PLAIN, 0.26), (Pattern.CLOUDY, 0.1), (Pattern.WOOD, 0.17), (Pattern.MARBLE, 0.12), (Pattern.CHECKER, 0.1),
    (Pattern.STRIPES, 0.13), (Pattern.DOTS, 0.12),
)  # fmt: skip


def random_paint(random: _Random, size_m: float) -> Paint:
    """Any family; the pattern's spacing suits a thing of that size."""
    pattern = pick_by_share(random, _FAMILIES)
    gloss = 0.0 if random.random() < 0.35 else random.uniform(0.15, 0.8)
    if pattern in (Pattern.WOOD, Pattern.MARBLE):
        colour, accent = pick(random, _WOODS if pattern is Pattern.WOOD else _STONES)
        grain_m = size_m * float(random.uniform(0.12, 0.3) if pattern is Pattern.WOOD else random.uniform(0.3, 0.7))
        return Paint(colour, accent, pattern, grain_m, 0.5 * gloss)
    colour = _random_colour(random)
    accent = (0.92, 0.9, 0.86) if random.random() < 0.4 else _random_colour(random)
    return Paint(colour, accent, pattern, size_m * random.uniform(0.13, 0.32), gloss)


def _random_colour(random: _Random) -> Colour:
    """A colour that a made thing may have: mostly clear, sometimes white, grey or black."""
    if random.random() < 0.18:
        grey = float(random.choice([0.08, 0.35, 0.62, 0.93]))
        return grey, grey, min(grey * 1.03, 1.0)
    hue, strength, bright = random.random(), random.uniform(0.45, 0.92), random.uniform(0.4, 0.95)
    return colorsys.hsv_to_rgb(hue, strength, bright)


def random_thing(random: _Random, *, side_m: float, dynamic: bool) -> Thing:
    """Some kind with a longest side of `side_m`, metres, the middle of its bounding box at the origin, of a random
    density. Its mass grows with the square of the side, as in Kubric-4D.
    """
    name = str(random.choice(list(KINDS)))
    parts = KINDS[name](random, random_paint(random, side_m), random_paint(random, side_m))
    low, high = bounds(parts)
    scale, move = side_m / float((high - low).max()), -(low + high) / 2
    density = random.lognormal(math.log(120.0), 0.5)  # kg/m3: hollow toys to solid wood
    return Thing(
        name=name,
        parts=tuple(
            replace(part, centre=_point(scale * (part.centre + move)), size=_point(scale * np.array(part.size)))
            for part in parts
        ),
        size=_point(scale * (high - low)),
        mass_kg=density * _FILLED * _MEAN_SIDE_M * side_m**2,
        friction=random.uniform(0.5, 0.9),
        restitution=random.uniform(0.1, 0.5),
        dynamic=dynamic,
    )


def bounds(parts: list[Part]) -> tuple[Floats, Floats]:
    """The lowest and the highest corner of the box around parts, along their frame's axes: [3] each, metres."""
    corners = np.concatenate([outline(part) for part in parts])
    return corners.min(0), corners.max(0)


def outline(part: Part) -> Floats:
    """All corners of a part's triangles in its body's frame, [N, 3], metres."""
    points = shape(part.shape)[0].reshape(-1, 3) * np.array(part.size, np.float32)
    turn = yawed(np.array(part.turn), part.yaw).astype(np.float32)
    return points @ rotations(turn).T + np.array(part.centre, np.float32)


def _point(values: NDArray[Any]) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _part(name: str, at: Point, size: Point, paint: Paint, turn: Quaternion = (1, 0, 0, 0)) -> Part:
    return Part(name, at, size, paint, DropLabel.OBJECT, turn)


def _single(name: str, low: Point = (1, 1, 1), high: Point = (1, 1, 1), *, round_: bool = False) -> _Maker:
    """One shape, each side by chance between two bounds; round ones are as deep as they are wide."""

    def make(random: _Random, a: Paint, b: Paint) -> list[Part]:
        x, y, z = (random.uniform(*sides) for sides in zip(low, high, strict=True))
        return [_part(name, (0, 0, 0), (x, x if round_ else y, z), a)]

    return make


def _plain(paint: Paint, factor: float = 1.0) -> Paint:
    """The paint's main colour without the pattern."""
    return Paint(shaded(paint.colour, factor), gloss=paint.gloss)


def _table(random: _Random, a: Paint, b: Paint) -> list[Part]:
    depth, high = random.uniform(0.6, 1.0), random.uniform(0.5, 0.8)
    at = [(x, y * depth) for x in (-0.42, 0.42) for y in (-0.42, 0.42)]
    legs = [_part("box", (x, y, -0.04), (0.09, 0.09, high), _plain(a, 0.8)) for x, y in at]
    return [_part("box", (0, 0, high / 2), (1, depth, 0.1), a), *legs]


def _dumbbell(random: _Random, a: Paint, b: Paint) -> list[Part]:
    ball = random.uniform(0.34, 0.48)
    ends = [_part("sphere", (x, 0, 0), (ball, ball, ball), a) for x in (ball / 2 - 0.5, 0.5 - ball / 2)]
    return [*ends, _part("cylinder", (0, 0, 0), (0.13, 0.13, 0.8), _plain(b), _ALONG_X)]


def _toy_car(random: _Random, a: Paint, b: Paint) -> list[Part]:
    tyre, hub = Paint((0.07, 0.07, 0.08), gloss=0.15), _plain(b)
    at: list[Point] = [(x, y, -0.15) for x in (-0.3, 0.3) for y in (-0.25, 0.25)]
    return [
        _part("box", (0, 0, -0.05), (1, 0.48, 0.2), a),
        _part("cabin", (-0.06, 0, 0.15), (0.56, 0.44, 0.22), Paint((0.12, 0.16, 0.2), gloss=0.8)),
        _part("box", (-0.09, 0, 0.265), (0.36, 0.34, 0.03), a),
        *(_part("cylinder", axle, (0.24, 0.24, 0.1), tyre, _ALONG_Y) for axle in at),
        *(_part("cylinder", axle, (0.12, 0.12, 0.11), hub, _ALONG_Y) for axle in at),
    ]


def _present(random: _Random, a: Paint, b: Paint) -> list[Part]:
    deep, high, ribbon = random.uniform(0.7, 1.0), random.uniform(0.45, 0.85), _plain(b)
    return [
        _part("box", (0, 0, 0), (1, deep, high), a),
        _part("box", (0, 0, 0), (1.012, 0.12, high * 1.012), ribbon),
        _part("box", (0, 0, 0), (0.12, deep * 1.012, high * 1.012), ribbon),
        *(_part("torus", (x, 0, high / 2 + 0.07), (0.26, 0.18, 0.3), ribbon, _ALONG_Y) for x in (-0.11, 0.11)),
    ]


KINDS: dict[str, _Maker] = {
    "ball": _single("sphere"),
    "box": _single("box", (1, 0.45, 0.3), (1, 1, 1)),
    "cube": _single("box"),
    "cylinder": _single("cylinder", (0.4, 0.4, 0.5), (1, 1, 1), round_=True),
    "capsule": _single("capsule"),
    "egg": _single("sphere", (1, 0.6, 0.5), (1, 0.8, 0.75)),
    "icosahedron": _single("icosahedron"),
    "round_cone": _single("round_cone", (0.6, 0.6, 0.8), (0.9, 0.9, 1), round_=True),
    "torus": _single("torus", (1, 1, 0.9), (1, 1, 1.4), round_=True),
    "tube": _single("tube", (0.5, 0.5, 0.6), (1, 1, 1), round_=True),
    "bottle": _single("bottle", (1, 1, 1), (1.5, 1.5, 1), round_=True),
    "bowl": _single("bowl", (1, 1, 0.8), (1, 1, 1.2), round_=True),
    "vase": _single("vase", (1, 1, 1), (1.3, 1.3, 1), round_=True),
    "spool": _single("spool", (0.8, 0.8, 0.8), (1, 1, 1), round_=True),
    "barrel": _single("barrel", (0.9, 0.9, 1), (1.2, 1.2, 1), round_=True),
    "pot": _single("pot", (0.8, 0.8, 0.8), (1, 1, 1), round_=True),
    "table": _table,
    "chair": lambda random, a, b: [
        _part("box", (0, 0, -0.04), (0.5, 0.5, 0.08), a),
        *(_part("cylinder", (x, y, -0.28), (0.07, 0.07, 0.45), _plain(b)) for x in (-0.2, 0.2) for y in (-0.2, 0.2)),
        *(_part("box", (-0.22, 0, z), (0.06, 0.46, 0.13), a) for z in (0.18, 0.4)),
        *(_part("box", (-0.22, y, 0.22), (0.07, 0.06, 0.5), _plain(b)) for y in (-0.2, 0.2)),
    ],
    "mug": lambda random, a, b: [
        _part("pot", (0, 0, 0), (0.72, 0.72, 0.9), a),
        _part("torus", (0.38, 0, 0), (0.42, 0.55, 0.36), _plain(a), _ALONG_Y),
    ],
    "dumbbell": _dumbbell,
    "toy_car": _toy_car,
    "house": lambda random, a, b: [
        _part("box", (0, 0, -0.15), (0.72, 0.7, 0.6), a),
        _part("gable", (0, 0, 0.32), (0.84, 0.9, 0.34), replace(b, accent=shaded(b.colour, 0.6), gloss=0.2)),
        _part("box", (0.36, 0, -0.28), (0.02, 0.16, 0.34), _plain(b, 0.6)),
        _part("box", (-0.15, 0.16, 0.4), (0.1, 0.1, 0.28), _plain(a, 0.7)),
    ],
    "snowman": lambda random, a, b: [
        *(_part("sphere", (0, 0, z), (d, d, d), a) for z, d in ((-0.27, 0.46), (0.05, 0.36), (0.31, 0.26))),
        _part("cylinder", (0, 0, 0.42), (0.3, 0.3, 0.03), _plain(b)),
        _part("cylinder", (0, 0, 0.5), (0.2, 0.2, 0.16), _plain(b)),
        _part("round_cone", (0.17, 0, 0.31), (0.07, 0.07, 0.14), Paint((0.9, 0.45, 0.1), gloss=0.1), _ALONG_X),
    ],
    "hammer": lambda random, a, b: [
        _part("barrel", (0, 0, 0.36), (0.3, 0.3, 0.5), a, _ALONG_X),
        _part("cylinder", (0, 0, -0.08), (0.1, 0.1, 0.85), b),
    ],
    "stacking_rings": lambda random, a, b: [
        _part("torus", (0, 0, -0.36), (1.0, 1.0, 0.72), _plain(a)),
        _part("torus", (0, 0, -0.16), (0.84, 0.84, 0.72), _plain(b)),
        _part("torus", (0, 0, 0.02), (0.68, 0.68, 0.72), _plain(a, 1.4)),
        _part("torus", (0, 0, 0.17), (0.52, 0.52, 0.72), _plain(b, 0.6)),
        _part("cylinder", (0, 0, 0), (0.16, 0.16, 0.9), _plain(a, 0.7)),
        _part("sphere", (0, 0, 0.4), (0.3, 0.3, 0.3), a),
    ],
    "rocket": lambda random, a, b: [
        _part("barrel", (0, 0, -0.08), (0.36, 0.36, 0.7), a),
        _part("round_cone", (0, 0, 0.38), (0.25, 0.25, 0.24), _plain(b)),
        *(_part("box", (x, 0, -0.36), (0.18, 0.03, 0.26), _plain(b)) for x in (0.19, -0.19)),
        *(_part("box", (0, y, -0.36), (0.03, 0.18, 0.26), _plain(b)) for y in (0.19, -0.19)),
        _part("sphere", (0.13, 0, 0.12), (0.12, 0.14, 0.14), Paint((0.15, 0.3, 0.45), gloss=0.8)),
    ],
    "jack": lambda random, a, b: [
        _part("capsule", (0, 0, 0), (0.25, 0.25, 1.0), a),
        _part("capsule", (0, 0, 0), (0.25, 0.25, 1.0), b, _ALONG_X),
        _part("capsule", (0, 0, 0), (0.25, 0.25, 1.0), a, _ALONG_Y),
    ],
    "present": _present,
    "mushroom": lambda random, a, b: [
        _part("sphere", (0, 0, 0.2), (0.95, 0.95, 0.6), a),
        _part("barrel", (0, 0, -0.2), (0.42, 0.42, 0.6), Paint((0.9, 0.86, 0.76), gloss=0.2)),
    ],
    "lamp": lambda random, a, b: [
        _part("cylinder", (0, 0, -0.47), (0.44, 0.44, 0.06), _plain(b)),
        _part("cylinder", (0, 0, -0.1), (0.06, 0.06, 0.7), _plain(b)),
        _part("pot", (0, 0, 0.32), (0.62, 0.62, 0.4), a, (0.0, 1.0, 0.0, 0.0)),
    ],
    "stairs": lambda random, a, b: [
        _part("box", (0, (k - 1) / 3, (k - 2) / 6), (0.7, 1 / 3, (k + 1) / 3), (a, b)[k % 2]) for k in range(3)
    ],
}
"""What there is, by name."""
