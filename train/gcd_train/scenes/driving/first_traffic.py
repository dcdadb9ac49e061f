"""Who moves in the driving world's first edition, and who stands there: nobody overlaps anybody, at any time step.

Vehicles, people and cyclists are x ahead, y left, z up, on the ground at the origin.
"""

from dataclasses import dataclass

import numpy as np

from gcd_train.scenes.description import Colour, Floats, Part, Point
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.roads import Road
from gcd_train.scenes.driving.things import block, picked
from gcd_train.scenes.driving.vehicles import OWN_PAINT, Assembly, varied

_FPS = 10.0
_BEGIN_M, _END_M = -40.0, 130.0
_OWN_LENGTH_M = 5.0
_MOST_MOVERS = 120
_GLASS: Colour = (0.08, 0.1, 0.13)
_TYRE: Colour = (0.06, 0.06, 0.065)
_PAINTS: tuple[Colour, ...] = (
    (0.92, 0.92, 0.92), (0.75, 0.76, 0.78), (0.45, 0.46, 0.48), (0.1, 0.1, 0.11), (0.08, 0.14, 0.35),
    (0.65, 0.08, 0.07), (0.2, 0.35, 0.6), (0.55, 0.5, 0.42), (0.1, 0.3, 0.18), (0.85, 0.6, 0.1), (0.4, 0.12, 0.1),
    (0.35, 0.5, 0.5),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, slots=True)
class Mover:
    """An assembly that travels along the road at a constant lateral place. speed: m/s, negative against the ego."""

    assembly: Assembly
    start_m: float
    lateral_m: float
    speed: float

    def pose(self, road: Road, seconds: float) -> tuple[float, float, float, float]:
        """x, y, z, yaw at a time."""
        x, y, heading = road.at(self.start_m + self.speed * seconds, self.lateral_m)
        return x, y, 0.0, heading + (np.pi if self.speed < 0 else 0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Traffic:
    """ego: the own car. movers: all others that have a body of their own. parked: parts of the world."""

    ego: Mover
    movers: tuple[Mover, ...]
    parked: tuple[tuple[Part, ...], ...]

    def poses(self, road: Road, frames: int) -> Floats:
        """[T, 2 + movers, 4]: the world, the ego, then the movers in order."""
        bodies = (self.ego, *self.movers)
        rows = [[(0.0, 0.0, 0.0, 0.0), *(body.pose(road, t / _FPS) for body in bodies)] for t in range(frames)]
        return np.array(rows, np.float32)


def random_traffic(road: Road, random: np.random.Generator) -> Traffic:
    """Lanes of equally fast vehicles, parked rows, people on the pavements and on zebras, cyclists at the kerb."""
    lane = int(random.integers(road.lanes_right))
    stands = random.random() < 0.15
    cruise = 0.0 if stands else float(random.uniform(3.0, 15.0))
    lateral = road.lane(lane) + float(random.normal(0, 0.12))
    ego = Mover(assembly=_own_car(), start_m=0.0, lateral_m=lateral, speed=cruise)
    density = float(random.uniform(0.15, 1.0))
    movers: list[Mover] = []
    for index in range(-road.lanes_left, road.lanes_right):
        speed = cruise if index == lane else max(0.0, cruise + float(random.normal(0, 1.5)))
        if index < 0:
            speed = -float(random.uniform(2.0, 15.0)) if random.random() < 0.8 else -0.001
        movers += _lane(road.lane(index), speed, density, index == lane, random)
    movers += _cyclists(road, random)
    movers += _people(road, random)
    return Traffic(ego=ego, movers=tuple(movers[:_MOST_MOVERS]), parked=tuple(_parked(road, random)))


def _lane(lateral: float, speed: float, density: float, is_egos: bool, random: np.random.Generator) -> list[Mover]:
    """Vehicles one behind the other; all of a lane drive equally fast, so their gaps never close."""
    movers: list[Mover] = []
    s = _BEGIN_M + float(random.exponential(15.0 / density))
    while s < _END_M:
        assembly = _random_truck(random) if random.random() < 0.13 else _random_car(random)
        middle = s + assembly.length / 2
        blocked = is_egos and middle + assembly.length / 2 + 2.5 > -_OWN_LENGTH_M and s - 2.5 < _OWN_LENGTH_M
        if not blocked:
            place = lateral + float(random.normal(0, 0.1))
            movers.append(Mover(assembly=assembly, start_m=middle, lateral_m=place, speed=speed))
        s += assembly.length + float(random.uniform(2.5, 7.0)) + float(random.exponential(14.0 / density))
    return movers


def _parked(road: Road, random: np.random.Generator) -> list[tuple[Part, ...]]:
    rows: list[tuple[Part, ...]] = []
    for (side, kerb), strip in zip(road.sides, road.parking_m, strict=True):
        fullness, s = float(random.uniform(0.3, 0.95)), _BEGIN_M
        while strip > 0 and s < 110.0:
            car = _random_car(random)
            s += car.length + float(random.uniform(0.7, 1.6))
            if random.random() < fullness and road.is_free(s - car.length / 2, 5.0 + car.length / 2):
                turn = np.pi if side > 0 else 0.0
                rows.append(road.put(car.parts, s - car.length / 2, side * (kerb - strip / 2), turn))
    return rows


def _cyclists(road: Road, random: np.random.Generator) -> list[Mover]:
    """At most one on each side, in the half metre between the outer lane and kerb or parking strip."""
    movers: list[Mover] = []
    for (side, kerb), strip in zip(road.sides, road.parking_m, strict=True):
        if random.random() < 0.35 and road.lane_m > 3.25:
            speed = float(random.uniform(3, 6)) * -side
            start = float(random.uniform(8, 45))
            place = side * (kerb - strip - 0.38)
            movers.append(Mover(assembly=_random_cyclist(random), start_m=start, lateral_m=place, speed=speed))
    return movers


def _people(road: Road, random: np.random.Generator) -> list[Mover]:
    movers: list[Mover] = []
    spacing = float(random.uniform(20, 90))
    for side, kerb in road.sides:
        for y in np.arange(0.85, road.pavement_m - 0.25, 0.6).tolist():  # walkers of one lane share their speed
            speed = float(random.choice([-1, 1])) * float(random.uniform(0.7, 1.8))
            s = float(random.uniform(0, 25))
            while s < 70.0:
                s += float(random.exponential(spacing)) + 1.0
                if road.is_free(s, 4.0):
                    person, place = _random_person(random), side * (kerb + y)
                    movers.append(Mover(assembly=person, start_m=s, lateral_m=place, speed=speed))
    return movers


@dataclass(frozen=True, kw_only=True, slots=True)
class _Body:
    """Proportions of a car. Metres; cabin: (start, end) as shares of the length from the rear."""

    length: float
    width: float
    height: float
    belt: float
    cabin: tuple[float, float]


_CARS = (
    _Body(length=4.5, width=1.8, height=1.45, belt=0.88, cabin=(0.08, 0.72)),  # saloon
    _Body(length=3.9, width=1.72, height=1.5, belt=0.92, cabin=(0.0, 0.7)),  # small car
    _Body(length=4.7, width=1.9, height=1.72, belt=1.05, cabin=(0.0, 0.72)),  # off-road
    _Body(length=4.6, width=1.82, height=1.48, belt=0.9, cabin=(0.0, 0.7)),  # estate
    _Body(length=5.0, width=1.95, height=2.0, belt=1.1, cabin=(0.0, 0.85)),  # van
    _Body(length=5.3, width=1.95, height=1.85, belt=1.05, cabin=(0.38, 0.72)),  # pick-up
)


def _random_car(random: np.random.Generator) -> Assembly:
    """One of several body styles in one of many paints."""
    body = _CARS[int(random.choice(len(_CARS), p=[0.3, 0.2, 0.18, 0.12, 0.12, 0.08]))]
    return _car(body, _paint(random), Label.CAR)


def _own_car() -> Assembly:
    """The ego car; its nose ends just behind the forward camera, which therefore never sees it."""
    car = _car(_CARS[1], OWN_PAINT, Label.OWN_CAR)
    return Assembly(parts=tuple(p.placed(-0.45, 0.0, 0.0, 0.0) for p in car.parts), length=car.length, width=car.width)


def _paint(random: np.random.Generator) -> Colour:
    return varied(picked(random, _PAINTS), random)


def _car(body: _Body, paint: Colour, label: Label) -> Assembly:
    length, width, low = body.length, body.width, 0.28
    start, end = (share * length - length / 2 for share in body.cabin)
    cabin_x, cabin_m, cabin_z = (start + end) / 2, end - start, (body.belt + body.height) / 2
    cabin, roof = (cabin_m, width * 0.94, body.height - body.belt), (cabin_m * 0.66, width * 0.7, 0.06)
    bumper, grey = (0.08, width * 0.9, 0.24), (0.12, 0.12, 0.13)
    parts = [
        block((0, 0, (low + body.belt) / 2), (length, width, body.belt - low), paint, label, gloss=0.5),
        block((cabin_x, 0, cabin_z), cabin, _GLASS, label, shape="cabin", gloss=0.8),
        block((cabin_x - 0.04 * cabin_m, 0, body.height), roof, paint, label, gloss=0.5),
        block((length / 2, 0, 0.45), bumper, grey, label, gloss=0.1),
        block((-length / 2, 0, 0.45), bumper, grey, label, gloss=0.1),
    ]
    for y in (-width * 0.36, width * 0.36):
        parts.append(block((length / 2, y, 0.7), (0.1, 0.34, 0.14), (0.9, 0.9, 0.82), label, gloss=0.6))
        parts.append(block((-length / 2, y, 0.74), (0.1, 0.32, 0.15), (0.6, 0.03, 0.03), label, gloss=0.6))
    wheels = _wheels((-length * 0.31, length * 0.31), width / 2 - 0.1, 0.33, 0.24, label)
    return Assembly(parts=(*parts, *wheels), length=length, width=width)


def _wheels(axles: tuple[float, ...], away: float, radius: float, wide: float, label: Label) -> list[Part]:
    """One at each end of every axle; away: from the middle."""
    size, sides = (2 * radius, wide, 2 * radius), (-away, away) if away else (0.0,)
    return [block((x, y, radius), size, _TYRE, label, shape="wheel") for x in axles for y in sides]


def _random_truck(random: np.random.Generator) -> Assembly:
    """A box truck, a lorry with trailer, or a bus."""
    kind, label = random.choice(["box", "lorry", "bus"], p=[0.5, 0.2, 0.3]), Label.TRUCK
    paint = _paint(random)
    if kind == "bus":
        length = float(random.uniform(9, 12))
        parts = [
            block((0, 0, 0.95), (length, 2.5, 1.3), paint, label, gloss=0.4),
            block((0, 0, 2.05), (length * 0.995, 2.46, 0.95), _GLASS, label, gloss=0.8),
            block((0, 0, 2.75), (length, 2.5, 0.5), paint, label, gloss=0.4),
            *_wheels((-length * 0.3, length * 0.3), 1.15, 0.48, 0.24, label),
        ]
        return Assembly(parts=tuple(parts), length=length, width=2.5)
    length = float(random.uniform(6, 8.5) if kind == "box" else random.uniform(11, 13.5))
    white = float(random.uniform(0.6, 0.95))
    cargo = (white, white, white) if random.random() < 0.6 else varied(paint, random)
    height, front, load = float(random.uniform(2.7, 3.6)), length / 2, length - 2.3
    parts = [
        block((front - 0.95, 0, 1.35), (1.9, 2.3, 1.9), paint, label, gloss=0.3),
        block((front - 0.02, 0, 1.85), (0.1, 2.1, 0.75), _GLASS, label, gloss=0.8),
        block((-front + load / 2, 0, (height + 0.9) / 2), (load, 2.45, height - 0.9), cargo, label, gloss=0.3),
        block((0, 0, 0.7), (length * 0.96, 1.0, 0.4), (0.1, 0.1, 0.1), label, gloss=0.3),
        block((-front, 0, 0.75), (0.1, 2.2, 0.2), (0.5, 0.05, 0.05), label, gloss=0.3),
        *_wheels((front - 1.2, -front + 1.4, -front + 2.6), 1.0, 0.5, 0.4, label),
    ]
    return Assembly(parts=tuple(parts), length=length, width=2.45)


def _random_person(random: np.random.Generator) -> Assembly:
    """A standing or walking person."""
    height = float(random.uniform(1.55, 1.9))
    coat, legs = _paint(random), _paint(random)
    stride = float(random.uniform(0, 0.28))
    return Assembly(parts=_figure(height, coat, legs, Label.PERSON, stride), length=0.5, width=0.5)


def _figure(
    height: float, coat: Colour, legs: Colour, label: Label, stride: float, lift: float = 0.0
) -> tuple[Part, ...]:
    hip = height * 0.48
    limbs: tuple[tuple[str, Point, Point, Colour], ...] = (
        ("box", (stride, 0.1, hip / 2), (0.17, 0.15, hip), legs),
        ("box", (-stride, -0.1, hip / 2), (0.17, 0.15, hip), legs),
        ("taper", (0, 0, hip + height * 0.18), (0.28, 0.46, height * 0.36), coat),
        ("ball", (0, 0, height - 0.13), (0.23, 0.22, 0.27), (0.72, 0.54, 0.44)),
    )
    return tuple(block((x, y, z + lift), size, colour, label, shape=shape) for shape, (x, y, z), size, colour in limbs)


def _random_cyclist(random: np.random.Generator) -> Assembly:
    """A person on a bicycle."""
    coat, legs = _paint(random), _paint(random)
    wheels = _wheels((-0.52, 0.52), 0.0, 0.34, 0.06, Label.CYCLIST)
    frame = block((0, 0, 0.62), (0.95, 0.06, 0.12), coat, Label.CYCLIST)
    return Assembly(parts=(*wheels, frame, *_figure(1.25, coat, legs, Label.CYCLIST, 0.1, 0.5)), length=1.8, width=0.6)
