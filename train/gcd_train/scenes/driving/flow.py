"""Who moves through the streets of the driving world: no two footprints ever touch, at no time step.

Every road user is proposed by a simple rule and kept only if it keeps clear, over the whole drive, of all who were
kept before.
"""

from dataclasses import dataclass, field

import numpy as np

from gcd_train.scenes.description import Doubles, Floats
from gcd_train.scenes.driving import vehicles
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.ground import PAVEMENT_M, stop_line_m, zebra_m
from gcd_train.scenes.driving.roads import Crossing, Road, Street
from gcd_train.scenes.driving.roadside import CAMERA_ROOM_M, Footprints, holds_a_point, touches, turned_back
from gcd_train.scenes.driving.vehicles import Assembly, Lamps

FPS = 10.0
_BEGIN_M, _END_M = -90.0, 240.0
_NEAR_M = 26.0
_GAP_M = 0.2
_MOST = 254
_NOWHERE = Crossing(at_m=0.0, half_m=0.0, zebra=False)


@dataclass(frozen=True, kw_only=True, slots=True)
class RoadUser:
    """A vehicle or a person. rows: x, y, z, yaw [T, 4] at every time step."""

    assembly: Assembly
    rows: Floats

    @property
    def moves(self) -> bool:
        """Whether it ever leaves its place."""
        return bool(np.ptp(self.rows, axis=0).max() > 1e-6)


@dataclass(frozen=True, kw_only=True, slots=True)
class Drive:
    """What the ego does. lane: counted from the centre line. waits_at: it stands before the first crossing ahead, whose
    side roads have green. rows: [T, 4].
    """

    lane: int
    speed: float
    gain: float
    waits_at: Crossing | None
    rows: Floats


def random_drive(street: Street, frames: int, random: np.random.Generator) -> Drive:
    """The ego's way through its street; it keeps its lane."""
    road = street.main
    lane = int(random.integers(road.lanes_right))
    lateral = road.lane(lane) + random.normal(0, 0.1)
    for crossing in road.crossings:  # the first one before which the ego, starting near s = 0, can stand
        place = crossing.at_m - stop_line_m(crossing) - 1.8  # of its middle, with its nose at the stop line
        if place > -4.0:
            if random.random() >= 0.25:
                break
            rows = _along(road, np.full(frames, min(0.0, place)), lateral)
            return Drive(lane=lane, speed=0.0, gain=0.0, waits_at=crossing, rows=rows)
    speed, gain = random.uniform(3.5, 14.5), float(np.clip(random.normal(0, 0.7), -1.6, 1.3))
    covered = travelled(speed, gain, frames)
    rows = _along(road, covered - covered[-1] / 2, lateral)  # the world's origin is amid the drive: it is drawn first
    return Drive(lane=lane, speed=speed, gain=gain, waits_at=None, rows=rows)


def travelled(speed: float, gain: float, frames: int) -> Doubles:
    """Metres [T] at a speed in m/s that changes evenly; nobody goes backwards or beyond 16 m/s."""
    seconds = np.arange(frames) / FPS
    pace = np.clip(speed + gain * seconds, 0.0, 16.0)
    return np.concatenate([[0.0], np.cumsum((pace[1:] + pace[:-1]) / 2 / FPS)])[:frames]


def _along(road: Road, s: Doubles, lateral: float, reverse: bool = False) -> Floats:
    places = road.places(s, lateral)
    yaw = places[:, 2] + (np.pi if reverse else 0.0)
    return np.stack([places[:, 0], places[:, 1], np.zeros(len(s)), yaw], -1).astype(np.float32)


@dataclass(kw_only=True, slots=True)
class Crowd:
    """All road users so far. obstacles: footprints of what stands, [N, 5]. cameras: [T, C, 3], where they are."""

    street: Street
    drive: Drive
    obstacles: Footprints
    cameras: Doubles
    users: list[RoadUser] = field(default_factory=list[RoadUser])
    _ground: list[Footprints] = field(default_factory=list[Footprints])

    def add(self, assembly: Assembly, rows: Floats) -> bool:
        """Keep a road user unless it would touch another one, a thing that stands, or a camera."""
        size = np.broadcast_to([assembly.length / 2, assembly.width / 2], (len(rows), 2))
        ground = np.concatenate([rows[:, [0, 1, 3]], size], -1).astype(np.float64)  # [T, 5]
        if self._ground and touches(ground[None], np.array(self._ground), _GAP_M):
            return False
        if touches(ground[:, None], self.obstacles[None], 0.05):
            return False
        away = self.cameras - rows[:, None, :3]
        near = np.hypot(away[..., 0], away[..., 1]) < assembly.length
        met = turned_back(away, rows[:, 3:])[near]
        if assembly.parts[0].label != Label.OWN_CAR and holds_a_point(assembly.parts, met, CAMERA_ROOM_M):
            return False
        self.users.append(RoadUser(assembly=assembly, rows=rows))
        self._ground.append(ground)
        return True

    def is_near(self, place: tuple[float, ...]) -> bool:
        """Whether the ego comes close to a place, x and y first."""
        return bool(np.hypot(*(self.drive.rows[:, :2] - place[:2]).T).min() < _NEAR_M)


def fill(crowd: Crowd, lamps: bool, random: np.random.Generator) -> None:
    """The ego first, then lanes, side roads, parked vehicles, cyclists and people."""
    crowd.add(vehicles.own_car(), crowd.drive.rows)
    density = random.uniform(0.25, 1.1)
    for index in range(-crowd.street.main.lanes_left, crowd.street.main.lanes_right):
        _lane(crowd, index, density, lamps, random)
    for road, crossing in zip(crowd.street.crossed, crowd.street.main.crossings, strict=True):
        _side_road(crowd, road, crossing == crowd.drive.waits_at, lamps, random)
    for road in crowd.street.roads:
        _parked(crowd, road, random)
    _two_wheelers(crowd, random)
    _walkers(crowd, random)
    del crowd.users[_MOST:]


def _vehicle(random: np.random.Generator, lamps: Lamps, near: bool) -> Assembly:
    draw = random.random()
    if draw < 0.08:
        return vehicles.random_truck(random, lamps, near)
    if draw < 0.13:
        return vehicles.random_bus(random, lamps, near)
    if draw < 0.17:
        return vehicles.random_motorcyclist(random, lamps)
    return vehicles.random_car(random, lamps, near)


def _lane(crowd: Crowd, index: int, density: float, lamps: bool, random: np.random.Generator) -> None:
    """Vehicles of one lane of the main road; all of them keep the same pace, so their gaps never close."""
    road, drive, frames = crowd.street.main, crowd.drive, len(crowd.drive.rows)
    oncoming, waits = index < 0, drive.waits_at is not None
    speed, gain = drive.speed, drive.gain
    if index != drive.lane:
        speed, gain = random.uniform(3.0, 13.0), random.normal(0, 0.5)
    if waits:
        speed, gain = 0.0, 0.0
    shine = Lamps(lit=lamps, brakes=waits or gain < -0.4)
    covered = travelled(speed, gain, frames) * (-1 if oncoming else 1)
    thick = density * (1.8 if waits else 1.0)
    rear = _BEGIN_M + random.exponential(12.0 / thick)
    while rear < _END_M:
        near = any(crowd.is_near(road.at(at)) for at in (rear, rear + covered[-1]))
        made = _vehicle(random, shine, near)
        middle = rear + made.length / 2
        if not waits or road.is_free(middle, stop_line_m(_NOWHERE) + made.length / 2):
            lateral = road.lane(index) + random.normal(0, 0.08)
            crowd.add(made, _along(road, middle + covered, lateral, oncoming))
        rear += made.length + random.uniform(2.2, 6.0) + random.exponential(13.0 / thick)


def _side_road(crowd: Crowd, road: Road, flows: bool, lamps: bool, random: np.random.Generator) -> None:
    """Vehicles that wait at the main road, or cross it while the ego waits."""
    crossing, frames = road.crossings[0], len(crowd.drive.rows)
    for index in range(-road.lanes_left, road.lanes_right):
        sign = -1 if index < 0 else 1
        covered = travelled(random.uniform(5, 9) if flows else 0.0, 0.0, frames)
        nose = 60.0 if flows else crossing.at_m * sign - stop_line_m(crossing)
        for _ in range(8 if flows else int(random.integers(0, 4))):
            made = _vehicle(random, Lamps(lit=lamps, brakes=not flows), crowd.is_near(road.at(sign * nose)))
            s = sign * (nose - made.length / 2 + covered)
            if nose < -90.0:
                break
            crowd.add(made, _along(road, s, road.lane(index), index < 0))
            nose -= made.length + random.uniform(1.5, 3.0) + (random.exponential(9.0) if flows else 0.0)


def _parked(crowd: Crowd, road: Road, random: np.random.Generator) -> None:
    frames = len(crowd.drive.rows)
    for (side, edge), strip in zip(road.sides, road.parking_m, strict=True):
        fullness, s = random.uniform(0.35, 0.95), max(_BEGIN_M, road.start_m)
        while strip > 0 and s < min(170.0, road.end_m):
            near = crowd.is_near(road.at(s))
            kind = vehicles.random_truck if random.random() < 0.05 else vehicles.random_car
            made = kind(random, Lamps(), near)
            s += made.length + random.uniform(0.7, 1.5)
            middle = s - made.length / 2
            if random.random() < fullness and road.is_free(middle, 7.5 + made.length / 2):
                lateral = side * (edge - strip / 2 + random.normal(0, 0.06))
                crowd.add(made, _along(road, np.full(frames, middle), lateral, side > 0))


def _two_wheelers(crowd: Crowd, random: np.random.Generator) -> None:
    """Those left on the pavement, side by side, square to the kerb; then cyclists near the kerb or the parked cars."""
    frames, road = len(crowd.drive.rows), crowd.street.main
    for side, kerb in road.sides:
        for _ in range(int(random.integers(0, 4))):
            s, heavy = random.uniform(-45, 70), random.random() < 0.3
            for number in range(int(random.integers(1, 5))):
                rows = _along(road, np.full(frames, s + number * (1.1 if heavy else 0.8)), side * (kerb + 1.25))
                rows[:, 2:] += [PAVEMENT_M, np.pi / 2]
                if road.is_free(s, 8.0):
                    crowd.add(vehicles.left_two_wheeler(random, heavy), rows)
    for side, lanes in ((-1.0, road.lanes_right), (1.0, road.lanes_left)):
        for _ in range(0 if crowd.drive.waits_at else int(random.integers(0, 4))):
            covered = travelled(random.uniform(2.5, 6.0), 0.0, frames)
            start = random.uniform(-15, 70)
            rows = _along(road, start - side * covered, side * (lanes * road.lane_m - 0.42), side > 0)
            crowd.add(vehicles.random_cyclist(random), rows)


def _walkers(crowd: Crowd, random: np.random.Generator) -> None:
    """On the pavements; then on the zebras before waiting vehicles, or on the side roads' while the main road flows."""
    frames, spacing = len(crowd.drive.rows), random.uniform(7, 45)
    for road in crowd.street.roads:
        for side, kerb in road.sides:
            s = max(-40.0, road.start_m)
            while s < min(120.0, road.end_m):
                s += random.exponential(spacing) + 0.7
                stands = random.random() < 0.2
                speed = 0.0 if stands else random.uniform(0.7, 1.8)
                way = float(random.choice([-1, 1]))
                path = s + way * travelled(speed, 0.0, frames)
                lateral = side * (kerb + random.uniform(0.5, road.pavement_m - 0.4))
                if all(road.is_free(float(at), 2.5) for at in (path[0], path[-1])):
                    rows = _along(road, path, lateral, way < 0)
                    rows[:, 2] = PAVEMENT_M
                    crowd.add(vehicles.random_person(random, not stands), rows)
    crossed = crowd.street.roads[:1] if crowd.drive.waits_at else crowd.street.crossed
    for road, crossing in [(each, crossing) for each in crossed for crossing in each.crossings]:
        near, far = zebra_m(crossing)
        for _ in range(int(random.integers(1, 6)) if crossing.zebra else 0):
            way, end = float(random.choice([-1, 1])), float(random.choice([-1, 1]))
            x, y, heading = road.at(crossing.at_m + end * random.uniform(near + 0.3, far - 0.3))
            start = random.uniform(-road.right_m - 1.5, road.left_m - 2.0)
            across = way * (start + travelled(random.uniform(0.9, 1.7), 0.0, frames))
            rows = np.stack([x - across * np.sin(heading), y + across * np.cos(heading),
                             np.zeros(frames), np.full(frames, heading + way * np.pi / 2)], -1)  # fmt: skip
            crowd.add(vehicles.random_person(random, walks=True), rows.astype(np.float32))
