"""Where things stand at the start, and where there is room for one more."""

import math

import numpy as np

from gcd_train.scenes.tabletop.arm import Arm
from gcd_train.scenes.tabletop.furniture import TABLE_M
from gcd_train.scenes.tabletop.model import BASE
from gcd_train.scenes.tabletop.things import Placed, random_thing

FINGER_ROOM_M = 0.085
"""How far the open gripper reaches from the middle of what it takes."""
WIDEST_AZIMUTH = 1.15
_GAP_M, _DROP_M, _TRIES = 0.015, 0.002, 400


def reachable_spot(random: np.random.Generator, arm: Arm) -> tuple[float, float]:
    """A point of the table, x and y in metres, that the arm can grasp at from above."""
    radius = float(random.uniform(arm.reach_m[0] + 0.02, arm.reach_m[1] - 0.02))
    azimuth = float(random.uniform(-WIDEST_AZIMUTH, WIDEST_AZIMUTH))
    return BASE[0] + radius * math.cos(azimuth), BASE[1] + radius * math.sin(azimuth)


def is_reachable(arm: Arm, x: float, y: float) -> bool:
    """Whether the arm can grasp at this point of the table."""
    radius = math.hypot(x - BASE[0], y - BASE[1])
    return arm.reach_m[0] <= radius <= arm.reach_m[1]


def random_things(random: np.random.Generator, arm: Arm, clutter: list[Placed]) -> list[Placed]:
    """Five to twelve loose things; the first four or so stand apart and within reach, so that they can be taken."""
    wanted = int(random.integers(5, 13))
    placed: list[Placed] = []
    for _ in range(_TRIES):
        if len(placed) == wanted:
            break
        first = len(placed) < 4
        thing = random_thing(random, 2 * arm.open_m - 0.022)
        x, y = reachable_spot(random, arm) if first else _anywhere(random)
        gap = FINGER_ROOM_M - 0.02 if first else _GAP_M
        if _is_free(x, y, thing.radius_m + gap, [*placed, *clutter]):
            place = (x, y, thing.size[2] / 2 + _DROP_M)
            placed.append(Placed(thing=thing, place=place, yaw=float(random.uniform(-math.pi, math.pi))))
    return placed


def _anywhere(random: np.random.Generator) -> tuple[float, float]:
    return float(random.uniform(-0.3, TABLE_M[0] - 0.1)), float(random.uniform(-TABLE_M[1] + 0.1, TABLE_M[1] - 0.1))


def _is_free(x: float, y: float, radius: float, others: list[Placed]) -> bool:
    apart = math.hypot(x - BASE[0], y - BASE[1]) > 0.2 + radius
    return apart and all(
        math.hypot(x - other.place[0], y - other.place[1]) > radius + other.thing.radius_m for other in others
    )
