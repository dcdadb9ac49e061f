"""Roads: a curved centre line with lanes, crossings and pavements; flat shapes along it; the streets of a scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gcd_train.scenes.description import Doubles, Floats, Part

STEP_M = 2.0
_START_M, _END_M, _SIDE_M = -160.0, 340.0, 130.0
_APART_M, _HOUSES_M = 48.0, 30.0
"""Room between crossings, and between the side roads further out."""
_CALM_M = 22.0
_NEAR_M = (-60.0, 180.0)
_KNOTS_M = np.concatenate([np.arange(-300.0, -60.0, 10.0), np.arange(180.0, 500.0, 10.0), np.arange(*_NEAR_M, 5.0)])
"""Where strips along a road have corners: half as many far away."""

Span = tuple[float, float]
Edge = tuple[float, float]
"""Lateral place and height, metres."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Crossing:
    """A side road across the main one. at_m: along the centre line. half_m: half its width."""

    at_m: float
    half_m: float
    zebra: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class Road:
    """The layout of one road; lateral distances count to the left of the centre line.

    headings: radians at every 2 m of the centre line, points: [N, 2] there. lanes_right, lanes_left: with and against
    the ego's direction (traffic keeps right). parking_m: width of the parking strip on (right, left). pavement_m,
    verge_m: of the pavement and of the green strip beyond it. start_m: where the centre line begins.
    """

    points: Doubles
    headings: Doubles
    lane_m: float
    lanes_right: int
    lanes_left: int
    parking_m: tuple[float, float]
    pavement_m: float
    verge_m: float
    crossings: tuple[Crossing, ...]
    start_m: float

    def places(self, s: Doubles, lateral: Doubles | float = 0.0) -> Doubles:
        """x, y and heading [..., 3] of places along the road, s [...]."""
        share, knots = (s - self.start_m) / STEP_M, np.arange(len(self.headings))
        heading = np.interp(share, knots, self.headings)
        x, y = (np.interp(share, knots, self.points[:, i]) for i in (0, 1))
        return np.stack([x - lateral * np.sin(heading), y + lateral * np.cos(heading), heading], -1)

    def at(self, s: float, lateral: float = 0.0) -> tuple[float, float, float]:
        """x, y and heading of one place."""
        x, y, heading = self.places(np.array(s), lateral).tolist()
        return x, y, heading

    def put(self, parts: Sequence[Part], s: float, lateral: float, turn: float = 0.0) -> tuple[Part, ...]:
        """An assembly stood at a place, its x along the road, or turned from there."""
        x, y, heading = self.at(s, lateral)
        return tuple(part.placed(x, y, 0.0, heading + turn) for part in parts)

    @property
    def end_m(self) -> float:
        """Where the centre line ends."""
        return self.start_m + STEP_M * (len(self.headings) - 1)

    @property
    def right_m(self) -> float:
        """Distance of the right kerb from the centre line."""
        return self.lanes_right * self.lane_m + self.parking_m[0]

    @property
    def left_m(self) -> float:
        """Distance of the left kerb from the centre line."""
        return self.lanes_left * self.lane_m + self.parking_m[1]

    @property
    def sides(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Of the right and the left side: its sign and the distance of its kerb."""
        return (-1.0, self.right_m), (1.0, self.left_m)

    def lane(self, index: int) -> float:
        """Lateral place of a lane's middle: 0, 1, ... to the right, -1, -2, ... to the left."""
        return -(index + 0.5) * self.lane_m

    def is_free(self, s: float, margin_m: float = 0.0) -> bool:
        """Whether a place lies outside all junctions."""
        return all(abs(s - crossing.at_m) >= crossing.half_m + margin_m for crossing in self.crossings)

    def free_spans(self, margin_m: float, begin_m: float = -np.inf, end_m: float = np.inf) -> list[Span]:
        """The stretches between the junctions, each junction widened by a margin on both sides."""
        start, end = max(begin_m, self.start_m), min(end_m, self.end_m)
        spans: list[Span] = []
        for crossing in sorted(self.crossings, key=lambda each: each.at_m):
            spans.append((start, min(end, crossing.at_m - crossing.half_m - margin_m)))
            start = max(start, crossing.at_m + crossing.half_m + margin_m)
        return [span for span in [*spans, (start, end)] if span[1] > span[0]]


# flat shapes: triangles [N, 3, 3]


def ribbon(road: Road, right: Edge, left: Edge, spans: list[Span] | None = None) -> Floats:
    """A strip along the road between two edges, all along or over some stretches."""
    pieces = [np.zeros((0, 3, 3), np.float32)]
    for begin, end in [(road.start_m, road.end_m)] if spans is None else spans:
        inside = _KNOTS_M[(begin + 0.3 < _KNOTS_M) & (end - 0.3 > _KNOTS_M)]
        s = np.sort(np.concatenate([[begin], inside, [end]]))
        low, high = (_lifted(road.places(s, lateral), z) for lateral, z in (right, left))
        pieces.append(quads(low[:-1], low[1:], high[1:], high[:-1]))
    return np.concatenate(pieces)


def patches(road: Road, rows: Doubles, z: float) -> Floats:
    """Small pieces on the road: rows [N, 4] of first and last s, right and left lateral place."""
    s0, s1, right, left = rows.reshape(-1, 4).T
    return quads(*(_lifted(road.places(s, y), z) for s, y in ((s0, right), (s1, right), (s1, left), (s0, left))))


def fan(centre: Doubles, rim: Doubles) -> Floats:
    """Triangles from a point [3] to the pieces of an open rim [N, 3]."""
    hub = np.broadcast_to(centre, (len(rim) - 1, 3))
    return np.stack([hub, rim[:-1], rim[1:]], 1).astype(np.float32)


def quads(a: Doubles, b: Doubles, c: Doubles, d: Doubles) -> Floats:
    """Two triangles for every four corners [N, 3], in order around."""
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.float32)


def _lifted(places: Doubles, z: float) -> Doubles:
    return np.concatenate([places[..., :2], np.full((*places.shape[:-1], 1), z)], -1)


# streets


@dataclass(frozen=True, kw_only=True, slots=True)
class Street:
    """main: the ego's road; its s = 0 is the middle of the drive. crossed: the roads across it, one for each of
    `main.crossings`; their s = 0 lies on the main road's centre line, and s grows to its left.
    """

    main: Road
    crossed: tuple[Road, ...]

    @property
    def roads(self) -> tuple[Road, ...]:
        """All of them, the main one first."""
        return (self.main, *self.crossed)


def random_street(random: np.random.Generator) -> Street:
    """A layout drawn at random. Roads neither meet themselves nor each other but in their crossings."""
    drawn: list[Crossing] = []
    for _ in range(int(random.choice([0, 1, 2, 3], p=[0.12, 0.38, 0.32, 0.18]))):
        at, zebra = random.uniform(-45, 125), bool(random.random() < 0.7)
        if all(abs(at - other.at_m) > _APART_M for other in drawn):
            drawn.append(Crossing(at_m=at, half_m=4.0, zebra=zebra))  # its width follows from the road below
    crossings = tuple(sorted(drawn, key=lambda crossing: crossing.at_m))
    s = np.arange(_START_M, _END_M + STEP_M, STEP_M)
    main = _road(s, _winding(s, crossings, random), crossings, random, most_lanes=3)
    made = [_side_road(main, crossing, random) for crossing in crossings]
    gaps = [[np.linalg.norm(a.points[:, None] - b.points, axis=-1).min() for b in made[:i]] for i, a in enumerate(made)]
    kept = [i for i, each in enumerate(gaps) if min(each, default=np.inf) > _HOUSES_M]
    crossings = tuple(replace(crossings[i], half_m=(made[i].right_m + made[i].left_m) / 2) for i in kept)
    return Street(main=replace(main, crossings=crossings), crossed=tuple(made[i] for i in kept))


def _winding(s: Doubles, crossings: tuple[Crossing, ...], random: np.random.Generator) -> Doubles:
    """Headings that sway but never turn back; straight in junctions, 0 at s = 0. No bend below 60 m of radius."""
    long, short = random.uniform(280, 480), random.uniform(140, 240)
    sway = float(random.choice([0.0, 0.35, 0.6])) * random.uniform(0.7, 1.0)
    slow = sway * np.sin(2 * np.pi * (s / long + random.uniform()))
    curvature = np.gradient(slow + 0.15 * sway * np.sin(2 * np.pi * (s / short + random.uniform())), s)
    for crossing in crossings:
        curvature = curvature * (1 - np.exp(-(((s - crossing.at_m) / _CALM_M) ** 4)))
    headings = np.cumsum(np.clip(curvature, -1 / 60, 1 / 60)) * STEP_M
    return headings - np.interp(0.0, s, headings)


def _road(
    s: Doubles, headings: Doubles, crossings: tuple[Crossing, ...], random: np.random.Generator, most_lanes: int
) -> Road:
    points = np.cumsum(np.stack([np.cos(headings), np.sin(headings)], -1) * STEP_M, 0)
    points -= [np.interp(0.0, s, points[:, i]) for i in (0, 1)]
    right, left = (int(random.choice([1, 2, 3], p=[0.5, 0.4, 0.1])) for _ in range(2))
    strips = [random.uniform(2.25, 2.6) if random.random() < 0.55 else 0.0 for _ in range(2)]
    return Road(
        points=points,
        headings=headings,
        lane_m=random.uniform(3.2, 3.7),
        lanes_right=min(right, most_lanes),
        lanes_left=min(left, most_lanes),
        parking_m=(strips[0], strips[1]),
        pavement_m=random.uniform(2.4, 4.6),
        verge_m=float(random.choice([0.0, random.uniform(1, 6)])),
        crossings=crossings,
        start_m=float(s[0]),
    )


def _side_road(main: Road, crossing: Crossing, random: np.random.Generator) -> Road:
    """A road square across the main one, which it sees as its own crossing; further out all of them run alike.

    It has as many lanes one way as the other, so that the junction is centred where the roads meet.
    """
    s = np.arange(-_SIDE_M, _SIDE_M + STEP_M, STEP_M)
    x, y, heading = main.at(crossing.at_m)
    settled = float(np.mean(main.headings)) + 0.2 * random.uniform(-1, 1)
    share = np.clip((np.abs(s) - 25.0) / 60.0, 0, 1)
    headings = np.pi / 2 + heading + (settled - heading) * share**2 * (3 - 2 * share)
    middle, half = (main.left_m - main.right_m) / 2, (main.left_m + main.right_m) / 2
    across = Crossing(at_m=middle, half_m=half, zebra=bool(random.random() < 0.5))
    road = _road(s, headings, (across,), random, most_lanes=2)
    lanes, strip = min(road.lanes_left, road.lanes_right), min(road.parking_m)
    points = road.points + np.array([x, y])
    return replace(road, points=points, lanes_left=lanes, lanes_right=lanes, parking_m=(strip, strip))
