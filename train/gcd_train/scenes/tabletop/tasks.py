"""Where things lie at the start, and what the arm does with them: tasks as steps of its tool.

A task is planned when the last one is done, from where things are by then.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Point
from gcd_train.scenes.tabletop.arm import BASE, OPEN_M, REACH_M, Model, random_arm
from gcd_train.scenes.tabletop.things import TABLE_M, Placed, Setting, random_clutter, random_table, random_thing

_FINGER_ROOM_M = 0.085
"""How far the open gripper reaches from the middle of what it takes."""
_WIDEST_AZIMUTH = 1.15
_GAP_M, _DROP_M, _TRIES = 0.015, 0.002, 400
_LOWEST_M, _ABOVE_M = 0.021, 0.11


def random_setting(random: np.random.Generator) -> Setting:
    """An arm, a table with clutter, and things that the arm can take."""
    arm, table, clutter = random_arm(random), random_table(random), random_clutter(random)
    return Setting(arm=arm, table=table, clutter=clutter, things=random_things(random, clutter))


def random_things(random: np.random.Generator, clutter: tuple[Placed, ...] = ()) -> tuple[Placed, ...]:
    """Five to twelve loose things; the first four or so stand apart and within reach, so that they can be taken."""
    wanted = int(random.integers(5, 13))
    placed: list[Placed] = []
    for _ in range(_TRIES):
        if len(placed) == wanted:
            break
        first = len(placed) < 4
        thing = random_thing(random, 2 * OPEN_M - 0.022)
        x, y = _reachable_spot(random) if first else _anywhere(random)
        gap = _FINGER_ROOM_M - 0.02 if first else _GAP_M
        if _is_free(x, y, thing.radius_m + gap, (*placed, *clutter)):
            place = (x, y, thing.size[2] / 2 + _DROP_M)
            placed.append(Placed(thing=thing, place=place, yaw=float(random.uniform(-math.pi, math.pi))))
    return tuple(placed)


def _reachable_spot(random: np.random.Generator) -> tuple[float, float]:
    """A point of the table, x and y in metres, that the arm can grasp at from above."""
    radius = float(random.uniform(REACH_M[0] + 0.02, REACH_M[1] - 0.02))
    azimuth = float(random.uniform(-_WIDEST_AZIMUTH, _WIDEST_AZIMUTH))
    return BASE[0] + radius * math.cos(azimuth), BASE[1] + radius * math.sin(azimuth)


def _anywhere(random: np.random.Generator) -> tuple[float, float]:
    return float(random.uniform(-0.3, TABLE_M[0] - 0.1)), float(random.uniform(-TABLE_M[1] + 0.1, TABLE_M[1] - 0.1))


def _is_free(x: float, y: float, radius: float, others: tuple[Placed, ...]) -> bool:
    apart = math.hypot(x - BASE[0], y - BASE[1]) > 0.2 + radius
    return apart and all(
        math.hypot(x - other.place[0], y - other.place[1]) > radius + other.thing.radius_m for other in others
    )


def _is_reachable(x: float, y: float) -> bool:
    return REACH_M[0] <= math.hypot(x - BASE[0], y - BASE[1]) <= REACH_M[1]


@dataclass(frozen=True, kw_only=True, slots=True)
class Step:
    """One leg of the way: where the tool is at its end, metres, its x axis at `yaw` radians.

    name: reach, descend, close, lift, carry, lower, open, retreat, push or wait. opening: of the gripper at the end,
    0..1. thing: index of what it is about, -1 for none.
    """

    name: str
    place: Point
    yaw: float
    opening: float
    seconds: float
    thing: int = -1


_Leg = tuple[str, Point, float, float]
"""Name, place, yaw and opening of a step."""


@dataclass(frozen=True, slots=True)
class Planner:
    """Chooses tasks at random and turns them into steps; reads the things' places from the running simulation."""

    model: Model
    data: Any
    things: tuple[Placed, ...]
    random: np.random.Generator
    speed: float

    def steps(self) -> Iterator[Step]:
        """For ever: one task after the other; where nothing can be done, the arm waits."""
        x, y, z = self.data.site_xpos[self.model.site].tolist()
        here: Point = (x, y, z)
        while True:
            index, legs = self._task(here)
            for name, place, yaw, opening in legs:
                seconds = max(0.22, math.dist(place, here) / self.speed)
                yield Step(name=name, place=place, yaw=yaw, opening=opening, seconds=seconds, thing=index)
                here = place

    def _task(self, here: Point) -> tuple[int, list[_Leg]]:
        """What it is about, and its legs."""
        order = self.random.permutation(len(self.things)).tolist()
        if self.random.random() < 0.25:
            pushed = next((i for i in order if self._push(i)), None)
            if pushed is not None:
                return pushed, self._push(pushed)
        taken = next((i for i in order if self._can_take(i)), None)
        return (
            (-1, [("wait", here, _natural_yaw(here), 1.0)]) if taken is None else (taken, self._pick_and_place(taken))
        )

    def _pick_and_place(self, index: int) -> list[_Leg]:
        thing = self.things[index].thing
        (x, y, z), yaw = self._pose(index)
        level = max(z + thing.grip_z, _LOWEST_M)
        above, grip = max(level + _ABOVE_M, 0.16), (x, y, level)
        natural = _natural_yaw(grip)
        if thing.any_yaw:
            turn = natural + float(self.random.uniform(-0.4, 0.4))
        else:  # fingers across the thing's y axis, with the least turn of the wrist
            turn = natural + (yaw - natural + math.pi / 2) % math.pi - math.pi / 2
        lifted = level + float(self.random.uniform(0.10, 0.17))
        to_x, to_y = self._free_spot(index)
        carried, down = (to_x, to_y, lifted), (to_x, to_y, level + 0.003)
        turned = _natural_yaw(carried) + (turn - natural) * float(self.random.uniform(0, 1))
        opening = min(1.0, (thing.size[1] / 2 + 0.018) / OPEN_M)
        return [
            ("reach", (x, y, above), turn, opening),
            ("descend", grip, turn, opening),
            ("close", grip, turn, 0.0),
            ("lift", (x, y, lifted), turn, 0.0),
            ("carry", carried, turned, 0.0),
            ("lower", down, turned, 0.0),
            ("open", down, turned, opening),
            ("retreat", (to_x, to_y, above), turned, opening),
        ]

    def _push(self, index: int) -> list[_Leg]:
        """A thing is pushed with closed fingers, sideways to the arm, if there is room; no legs else."""
        (x, y, z), _ = self._pose(index)
        radius, low = self.things[index].thing.radius_m, max(_LOWEST_M, min(z, 0.05))
        for turn in self.random.permutation([0.5 * math.pi, -0.5 * math.pi, 0.25 * math.pi, -0.25 * math.pi]).tolist():
            yaw = math.atan2(y - BASE[1], x - BASE[0]) + turn
            ahead = np.array([math.cos(yaw), math.sin(yaw)])
            before, after = np.array([x, y]) - (radius + 0.035) * ahead, np.array([x, y]) + (0.10 - radius) * ahead
            inside = _is_reachable(*before) and _is_reachable(*after)
            free = self._clearance(before, index) > 0.06 and self._clearance(after + radius * ahead, index) > 0.03
            if inside and free:
                (x, y), (to_x, to_y) = before.tolist(), after.tolist()
                return [
                    ("reach", (x, y, low + 0.13), yaw, 0.1),
                    ("descend", (x, y, low), yaw, 0.1),
                    ("push", (to_x, to_y, low), yaw, 0.1),
                    ("retreat", (to_x, to_y, low + 0.13), yaw, 0.1),
                ]
        return []

    def _can_take(self, index: int) -> bool:
        (x, y, z), _ = self._pose(index)
        thing = self.things[index].thing
        upright = self.data.xmat[self.model.things[index]][8] > 0.98
        stands = upright and abs(z - thing.size[2] / 2) < 0.01
        return stands and _is_reachable(x, y) and self._clearance(np.array([x, y]), index) > 0.06

    def _free_spot(self, index: int) -> tuple[float, float]:
        """A spot near by with room for the thing and the hand; where it is, if a few tries find none."""
        (x, y, _), _ = self._pose(index)
        apart = max(_FINGER_ROOM_M, self.things[index].thing.radius_m + 0.03)
        for spot in [_reachable_spot(self.random) for _ in range(40)]:
            way = math.hypot(spot[0] - x, spot[1] - y)
            if 0.12 < way < 0.45 and self._clearance(np.array(spot), index) > apart:
                return spot
        return x, y

    def _clearance(self, spot: NDArray[np.float64], but: int) -> float:
        """Distance from a point of the table to the nearest other loose thing's circle, metres."""
        gaps = [
            math.hypot(*(spot - np.array(self._pose(i)[0][:2]))) - self.things[i].thing.radius_m
            for i in range(len(self.things))
            if i != but
        ]
        return min(gaps, default=1.0)

    def _pose(self, index: int) -> tuple[Point, float]:
        """Place and yaw of a thing now."""
        body = self.model.things[index]
        x, y, z = self.data.xpos[body].tolist()
        turned = self.data.xmat[body].reshape(3, 3)
        return (x, y, z), math.atan2(turned[1, 0], turned[0, 0])


def _natural_yaw(place: Point) -> float:
    """The tool's yaw when the wrist is not turned: its x axis points back to the base."""
    return math.atan2(place[1] - BASE[1], place[0] - BASE[0]) + math.pi
