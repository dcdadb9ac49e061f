"""The things that are dropped: plain solids, turned pieces and small assemblies, in their own frames.

Every maker gives parts for a longest side of 1 or nearly so; `random_thing` scales them to what was asked.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Floats, Part, Point, Quaternion, rotations
from gcd_train.scenes.drop.looks import DropLabel, Material, random_material, shaded
from gcd_train.scenes.primitives import shape

_Random = np.random.Generator
_Maker = Callable[[_Random, Material, Material], list[Part]]
_ALONG_X: Quaternion = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
_ALONG_Y: Quaternion = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
_FILLED = 0.3
"""Share of its bounding cube that a thing fills, for its mass."""
_MEAN_SIDE_M = 1.875
"""Kubric-4D's mean longest side: a thing of this size has its material's density."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Thing:
    """One thing before it has a place.

    name: which kind. parts: in its own frame, metres, the middle of the bounding box at the origin. size: of the box.
    """

    name: str
    parts: tuple[Part, ...]
    size: Point
    mass_kg: float
    friction: float
    restitution: float
    dynamic: bool


def random_thing(random: _Random, *, side_m: float, dynamic: bool) -> Thing:
    """Some kind with a longest side of `side_m`, metres, and a random density.

    Its mass grows with the square of the side, as in Kubric-4D.
    """
    name = str(random.choice(list(KINDS)))
    parts = KINDS[name](random, random_material(random, side_m), random_material(random, side_m))
    low, high = bounds(parts)
    scale = side_m / float((high - low).max())
    density = float(random.lognormal(math.log(120.0), 0.5))  # kg/m3: hollow toys to solid wood
    return Thing(
        name=name,
        parts=tuple(_scaled(part, scale, -(low + high) / 2) for part in parts),
        size=_point(scale * (high - low)),
        mass_kg=density * _FILLED * _MEAN_SIDE_M * side_m**2,
        friction=float(random.uniform(0.5, 0.9)),
        restitution=float(random.uniform(0.1, 0.5)),
        dynamic=dynamic,
    )


def bounds(parts: list[Part]) -> tuple[Floats, Floats]:
    """The lowest and the highest corner of the box around parts, along their frame's axes: [3] each, metres."""
    corners = np.concatenate([outline(part) for part in parts])
    return corners.min(0), corners.max(0)


def outline(part: Part) -> Floats:
    """All corners of a part's triangles in its body's frame, [N, 3], metres."""
    points = shape(part.shape)[0].reshape(-1, 3) * np.array(part.size, np.float32)
    return points @ rotations(np.array(turned(part), np.float32)).T + np.array(part.centre, np.float32)


def turned(part: Part) -> Quaternion:
    """Turn and yaw in one: w, x, y, z, body_from_part."""
    (w, x, y, z), c, s = part.turn, math.cos(part.yaw / 2), math.sin(part.yaw / 2)
    return c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w


def _scaled(part: Part, scale: float, move: NDArray[Any]) -> Part:
    centre = scale * (np.array(part.centre) + move)
    return replace(part, centre=_point(centre), size=_point(scale * np.array(part.size)))


def _point(values: NDArray[Any]) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _part(name: str, at: Point, size: Point, paint: Material, turn: Quaternion = (1, 0, 0, 0)) -> Part:
    return paint.on(
        Part(shape=name, centre=at, size=size, colour=paint.colour, label=DropLabel.OBJECT, turn=turn),
    )


def _single(name: str, low: Point = (1, 1, 1), high: Point = (1, 1, 1), *, round_: bool = False) -> _Maker:
    """One shape, each side by chance between two bounds; round ones are as deep as they are wide."""

    def make(random: _Random, paint: Material, other: Material) -> list[Part]:
        x, y, z = (float(random.uniform(a, b)) for a, b in zip(low, high, strict=True))
        return [_part(name, (0, 0, 0), (x, x if round_ else y, z), paint)]

    return make


def _plain(paint: Material, factor: float = 1.0) -> Material:
    """The material's main colour without the pattern."""
    return Material(colour=shaded(paint.colour, factor), gloss=paint.gloss)


def _table(random: _Random, paint: Material, other: Material) -> list[Part]:
    depth, high = float(random.uniform(0.6, 1.0)), float(random.uniform(0.5, 0.8))
    at = [(x, y * depth) for x in (-0.42, 0.42) for y in (-0.42, 0.42)]
    legs = [_part("box", (x, y, -0.04), (0.09, 0.09, high), _plain(paint, 0.8)) for x, y in at]
    return [_part("box", (0, 0, high / 2), (1, depth, 0.1), paint), *legs]


def _chair(random: _Random, paint: Material, other: Material) -> list[Part]:
    legs = [
        _part("cylinder", (x, y, -0.28), (0.07, 0.07, 0.45), _plain(other)) for x in (-0.2, 0.2) for y in (-0.2, 0.2)
    ]
    back = [_part("box", (-0.22, 0, z), (0.06, 0.46, 0.13), paint) for z in (0.18, 0.4)]
    posts = [_part("box", (-0.22, y, 0.22), (0.07, 0.06, 0.5), _plain(other)) for y in (-0.2, 0.2)]
    return [_part("box", (0, 0, -0.04), (0.5, 0.5, 0.08), paint), *legs, *back, *posts]


def _mug(random: _Random, paint: Material, other: Material) -> list[Part]:
    handle = _part("torus", (0.38, 0, 0), (0.42, 0.55, 0.36), _plain(paint), _ALONG_Y)
    return [_part("pot", (0, 0, 0), (0.72, 0.72, 0.9), paint), handle]


def _dumbbell(random: _Random, paint: Material, other: Material) -> list[Part]:
    ball = float(random.uniform(0.34, 0.48))
    ends = [_part("sphere", (x, 0, 0), (ball, ball, ball), paint) for x in (ball / 2 - 0.5, 0.5 - ball / 2)]
    return [*ends, _part("cylinder", (0, 0, 0), (0.13, 0.13, 0.8), _plain(other), _ALONG_X)]


def _toy_car(random: _Random, paint: Material, other: Material) -> list[Part]:
    tyre = Material(colour=(0.07, 0.07, 0.08), gloss=0.15)
    glass = Material(colour=(0.12, 0.16, 0.2), gloss=0.8)
    hub = _plain(other)
    wheels = [
        _part("cylinder", (x, y, -0.15), (0.24, 0.24, 0.1), tyre, _ALONG_Y) for x in (-0.3, 0.3) for y in (-0.25, 0.25)
    ]
    hubs = [
        _part("cylinder", (x, y, -0.15), (0.12, 0.12, 0.11), hub, _ALONG_Y) for x in (-0.3, 0.3) for y in (-0.25, 0.25)
    ]
    body = [
        _part("box", (0, 0, -0.05), (1, 0.48, 0.2), paint),
        _part("cabin", (-0.06, 0, 0.15), (0.56, 0.44, 0.22), glass),
    ]
    roof = _part("box", (-0.09, 0, 0.265), (0.36, 0.34, 0.03), paint)
    return [*body, roof, *wheels, *hubs]


def _house(random: _Random, paint: Material, other: Material) -> list[Part]:
    roof = Material(colour=other.colour, accent=shaded(other.colour, 0.6), pattern=other.pattern, grain_m=other.grain_m)
    door = _part("box", (0.36, 0, -0.28), (0.02, 0.16, 0.34), _plain(other, 0.6))
    chimney = _part("box", (-0.15, 0.16, 0.4), (0.1, 0.1, 0.28), _plain(paint, 0.7))
    return [
        _part("box", (0, 0, -0.15), (0.72, 0.7, 0.6), paint),
        _part("gable", (0, 0, 0.32), (0.84, 0.9, 0.34), roof),
        door,
        chimney,
    ]


def _snowman(random: _Random, paint: Material, other: Material) -> list[Part]:
    nose = Material(colour=(0.9, 0.45, 0.1), gloss=0.1)
    balls = [_part("sphere", (0, 0, z), (d, d, d), paint) for z, d in ((-0.27, 0.46), (0.05, 0.36), (0.31, 0.26))]
    hat = [
        _part("cylinder", (0, 0, 0.42), (0.3, 0.3, 0.03), _plain(other)),
        _part("cylinder", (0, 0, 0.5), (0.2, 0.2, 0.16), _plain(other)),
    ]
    return [*balls, *hat, _part("round_cone", (0.17, 0, 0.31), (0.07, 0.07, 0.14), nose, _ALONG_X)]


def _hammer(random: _Random, paint: Material, other: Material) -> list[Part]:
    head = _part("barrel", (0, 0, 0.36), (0.3, 0.3, 0.5), paint, _ALONG_X)
    return [head, _part("cylinder", (0, 0, -0.08), (0.1, 0.1, 0.85), other)]


def _stacking_rings(random: _Random, paint: Material, other: Material) -> list[Part]:
    rows = [(-0.36, 1.0), (-0.16, 0.84), (0.02, 0.68), (0.17, 0.52)]
    coats = (_plain(paint), _plain(other), _plain(paint, 1.4), _plain(other, 0.6))
    rings = [_part("torus", (0, 0, z), (d, d, 0.72), coat) for (z, d), coat in zip(rows, coats, strict=True)]
    pole = _part("cylinder", (0, 0, 0), (0.16, 0.16, 0.9), _plain(paint, 0.7))
    return [*rings, pole, _part("sphere", (0, 0, 0.4), (0.3, 0.3, 0.3), paint)]


def _rocket(random: _Random, paint: Material, other: Material) -> list[Part]:
    fins = [_part("box", (x, y, -0.36), sized, _plain(other)) for x, y, sized in _FINS]
    window = _part("sphere", (0.13, 0, 0.12), (0.12, 0.14, 0.14), Material(colour=(0.15, 0.3, 0.45), gloss=0.8))
    body = _part("barrel", (0, 0, -0.08), (0.36, 0.36, 0.7), paint)
    return [body, _part("round_cone", (0, 0, 0.38), (0.25, 0.25, 0.24), _plain(other)), *fins, window]


_FINS: tuple[tuple[float, float, Point], ...] = (
    (0.19, 0.0, (0.18, 0.03, 0.26)),
    (-0.19, 0.0, (0.18, 0.03, 0.26)),
    (0.0, 0.19, (0.03, 0.18, 0.26)),
    (0.0, -0.19, (0.03, 0.18, 0.26)),
)


def _jack(random: _Random, paint: Material, other: Material) -> list[Part]:
    size: Point = (0.25, 0.25, 1.0)
    turns: tuple[Quaternion, ...] = ((1, 0, 0, 0), _ALONG_X, _ALONG_Y)
    return [
        _part("capsule", (0, 0, 0), size, coat, turn) for turn, coat in zip(turns, (paint, other, paint), strict=True)
    ]


def _present(random: _Random, paint: Material, other: Material) -> list[Part]:
    ribbon = _plain(other)
    deep, high = float(random.uniform(0.7, 1.0)), float(random.uniform(0.45, 0.85))
    bands = [
        _part("box", (0, 0, 0), (1.012, 0.12, high * 1.012), ribbon),
        _part("box", (0, 0, 0), (0.12, deep * 1.012, high * 1.012), ribbon),
    ]
    bow = [_part("torus", (x, 0, high / 2 + 0.07), (0.26, 0.18, 0.3), ribbon, _ALONG_Y) for x in (-0.11, 0.11)]
    return [_part("box", (0, 0, 0), (1, deep, high), paint), *bands, *bow]


def _mushroom(random: _Random, paint: Material, other: Material) -> list[Part]:
    stem = Material(colour=(0.9, 0.86, 0.76))
    cap = _part("sphere", (0, 0, 0.2), (0.95, 0.95, 0.6), paint)
    return [cap, _part("barrel", (0, 0, -0.2), (0.42, 0.42, 0.6), stem)]


def _lamp(random: _Random, paint: Material, other: Material) -> list[Part]:
    foot = [
        _part("cylinder", (0, 0, -0.47), (0.44, 0.44, 0.06), _plain(other)),
        _part("cylinder", (0, 0, -0.1), (0.06, 0.06, 0.7), _plain(other)),
    ]
    return [*foot, _part("pot", (0, 0, 0.32), (0.62, 0.62, 0.4), paint, (0.0, 1.0, 0.0, 0.0))]


def _stairs(random: _Random, paint: Material, other: Material) -> list[Part]:
    coats = (paint, other, paint)
    return [
        _part("box", (0, (k - 1) / 3, (k - 2) / 6), (0.7, 1 / 3, (k + 1) / 3), coat) for k, coat in enumerate(coats)
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
    "chair": _chair,
    "mug": _mug,
    "dumbbell": _dumbbell,
    "toy_car": _toy_car,
    "house": _house,
    "snowman": _snowman,
    "hammer": _hammer,
    "stacking_rings": _stacking_rings,
    "rocket": _rocket,
    "jack": _jack,
    "present": _present,
    "mushroom": _mushroom,
    "lamp": _lamp,
    "stairs": _stairs,
}
"""What there is, by name."""
