"""The driving world's first edition, frozen: what the packaged driving models learned in, and in part the live one."""

import math

import numpy as np

from gcd_train.scenes.description import Colour, Floats, Light, Part, Pattern, Scene, Sheet, upright
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.first_traffic import Traffic, random_traffic
from gcd_train.scenes.driving.ground import flat, terrain
from gcd_train.scenes.driving.roads import STEP_M, Crossing, Road, centre_line, patches, quads
from gcd_train.scenes.driving.things import (
    DISTRICTS,
    District,
    block,
    building,
    bush,
    random_district,
    sagitta,
    sky_dome,
    tone,
    tree,
)
from gcd_train.scenes.driving.weather import shadow_focus

_START_M, _END_M = -70.0, 230.0
_BUILT_M = -55.0, 190.0
_PAVEMENT_M, _MARK_M = 0.10, 0.012


def first_edition(seed: int, frames: int) -> tuple[Scene, Floats]:
    """The world of a seed over so many time steps at 10 Hz, without cameras, and x, y, z, yaw [T, 4] of the ego."""
    random = np.random.default_rng([seed, 0x6D])
    road = random_road(random)
    district = random_district(random)
    sheets = _ground(road, random)
    parts = [sky_dome(), *_surroundings(road, DISTRICTS[district], random)]
    traffic = random_traffic(road, random)
    light = _random_light(random)
    rows = traffic.poses(road, frames)
    scene = Scene(
        parts=(*parts, *_users(traffic)),
        sheets=tuple(sheets),
        poses=upright(rows),
        focus=shadow_focus(rows[:, 1]),
        cameras={},
        hfov_deg=85.0,
        light=light,
        facts={
            "seed": seed,
            "district": district,
            "lanes": road.lanes_left + road.lanes_right,
            "crossings": len(road.crossings),
            "movers": len(traffic.movers),
            "parked": len(traffic.parked),
            "ego_m_s": round(traffic.ego.speed, 3),
        },
    )
    return scene, rows[:, 1]


def _users(traffic: Traffic) -> list[Part]:
    """Parts of the ego (instance 1, body 1), of what moves and of what is parked; instances repeat beyond 255."""
    parts = [part.of(instance=1, body=1) for part in traffic.ego.assembly.parts]
    for index, mover in enumerate(traffic.movers):
        parts += [part.of(instance=2 + index % 254, body=2 + index) for part in mover.assembly.parts]
    for index, row in enumerate(traffic.parked, start=len(traffic.movers)):
        parts += [part.of(instance=2 + index % 254) for part in row]
    return parts


def random_road(random: np.random.Generator) -> Road:
    """A layout drawn at random; the ego starts near s = 0."""
    s = np.arange(_START_M, _END_M, STEP_M)
    bend = 0.0 if random.random() < 0.35 else random.uniform(-1, 1) * 0.011
    sway = random.uniform(-1, 1) * 0.009 if random.random() < 0.5 else 0.0
    curvature = bend + sway * np.sin(s / random.uniform(25, 60) + random.uniform(0, 6))
    headings = np.cumsum(curvature) * STEP_M
    headings -= headings[int(-_START_M / STEP_M)]
    points = centre_line(headings)
    points -= points[int(-_START_M / STEP_M)]
    parking = [float(random.uniform(2.2, 2.6)) if random.random() < 0.5 else 0.0 for _ in range(2)]
    return Road(
        points=points,
        headings=headings,
        lane_m=float(random.uniform(3.1, 3.7)),
        lanes_right=int(random.choice([1, 2, 3], p=[0.5, 0.4, 0.1])),
        lanes_left=int(random.choice([1, 2, 3], p=[0.55, 0.37, 0.08])),
        parking_m=(parking[0], parking[1]),
        pavement_m=float(random.uniform(1.6, 4.5)),
        verge_m=float(random.choice([0.0, random.uniform(1, 6)])),
        crossings=_random_crossings(random),
        start_m=_START_M,
    )


def _random_crossings(random: np.random.Generator) -> tuple[Crossing, ...]:
    crossings: list[Crossing] = []
    for _ in range(int(random.choice([0, 1, 2, 3], p=[0.25, 0.4, 0.25, 0.1]))):
        at, half = float(random.uniform(-40, 120)), float(random.uniform(3.2, 7.0))
        made = Crossing(at_m=at, half_m=half, zebra=bool(random.random() < 0.7))
        if all(abs(at - other.at_m) > 40 for other in crossings):
            crossings.append(made)
    return tuple(crossings)


def _ground(road: Road, random: np.random.Generator) -> list[Sheet]:
    """Everything flat: terrain, carriageway, pavements, side roads, marks."""
    shade = random.uniform(0.24, 0.42)
    asphalt: Colour = (shade, shade * random.uniform(0.96, 1.02), shade * random.uniform(0.96, 1.06))
    grey = random.uniform(0.5, 0.72)
    paving: Colour = (grey, grey * random.uniform(0.92, 1.0), grey * random.uniform(0.84, 1.0))
    grass: Colour = (random.uniform(0.22, 0.45), random.uniform(0.38, 0.52), random.uniform(0.14, 0.28))
    dry: Colour = (random.uniform(0.5, 0.66), random.uniform(0.45, 0.56), random.uniform(0.3, 0.42))
    sheets = [
        terrain(600.0, 100.0, grass if random.random() < 0.75 else dry),
        flat(_along(road, -road.right_m, road.left_m, 0.0), asphalt, Label.ROAD, Pattern.SPECKLE),
    ]
    for side, kerb in road.sides:
        edge = side * kerb
        outer = edge + side * road.pavement_m
        strip = _along(road, min(edge, outer), max(edge, outer), _PAVEMENT_M, free_only=True)
        stones = _along(road, edge - 0.09, edge + 0.09, _PAVEMENT_M + 0.01, free_only=True)
        sheets += [flat(strip, paving, Label.PAVEMENT, Pattern.TILES), flat(stones, (0.72, 0.72, 0.7), Label.PAVEMENT)]
    for crossing in road.crossings:
        for side, kerb in road.sides:
            half, reach = crossing.half_m, (side * (kerb - 0.1), side * (kerb + 140.0))
            lanes = _across(road, crossing, (-half, half), reach, 0.0)
            sheets.append(flat(lanes, asphalt, Label.ROAD, Pattern.SPECKLE))
            for along in ((-half - 2.2, -half), (half, half + 2.2)):
                pavement = _across(road, crossing, along, reach, _PAVEMENT_M - 0.02)
                sheets.append(flat(pavement, paving, Label.PAVEMENT, Pattern.TILES))
    marks = _marks(road, random)
    white = random.uniform(0.8, 0.97)
    return [*sheets, flat(marks, (white, white, white * random.uniform(0.9, 1.0)), Label.LANE_MARKING)]


def _along(road: Road, right: float, left: float, z: float, *, free_only: bool = False) -> Floats:
    """A strip along the road; with `free_only` it stops at the junctions."""
    s = _START_M + STEP_M * np.arange(len(road.headings), dtype=np.float64)
    low, high = (np.append(road.places(s, y)[:, :2], np.full((len(s), 1), z), 1) for y in (right, left))
    kept = np.array([not free_only or road.is_free(float(m)) for m in s[:-1] + STEP_M / 2])
    return quads(low[:-1][kept], low[1:][kept], high[1:][kept], high[:-1][kept])


def _across(road: Road, crossing: Crossing, along: tuple[float, float], reach: tuple[float, float], z: float) -> Floats:
    """A straight strip square to the main road."""
    x, y, heading = road.at(crossing.at_m)
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    ends = ((along[0], reach[0]), (along[1], reach[0]), (along[1], reach[1]), (along[0], reach[1]))
    a, b, c, d = (np.append(np.array([x, y]) + ahead * m + left * n, z)[None] for m, n in ends)
    return quads(a, b, c, d)


def _marks(road: Road, random: np.random.Generator) -> Floats:
    """Lane lines, edge lines, stop lines and zebras."""
    width = float(random.uniform(0.12, 0.2))
    dash, gap = float(random.uniform(2.5, 5.0)), float(random.uniform(4.0, 8.0))
    rows: list[tuple[float, float, float, float]] = []
    for index in range(-road.lanes_left + 1, road.lanes_right):
        solid = index == 0 and random.random() < 0.5
        rows += _line(road, -index * road.lane_m, width, (4.0, 0.0) if solid else (dash, gap))
    right, left = -road.lanes_right * road.lane_m, road.lanes_left * road.lane_m
    if random.random() < 0.7:
        rows += _line(road, right + 0.15, width, (4.0, 0.0)) + _line(road, left - 0.15, width, (4.0, 0.0))
    for crossing in road.crossings:
        before, after = crossing.at_m - crossing.half_m, crossing.at_m + crossing.half_m
        rows += [(before - 4.6, before - 4.2, right, 0.0), (after + 4.2, after + 4.6, 0.0, left)]
        if crossing.zebra:
            stripes = np.arange(right + 0.3, left - 0.3, 1.0).tolist()
            ends = ((before - 3.6, before - 0.8), (after + 0.8, after + 3.6))
            rows += [(*end, y, y + 0.5) for end in ends for y in stripes]
    return patches(road, np.array(rows), _MARK_M)


def _line(
    road: Road, lateral: float, width: float, dashes: tuple[float, float]
) -> list[tuple[float, float, float, float]]:
    length, gap = dashes
    return [
        (s, s + length, lateral - width / 2, lateral + width / 2)
        for s in np.arange(-60.0, 170.0, length + gap).tolist()
        if road.is_free(s, 3.0) and road.is_free(s + length, 3.0)
    ]


def _surroundings(road: Road, district: District, random: np.random.Generator) -> list[Part]:
    """Everything that stands, on both sides."""
    parts: list[Part] = []
    for side, kerb in road.sides:
        parts += _buildings(road, district, side, kerb + road.pavement_m + road.verge_m, random)
        parts += _trees(road, district, side, kerb, random)
        parts += _posts(road, side, kerb, random)
    for crossing in road.crossings:
        for side, kerb in road.sides:
            parts += _side_street(road, crossing, side, kerb, district, random)
    return parts


def _buildings(road: Road, district: District, side: float, edge: float, random: np.random.Generator) -> list[Part]:
    parts: list[Part] = []
    s = _BUILT_M[0] + float(random.uniform(0, 10))
    while s < _BUILT_M[1]:
        width, depth = float(random.uniform(*district.width_m)), float(random.uniform(9, 18))
        middle = s + width / 2
        clear = all(abs(middle - c.at_m) > c.half_m + 2.5 + width / 2 for c in road.crossings)
        if clear and random.random() < district.built:
            away = edge + float(random.uniform(*district.setback_m)) + depth / 2
            away += sagitta(road, middle, width)
            parts += road.put(building(width, depth, district, random), middle, side * away)
        s += width + float(random.uniform(*district.gap_m))
    return parts


def _side_street(
    road: Road, crossing: Crossing, side: float, kerb: float, district: District, random: np.random.Generator
) -> list[Part]:
    """Buildings along a side road, beyond those of the main one."""
    parts: list[Part] = []
    away = kerb + road.pavement_m + road.verge_m + 34.0
    at_x, at_y, heading = road.at(crossing.at_m)
    while away < 120.0:
        width = float(random.uniform(*district.width_m))
        for flank in (-1.0, 1.0):
            if random.random() < district.built:
                depth = float(random.uniform(9, 15))
                house = building(width, depth, district, random)
                offset = crossing.at_m + flank * (crossing.half_m + 4.0 + depth / 2)
                along, across = offset - crossing.at_m, side * (away + width / 2)
                x = at_x + (along * np.cos(heading) - across * np.sin(heading))
                y = at_y + (along * np.sin(heading) + across * np.cos(heading))
                parts += [part.placed(0.0, 0.0, 0.0, np.pi / 2).placed(x, y, 0.0, heading) for part in house]
        away += width + float(random.uniform(*district.gap_m))
    return parts


def _trees(road: Road, district: District, side: float, kerb: float, random: np.random.Generator) -> list[Part]:
    if random.random() < 0.15:
        return []
    parts: list[Part] = []
    s = _BUILT_M[0] + float(random.uniform(0, district.trees_every_m))
    while s < 150.0:
        if road.is_free(s, 3.5):
            kind = bush if random.random() < 0.15 else tree
            lateral = kerb + road.pavement_m * 0.75 + road.verge_m * float(random.uniform(0.3, 0.9))
            parts += road.put(kind(random), s, side * lateral)
        s += district.trees_every_m * float(random.uniform(0.5, 1.6))
    return parts


def _posts(road: Road, side: float, kerb: float, random: np.random.Generator) -> list[Part]:
    """Street lamps, and signals at the crossings."""
    parts: list[Part] = []
    grey, label = tone(random, (0.36, 0.38, 0.38), 0.3), Label.POLE
    every, height = float(random.uniform(22, 40)), float(random.uniform(5.5, 9))
    lamp = [
        block((0, 0, height / 2), (0.17, 0.17, height), grey, label, shape="post"),
        block((0, -side * 1.8 / 2, height), (0.1, 1.8, 0.1), grey, label),
        block((0, -side * 1.8, height - 0.06), (0.3, 0.7, 0.14), (0.7, 0.7, 0.66), label),
    ]
    s = _BUILT_M[0] + float(random.uniform(0, every))
    while s < 150.0:
        if road.is_free(s, 1.5):
            parts += road.put(lamp, s, side * (kerb + 0.5))
        s += every
    for crossing in road.crossings:
        at = crossing.at_m - side * (crossing.half_m + 1.2)
        if road.is_free(at, 1.0):
            shine: Colour = (0.1, 0.7, 0.3) if random.random() < 0.5 else (0.8, 0.1, 0.08)
            signal = [
                block((0, 0, 1.7), (0.14, 0.14, 3.4), grey, label, shape="post"),
                block((0, 0, 3.3), (0.34, 0.34, 0.95), (0.1, 0.1, 0.1), label),
                block((0.2 * side, 0, 3.5), (0.04, 0.2, 0.2), shine, label, lit=True),
            ]
            parts += road.put(signal, at, side * (kerb + 0.6))
    return parts


def _random_light(random: np.random.Generator) -> Light:
    overcast = random.random() < 0.25
    height = float(random.uniform(12, 68)) * math.pi / 180
    azimuth = float(random.uniform(0, 2 * math.pi))
    low = math.exp(-height / 0.35)  # how golden the light is
    strength = 0.15 if overcast else 1.9
    blue = float(random.uniform(0.0, 1.0)) * (0.1 if overcast else 1.0)
    bright = float(random.uniform(0.55, 0.85))
    fill = 0.95 if overcast else 0.55
    return Light(
        sun_to=(math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)),
        sun=(strength, strength * (1 - 0.25 * low), strength * (0.92 - 0.45 * low)),
        sky=(fill * (0.9 - 0.12 * blue), fill * 0.92, fill * (0.94 + 0.14 * blue)),
        ground=(0.32 * fill, 0.3 * fill, 0.28 * fill),
        horizon=(0.72 * bright + 0.2 * low, 0.78 * bright + 0.06 * low, 0.86 * bright),
        zenith=(bright * (0.7 - 0.5 * blue), bright * (0.74 - 0.36 * blue), bright * (0.8 + 0.12 * blue)),
        fog_m=float(random.uniform(160, 700)),
        cloud=0.0 if overcast else float(random.uniform(0, 0.9)),
        exposure=float(random.uniform(1.3, 2.0)),
    )
