"""Who moves on the road of the driving world, and who stands there: nobody overlaps anybody, at any time step."""

from dataclasses import dataclass

import numpy as np

from gcd_train.scenes.description import Floats, Part
from gcd_train.scenes.driving.road import Road
from gcd_train.scenes.driving.vehicles import Assembly, own_car, random_car, random_cyclist, random_person, random_truck

_FPS = 10.0
_BEGIN_M, _END_M = -40.0, 130.0
_OWN_LENGTH_M = 5.0
_MOST_MOVERS = 120


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
    ego = Mover(assembly=own_car(), start_m=0.0, lateral_m=lateral, speed=cruise)
    density = float(random.uniform(0.15, 1.0))
    movers: list[Mover] = []
    for index in range(-road.lanes_left, road.lanes_right):
        taken = (-_OWN_LENGTH_M, _OWN_LENGTH_M) if index == lane else None
        speed = cruise if index == lane else max(0.0, cruise + float(random.normal(0, 1.5)))
        if index < 0:
            speed = -float(random.uniform(2.0, 15.0)) if random.random() < 0.8 else -0.001
        movers += _lane(road.lane(index), speed, density, taken, random)
    movers += _cyclists(road, random)
    movers += _people(road, random)
    return Traffic(ego=ego, movers=tuple(movers[:_MOST_MOVERS]), parked=_parked(road, random))


def _lane(
    lateral: float, speed: float, density: float, taken: tuple[float, float] | None, random: np.random.Generator
) -> list[Mover]:
    """Vehicles one behind the other; all of a lane drive equally fast, so their gaps never close."""
    movers: list[Mover] = []
    s = _BEGIN_M + float(random.exponential(15.0 / density))
    while s < _END_M:
        assembly = random_truck(random) if random.random() < 0.13 else random_car(random)
        middle = s + assembly.length / 2
        blocked = taken is not None and middle + assembly.length / 2 + 2.5 > taken[0] and s - 2.5 < taken[1]
        if not blocked:
            place = lateral + float(random.normal(0, 0.1))
            movers.append(Mover(assembly=assembly, start_m=middle, lateral_m=place, speed=speed))
        s += assembly.length + float(random.uniform(2.5, 7.0)) + float(random.exponential(14.0 / density))
    return movers


def _parked(road: Road, random: np.random.Generator) -> tuple[tuple[Part, ...], ...]:
    rows: list[tuple[Part, ...]] = []
    for side, strip, edge in ((-1.0, road.parking_m[0], road.right_m), (1.0, road.parking_m[1], road.left_m)):
        fullness, s = float(random.uniform(0.3, 0.95)), _BEGIN_M
        while strip > 0 and s < 110.0:
            car = random_car(random)
            s += car.length + float(random.uniform(0.7, 1.6))
            if random.random() < fullness and road.is_free(s - car.length / 2, 5.0 + car.length / 2):
                x, y, heading = road.at(s - car.length / 2, side * (edge - strip / 2))
                turn = heading + (np.pi if side > 0 else 0.0)
                rows.append(tuple(part.placed(x, y, 0.0, turn) for part in car.parts))
    return tuple(rows)


def _cyclists(road: Road, random: np.random.Generator) -> list[Mover]:
    """At most one on each side, in the half metre between the outer lane and kerb or parking strip."""
    movers: list[Mover] = []
    for side, edge in ((-1.0, road.right_m - road.parking_m[0]), (1.0, road.left_m - road.parking_m[1])):
        if random.random() < 0.35 and road.lane_m > 3.25:
            speed = float(random.uniform(3, 6)) * -side
            start = float(random.uniform(8, 45))
            rider, place = random_cyclist(random), side * (edge - 0.38)
            movers.append(Mover(assembly=rider, start_m=start, lateral_m=place, speed=speed))
    return movers


def _people(road: Road, random: np.random.Generator) -> list[Mover]:
    movers: list[Mover] = []
    spacing = float(random.uniform(20, 90))
    for side, kerb in ((-1.0, road.right_m), (1.0, road.left_m)):
        lanes = np.arange(0.85, road.pavement_m - 0.25, 0.6)  # walkers of one lane share their speed
        for y in lanes:
            speed = float(random.choice([-1, 1])) * float(random.uniform(0.7, 1.8))
            s = float(random.uniform(0, 25))
            while s < 70.0:
                s += float(random.exponential(spacing)) + 1.0
                if road.is_free(s, 4.0):
                    person, place = random_person(random), side * (kerb + float(y))
                    movers.append(Mover(assembly=person, start_m=s, lateral_m=place, speed=speed))
    return movers
