"""What stands beside the streets of the driving world: nothing on a road, nothing in another thing, and nothing
where a camera passes.

A footprint is [..., 5]: x and y of its centre, yaw in radians, half its length along the yaw and half its width.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

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
Side = tuple[Road, float, float]
"""One side of a road: its sign (-1: right), and how far from the centre line its kerb is."""


def touches(first: Footprints, second: Footprints, gap_m: float = 0.0) -> bool:
    """Whether any two rectangles of a pair come closer than a gap; sizes broadcast.

    Two convex shapes are apart if and only if an edge's normal separates them. Only near pairs are looked at.
    """
    away = first[..., :2] - second[..., :2]
    radius = np.hypot(first[..., 3], first[..., 4]) + np.hypot(second[..., 3], second[..., 4]) + 2 * gap_m
    near = away[..., 0] ** 2 + away[..., 1] ** 2 < radius**2
    if not near.any():
        return False
    pair = [np.broadcast_to(boxes, (*near.shape, 5))[near] for boxes in (first, second)]
    apart, touching = pair[1][:, :2] - pair[0][:, :2], np.ones(len(pair[0]), bool)
    for axis in (yaw for boxes in pair for yaw in (boxes[:, 2], boxes[:, 2] + np.pi / 2)):
        distance = np.abs(apart[:, 0] * np.cos(axis) + apart[:, 1] * np.sin(axis))
        reach = [  # half the length of each rectangle's shadow on the axis
            np.abs(np.cos(axis - box[:, 2])) * box[:, 3] + np.abs(np.sin(axis - box[:, 2])) * box[:, 4] for box in pair
        ]
        touching &= distance < reach[0] + reach[1] + gap_m
    return bool(touching.any())


def footprint_of(parts: Sequence[Part]) -> Footprints:
    """A rectangle along the first part's yaw that holds all parts, [5]."""
    yaw = parts[0].yaw
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    centres = np.array([part.centre[:2] for part in parts])
    turn = np.array([part.yaw for part in parts]) - yaw
    cos, sin, half = np.abs(np.cos(turn)), np.abs(np.sin(turn)), np.abs([part.size[:2] for part in parts]) / 2
    halves = np.stack([cos * half[:, 0] + sin * half[:, 1], sin * half[:, 0] + cos * half[:, 1]], -1)
    places = np.stack([centres @ ahead, centres @ left], -1)
    low, high = (places - halves).min(0), (places + halves).max(0)
    middle = (low + high) / 2
    x, y = ahead * middle[0] + left * middle[1]
    return np.array([x, y, yaw, *((high - low) / 2)])


def holds_a_point(parts: Sequence[Part], points: NDArray[Any], margin_m: float) -> bool:
    """Whether a point [N, 3] lies within a margin of a part's bounding box; the parts stand upright."""
    hub = np.array(parts[0].centre)
    radius = max(float(np.linalg.norm(part.centre - hub) + np.linalg.norm(part.size) / 2) for part in parts)
    points = points[((points - hub) ** 2).sum(-1) < (radius + 2 * margin_m) ** 2]
    return len(points) > 0 and any(
        bool((np.abs(turned_back(points - part.centre, part.yaw)) < np.abs(part.size) / 2 + margin_m).all(-1).any())
        for part in parts
    )


def turned_back(away: NDArray[Any], yaw: NDArray[Any] | float) -> NDArray[Any]:
    """Points [..., 3] about an origin, in axes that are turned about the vertical by `yaw` radians."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = away[..., 0] * cos + away[..., 1] * sin, away[..., 1] * cos - away[..., 0] * sin
    return np.stack([x, y, away[..., 2]], -1)


@dataclass(kw_only=True, slots=True)
class Plot:
    """The ground and what has been put on it. cameras: every place where one stands at some time, [N, 3].

    lamps: x, y and heading of what street lamps shine on, and how far along their road that is.
    """

    street: Street
    cameras: Doubles
    things: list[tuple[Part, ...]] = field(default_factory=list[tuple[Part, ...]])
    lamps: list[tuple[float, float, float, float]] = field(default_factory=list[tuple[float, float, float, float]])
    _taken: list[Footprints] = field(default_factory=list[Footprints])
    _roads: Footprints = field(init=False)
    _lanes: Footprints = field(init=False)

    def __post_init__(self) -> None:
        self._roads = np.concatenate([corridor(road, road.pavement_m) for road in self.street.roads])
        self._lanes = np.concatenate([corridor(road, 0.0) for road in self.street.roads])

    def shows_details(self, road: Road, s: float, lateral: float) -> bool:
        """Whether a camera comes close to a place."""
        x, y, _ = road.at(s, lateral)
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
    middle, half = (road.left_m - road.right_m) / 2, (road.left_m + road.right_m) / 2 + beyond_m
    return np.concatenate([road.places(s, middle), np.full((len(s), 1), 3.2), np.full((len(s), 1), half)], -1)


def furnish(plot: Plot, district: District, paved: bool, lit: bool, green: bool, random: np.random.Generator) -> None:
    """Everything that stands, along all roads, the main one first.

    lit: whether lamps shine. green: whether the main road's signals are green.
    """
    grey = tone(random, (0.33, 0.35, 0.36), 0.3)
    if random.random() >= 0.25:
        for road, crossing in [(each, crossing) for each in plot.street.roads for crossing in each.crossings]:
            for side, kerb in road.sides:
                at = crossing.at_m + side * (crossing.half_m + _CLEAR_M + 3.2)
                shown = things.signal(green if road is plot.street.main else not green, grey)
                plot.put(road.put(shown, at, side * (kerb + 0.6), 0.0 if side < 0 else np.pi), on_pavement=True)
    sides = [(road, side, kerb) for road in plot.street.roads for side, kerb in road.sides]
    for road, side, kerb in sides:
        every, height = random.uniform(22, 38), random.uniform(5.8, 8.5)
        first = max(_BEGIN_M, road.start_m) + random.uniform(0, every)
        for s in np.arange(first, min(road.end_m, 190.0), every).tolist():
            lamp = road.put(things.street_lamp(height, side, grey, lit), s, side * (kerb + 0.5))
            # its arm reaches over the road
            if road.is_free(s, _CLEAR_M + 1.0) and plot.put(lamp, on_pavement=True, on_foot=True):
                plot.lamps.append((*road.at(s, side * (kerb + 0.5 - 2.0)), s))
    for side in sides:
        _houses(plot, side, district, paved, lit, random)
    for side in sides:
        _furniture(plot, side, lit, grey, random)
        _greenery(plot, side, district, paved, random)


def _houses(plot: Plot, place: Side, district: District, paved: bool, lit: bool, random: np.random.Generator) -> None:
    road, side, kerb = place
    edge = road.pavement_m + road.verge_m * (0.0 if paved else 1.0) + 0.8
    s = max(_BEGIN_M, road.start_m) + random.uniform(0, 10)
    while s < min(_END_M, road.end_m):
        width, depth = random.uniform(*district.width_m), random.uniform(9, 17)
        if random.random() < district.built:
            middle = s + width / 2
            bend = abs(road.at(middle + width / 2)[2] - road.at(middle - width / 2)[2])
            back = random.uniform(*district.setback_m) + (width * bend / 4 + 0.3)  # fronts are straight
            lateral = side * (kerb + (edge + back + depth / 2))
            house = things.building(width, depth, district, random)
            roof = house[1]
            if roof.shape == "gable":  # closed from below
                below = (0.0, 0.0, roof.centre[2] - roof.size[2] / 2 - 0.05)
                size = (roof.size[0], roof.size[1], 0.1)
                soffit = replace(roof.paint, colour=(0.7, 0.68, 0.64))
                house.append(replace(roof, shape="box", centre=below, size=size, paint=soffit))
            if paved and plot.shows_details(road, middle, lateral):
                house += things.shop(width, -side * depth / 2, lit, random)
            plot.put(road.put(house, middle, lateral))
        s += width + random.uniform(*district.gap_m)


def _furniture(plot: Plot, place: Side, lit: bool, grey: Colour, random: np.random.Generator) -> None:
    road, side, kerb = place
    makers: tuple[tuple[Callable[[], list[Part]], float], ...] = (
        (lambda: things.sign(random, grey), 0.45),
        (lambda: things.planter(random), 1.1),
        (lambda: things.shelter(random, lit), 1.3),
        (lambda: things.kiosk(random, lit), 1.6),
    )
    s = max(_BEGIN_M, road.start_m) + random.uniform(0, 20)
    while s < min(150.0, road.end_m):
        make, away = makers[int(random.choice(4, p=[0.45, 0.2, 0.2, 0.15]))]
        if road.is_free(s, _CLEAR_M + 4.0) and road.pavement_m > away + 0.9:
            plot.put(road.put(make(), s, side * (kerb + away), 0.0 if side < 0 else np.pi), on_pavement=True)
        s += random.uniform(12, 45)


def _greenery(plot: Plot, place: Side, district: District, paved: bool, random: np.random.Generator) -> None:
    """Trees in a row, and hedges or fences before the gardens."""
    road, side, kerb = place
    bare, firs = random.random() < 0.12, 0.0 if paved else float(random.choice([0.0, 0.1, 0.4]))
    in_row = road.pavement_m - 0.7 if paved else road.pavement_m + max(0.5 * road.verge_m, 0.6)
    every = district.trees_every_m * (1.0 if paved else 0.8)
    begin = max(_BEGIN_M, road.start_m)
    s = begin + random.uniform(0, every)
    while s < min(_PLANTED_M, road.end_m) and not bare:
        draw = random.random()
        kind = things.bush if draw < 0.12 else things.conifer if draw < 0.12 + firs else things.tree
        made = kind(random)
        lateral = side * (kerb + (in_row + random.uniform(0, 0.5)))
        if road.is_free(s, _CLEAR_M + 3.0):
            whole = len(made) < 3 or plot.shows_details(road, s, lateral)  # far away one crown is enough
            plot.put(road.put(made if whole else made[:2], s, lateral), on_pavement=True, on_foot=True)
        s += every * random.uniform(0.5, 1.6)
    s, edge = begin, road.pavement_m + road.verge_m + 0.5
    while s < min(150.0, road.end_m) and not paved:
        length = random.uniform(5, 14)
        make = things.hedge if random.random() < 0.6 else things.fence
        if random.random() < 0.6 and road.is_free(s + length / 2, length / 2 + _CLEAR_M):
            plot.put(road.put(make(random, length), s + length / 2, side * (kerb + edge)), gap_m=0.1)
        s += length + random.uniform(1.5, 8)
