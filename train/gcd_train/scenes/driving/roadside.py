"""What stands beside the streets of the driving world: nothing on a road, nothing in another thing, and nothing
where a camera passes.

A footprint is [..., 5]: x and y of its centre, yaw in radians, half its length along the yaw and half its width.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Colour, Doubles, Part
from gcd_train.scenes.driving import things
from gcd_train.scenes.driving.roads import Road, Street
from gcd_train.scenes.driving.things import District, tone

CAMERA_ROOM_M = 0.6
_BEGIN_M, _END_M = -120.0, 290.0
_NEAR_M, _PLANTED_M = 38.0, 175.0
_CLEAR_M = 3.2

Footprints = Doubles
Parts = Sequence[Part]


def overlap(first: Footprints, second: Footprints, gap_m: float = 0.0) -> NDArray[np.bool_]:
    """Whether rectangles come closer than a gap (along one of their axes), [...]; sizes broadcast.

    Two convex shapes are apart if and only if an edge's normal separates them.
    """
    apart = second[..., :2] - first[..., :2]
    touching = np.ones(np.broadcast_shapes(first.shape[:-1], second.shape[:-1]), bool)
    for yaw in (first[..., 2], first[..., 2] + np.pi / 2, second[..., 2], second[..., 2] + np.pi / 2):
        distance = np.abs(apart[..., 0] * np.cos(yaw) + apart[..., 1] * np.sin(yaw))
        touching &= distance < _reach(first, yaw) + _reach(second, yaw) + gap_m
    return touching


def touches(first: Footprints, second: Footprints, gap_m: float = 0.0) -> bool:
    """Whether any two rectangles of a pair overlap; sizes broadcast. Only those near each other are looked at."""
    away = first[..., :2] - second[..., :2]
    radius = np.hypot(first[..., 3], first[..., 4]) + np.hypot(second[..., 3], second[..., 4]) + 2 * gap_m
    near = away[..., 0] ** 2 + away[..., 1] ** 2 < radius**2
    if not near.any():
        return False
    shape = (*near.shape, 5)
    return bool(overlap(np.broadcast_to(first, shape)[near], np.broadcast_to(second, shape)[near], gap_m).any())


def _reach(box: Footprints, yaw: Doubles) -> Doubles:
    """Half the length of a rectangle's shadow on an axis."""
    turn = yaw - box[..., 2]
    return np.abs(np.cos(turn)) * box[..., 3] + np.abs(np.sin(turn)) * box[..., 4]


def footprint_of(parts: Sequence[Part]) -> Footprints:
    """A rectangle along the first part's yaw that holds all parts, [5]."""
    yaw = parts[0].yaw
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    centres = np.array([part.centre[:2] for part in parts])
    turn = np.array([part.yaw for part in parts]) - yaw
    cos, sin, half = np.abs(np.cos(turn)), np.abs(np.sin(turn)), np.abs([part.size[:2] for part in parts]) / 2
    halves = np.stack([cos * half[:, 0] + sin * half[:, 1], sin * half[:, 0] + cos * half[:, 1]], -1)
    along, aside = centres @ ahead, centres @ left
    low = np.array([(along - halves[:, 0]).min(), (aside - halves[:, 1]).min()])
    high = np.array([(along + halves[:, 0]).max(), (aside + halves[:, 1]).max()])
    middle = (low + high) / 2
    x, y = ahead * middle[0] + left * middle[1]
    return np.array([x, y, yaw, (high[0] - low[0]) / 2, (high[1] - low[1]) / 2])


def holds_a_point(parts: Sequence[Part], points: Doubles, margin_m: float) -> bool:
    """Whether a point [N, 3] lies within a margin of a part's bounding box; the parts stand upright."""
    hub = np.array(parts[0].centre)
    radius = max(float(np.linalg.norm(part.centre - hub) + np.linalg.norm(part.size) / 2) for part in parts)
    points = points[((points - hub) ** 2).sum(-1) < (radius + 2 * margin_m) ** 2]
    for part in parts if len(points) else ():
        away = points - part.centre
        cos, sin = np.cos(part.yaw), np.sin(part.yaw)
        local = np.stack([away[:, 0] * cos + away[:, 1] * sin, away[:, 1] * cos - away[:, 0] * sin, away[:, 2]], -1)
        reach = np.abs(part.size) / 2 + margin_m
        if bool((np.abs(local) < reach).all(-1).any()):
            return True
    return False


@dataclass(frozen=True, kw_only=True, slots=True)
class Place:
    """A place along a road, on one side (-1: right) at a distance from its centre line."""

    road: Road
    s: float
    side: float
    away: float

    def moved(self, s: float, more_m: float) -> "Place":
        """On the same side at another `s`, so much further from the road."""
        return replace(self, s=s, away=self.away + more_m)

    def put(self, parts: Parts, turn: float = 0.0) -> tuple[Part, ...]:
        """An assembly stood there, its x along the road."""
        return self.road.put(parts, self.s, self.side * self.away, turn)


@dataclass(kw_only=True, slots=True)
class Plot:
    """The ground and what has been put on it; cameras: every place where one stands at some time, [N, 3]."""

    street: Street
    cameras: Doubles
    things: list[tuple[Part, ...]] = field(default_factory=list[tuple[Part, ...]])
    lamps: list[Place] = field(default_factory=list[Place])
    _taken: list[Footprints] = field(default_factory=list[Footprints])
    _roads: Footprints = field(init=False)
    _lanes: Footprints = field(init=False)

    def __post_init__(self) -> None:
        self._roads = np.concatenate([corridor(road, road.pavement_m) for road in self.street.roads])
        self._lanes = np.concatenate([corridor(road, 0.0) for road in self.street.roads])

    def shows_details(self, place: Place) -> bool:
        """Whether a camera comes close to a place."""
        x, y, _ = place.road.at(place.s, place.side * place.away)
        return bool(np.hypot(self.cameras[:, 0] - x, self.cameras[:, 1] - y).min() < _NEAR_M)

    def put(
        self, parts: tuple[Part, ...], *, on_pavement: bool = False, on_foot: bool = False, gap_m: float = 0.3
    ) -> bool:
        """Add a thing if there is room for it; what stands on a pavement may not stand on the lanes either.

        on_foot: only its first part needs ground.
        """
        ground = footprint_of(parts[:1] if on_foot else parts)
        roads = self._lanes if on_pavement else self._roads
        if touches(ground, roads, 0.05) or (self._taken and touches(ground, np.array(self._taken), gap_m)):
            return False
        if holds_a_point(parts, self.cameras, CAMERA_ROOM_M):
            return False
        self._taken.append(ground)
        self.things.append(parts)
        return True

    @property
    def taken(self) -> Footprints:
        """Footprints of all things, [N, 5]."""
        return np.array(self._taken).reshape(-1, 5)


def corridor(road: Road, beyond_m: float) -> Footprints:
    """A road up to its kerbs, and so much beyond them, as a chain of rectangles."""
    s = np.arange(road.start_m, road.end_m, 6.0) + 3.0
    middle = (road.left_m - road.right_m) / 2
    half = (road.left_m + road.right_m) / 2 + beyond_m
    return np.concatenate([road.places(s, middle), np.full((len(s), 1), 3.2), np.full((len(s), 1), half)], -1)


def furnish(plot: Plot, district: District, paved: bool, lit: bool, green: bool, random: np.random.Generator) -> None:
    """Everything that stands, along all roads, the main one first.

    lit: whether lamps shine. green: whether the main road's signals are green.
    """
    grey = tone(random, (0.33, 0.35, 0.36), 0.3)
    _signals(plot, green, grey, random)
    sides = [Place(road=road, s=0.0, side=side, away=kerb) for road in plot.street.roads for side, kerb in road.sides]
    for side in sides:
        _lamps(plot, side.moved(0.0, 0.5), grey, lit, random)
    for side in sides:
        _houses(plot, side, district, paved, lit, random)
    for side in sides:
        _furniture(plot, side, lit, grey, random)
        _greenery(plot, side, district, paved, random)


def _signals(plot: Plot, green: bool, grey: Colour, random: np.random.Generator) -> None:
    if random.random() < 0.25:
        return
    for number, road in enumerate(plot.street.roads):
        for crossing in road.crossings:
            for side, kerb in road.sides:
                at = crossing.at_m + side * (crossing.half_m + _CLEAR_M + 3.2)
                place = Place(road=road, s=at, side=side, away=kerb + 0.6)
                shown = things.signal(green if number == 0 else not green, grey)
                plot.put(place.put(shown, 0.0 if side < 0 else np.pi), on_pavement=True)


def _lamps(plot: Plot, place: Place, grey: Colour, lit: bool, random: np.random.Generator) -> None:
    road = place.road
    every, height = float(random.uniform(22, 38)), float(random.uniform(5.8, 8.5))
    first = max(_BEGIN_M, road.start_m) + float(random.uniform(0, every))
    for s in np.arange(first, min(road.end_m, 190.0), every):
        at = place.moved(float(s), 0.0)
        if road.is_free(at.s, _CLEAR_M + 1.0):
            lamp = at.put(things.street_lamp(height, place.side, grey, lit))
            if plot.put(lamp, on_pavement=True, on_foot=True):  # its arm reaches over the road
                plot.lamps.append(at)


def _houses(plot: Plot, place: Place, district: District, paved: bool, lit: bool, random: np.random.Generator) -> None:
    road = place.road
    edge = road.pavement_m + road.verge_m * (0.0 if paved else 1.0) + 0.8
    s = max(_BEGIN_M, road.start_m) + float(random.uniform(0, 10))
    while s < min(_END_M, road.end_m):
        width, depth = float(random.uniform(*district.width_m)), float(random.uniform(9, 17))
        if random.random() < district.built:
            middle = s + width / 2
            bend = abs(road.at(middle + width / 2)[2] - road.at(middle - width / 2)[2])
            back = float(random.uniform(*district.setback_m)) + (width * bend / 4 + 0.3)  # fronts are straight
            at = place.moved(middle, edge + back + depth / 2)
            house = things.building(width, depth, district, random)
            roof = house[1]
            if roof.shape == "gable":  # closed from below
                below = (0.0, 0.0, roof.centre[2] - roof.size[2] / 2 - 0.05)
                size = (roof.size[0], roof.size[1], 0.1)
                soffit = replace(roof.paint, colour=(0.7, 0.68, 0.64))
                house.append(replace(roof, shape="box", centre=below, size=size, paint=soffit))
            if paved and plot.shows_details(at):
                house += things.shop(width, -place.side * depth / 2, lit, random)
            plot.put(at.put(house))
        s += width + float(random.uniform(*district.gap_m))


def _furniture(plot: Plot, place: Place, lit: bool, grey: Colour, random: np.random.Generator) -> None:
    road, room = place.road, place.road.pavement_m
    makers: tuple[tuple[Callable[[], list[Part]], float, float], ...] = (
        (lambda: things.sign(random, grey), 0.45, 0.45),
        (lambda: things.planter(random), 0.2, 1.1),
        (lambda: things.shelter(random, lit), 0.2, 1.3),
        (lambda: things.kiosk(random, lit), 0.15, 1.6),
    )
    s = max(_BEGIN_M, road.start_m) + float(random.uniform(0, 20))
    while s < min(150.0, road.end_m):
        make, _, away = makers[int(random.choice(4, p=[share for _, share, _ in makers]))]
        if road.is_free(s, _CLEAR_M + 4.0) and room > away + 0.9:
            plot.put(place.moved(s, away).put(make(), 0.0 if place.side < 0 else np.pi), on_pavement=True)
        s += float(random.uniform(12, 45))


def _greenery(plot: Plot, place: Place, district: District, paved: bool, random: np.random.Generator) -> None:
    """Trees in a row, and hedges or fences before the gardens."""
    road = place.road
    bare, firs = random.random() < 0.12, 0.0 if paved else float(random.choice([0.0, 0.1, 0.4]))
    in_row = road.pavement_m - 0.7 if paved else road.pavement_m + max(0.5 * road.verge_m, 0.6)
    every = district.trees_every_m * (1.0 if paved else 0.8)
    s = max(_BEGIN_M, road.start_m) + float(random.uniform(0, every))
    while s < min(_PLANTED_M, road.end_m) and not bare:
        draw = float(random.random())
        kind = things.bush if draw < 0.12 else things.conifer if draw < 0.12 + firs else things.tree
        made = kind(random)
        at = place.moved(s, in_row + float(random.uniform(0, 0.5)))
        if road.is_free(s, _CLEAR_M + 3.0):
            shown = made if plot.shows_details(at) or len(made) < 3 else made[:2]  # far away one crown is enough
            plot.put(at.put(shown), on_pavement=True, on_foot=True)
        s += every * float(random.uniform(0.5, 1.6))
    if not paved:
        _borders(plot, place, random)


def _borders(plot: Plot, place: Place, random: np.random.Generator) -> None:
    road = place.road
    edge = road.pavement_m + road.verge_m + 0.5
    s = max(_BEGIN_M, road.start_m)
    while s < min(150.0, road.end_m):
        length = float(random.uniform(5, 14))
        make = things.hedge if random.random() < 0.6 else things.fence
        if random.random() < 0.6 and road.is_free(s + length / 2, length / 2 + _CLEAR_M):
            plot.put(place.moved(s + length / 2, edge).put(make(random, length)), gap_m=0.1)
        s += length + float(random.uniform(1.5, 8))
