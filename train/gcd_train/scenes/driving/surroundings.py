"""What stands beside the road: buildings, trees, lamp posts, signs."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gcd_train.scenes.description import Colour, Part, Pattern, Point
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.road import Road

_BEGIN_M, _END_M = -55.0, 190.0


@dataclass(frozen=True, kw_only=True, slots=True)
class District:
    """The character of a neighbourhood: buildings' floors, width and distance, gaps, share of trees."""

    floors: tuple[int, int]
    width_m: tuple[float, float]
    setback_m: tuple[float, float]
    gap_m: tuple[float, float]
    built: float
    trees_every_m: float
    gabled: float


DISTRICTS: dict[str, District] = {
    "city": District(
        floors=(3, 12),
        width_m=(10, 28),
        setback_m=(0, 2),
        gap_m=(0, 2),
        built=0.95,
        trees_every_m=22,
        gabled=0.1,
    ),
    "suburb": District(
        floors=(1, 3),
        width_m=(7, 13),
        setback_m=(3, 9),
        gap_m=(3, 12),
        built=0.85,
        trees_every_m=11,
        gabled=0.8,
    ),
    "business": District(
        floors=(1, 5),
        width_m=(18, 45),
        setback_m=(4, 16),
        gap_m=(4, 20),
        built=0.8,
        trees_every_m=18,
        gabled=0.05,
    ),
    "green": District(
        floors=(1, 3),
        width_m=(8, 16),
        setback_m=(6, 20),
        gap_m=(10, 50),
        built=0.35,
        trees_every_m=7,
        gabled=0.6,
    ),
}
_WALLS: tuple[Colour, ...] = (
    (0.72, 0.68, 0.6), (0.6, 0.36, 0.28), (0.78, 0.76, 0.72), (0.5, 0.5, 0.53), (0.66, 0.55, 0.42), (0.42, 0.28, 0.24),
    (0.82, 0.78, 0.62), (0.48, 0.56, 0.62), (0.36, 0.38, 0.42), (0.7, 0.6, 0.62), (0.58, 0.62, 0.5), (0.86, 0.85, 0.82),
)  # fmt: skip


def surroundings(road: Road, district: District, random: np.random.Generator) -> list[Part]:
    """Everything that stands, on both sides."""
    parts: list[Part] = []
    for side, kerb in ((-1.0, road.right_m), (1.0, road.left_m)):
        edge = kerb + road.pavement_m + road.verge_m
        parts += _buildings(road, district, side, edge, random)
        parts += _trees(road, district, side, kerb, random)
        parts += _posts(road, side, kerb, random)
    for crossing in road.crossings:
        for side, kerb in ((-1.0, road.right_m), (1.0, road.left_m)):
            parts += _side_street(road, crossing.at_m, crossing.half_m, side, kerb, district, random)
    return parts


def _put(road: Road, s: float, lateral: float, parts: list[Part]) -> Iterator[Part]:
    x, y, heading = road.at(s, lateral)
    return (part.placed(x, y, 0.0, heading) for part in parts)


def tone(random: np.random.Generator, colour: Colour, spread: float = 0.15) -> Colour:
    """A colour a little lighter or darker, and a little off."""
    shade = random.uniform(1 - spread, 1 + spread)
    r, g, b = (float(np.clip(c * shade * random.uniform(0.95, 1.05), 0.02, 0.97)) for c in colour)
    return r, g, b


def _buildings(road: Road, district: District, side: float, edge: float, random: np.random.Generator) -> list[Part]:
    parts: list[Part] = []
    s = _BEGIN_M + float(random.uniform(0, 10))
    while s < _END_M:
        width, depth = float(random.uniform(*district.width_m)), float(random.uniform(9, 18))
        middle = s + width / 2
        clear = all(abs(middle - c.at_m) > c.half_m + 2.5 + width / 2 for c in road.crossings)
        if clear and random.random() < district.built:
            away = edge + float(random.uniform(*district.setback_m)) + depth / 2
            away += sagitta(road, middle, width)
            parts += _put(road, middle, side * away, building(width, depth, district, random))
        s += width + float(random.uniform(*district.gap_m))
    return parts


def sagitta(road: Road, s: float, width: float) -> float:
    """How far a straight front must stand back from a curved road."""
    turn = abs(road.at(s + width / 2)[2] - road.at(s - width / 2)[2])
    return width * turn / 4 + 0.3


def building(width: float, depth: float, district: District, random: np.random.Generator) -> list[Part]:
    """One house: its body with windows, then its roof; along x by its width."""
    wall = tone(random, _WALLS[int(random.integers(len(_WALLS)))])
    height = float(random.integers(district.floors[0], district.floors[1] + 1)) * 3.1 + 0.8
    body = _piece("box", height / 2, (width, depth, height), wall, Pattern.WINDOWS)
    dark = tone(random, (0.36, 0.25, 0.22) if random.random() < 0.5 else (0.3, 0.31, 0.33))
    if random.random() < district.gabled:
        size = (width * 1.06, depth * 1.08, depth * float(random.uniform(0.3, 0.5)))
        return [body, _piece("gable", height + size[2] / 2, size, dark, Pattern.BRICK)]
    rim = _piece("box", height + 0.2, (width * 1.02, depth * 1.02, 0.4), dark)
    along = float(random.uniform(-0.2, 0.2)) * width
    hut = _piece("box", height + 1.2, (3.5, 3.0, 2.0), tone(random, (0.55, 0.55, 0.56)))
    return [body, rim, hut.placed(along, 0.0, 0.0, 0.0)]


def _piece(shape: str, z: float, size: Point, colour: Colour, pattern: Pattern = Pattern.PLAIN) -> Part:
    return Part(shape=shape, centre=(0, 0, z), size=size, colour=colour, label=Label.BUILDING, pattern=pattern)


def _side_street(
    road: Road, at_m: float, half_m: float, side: float, kerb: float, district: District, random: np.random.Generator
) -> list[Part]:
    """Buildings along a side road, beyond those of the main one."""
    parts: list[Part] = []
    away = kerb + road.pavement_m + road.verge_m + 34.0
    while away < 120.0:
        width = float(random.uniform(*district.width_m))
        for flank in (-1.0, 1.0):
            if random.random() < district.built:
                depth = float(random.uniform(9, 15))
                house = building(width, depth, district, random)
                turned = [part.placed(0.0, 0.0, 0.0, np.pi / 2) for part in house]
                offset = at_m + flank * (half_m + 4.0 + depth / 2)
                x, y, heading = road.at(at_m)
                along, across = offset - at_m, side * (away + width / 2)
                x += along * np.cos(heading) - across * np.sin(heading)
                y += along * np.sin(heading) + across * np.cos(heading)
                parts += [part.placed(x, y, 0.0, heading) for part in turned]
        away += width + float(random.uniform(*district.gap_m))
    return parts


def _trees(road: Road, district: District, side: float, kerb: float, random: np.random.Generator) -> list[Part]:
    if random.random() < 0.15:
        return []
    parts: list[Part] = []
    s = _BEGIN_M + float(random.uniform(0, district.trees_every_m))
    while s < 150.0:
        if road.is_free(s, 3.5):
            kind = bush if random.random() < 0.15 else tree
            lateral = kerb + road.pavement_m * 0.75 + road.verge_m * float(random.uniform(0.3, 0.9))
            parts += _put(road, s, side * lateral, kind(random))
        s += district.trees_every_m * float(random.uniform(0.5, 1.6))
    return parts


def leaf_colour(random: np.random.Generator) -> Colour:
    """Mostly green."""
    return tone(random, (0.26, 0.4, 0.16) if random.random() < 0.85 else (0.5, 0.42, 0.15), 0.25)


def tree(random: np.random.Generator) -> list[Part]:
    """A stem with two or three crowns."""
    height, spread = float(random.uniform(4.5, 10)), float(random.uniform(2.4, 5.0))
    leaf, stem = leaf_colour(random), height * float(random.uniform(0.3, 0.42))
    bark: Colour = (0.3, 0.22, 0.16)
    size = (0.3, 0.3, stem + 0.6)
    parts = [Part(shape="post", centre=(0, 0, stem / 2 + 0.3), size=size, colour=bark, label=Label.VEGETATION)]
    for _ in range(int(random.integers(2, 4))):
        x, y = (float(random.uniform(-0.22, 0.22)) * spread for _ in range(2))
        crown = (height - stem) * float(random.uniform(0.75, 1.0))
        size = (spread * float(random.uniform(0.7, 1)), spread * float(random.uniform(0.7, 1)), crown)
        z = stem + crown / 2 + float(random.uniform(-0.2, 0.6))
        parts.append(foliage((x, y, z), size, tone(random, leaf, 0.1)))
    return parts


def foliage(centre: Point, size: Point, colour: Colour) -> Part:
    """One ball of leaves."""
    return Part(shape="ball", centre=centre, size=size, colour=colour, label=Label.VEGETATION, pattern=Pattern.LEAVES)


def bush(random: np.random.Generator) -> list[Part]:
    """One low crown."""
    size = (float(random.uniform(1.2, 3.5)), float(random.uniform(0.9, 1.5)), float(random.uniform(0.8, 1.7)))
    return [foliage((0, 0, size[2] * 0.35), size, leaf_colour(random))]


def _posts(road: Road, side: float, kerb: float, random: np.random.Generator) -> list[Part]:
    parts: list[Part] = []
    grey = tone(random, (0.36, 0.38, 0.38), 0.3)
    every, height = float(random.uniform(22, 40)), float(random.uniform(5.5, 9))
    s = _BEGIN_M + float(random.uniform(0, every))
    while s < 150.0:
        if road.is_free(s, 1.5):
            parts += _put(road, s, side * (kerb + 0.5), _lamp(height, side, grey))
        s += every
    for crossing in road.crossings:
        at = crossing.at_m - side * (crossing.half_m + 1.2)
        if road.is_free(at, 1.0):
            parts += _put(road, at, side * (kerb + 0.6), _signal(side, grey, random))
    return parts


def _lamp(height: float, side: float, grey: Colour) -> list[Part]:
    reach = 1.8
    return [
        _post("post", (0, 0, height / 2), (0.17, 0.17, height), grey),
        _post("box", (0, -side * reach / 2, height), (0.1, reach, 0.1), grey),
        _post("box", (0, -side * reach, height - 0.06), (0.3, 0.7, 0.14), (0.7, 0.7, 0.66)),
    ]


def _signal(side: float, grey: Colour, random: np.random.Generator) -> list[Part]:
    lamp: Colour = (0.1, 0.7, 0.3) if random.random() < 0.5 else (0.8, 0.1, 0.08)
    face = -0.2 if side < 0 else 0.2
    return [
        _post("post", (0, 0, 1.7), (0.14, 0.14, 3.4), grey),
        _post("box", (0, 0, 3.3), (0.34, 0.34, 0.95), (0.1, 0.1, 0.1)),
        _post("box", (face, 0, 3.5), (0.04, 0.2, 0.2), lamp, Pattern.LIT),
    ]


def _post(shape: str, centre: Point, size: Point, colour: Colour, pattern: Pattern = Pattern.PLAIN) -> Part:
    return Part(shape=shape, centre=centre, size=size, colour=colour, label=Label.POLE, pattern=pattern)
