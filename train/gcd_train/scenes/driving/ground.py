"""The ground of the driving world: asphalt, kerbs, rounded corners, pavements, marks, and what rain leaves."""

from collections.abc import Iterable, Iterator

import numpy as np

from gcd_train.scenes.description import Colour, Doubles, Floats, Paint, Pattern, Sheet, mixed, shaded
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.roads import Crossing, Road, Street, fan, patches, quads, ribbon

ROAD_M, PATCH_M, MARK_M, PAVEMENT_M = 0.0, 0.004, 0.014, 0.12
_KERB_WIDE_M, _KERB_SLOPE_M = 0.16, 0.05
_CORNER_M, _COURT_M = 2.2, PAVEMENT_M - 0.03
_MARKED_M = -70.0, 190.0
_POOL_STEPS = 7


def ground_sheets(street: Street, wetness: float, paved: bool, random: np.random.Generator) -> list[Sheet]:
    """Everything flat.

    wetness: 0..1; wet ground is darker, and shines. paved: whether stone lies between the pavements and the houses.
    """
    tone = random.uniform(0.24, 0.4)
    asphalt: Colour = (tone, tone * random.uniform(0.97, 1.02), tone * random.uniform(0.98, 1.07))
    grey = random.uniform(0.45, 0.66)
    paving: Colour = (grey, grey * random.uniform(0.92, 1.0), grey * random.uniform(0.84, 1.0))
    grass: Colour = (random.uniform(0.24, 0.4), random.uniform(0.38, 0.48), random.uniform(0.16, 0.26))
    dry: Colour = (random.uniform(0.5, 0.62), random.uniform(0.46, 0.54), random.uniform(0.32, 0.4))
    terrain, main = grass if random.random() < 0.75 else dry, street.main
    cell = 200.0  # a square of cells just below all roads; split, so that interpolation stays exact far away
    x, y = np.meshgrid(np.arange(-800.0, 800.0, cell), np.arange(-800.0, 800.0, cell))
    low = np.stack([x.reshape(-1), y.reshape(-1), np.full(x.size, -0.06)], -1)
    cells = quads(low, *(low + np.array([a, b, 0.0]) for a, b in ((cell, 0.0), (cell, cell), (0.0, cell))))
    sheets = [_flat(cells, terrain, Label.TERRAIN, Pattern.SPECKLE, 0.3 * wetness)]
    if paved:
        court = [piece for road in street.roads for piece in _beside(road, 1.0, road.pavement_m + 16.0, _COURT_M)]
        sheets.append(_flat(np.concatenate(court), shaded(paving, 0.86), Label.PAVEMENT, Pattern.SPECKLE, wetness))
    sheets.append(_flat(_asphalt(street), asphalt, Label.ROAD, Pattern.SPECKLE, wetness))
    count = int(random.integers(4, 16))  # darker patches where the road was mended
    s, lateral = random.uniform(-40, 130, count), random.uniform(-main.right_m, main.left_m - 1.5, count)
    ends = s + random.uniform(1, 9, count), lateral, lateral + random.uniform(0.6, 1.5, count)
    mended = patches(main, np.stack([s, *ends], -1), PATCH_M)
    sheets.append(_flat(mended, shaded(asphalt, 0.8), Label.ROAD, Pattern.SPECKLE, wetness))
    if wetness > 0:
        sheets.append(_flat(_puddles(main, random), (0.07, 0.075, 0.08), Label.ROAD, wetness=1.0))
    stone = [piece for road in street.roads for piece in _beside(road, 0.0, road.pavement_m, PAVEMENT_M)]
    for middle, first, second in _quadrants(street):
        stone.append(fan(np.append(middle, PAVEMENT_M), _rim(middle, first, second, _CORNER_M, PAVEMENT_M)))
    sheets.append(_flat(np.concatenate(stone), paving, Label.PAVEMENT, Pattern.TILES, wetness))
    sheets.append(_flat(_kerbs(street), (0.62, 0.62, 0.6), Label.KERB, wetness=wetness))
    return [*sheets, *_marks(street, wetness, random)]


def _flat(
    corners: Floats, colour: Colour, label: Label, pattern: Pattern = Pattern.PLAIN, wetness: float = 0.0
) -> Sheet:
    """Triangles turned so that they face up; what is wet is darker, and shines."""
    edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    upward = np.where((edges[:, 2] < 0)[:, None, None], corners[:, ::-1], corners).astype(np.float32)
    dark = shaded(colour, 1 - 0.35 * wetness) if label != Label.LANE_MARKING else colour
    return Sheet(upward, Paint(dark, pattern=pattern, gloss=wetness), label)


def _asphalt(street: Street) -> Floats:
    """The lanes, and what lies under and before the rounded corners."""
    pieces = [ribbon(road, (-road.right_m, ROAD_M), (road.left_m, ROAD_M)) for road in street.roads]
    reach = _CORNER_M * 1.05
    for middle, first, second in _quadrants(street):
        square = [middle, middle + first * reach, middle + (first + second) * reach, middle + second * reach]
        a, b, c, d = (np.append(corner, ROAD_M)[None] for corner in square)
        pieces.append(quads(a, b, c, d))
    return np.concatenate(pieces)


def _beside(road: Road, near_m: float, far_m: float, near_z: float, far_z: float | None = None) -> Iterator[Floats]:
    """Strips on both sides, between two distances from the kerb, that stop before the junctions' corners."""
    spans = road.free_spans(_CORNER_M)
    for side, kerb in road.sides:
        near, far = (side * (kerb + near_m), near_z), (side * (kerb + far_m), near_z if far_z is None else far_z)
        yield ribbon(road, *((near, far) if side > 0 else (far, near)), spans)


def _kerbs(street: Street) -> Floats:
    """The kerb stones' tops, and their faces towards the road."""
    top, pieces = PAVEMENT_M + 0.008, [np.zeros((0, 3, 3), np.float32)]
    for road in street.roads:
        pieces += _beside(road, _KERB_SLOPE_M, _KERB_WIDE_M, top)
        pieces += _beside(road, 0.0, _KERB_SLOPE_M, ROAD_M, top)
    for corner in _quadrants(street):
        edges = ((0.0, ROAD_M), (_KERB_SLOPE_M, top), (_KERB_WIDE_M, top))
        low, edge, inner = (_rim(*corner, _CORNER_M - away, z) for away, z in edges)
        pieces += [quads(low[:-1], low[1:], edge[1:], edge[:-1]), quads(edge[:-1], edge[1:], inner[1:], inner[:-1])]
    return np.concatenate(pieces)


def _quadrants(street: Street) -> Iterator[tuple[Doubles, Doubles, Doubles]]:
    """Of every corner of a junction: its middle of rounding [2] and the axes [2] from there to the two roads."""
    for crossing in street.main.crossings:
        x, y, heading = street.main.at(crossing.at_m)
        ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        for along in (-1.0, 1.0):
            for side, kerb in street.main.sides:
                middle = np.array([x, y]) + along * ahead * (crossing.half_m + _CORNER_M)
                yield middle + side * left * (kerb + _CORNER_M), -along * ahead, -side * left


def _rim(middle: Doubles, first: Doubles, second: Doubles, radius: float, z: float) -> Doubles:
    turn = np.linspace(0, np.pi / 2, 6)[:, None]
    rim = middle + radius * (np.cos(turn) * first + np.sin(turn) * second)
    return np.append(rim, np.full((6, 1), z), 1)


def _puddles(road: Road, random: np.random.Generator) -> Floats:
    pieces: list[Floats] = []
    for _ in range(24):
        x, y, _ = road.at(random.uniform(-30, 110), random.uniform(-road.right_m, road.left_m))
        turn = np.linspace(0, 2 * np.pi, 11)
        radius = random.uniform(0.5, 1.8) * random.uniform(0.75, 1.0, 11)
        radius[-1] = radius[0]
        rim = np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn), np.full(11, PATCH_M + 0.003)], -1)
        pieces.append(fan(np.array([x, y, PATCH_M + 0.003]), rim))
    return np.concatenate(pieces)


def _marks(street: Street, wetness: float, random: np.random.Generator) -> list[Sheet]:
    """Lane lines, centre lines, zebras and stop lines."""
    white = random.uniform(0.78, 0.95)
    paint: Colour = (white, white, white * random.uniform(0.93, 1.0))
    middle: Colour = paint if random.random() < 0.6 else (white, 0.72 * white, 0.12)
    width = random.uniform(0.12, 0.18)
    dash = (random.uniform(2.5, 4.5), random.uniform(4.0, 8.0))
    edged, solid = random.random() < 0.6, random.random() < 0.5
    none = [np.zeros((0, 3, 3), np.float32)]
    lanes, centre, zebras, stops = [*none], [*none], [*none], [*none]
    for road in street.roads:
        lanes += _lane_lines(road, width, dash, edged)
        centre.append(_dashes(road, 0.0, width, None if solid else dash))
        stripes = np.arange(-road.right_m + 0.5, road.left_m - 0.6, 1.0)
        right, left = -road.lanes_right * road.lane_m, road.lanes_left * road.lane_m
        for crossing in road.crossings:
            at, (near, far), away = crossing.at_m, zebra_m(crossing), stop_line_m(crossing) - 0.9
            ends = ((at - far, at - near), (at + near, at + far))
            zebra = np.array([(*end, y, y + 0.5) for end in ends for y in stripes if crossing.zebra])
            zebras.append(patches(road, zebra, MARK_M))
            lines = [(at - away, at - away + 0.4, right, 0.0), (at + away - 0.4, at + away, 0.0, left)]
            stops.append(patches(road, np.array(lines), MARK_M))
    kinds = ((lanes, paint, Label.LANE_MARKING), (centre, middle, Label.LANE_MARKING),
             (zebras, paint, Label.CROSSWALK), (stops, paint, Label.STOP_LINE))  # fmt: skip
    return [_flat(np.concatenate(shapes), colour, label, wetness=0.5 * wetness) for shapes, colour, label in kinds]


def _lane_lines(road: Road, width: float, dash: tuple[float, float], edged: bool) -> list[Floats]:
    """Between lanes of one direction, at the outer edges, and around the parking places."""
    inner = [-i * road.lane_m for i in range(-road.lanes_left + 1, road.lanes_right) if i != 0]
    pieces = [_dashes(road, lateral, width, dash) for lateral in inner]
    outer = (-road.lanes_right * road.lane_m, road.lanes_left * road.lane_m)
    for lateral, strip in zip(outer, road.parking_m, strict=True):
        if strip > 0:
            pieces.append(_dashes(road, lateral, 0.1, (1.0, 4.6)))
        elif edged:
            pieces.append(_dashes(road, lateral - np.sign(lateral) * 0.25, width, None))
    return pieces


def _dashes(road: Road, lateral: float, width: float, dash: tuple[float, float] | None) -> Floats:
    spans = road.free_spans(_CORNER_M + 5.6, *_MARKED_M)
    right, left = lateral - width / 2, lateral + width / 2
    if dash is None:
        return ribbon(road, (right, MARK_M), (left, MARK_M), spans)
    starts = np.concatenate([[], *(np.arange(lo, hi - dash[0], sum(dash)) for lo, hi in spans)])
    return patches(road, np.stack([starts, starts + dash[0], 0 * starts + right, 0 * starts + left], -1), MARK_M)


def stop_line_m(crossing: Crossing) -> float:
    """How far before a crossing's middle the first vehicle's nose stands."""
    return crossing.half_m + _CORNER_M + 5.2


def zebra_m(crossing: Crossing) -> tuple[float, float]:
    """Where people cross, as distances from the crossing's middle."""
    return crossing.half_m + _CORNER_M + 0.4, crossing.half_m + _CORNER_M + 3.2


def lamp_pools(spots: Iterable[tuple[float, float, float]], asphalt: Colour, strength: float) -> list[Sheet]:
    """Light on the road: discs one within the other, each a little brighter, just above the asphalt.

    The renderer has no lamps; lit ground is brighter paint, below the lane marks. spots: x, y and heading of their
    middles. strength: 0..1.
    """
    sheets: list[Sheet] = []
    turn, spots = np.linspace(0, 2 * np.pi, 15), list(spots)
    for step in range(_POOL_STEPS):
        radius, z = 6.5 * (1 - step / _POOL_STEPS), PATCH_M + 0.0008 * (1 + step)
        along, aside = radius * 1.25 * np.cos(turn), radius * np.sin(turn)
        pieces = [np.zeros((0, 3, 3), np.float32)]
        for x, y, heading in spots:
            cos, sin = np.cos(heading), np.sin(heading)
            rim = np.stack([x + along * cos - aside * sin, y + along * sin + aside * cos, 0 * turn + z], -1)
            pieces.append(fan(np.array([x, y, z]), rim))
        colour = mixed(asphalt, strength * ((step + 1) / _POOL_STEPS) ** 2, (0.92, 0.74, 0.5))
        sheets.append(Sheet(np.concatenate(pieces), Paint(colour), Label.ROAD))
    return sheets
