"""The ground of a grown driving world: asphalt, kerbs, rounded corners, pavements, marks, and what rain leaves."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Colour, Floats, Pattern, Sheet
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.ribbon import Span, fan, free_spans, patches, quads, ribbon
from gcd_train.scenes.driving.road import Crossing, Road
from gcd_train.scenes.driving.street import Street

ROAD_M, PATCH_M, MARK_M, PAVEMENT_M = 0.0, 0.004, 0.014, 0.12
_GROUND_M = -0.06
_KERB_WIDE_M, _KERB_SLOPE_M = 0.16, 0.05
_CORNER_M = 2.2
_MARKED: Span = (-70.0, 190.0)


def ground_sheets(street: Street, wetness: float, paved: bool, random: np.random.Generator) -> list[Sheet]:
    """Everything flat.

    wetness: 0..1; wet ground is darker, and shines. paved: whether stone lies between the pavements and the houses.
    """
    tone = random.uniform(0.24, 0.4)
    asphalt: Colour = (tone, tone * random.uniform(0.97, 1.02), tone * random.uniform(0.98, 1.07))
    grey = random.uniform(0.45, 0.66)
    paving: Colour = (grey, grey * random.uniform(0.92, 1.0), grey * random.uniform(0.84, 1.0))
    roads = street.roads
    sheets = [_terrain(street, wetness, random)]
    if paved:
        court = np.concatenate([_courts(road) for road in roads])
        sheets.append(_sheet(court, _times(paving, 0.86), Label.PAVEMENT, Pattern.SPECKLE, wetness))
    sheets.append(_sheet(_asphalt(street), asphalt, Label.ROAD, Pattern.SPECKLE, wetness))
    sheets.append(_sheet(_repairs(street.main, random), _times(asphalt, 0.8), Label.ROAD, Pattern.SPECKLE, wetness))
    if wetness > 0:
        sheets.append(_sheet(_puddles(street.main, random), (0.07, 0.075, 0.08), Label.ROAD, gloss=1.0))
    stone = np.concatenate([_pavements(street), _corners(street, 0.0, PAVEMENT_M)])
    sheets.append(_sheet(stone, paving, Label.PAVEMENT, Pattern.TILES, wetness))
    sheets.append(_sheet(_kerbs(street), (0.62, 0.62, 0.6), Label.KERB, gloss=wetness))
    return [*sheets, *_marks(street, wetness, random)]


def _times(colour: Colour, factor: float) -> Colour:
    r, g, b = (min(channel * factor, 1.0) for channel in colour)
    return r, g, b


def _sheet(
    corners: Floats, colour: Colour, label: Label, pattern: Pattern = Pattern.PLAIN, gloss: float = 0.0
) -> Sheet:
    """Triangles turned so that they face up; what is wet is darker."""
    edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    upward = np.where((edges[:, 2] < 0)[:, None, None], corners[:, ::-1], corners).astype(np.float32)
    dark = _times(colour, 1 - 0.35 * gloss) if label != Label.LANE_MARKING else colour
    return Sheet(corners=upward, colour=dark, label=label, pattern=pattern, gloss=gloss)


def _terrain(street: Street, wetness: float, random: np.random.Generator) -> Sheet:
    grass: Colour = (random.uniform(0.24, 0.4), random.uniform(0.38, 0.48), random.uniform(0.16, 0.26))
    dry: Colour = (random.uniform(0.5, 0.62), random.uniform(0.46, 0.54), random.uniform(0.32, 0.4))
    colour = grass if random.random() < 0.75 else dry
    x, y = np.meshgrid(np.arange(-800.0, 800.0, 200.0), np.arange(-800.0, 800.0, 200.0))
    low = np.stack([x.reshape(-1), y.reshape(-1), np.full(x.size, _GROUND_M)], -1)
    corners = quads(low, *(low + np.array([a, b, 0.0]) for a, b in ((200.0, 0.0), (200.0, 200.0), (0.0, 200.0))))
    return _sheet(corners, colour, Label.TERRAIN, Pattern.SPECKLE, 0.3 * wetness)


def _asphalt(street: Street) -> Floats:
    pieces = [ribbon(road, -road.right_m, road.left_m, ROAD_M) for road in street.roads]
    return np.concatenate([*pieces, _corners(street, ROAD_M, None)])


def _sides(road: Road) -> tuple[tuple[float, float], tuple[float, float]]:
    """Direction of each side and where its kerb is: right, left."""
    return (-1.0, road.right_m), (1.0, road.left_m)


def _pavements(street: Street) -> Floats:
    pieces = [
        ribbon(road, *_ordered(side * kerb, side * (kerb + road.pavement_m)), PAVEMENT_M, free_spans(road, _CORNER_M))
        for road in street.roads
        for side, kerb in _sides(road)
    ]
    return np.concatenate(pieces)


def _courts(road: Road) -> Floats:
    spans = free_spans(road, _CORNER_M)
    pieces = [
        ribbon(road, *_ordered(side * (kerb + 1.0), side * (kerb + road.pavement_m + 16.0)), PAVEMENT_M - 0.03, spans)
        for side, kerb in _sides(road)
    ]
    return np.concatenate(pieces)


def _ordered(a: float, b: float) -> tuple[float, float]:
    return min(a, b), max(a, b)


def _kerbs(street: Street) -> Floats:
    """The kerb stones' tops, and their faces towards the road."""
    pieces: list[Floats] = []
    for road in street.roads:
        spans = free_spans(road, _CORNER_M)
        for side, kerb in _sides(road):
            inner, edge, outer = side * kerb, side * (kerb + _KERB_SLOPE_M), side * (kerb + _KERB_WIDE_M)
            top = PAVEMENT_M + 0.008
            pieces.append(ribbon(road, *_ordered(edge, outer), top, spans))
            heights = (top, ROAD_M) if side < 0 else (ROAD_M, top)
            pieces.append(ribbon(road, *_ordered(inner, edge), heights, spans))
    return np.concatenate([*pieces, *_kerb_corners(street)])


def _quadrants(street: Street) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """Of every corner of a junction: its middle of rounding [2] and the axes [2] from there to the two roads."""
    for crossing in street.main.crossings:
        x, y, heading = street.main.at(crossing.at_m)
        ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        for along in (-1.0, 1.0):
            for side, kerb in _sides(street.main):
                middle = np.array([x, y]) + along * ahead * (crossing.half_m + _CORNER_M)
                yield middle + side * left * (kerb + _CORNER_M), -along * ahead, -side * left


def _rim(
    middle: NDArray[np.float64], first: NDArray[np.float64], second: NDArray[np.float64], radius: float, z: float
) -> NDArray[np.float64]:
    turn = np.linspace(0, np.pi / 2, 6)[:, None]
    rim = middle + radius * (np.cos(turn) * first + np.sin(turn) * second)
    return np.append(rim, np.full((6, 1), z), 1)


def _corners(street: Street, road_z: float, pavement_z: float | None) -> Floats:
    """The rounded corners: as stone where a height is given for it, else the asphalt under and before them."""
    pieces: list[Floats] = [np.zeros((0, 3, 3), np.float32)]
    for middle, first, second in _quadrants(street):
        if pavement_z is not None:
            rim = _rim(middle, first, second, _CORNER_M, pavement_z)
            pieces.append(fan(np.append(middle, pavement_z), rim))
        else:
            reach = _CORNER_M * 1.05
            square = [middle, middle + first * reach, middle + (first + second) * reach, middle + second * reach]
            a, b, c, d = (np.append(corner, road_z)[None] for corner in square)
            pieces.append(quads(a, b, c, d))
    return np.concatenate(pieces)


def _kerb_corners(street: Street) -> list[Floats]:
    pieces: list[Floats] = []
    for middle, first, second in _quadrants(street):
        top = PAVEMENT_M + 0.008
        low = _rim(middle, first, second, _CORNER_M, ROAD_M)
        edge = _rim(middle, first, second, _CORNER_M - _KERB_SLOPE_M, top)
        inner = _rim(middle, first, second, _CORNER_M - _KERB_WIDE_M, top)
        pieces += [quads(low[:-1], low[1:], edge[1:], edge[:-1]), quads(edge[:-1], edge[1:], inner[1:], inner[:-1])]
    return pieces


def _repairs(road: Road, random: np.random.Generator) -> Floats:
    """Darker patches where the road was mended."""
    count = int(random.integers(4, 16))
    s, y = random.uniform(-40, 130, count), random.uniform(-road.right_m, road.left_m - 1.5, count)
    rows = np.stack([s, s + random.uniform(1, 9, count), y, y + random.uniform(0.6, 1.5, count)], -1)
    return patches(road, rows, PATCH_M)


def _puddles(road: Road, random: np.random.Generator) -> Floats:
    pieces: list[Floats] = []
    for _ in range(24):
        x, y, _ = road.at(float(random.uniform(-30, 110)), float(random.uniform(-road.right_m, road.left_m)))
        turn = np.linspace(0, 2 * np.pi, 11)
        radius = float(random.uniform(0.5, 1.8)) * random.uniform(0.75, 1.0, 11)
        radius[-1] = radius[0]
        rim = np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn), np.full(11, PATCH_M + 0.003)], -1)
        pieces.append(fan(np.array([x, y, PATCH_M + 0.003]), rim))
    return np.concatenate(pieces)


def _marks(street: Street, wetness: float, random: np.random.Generator) -> list[Sheet]:
    white = float(random.uniform(0.78, 0.95))
    paint: Colour = (white, white, white * float(random.uniform(0.93, 1.0)))
    middle: Colour = paint if random.random() < 0.6 else (white, 0.72 * white, 0.12)
    width = float(random.uniform(0.12, 0.18))
    dash = (float(random.uniform(2.5, 4.5)), float(random.uniform(4.0, 8.0)))
    edged, solid = random.random() < 0.6, random.random() < 0.5
    lanes, centre, zebras, stops = [], [], [], []
    for road in street.roads:
        lanes.append(_lane_lines(road, width, dash, edged))
        centre.append(_dashes(road, 0.0, width, None if solid else dash))
        for crossing in road.crossings:
            zebras.append(patches(road, _zebra(road, crossing), MARK_M))
            stops.append(patches(road, _stop_lines(road, crossing), MARK_M))
    pairs = ((lanes, paint, Label.LANE_MARKING), (centre, middle, Label.LANE_MARKING),
             (zebras, paint, Label.CROSSWALK), (stops, paint, Label.STOP_LINE))  # fmt: skip
    none = np.zeros((0, 3, 3), np.float32)
    return [
        _sheet(np.concatenate([none, *shapes]), colour, label, gloss=0.5 * wetness) for shapes, colour, label in pairs
    ]


def _lane_lines(road: Road, width: float, dash: tuple[float, float], edged: bool) -> Floats:
    """Between lanes of one direction, at the outer edges, and around the parking places."""
    inner = [-i * road.lane_m for i in range(-road.lanes_left + 1, road.lanes_right) if i != 0]
    pieces = [_dashes(road, lateral, width, dash) for lateral in inner]
    outer = (-road.lanes_right * road.lane_m, road.lanes_left * road.lane_m)
    for lateral, strip in zip(outer, road.parking_m, strict=True):
        if strip > 0:
            pieces.append(_dashes(road, lateral, 0.1, (1.0, 4.6)))
        elif edged:
            pieces.append(_dashes(road, lateral - np.sign(lateral) * 0.25, width, None))
    return np.concatenate([np.zeros((0, 3, 3), np.float32), *pieces])


def _dashes(road: Road, lateral: float, width: float, dash: tuple[float, float] | None) -> Floats:
    begin, end = max(_MARKED[0], road.start_m), min(_MARKED[1], road.end_m)
    spans = free_spans(road, _CORNER_M + 5.6, begin, end)
    right, left = lateral - width / 2, lateral + width / 2
    if dash is None:
        return ribbon(road, right, left, MARK_M, spans)
    starts = np.concatenate([[], *(np.arange(lo, hi - dash[0], sum(dash)) for lo, hi in spans)])
    return patches(road, np.stack([starts, starts + dash[0], 0 * starts + right, 0 * starts + left], -1), MARK_M)


def stop_line_m(crossing: Crossing) -> float:
    """How far before a crossing's middle the first vehicle's nose stands."""
    return crossing.half_m + _CORNER_M + 5.2


def zebra_m(crossing: Crossing) -> tuple[float, float]:
    """Where people cross, as distances from the crossing's middle."""
    return crossing.half_m + _CORNER_M + 0.4, crossing.half_m + _CORNER_M + 3.2


def _zebra(road: Road, crossing: Crossing) -> NDArray[np.float64]:
    if not crossing.zebra:
        return np.zeros((0, 4))
    stripes = np.arange(-road.right_m + 0.5, road.left_m - 0.6, 1.0)
    near, far = zebra_m(crossing)
    ends = ((crossing.at_m - far, crossing.at_m - near), (crossing.at_m + near, crossing.at_m + far))
    return np.array([(*end, y, y + 0.5) for end in ends for y in stripes])


def _stop_lines(road: Road, crossing: Crossing) -> NDArray[np.float64]:
    away = stop_line_m(crossing) - 0.9
    right, left = -road.lanes_right * road.lane_m, road.lanes_left * road.lane_m
    at = crossing.at_m
    return np.array([(at - away, at - away + 0.4, right, 0.0), (at + away - 0.4, at + away, 0.0, left)])
