"""What stands beside the streets of a grown driving world: nothing on a road, nothing in another thing, and nothing
where a camera passes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Colour, Part, Pattern
from gcd_train.scenes.driving import furniture
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.footprint import Footprints, footprint_of, holds_a_point, touches
from gcd_train.scenes.driving.road import Road
from gcd_train.scenes.driving.street import Street
from gcd_train.scenes.driving.surroundings import District, building, bush, sagitta, tone, tree

CAMERA_ROOM_M = 0.6
_BEGIN_M, _END_M = -120.0, 290.0
_NEAR_M, _PLANTED_M = 38.0, 175.0
_CLEAR_M = 3.2
_BOARDS: tuple[Colour, ...] = (
    (0.6, 0.1, 0.1),
    (0.1, 0.25, 0.5),
    (0.15, 0.4, 0.2),
    (0.2, 0.2, 0.2),
    (0.8, 0.6, 0.15),
)

Parts = Sequence[Part]


@dataclass(frozen=True, kw_only=True, slots=True)
class Place:
    """A place along a road, on one side (-1: right) at a distance from its centre line."""

    road: Road
    s: float
    side: float
    away: float

    def put(self, parts: Parts, turn: float = 0.0) -> tuple[Part, ...]:
        """An assembly stood there, its x along the road."""
        x, y, heading = self.road.at(self.s, self.side * self.away)
        return tuple(part.placed(x, y, 0.0, heading + turn) for part in parts)


@dataclass(kw_only=True, slots=True)
class Plot:
    """The ground and what has been put on it; cameras: every place where one stands at some time, [N, 3]."""

    street: Street
    cameras: NDArray[np.float64]
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

    def put(self, parts: tuple[Part, ...], *, on_pavement: bool = False, gap_m: float = 0.3) -> bool:
        """Add a thing if there is room for it; what stands on a pavement may not stand on the lanes either."""
        ground = footprint_of(parts)
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
    for road in plot.street.roads:
        for side, kerb in ((-1.0, road.right_m), (1.0, road.left_m)):
            _lamps(plot, Place(road=road, s=0.0, side=side, away=kerb + 0.5), grey, lit, random)
    for road in plot.street.roads:
        for side, kerb in ((-1.0, road.right_m), (1.0, road.left_m)):
            _houses(plot, Place(road=road, s=0.0, side=side, away=kerb), district, paved, lit, random)
    for road in plot.street.roads:
        for side, kerb in ((-1.0, road.right_m), (1.0, road.left_m)):
            at = Place(road=road, s=0.0, side=side, away=kerb)
            _furniture(plot, at, lit, grey, random)
            _greenery(plot, at, district, paved, random)


def _at(place: Place, s: float, more_m: float) -> Place:
    return Place(road=place.road, s=s, side=place.side, away=place.away + more_m)


def _begin(road: Road) -> float:
    return max(_BEGIN_M, road.start_m)


def _end(road: Road) -> float:
    return min(_END_M, road.end_m)


def _signals(plot: Plot, green: bool, grey: Colour, random: np.random.Generator) -> None:
    if random.random() < 0.25:
        return
    for number, road in enumerate(plot.street.roads):
        for crossing in road.crossings:
            for side, kerb in ((-1.0, road.right_m), (1.0, road.left_m)):
                at = crossing.at_m + side * (crossing.half_m + _CLEAR_M + 3.2)
                place = Place(road=road, s=at, side=side, away=kerb + 0.6)
                shown = furniture.signal(green if number == 0 else not green, grey)
                plot.put(place.put(shown, 0.0 if side < 0 else np.pi), on_pavement=True)


def _lamps(plot: Plot, place: Place, grey: Colour, lit: bool, random: np.random.Generator) -> None:
    every, height = float(random.uniform(22, 38)), float(random.uniform(5.8, 8.5))
    for s in np.arange(_begin(place.road) + float(random.uniform(0, every)), min(_end(place.road), 190.0), every):
        at = _at(place, float(s), 0.0)
        if place.road.is_free(at.s, _CLEAR_M + 1.0):
            parts = at.put(furniture.street_lamp(height, place.side, grey, lit))
            ground = parts[:1]  # its arm reaches over the road
            if not holds_a_point(parts, plot.cameras, CAMERA_ROOM_M) and plot.put(ground, on_pavement=True):
                plot.things[-1] = parts
                plot.lamps.append(at)


def _houses(plot: Plot, place: Place, district: District, paved: bool, lit: bool, random: np.random.Generator) -> None:
    road = place.road
    edge = road.pavement_m + road.verge_m * (0.0 if paved else 1.0) + 0.8
    s = _begin(road) + float(random.uniform(0, 10))
    while s < _end(road):
        width, depth = float(random.uniform(*district.width_m)), float(random.uniform(9, 17))
        if random.random() < district.built:
            back = float(random.uniform(*district.setback_m)) + sagitta(road, s + width / 2, width)
            at = _at(place, s + width / 2, edge + back + depth / 2)
            house = building(width, depth, district, random)
            house += _eaves(house)
            if paved and plot.shows_details(at):
                house += _shop(width, depth, place.side, lit, random)
            plot.put(at.put(house))
        s += width + float(random.uniform(*district.gap_m))


def _eaves(house: Parts) -> list[Part]:
    """What closes a gabled roof from below."""
    roof = house[1]
    if roof.shape != "gable":
        return []
    x, y, z = roof.centre
    length, depth, height = roof.size
    below = (x, y, z - height / 2 - 0.05)
    return [replace(roof, shape="box", centre=below, size=(length, depth, 0.1), colour=(0.7, 0.68, 0.64))]


def _shop(width: float, depth: float, side: float, lit: bool, random: np.random.Generator) -> list[Part]:
    """A shop window and its sign along the ground floor."""
    if random.random() < 0.35:
        return []
    front, wide = -side * depth / 2, width * float(random.uniform(0.5, 0.92))
    board = tone(random, _BOARDS[int(random.integers(len(_BOARDS)))], 0.2)
    shines = lit and random.random() < 0.6
    window = Part(
        shape="box",
        centre=(0, front, 1.45),
        size=(wide, 0.16, 2.1),
        colour=(0.95, 0.8, 0.55) if shines else (0.1, 0.12, 0.14),
        gloss=0.7,
        label=Label.BUILDING,
        pattern=Pattern.LIT if shines else Pattern.PLAIN,
    )
    above = Part(shape="box", centre=(0, front, 2.85), size=(wide + 0.3, 0.4, 0.5), colour=board, label=Label.BUILDING)
    return [window, above]


def _furniture(plot: Plot, place: Place, lit: bool, grey: Colour, random: np.random.Generator) -> None:
    road, room = place.road, place.road.pavement_m
    makers: tuple[tuple[Callable[[], list[Part]], float, float], ...] = (
        (lambda: furniture.sign(random, grey), 0.45, 0.45),
        (lambda: furniture.planter(random), 0.2, 1.1),
        (lambda: furniture.shelter(random, lit), 0.2, 1.3),
        (lambda: furniture.kiosk(random, lit), 0.15, 1.6),
    )
    s = _begin(road) + float(random.uniform(0, 20))
    while s < min(150.0, _end(road)):
        make, _, away = makers[int(random.choice(4, p=[share for _, share, _ in makers]))]
        if road.is_free(s, _CLEAR_M + 4.0) and room > away + 0.9:
            plot.put(_at(place, s, away).put(make(), 0.0 if place.side < 0 else np.pi), on_pavement=True)
        s += float(random.uniform(12, 45))


def _greenery(plot: Plot, place: Place, district: District, paved: bool, random: np.random.Generator) -> None:
    """Trees in a row, and hedges or fences before the gardens."""
    road = place.road
    bare, firs = random.random() < 0.12, 0.0 if paved else float(random.choice([0.0, 0.1, 0.4]))
    in_row = road.pavement_m - 0.7 if paved else road.pavement_m + max(0.5 * road.verge_m, 0.6)
    every = district.trees_every_m * (1.0 if paved else 0.8)
    s = max(-_PLANTED_M, _begin(road)) + float(random.uniform(0, every))
    while s < min(_PLANTED_M, _end(road)) and not bare:
        draw = float(random.random())
        made = bush(random) if draw < 0.12 else furniture.conifer(random) if draw < 0.12 + firs else tree(random)
        at = _at(place, s, in_row + float(random.uniform(0, 0.5)))
        if road.is_free(s, _CLEAR_M + 3.0):
            _plant(plot, at, made)
        s += every * float(random.uniform(0.5, 1.6))
    if not paved:
        _borders(plot, place, random)


def _plant(plot: Plot, at: Place, made: list[Part]) -> None:
    """Only the stem needs ground; far away one crown is enough."""
    shown = made if plot.shows_details(at) or len(made) < 3 else made[:2]
    parts = at.put(shown)
    if not holds_a_point(parts, plot.cameras, CAMERA_ROOM_M) and plot.put(parts[:1], on_pavement=True):
        plot.things[-1] = parts


def _borders(plot: Plot, place: Place, random: np.random.Generator) -> None:
    road = place.road
    edge = road.pavement_m + road.verge_m + 0.5
    s = _begin(road)
    while s < min(150.0, _end(road)):
        length = float(random.uniform(5, 14))
        make = furniture.hedge if random.random() < 0.6 else furniture.fence
        if random.random() < 0.6 and road.is_free(s + length / 2, length / 2 + _CLEAR_M):
            plot.put(_at(place, s + length / 2, edge).put(make(random, length)), gap_m=0.1)
        s += length + float(random.uniform(1.5, 8))
