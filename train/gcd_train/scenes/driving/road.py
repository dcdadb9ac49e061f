"""The road of the driving world: a curved centre line, its lanes, crossings, marks and pavements."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Colour, Floats, Pattern, Sheet
from gcd_train.scenes.driving.classes import Label

_STEP_M = 2.0
_START_M, _END_M = -70.0, 230.0
_KERB_M, _MARK_M, _ROAD_M, _GROUND_M = 0.10, 0.012, 0.0, -0.06


@dataclass(frozen=True, kw_only=True, slots=True)
class Crossing:
    """A side road across the main one. at_m: along the centre line. half_m: half its width."""

    at_m: float
    half_m: float
    zebra: bool

    def covers(self, s: float, margin_m: float = 0.0) -> bool:
        """Whether a place along the main road lies in the junction."""
        return abs(s - self.at_m) < self.half_m + margin_m


@dataclass(frozen=True, kw_only=True, slots=True)
class Road:
    """The layout of one scene; lateral distances count to the left of the centre line.

    headings: radians at every 2 m of the centre line, points: [N, 2] there. lanes_right, lanes_left: with and against
    the ego's direction (traffic keeps right). parking_m: width of the parking strip on (right, left). pavement_m,
    verge_m: of the pavement and of the green strip beyond it. start_m: where the centre line begins.
    """

    points: NDArray[np.float64]
    headings: NDArray[np.float64]
    lane_m: float
    lanes_right: int
    lanes_left: int
    parking_m: tuple[float, float]
    pavement_m: float
    verge_m: float
    crossings: tuple[Crossing, ...]
    start_m: float = _START_M

    def at(self, s: float, lateral: float = 0.0) -> tuple[float, float, float]:
        """x, y and heading of a place along the road."""
        share = (s - self.start_m) / _STEP_M
        knots = np.arange(len(self.headings))
        heading = float(np.interp(share, knots, self.headings))
        x, y = (float(np.interp(share, knots, self.points[:, i])) for i in (0, 1))
        return x - lateral * np.sin(heading), y + lateral * np.cos(heading), heading

    def places(self, s: NDArray[np.float64], lateral: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
        """Many places at once: x, y and heading [..., 3] of s [...]."""
        share, knots = (s - self.start_m) / _STEP_M, np.arange(len(self.headings))
        heading = np.interp(share, knots, self.headings)
        x, y = (np.interp(share, knots, self.points[:, i]) for i in (0, 1))
        return np.stack([x - lateral * np.sin(heading), y + lateral * np.cos(heading), heading], -1)

    @property
    def end_m(self) -> float:
        """Where the centre line ends."""
        return self.start_m + _STEP_M * (len(self.headings) - 1)

    @property
    def right_m(self) -> float:
        """Distance of the right kerb from the centre line."""
        return self.lanes_right * self.lane_m + self.parking_m[0]

    @property
    def left_m(self) -> float:
        """Distance of the left kerb from the centre line."""
        return self.lanes_left * self.lane_m + self.parking_m[1]

    def lane(self, index: int) -> float:
        """Lateral place of a lane's middle: 0, 1, ... to the right, -1, -2, ... to the left."""
        return -(index + 0.5) * self.lane_m

    def is_free(self, s: float, margin_m: float = 0.0) -> bool:
        """Whether a place lies outside all junctions."""
        return not any(crossing.covers(s, margin_m) for crossing in self.crossings)


def random_road(random: np.random.Generator) -> Road:
    """A layout drawn at random; the ego starts near s = 0."""
    s = np.arange(_START_M, _END_M, _STEP_M)
    bend = 0.0 if random.random() < 0.35 else random.uniform(-1, 1) * 0.011
    sway = random.uniform(-1, 1) * 0.009 if random.random() < 0.5 else 0.0
    curvature = bend + sway * np.sin(s / random.uniform(25, 60) + random.uniform(0, 6))
    headings = np.cumsum(curvature) * _STEP_M
    headings -= headings[int(-_START_M / _STEP_M)]
    steps = np.stack([np.cos(headings), np.sin(headings)], -1) * _STEP_M
    points = np.cumsum(steps, 0)
    points -= points[int(-_START_M / _STEP_M)]
    parking = tuple(float(random.uniform(2.2, 2.6)) if random.random() < 0.5 else 0.0 for _ in range(2))
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
    )


def _random_crossings(random: np.random.Generator) -> tuple[Crossing, ...]:
    crossings: list[Crossing] = []
    for _ in range(int(random.choice([0, 1, 2, 3], p=[0.25, 0.4, 0.25, 0.1]))):
        made = Crossing(
            at_m=float(random.uniform(-40, 120)),
            half_m=float(random.uniform(3.2, 7.0)),
            zebra=bool(random.random() < 0.7),
        )
        if all(abs(made.at_m - other.at_m) > 40 for other in crossings):
            crossings.append(made)
    return tuple(crossings)


def road_sheets(road: Road, random: np.random.Generator) -> list[Sheet]:
    """Everything flat: terrain, carriageway, marks, pavements, side roads."""
    tone = random.uniform(0.24, 0.42)
    asphalt: Colour = (tone, tone * random.uniform(0.96, 1.02), tone * random.uniform(0.96, 1.06))
    grey = random.uniform(0.5, 0.72)
    paving: Colour = (grey, grey * random.uniform(0.92, 1.0), grey * random.uniform(0.84, 1.0))
    return [
        _terrain(random),
        _sheet(_ribbon(road, -road.right_m, road.left_m, _ROAD_M), asphalt, Label.ROAD, Pattern.SPECKLE),
        *_pavements(road, paving),
        *_side_roads(road, asphalt, paving),
        _sheet(_marks(road, random), _mark_colour(random), Label.LANE_MARKING),
    ]


def _terrain(random: np.random.Generator) -> Sheet:
    grass: Colour = (random.uniform(0.22, 0.45), random.uniform(0.38, 0.52), random.uniform(0.14, 0.28))
    dry: Colour = (random.uniform(0.5, 0.66), random.uniform(0.45, 0.56), random.uniform(0.3, 0.42))
    colour = grass if random.random() < 0.75 else dry
    cells = np.arange(-600.0, 601.0, 100.0, dtype=np.float32)  # split, so that interpolation stays exact far away
    x, y = (grid.reshape(-1) for grid in np.meshgrid(cells[:-1], cells[:-1]))
    return _sheet(_rectangles(x, y, x + 100, y + 100, _GROUND_M), colour, Label.TERRAIN, Pattern.SPECKLE)


def _rectangles(x0: Floats, y0: Floats, x1: Floats, y1: Floats, z: float) -> Floats:
    height = np.full_like(x0, z)
    a, b, c, d = (np.stack([x, y, height], -1) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1)))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.float32)


def _pavements(road: Road, paving: Colour) -> list[Sheet]:
    sheets: list[Sheet] = []
    for inner, outer in _pavement_strips(road):
        strip = _ribbon(road, inner, outer, _KERB_M, free_only=True)
        edge = inner if abs(inner) < abs(outer) else outer
        kerb = _ribbon(road, edge - 0.09, edge + 0.09, _KERB_M + 0.01, free_only=True)
        sheets.append(_sheet(strip, paving, Label.PAVEMENT, Pattern.TILES))
        sheets.append(_sheet(kerb, (0.72, 0.72, 0.7), Label.PAVEMENT))
    return sheets


def _pavement_strips(road: Road) -> list[tuple[float, float]]:
    return [(-road.right_m - road.pavement_m, -road.right_m), (road.left_m, road.left_m + road.pavement_m)]


def _side_roads(road: Road, asphalt: Colour, paving: Colour) -> list[Sheet]:
    sheets: list[Sheet] = []
    for crossing in road.crossings:
        for side, edge in ((-1.0, road.right_m), (1.0, road.left_m)):
            for low, high, z, colour, label, pattern in (
                (-crossing.half_m, crossing.half_m, _ROAD_M, asphalt, Label.ROAD, Pattern.SPECKLE),
                (-crossing.half_m - 2.2, -crossing.half_m, _KERB_M - 0.02, paving, Label.PAVEMENT, Pattern.TILES),
                (crossing.half_m, crossing.half_m + 2.2, _KERB_M - 0.02, paving, Label.PAVEMENT, Pattern.TILES),
            ):
                corners = _across(road, crossing.at_m, (low, high), side * (edge - 0.1), side * (edge + 140.0), z)
                sheets.append(_sheet(corners, colour, label, pattern))
    return sheets


def _across(road: Road, at_m: float, along: tuple[float, float], near: float, far: float, z: float) -> Floats:
    """A straight strip square to the main road."""
    x, y, heading = road.at(at_m)
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    ends = ((along[0], near), (along[1], near), (along[1], far), (along[0], far))
    corners = [np.array([x, y]) + ahead * a + left * b for a, b in ends]
    a, b, c, d = (np.append(corner, z) for corner in corners)
    return np.array([[a, b, c], [a, c, d]], np.float32)


def _mark_colour(random: np.random.Generator) -> Colour:
    white = random.uniform(0.8, 0.97)
    return white, white, white * random.uniform(0.9, 1.0)


def _marks(road: Road, random: np.random.Generator) -> Floats:
    """Lane lines, edge lines, stop lines and zebras."""
    width = float(random.uniform(0.12, 0.2))
    dash, gap = float(random.uniform(2.5, 5.0)), float(random.uniform(4.0, 8.0))
    pieces: list[Floats] = []
    for index in range(-road.lanes_left + 1, road.lanes_right):
        lateral = -index * road.lane_m
        solid = index == 0 and random.random() < 0.5
        pieces += _line(road, lateral, width, None if solid else (dash, gap))
    if random.random() < 0.7:
        pieces += _line(road, -road.lanes_right * road.lane_m + 0.15, width, None)
        pieces += _line(road, road.lanes_left * road.lane_m - 0.15, width, None)
    for crossing in road.crossings:
        pieces += _junction_marks(road, crossing)
    return np.concatenate(pieces) if pieces else np.zeros((0, 3, 3), np.float32)


def _line(road: Road, lateral: float, width: float, dashes: tuple[float, float] | None) -> list[Floats]:
    length, gap = dashes if dashes else (4.0, 0.0)
    starts = np.arange(-60.0, 170.0, length + gap)
    return [
        _piece(road, float(s), float(s) + length, lateral - width / 2, lateral + width / 2)
        for s in starts
        if road.is_free(float(s), 3.0) and road.is_free(float(s) + length, 3.0)
    ]


def _junction_marks(road: Road, crossing: Crossing) -> list[Floats]:
    before, after = crossing.at_m - crossing.half_m, crossing.at_m + crossing.half_m
    inner_right, inner_left = -road.lanes_right * road.lane_m, road.lanes_left * road.lane_m
    pieces = [
        _piece(road, before - 4.6, before - 4.2, inner_right, 0.0),
        _piece(road, after + 4.2, after + 4.6, 0.0, inner_left),
    ]
    if not crossing.zebra:
        return pieces
    stripes = np.arange(inner_right + 0.3, inner_left - 0.3, 1.0)
    ends = ((before - 3.6, before - 0.8), (after + 0.8, after + 3.6))
    return pieces + [_piece(road, *end, float(y), float(y) + 0.5) for end in ends for y in stripes]


def _piece(road: Road, start: float, end: float, right: float, left: float) -> Floats:
    a, b, c, d = ((*road.at(s, y)[:2], _MARK_M) for s, y in ((start, right), (end, right), (end, left), (start, left)))
    return np.array([[a, b, c], [a, c, d]], np.float32)


def _ribbon(road: Road, right: float, left: float, z: float, *, free_only: bool = False) -> Floats:
    """A strip along the road; with `free_only` it stops at the junctions."""
    s = _START_M + _STEP_M * np.arange(len(road.headings))
    normal = np.stack([-np.sin(road.headings), np.cos(road.headings)], -1)
    low, high = (np.append(road.points + normal * y, np.full((len(s), 1), z), 1) for y in (right, left))
    a, b, c, d = low[:-1], low[1:], high[1:], high[:-1]
    if free_only:
        kept = np.array([road.is_free(float(m), 0.0) for m in s[:-1] + _STEP_M / 2])
        a, b, c, d = a[kept], b[kept], c[kept], d[kept]
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.float32)


def _sheet(corners: Floats, colour: Colour, label: Label, pattern: Pattern = Pattern.PLAIN) -> Sheet:
    """Triangles turned so that they face up."""
    edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    upward = np.where((edges[:, 2] < 0)[:, None, None], corners[:, ::-1], corners)
    return Sheet(corners=upward.astype(np.float32), colour=colour, label=label, pattern=pattern)
