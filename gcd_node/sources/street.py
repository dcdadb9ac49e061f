"""A small analytic street: what stands where, and where a car driving through it is. No pixels in here.

World axes: x along the street, y to the left, z up, metres. Traffic keeps right. Everything follows from the seed.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.floating[Any]]

Look: TypeAlias = Literal["plain", "house", "body", "cabin"]
"""How a box is painted: one colour, windows in rows, a car's body with lamps, a car's windows under a roof."""

Colour: TypeAlias = tuple[float, float, float]
"""RGB, 0..255."""

LANE_M = 3.5
PARKING_M = 5.8
KERB_M = 6.0
PAVEMENT_M = 9.0
SPEED_M_S = 8.0
_BEND_M = 8.0
_WAVE_M = 150.0
_BEHIND_M = 12.0
_AHEAD_M = 115.0
_CAMERA_AHEAD_M = 1.6

_WALLS: tuple[Colour, ...] = ((196, 168, 138), (176, 112, 92), (208, 200, 184), (150, 148, 150), (222, 190, 140))
_PAINTS: tuple[Colour, ...] = (
    (186, 34, 32),
    (38, 70, 140),
    (225, 225, 225),
    (40, 42, 48),
    (150, 156, 162),
    (214, 160, 30),
)
_GLASS: Colour = (52, 62, 74)
_TYRE: Colour = (24, 24, 26)


@dataclass(frozen=True, kw_only=True, slots=True)
class Box:
    """A level box. centre: of the box, [x, y, z]. size: along its own axes. yaw_rad: left turn about z."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw_rad: float
    colour: Colour
    look: Look = "plain"


@dataclass(frozen=True, kw_only=True, slots=True)
class Ball:
    """A tree's crown."""

    centre: tuple[float, float, float]
    radius_m: float
    colour: Colour


@dataclass(frozen=True, kw_only=True, slots=True)
class Standpoint:
    """Where the camera is, level. yaw_rad: its heading, left turn from the x axis."""

    x: float
    y: float
    yaw_rad: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Street:
    """The street of one seed."""

    seed: int

    def centre(self, x: Floats) -> Floats:
        """y of the road's middle at x, metres."""
        return np.float32(_BEND_M) * np.sin(x * np.float32(math.tau / _WAVE_M) + np.float32(self._phase))

    def slope(self, x: Floats) -> Floats:
        """dy/dx of the road's middle at x."""
        rate = math.tau / _WAVE_M
        return np.float32(_BEND_M * rate) * np.cos(x * np.float32(rate) + np.float32(self._phase))

    def camera(self, time_s: float) -> Standpoint:
        """Where the camera of the driving car is: in the right lane, ahead of the car's middle."""
        x, y, yaw = self._beside(SPEED_M_S * time_s, -LANE_M / 2)
        return Standpoint(x=x + _CAMERA_AHEAD_M * math.cos(yaw), y=y + _CAMERA_AHEAD_M * math.sin(yaw), yaw_rad=yaw)

    def things(self, time_s: float) -> list[Box | Ball]:
        """Everything near the camera that is not the ground."""
        here = SPEED_M_S * time_s
        found: list[Box | Ball] = []
        for side in (-1, 1):
            for cell in _cells(here, 13.0):
                found.append(self._house(side, cell))
            for cell in _cells(here, 11.0):
                found += self._kerbside(side, cell)
        for cell in _cells(here, 9.0):
            found += self._parked(cell)
        return found + self._traffic(time_s)

    @property
    def _phase(self) -> float:
        return _phase(self.seed)

    def _beside(self, x: float, left_m: float) -> tuple[float, float, float]:
        """Point beside the road's middle at x, and the road's heading there."""
        yaw = math.atan(float(self.slope(np.asarray(x))))
        middle = float(self.centre(np.asarray(x)))
        return x - left_m * math.sin(yaw), middle + left_m * math.cos(yaw), yaw

    def _house(self, side: int, cell: int) -> Box:
        random = _random(self.seed, 1 + side, cell)
        length, depth, height = random.uniform(10.5, 12.6), random.uniform(8, 11), random.choice([6.4, 9.4, 12.4, 15.4])
        x, y, yaw = self._beside(cell * 13.0, side * (PAVEMENT_M + depth / 2 + random.uniform(0.0, 1.2)))
        wall = np.array(_WALLS[int(random.integers(len(_WALLS)))]) * random.uniform(0.85, 1.08)
        return Box(
            centre=(x, y, height / 2), size=(length, depth, height), yaw_rad=yaw, colour=_colour(wall), look="house"
        )

    def _kerbside(self, side: int, cell: int) -> list[Box | Ball]:
        """A tree, a lamp post or nothing."""
        random = _random(self.seed, 5 + side, cell)
        x, y, yaw = self._beside(cell * 11.0 + random.uniform(-1.5, 1.5), side * (KERB_M + 0.8))
        kind = random.random()
        if kind < 0.5:
            height, radius = random.uniform(2.8, 3.6), random.uniform(1.3, 1.9)
            green = np.array([62, 104, 48]) * random.uniform(0.8, 1.25)
            trunk = Box(centre=(x, y, height / 2), size=(0.3, 0.3, height), yaw_rad=yaw, colour=(84, 66, 50))
            return [trunk, Ball(centre=(x, y, height + 0.7 * radius), radius_m=radius, colour=_colour(green))]
        if kind < 0.8:
            post = Box(centre=(x, y, 3.0), size=(0.14, 0.14, 6.0), yaw_rad=yaw, colour=(96, 100, 104))
            arm_x, arm_y, _ = self._beside(x, side * (KERB_M - 0.1))
            return [post, Box(centre=(arm_x, arm_y, 6.0), size=(0.3, 1.9, 0.12), yaw_rad=yaw, colour=(110, 112, 116))]
        return []

    def _parked(self, cell: int) -> list[Box | Ball]:
        random = _random(self.seed, 9, cell)
        cars: list[Box | Ball] = []
        for side in (-1, 1):
            if random.random() < 0.5:
                cars += self._car(cell * 9.0 + random.uniform(-1, 1), side * 4.7, random, ahead=-side)
        return cars

    def _traffic(self, time_s: float) -> list[Box | Ball]:
        """One car ahead in the own lane, and a row that comes towards us."""
        here = SPEED_M_S * time_s
        cars = self._car(here + 17.0 + 2.0 * math.sin(0.5 * time_s), -LANE_M / 2, _random(self.seed, 10, 0), ahead=1)
        spacing = 34.0
        shift = -SPEED_M_S * time_s + 20.0
        for cell in range(math.floor((here - shift) / spacing), math.ceil((here + _AHEAD_M - shift) / spacing)):
            cars += self._car(cell * spacing + shift, LANE_M / 2, _random(self.seed, 11, cell), ahead=-1)
        return cars

    def _car(self, x: float, left_m: float, random: np.random.Generator, *, ahead: int) -> list[Box | Ball]:
        """Body, cabin and two pairs of wheels; ahead is 1 for our direction, -1 for the other."""
        paint = _PAINTS[int(random.integers(len(_PAINTS)))]
        x, y, yaw = self._beside(x, left_m)
        yaw += 0.0 if ahead > 0 else math.pi

        def part(
            forward: float, up: float, size: tuple[float, float, float], colour: Colour, look: Look = "plain"
        ) -> Box:
            centre = (x + forward * math.cos(yaw), y + forward * math.sin(yaw), up)
            return Box(centre=centre, size=size, yaw_rad=yaw, colour=colour, look=look)

        return [
            part(0.0, 0.62, (4.3, 1.8, 0.66), paint, "body"),
            part(-0.25, 1.22, (2.2, 1.56, 0.56), paint, "cabin"),
            part(-1.35, 0.32, (0.64, 1.84, 0.64), _TYRE),
            part(1.35, 0.32, (0.64, 1.84, 0.64), _TYRE),
        ]


@cache
def _phase(seed: int) -> float:
    return math.tau * float(np.random.default_rng((seed, 0)).random())


def _cells(here: float, length_m: float) -> range:
    return range(math.floor((here - _BEHIND_M) / length_m), math.ceil((here + _AHEAD_M) / length_m))


def _random(seed: int, kind: int, cell: int) -> np.random.Generator:
    return np.random.default_rng((seed, kind, cell + 1_000_000))


def _colour(values: Floats) -> Colour:
    red, green, blue = (min(float(value), 255.0) for value in values)
    return red, green, blue
