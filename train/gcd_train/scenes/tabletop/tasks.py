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
from gcd_train.scenes.tabletop.furniture import TABLE_M, random_clutter, random_table
from gcd_train.scenes.tabletop.things import Placed, Setting, random_thing

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
        here = self._tool()
        while True:
            task = list(self._task(here))
            if not task:
                task = [self._step("wait", here, self._natural_yaw(here), 1.0, here)]
            yield from task
            here = task[-1].place

    def _task(self, here: Point) -> Iterator[Step]:
        order = self.random.permutation(len(self.things)).tolist()
        if self.random.random() < 0.25:
            pushed = next((i for i in order if self._push_way(i) is not None), None)
            if pushed is not None:
                yield from self._push(pushed, here)
                return
        taken = next((i for i in order if self._can_take(i)), None)
        if taken is not None:
            yield from self._pick_and_place(taken, here)

    def _pick_and_place(self, index: int, here: Point) -> Iterator[Step]:
        thing = self.things[index].thing
        place, yaw = self._pose(index)
        level = max(place[2] + thing.grip_z, _LOWEST_M)
        grip: Point = (place[0], place[1], level)
        turn = self._grip_yaw(index, grip, yaw)
        above: Point = (grip[0], grip[1], max(level + _ABOVE_M, 0.16))
        lifted: Point = (grip[0], grip[1], level + float(self.random.uniform(0.10, 0.17)))
        opening = min(1.0, (thing.grip_m / 2 + 0.018) / OPEN_M)
        yield self._step("reach", above, turn, opening, here, index)
        yield self._step("descend", grip, turn, opening, above, index)
        yield Step(name="close", place=grip, yaw=turn, opening=0.0, seconds=0.22, thing=index)
        yield self._step("lift", lifted, turn, 0.0, grip, index)
        x, y = self._free_spot(index)
        carried: Point = (x, y, lifted[2])
        down: Point = (x, y, level + 0.003)
        turned = self._natural_yaw(carried) + (turn - self._natural_yaw(grip)) * float(self.random.uniform(0, 1))
        yield self._step("carry", carried, turned, 0.0, lifted, index)
        yield self._step("lower", down, turned, 0.0, carried, index)
        yield Step(name="open", place=down, yaw=turned, opening=opening, seconds=0.22, thing=index)
        up: Point = (x, y, max(level + _ABOVE_M, 0.16))
        yield self._step("retreat", up, turned, opening, down, index)

    def _push(self, index: int, here: Point) -> Iterator[Step]:
        way = self._push_way(index)
        if way is None:
            return
        start, end, yaw = way
        above: Point = (start[0], start[1], start[2] + 0.13)
        yield self._step("reach", above, yaw, 0.1, here, index)
        yield self._step("descend", start, yaw, 0.1, above, index)
        yield self._step("push", end, yaw, 0.1, start, index)
        yield self._step("retreat", (end[0], end[1], end[2] + 0.13), yaw, 0.1, end, index)

    def _push_way(self, index: int) -> tuple[Point, Point, float] | None:
        """From where to where the closed fingers go to push a thing, if there is room; sideways to the arm."""
        place, _ = self._pose(index)
        radius, low = self.things[index].thing.radius_m, max(_LOWEST_M, min(place[2], 0.05))
        away = math.atan2(place[1] - BASE[1], place[0] - BASE[0])
        for turn in self.random.permutation([0.5 * math.pi, -0.5 * math.pi, 0.25 * math.pi, -0.25 * math.pi]).tolist():
            ahead = np.array([math.cos(away + turn), math.sin(away + turn)])
            before = np.array(place[:2]) - (radius + 0.035) * ahead
            after = np.array(place[:2]) + (0.10 - radius) * ahead
            inside = _is_reachable(*before) and _is_reachable(*after)
            free = self._clearance(before, index) > 0.06 and self._clearance(after + radius * ahead, index) > 0.03
            if inside and free:
                start, end = before.tolist(), after.tolist()
                return (start[0], start[1], low), (end[0], end[1], low), away + turn
        return None

    def _can_take(self, index: int) -> bool:
        place, _ = self._pose(index)
        thing = self.things[index].thing
        stands = abs(place[2] - thing.size[2] / 2) < 0.01 and self._is_upright(index)
        near = _is_reachable(place[0], place[1])
        return thing.grip_m > 0 and stands and near and self._clearance(np.array(place[:2]), index) > 0.06

    def _free_spot(self, index: int) -> tuple[float, float]:
        """A spot with room for the thing and the hand, as far from where it is as a few tries find."""
        place, _ = self._pose(index)
        radius = self.things[index].thing.radius_m
        tries = [_reachable_spot(self.random) for _ in range(40)]
        room = [spot for spot in tries if self._clearance(np.array(spot), index) > max(_FINGER_ROOM_M, radius + 0.03)]
        room = [spot for spot in room if 0.12 < math.hypot(spot[0] - place[0], spot[1] - place[1]) < 0.45]
        return room[0] if room else (place[0], place[1])

    def _clearance(self, spot: NDArray[np.float64], but: int) -> float:
        """Distance from a point of the table to the nearest other loose thing's circle, metres."""
        gaps = [
            math.hypot(*(spot - np.array(self._pose(i)[0][:2]))) - self.things[i].thing.radius_m
            for i in range(len(self.things))
            if i != but
        ]
        return min(gaps, default=1.0)

    def _step(self, name: str, place: Point, yaw: float, opening: float, since: Point, thing: int = -1) -> Step:
        way = math.dist(place, since)
        return Step(name=name, place=place, yaw=yaw, opening=opening, seconds=max(0.22, way / self.speed), thing=thing)

    def _grip_yaw(self, index: int, grip: Point, yaw: float) -> float:
        """The yaw of the tool that puts the fingers across the thing's y axis with the least turn of the wrist."""
        natural = self._natural_yaw(grip)
        if self.things[index].thing.any_yaw:
            return natural + float(self.random.uniform(-0.4, 0.4))
        return natural + (yaw - natural + math.pi / 2) % math.pi - math.pi / 2

    def _natural_yaw(self, place: Point) -> float:
        """The tool's yaw when the wrist is not turned: its x axis points back to the base."""
        return math.atan2(place[1] - BASE[1], place[0] - BASE[0]) + math.pi

    def _tool(self) -> Point:
        x, y, z = self.data.site_xpos[self.model.site].tolist()
        return x, y, z

    def _pose(self, index: int) -> tuple[Point, float]:
        """Place and yaw of a thing now."""
        body = self.model.things[index]
        x, y, z = self.data.xpos[body].tolist()
        turned = self.data.xmat[body].reshape(3, 3)
        return (x, y, z), math.atan2(turned[1, 0], turned[0, 0])

    def _is_upright(self, index: int) -> bool:
        return bool(self.data.xmat[self.model.things[index]][8] > 0.98)
