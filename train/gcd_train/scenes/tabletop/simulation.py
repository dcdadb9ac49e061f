"""The arm at work: tasks become steps of its tool, the controller follows them, the physics answers, frames are kept.

A task is planned when the last one is done, from where things are by then.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gcd_train.errors import RenderError
from gcd_train.scenes.description import Doubles, Point, Tracks
from gcd_train.scenes.drop.world import load_mujoco
from gcd_train.scenes.tabletop.arm import (
    BASE,
    FINGER_ROOM_M,
    FINGERS,
    HOME,
    JOINTS,
    OPEN_M,
    STEP_S,
    is_reachable,
    reachable_spot,
)
from gcd_train.scenes.tabletop.things import Placed

FPS = 24.0
_STEPS_A_TICK = 4
_TICK_S = _STEPS_A_TICK * STEP_S
_TICKS_A_FRAME = round(1 / (FPS * _TICK_S))
_SETTLE_S = 0.5
_LEAD_S = 0.03
"""Joints are told where to be a little later, since they follow with this delay."""
_SLIP_M = 0.03
_LOWEST_M, _ABOVE_M = 0.021, 0.11
_ROUNDS, _DAMPING, _LARGEST_TURN, _HOMING = 2, 0.03, 0.25, 0.02


class Step(NamedTuple):
    """One leg of the way: where the tool is at its end, metres, its x axis at `yaw` radians.

    name: reach, descend, close, lift, carry, lower, open, retreat, push or wait. opening: of the gripper at the end,
    0..1. thing: index of what it is about, -1 for none.
    """

    name: str
    place: Point
    yaw: float
    opening: float
    thing: int = -1


@dataclass(frozen=True, kw_only=True, slots=True)
class Grasp:
    """One attempt to hold a thing.

    thing: index. lifted: by how much it had risen at the end of the lift, metres. slip: the most by which it moved in
    the hand until it was put down or the clip ended.
    """

    thing: int
    lifted: float
    slip: float

    @property
    def held(self) -> bool:
        """Whether it followed the gripper."""
        return self.lifted > 0.05 and self.slip < _SLIP_M


@dataclass(frozen=True, slots=True)
class Motion:
    """What happened, a row a frame; metres, radians, seconds, in the frame of the table.

    tracks: of all bodies of the model. tool: [T, 4, 4], table_from_tool. state, action: [T, J + 2], joints and fingers:
    where they are and where they are told to be. steps: name of the step of each frame.
    """

    tracks: Tracks
    tool: Doubles
    state: Doubles
    action: Doubles
    steps: tuple[str, ...]
    grasps: tuple[Grasp, ...]
    tasks: tuple[tuple[str, int], ...]


class Simulation:
    """One run. `model`: see `build_model`; `things`: in it; `speed`: of the tool, metres a second."""

    def __init__(self, model: Any, things: tuple[Placed, ...], random: np.random.Generator, speed: float) -> None:
        self._mujoco, self._model = load_mujoco(), model
        self._things, self._random, self._speed = [each.thing for each in things], random, speed
        self._data, self._scratch = self._mujoco.MjData(model), self._mujoco.MjData(model)
        # where joints and fingers are in qpos, and joints in qvel; their actuators; bodies of the things; the tool
        self._at = [model.joint(name).qposadr[0] for name in (*JOINTS, *FINGERS)]
        self._rates = [model.joint(name).dofadr[0] for name in JOINTS]
        self._controls = [model.actuator(name).id for name in (*JOINTS, *FINGERS)]
        self._bodies = [model.body(f"thing_{index}").id for index in range(len(things))]
        self._site = model.site("tool").id
        self._joints, self._opening, self._clock = np.asarray(HOME), 1.0, 0.0  # seconds since the first frame
        self._rows: list[tuple[Any, ...]] = []
        # of the thing in the hand: its index, its place there and its height at first, and what became of it
        self._held, self._offset, self._low, self._lifted, self._slip = -1, np.zeros(3), 0.0, math.nan, 0.0
        self._grasps: list[Grasp] = []
        self._tasks: list[tuple[str, int]] = []

    def run(self, frames: int, skipped_s: float) -> Motion:
        """Let things settle, let `skipped_s` of work pass unseen, then keep `frames`.

        Raises: RenderError if the physics became unstable.
        """
        mujoco, data = self._mujoco, self._data
        data.qpos[self._at] = (*self._joints, OPEN_M, OPEN_M)
        self._command(self._joints)
        mujoco.mj_step(self._model, data, round(_SETTLE_S / STEP_S))
        first = round(skipped_s / _TICK_S)
        self._clock = -first * _TICK_S
        for tick, step in enumerate(self._followed()):
            if tick >= first and (tick - first) % _TICKS_A_FRAME == 0:
                self._keep(step)
            if len(self._rows) == frames:
                break
            mujoco.mj_step(self._model, data, _STEPS_A_TICK)
            self._clock += _TICK_S
            if self._held >= 0:
                self._slip = max(self._slip, float(np.linalg.norm(self._in_hand() - self._offset)))
        self._end_grasp()
        faults = mujoco.mjtWarning  # MuJoCo starts a diverging simulation anew and only counts that
        kinds = (faults.mjWARN_BADQPOS, faults.mjWARN_BADQVEL, faults.mjWARN_BADQACC)
        if any(data.warning[int(kind)].number for kind in kinds):
            raise RenderError("the physics of this tabletop scene became unstable; leave its seed out")
        *rows, names = zip(*self._rows, strict=True)
        positions, quaternions, rates, tool, state, action = map(np.stack, rows)
        tracks = Tracks(
            positions=positions, quaternions=quaternions, velocities=rates[..., 3:], angular_velocities=rates[..., :3]
        )
        return Motion(tracks, tool, state, action, names, tuple(self._grasps), tuple(self._tasks))

    def _followed(self) -> Iterator[Step]:
        """The step in force at every tick, for ever; the actuators have their targets when it is yielded."""
        x, y, z = self._data.site_xpos[self._site].tolist()
        place: Point = (x, y, z)
        here, yaw = _polar(place), math.atan2(*self._data.site_xmat[self._site][[3, 0]].tolist())
        while True:
            for step in self._next_task(place):
                self._begin(step)
                goal, turn = _polar(step.place), yaw + (step.yaw - yaw + math.pi) % (2 * math.pi) - math.pi
                opening = self._opening
                ticks = max(1, math.ceil(max(0.22, math.dist(step.place, place) / self._speed) / _TICK_S))
                for tick in range(1, ticks + 1):
                    share = tick / ticks
                    share = share**3 * (10 - 15 * share + 6 * share**2)  # minimum jerk: at rest at both ends
                    self._opening = opening + share * (step.opening - opening)
                    before, (azimuth, radius, height) = self._joints, here + share * (goal - here)
                    at = np.array([BASE[0] + radius * math.cos(azimuth), BASE[1] + radius * math.sin(azimuth), height])
                    self._joints = self._solved(at, yaw + share * (turn - yaw))
                    self._command(self._joints + (self._joints - before) * (_LEAD_S / _TICK_S))
                    yield step
                here, yaw, place = goal, turn, step.place

    def _solved(self, place: Doubles, yaw: float) -> Doubles:
        """Joint angles [J] nearer to the tool at `place` [3], pointing down, its x axis at `yaw` radians.

        Damped least squares on the arm's Jacobian, from wherever the joints were last. Source: Buss and Kim,
        "Selectively damped least squares for inverse kinematics" (2005), section 2: the plain damped form, with the
        pull towards the home pose in the null space.
        """
        mujoco, model, data, joints = self._mujoco, self._model, self._scratch, self._joints
        limits, cos, sin = model.jnt_range[model.dof_jntid[self._rates]].T, np.cos(yaw), np.sin(yaw)
        wanted = np.array([[cos, sin, 0.0], [sin, -cos, 0.0], [0.0, 0.0, -1.0]])  # the tool's axes as columns
        for _ in range(_ROUNDS):
            data.qpos[self._at[: len(joints)]] = joints
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            full = np.zeros((6, model.nv))
            mujoco.mj_jacSite(model, data, full[:3], full[3:], self._site)
            twist = 0.5 * np.cross(data.site_xmat[self._site].reshape(3, 3), wanted, axis=0).sum(1)
            error, jacobian = np.concatenate([place - data.site_xpos[self._site], twist]), full[:, self._rates]
            square = jacobian @ jacobian.T + _DAMPING**2 * np.eye(6)
            pull = _HOMING * (np.asarray(HOME) - joints)
            move = pull + jacobian.T @ np.linalg.solve(square, error - jacobian @ pull)
            joints = np.clip(joints + np.clip(move, -_LARGEST_TURN, _LARGEST_TURN), *limits)
        return joints

    def _command(self, joints: Doubles) -> None:
        self._data.ctrl[self._controls] = (*joints, *(2 * [self._opening * OPEN_M]))

    def _keep(self, step: Step) -> None:
        mujoco, model, data = self._mujoco, self._model, self._data
        mujoco.mj_forward(model, data)
        rates = np.zeros((model.nbody, 6))
        for body, row in enumerate(rates):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, row, 0)
        tool = np.eye(4)
        tool[:3, :3], tool[:3, 3] = data.site_xmat[self._site].reshape(3, 3), data.site_xpos[self._site]
        action = np.concatenate([self._joints, data.ctrl[self._controls[len(JOINTS) :]]])
        state = data.qpos[self._at].copy()
        self._rows.append((data.xpos.copy(), data.xquat.copy(), rates, tool, state, action, step.name))

    # whether what was grasped follows the hand

    def _begin(self, step: Step) -> None:
        """A step begins: at the lift the fingers have closed, at the opening the grasp ends."""
        if step.name == "lift":
            self._held, self._slip, self._lifted = step.thing, 0.0, math.nan
            self._offset, self._low = self._in_hand(), self._pose(step.thing)[0][2]
        if step.name == "carry":
            self._lifted = self._pose(self._held)[0][2] - self._low
        if step.name in ("lift", "push") and self._clock > -0.3:
            self._tasks.append((step.name, step.thing))
        if step.name == "open":
            self._end_grasp()

    def _end_grasp(self) -> None:
        """The grasp is over; one that never got to the end of the lift does not count."""
        if self._held >= 0 and not math.isnan(self._lifted):
            self._grasps.append(Grasp(thing=self._held, lifted=self._lifted, slip=self._slip))
        self._held = -1

    def _in_hand(self) -> Doubles:
        """The held thing's origin in the tool's frame."""
        data, site = self._data, self._site
        return data.site_xmat[site].reshape(3, 3).T @ (data.xpos[self._bodies[self._held]] - data.site_xpos[site])

    # tasks: chosen at random and turned into steps, from where things are by now

    def _next_task(self, here: Point) -> list[Step]:
        """Its steps; the arm at `here` waits where nothing can be done."""
        order = self._random.permutation(len(self._things)).tolist()
        if self._random.random() < 0.25:
            pushed = next((i for i in order if self._push(i)), None)
            if pushed is not None:
                return self._push(pushed)
        for i in order:
            (x, y, z), _ = self._pose(i)
            stands = self._data.xmat[self._bodies[i]][8] > 0.98 and abs(z - self._things[i].size[2] / 2) < 0.01
            if stands and is_reachable(x, y) and self._clearance(np.array([x, y]), i) > 0.06:
                return self._pick_and_place(i)
        return [Step("wait", here, _natural_yaw(here), 1.0)]

    def _pick_and_place(self, index: int) -> list[Step]:
        thing = self._things[index]
        (x, y, z), yaw = self._pose(index)
        level = max(z + thing.grip_z, _LOWEST_M)
        above, grip = max(level + _ABOVE_M, 0.16), (x, y, level)
        natural = _natural_yaw(grip)
        if thing.any_yaw:
            turn = natural + self._random.uniform(-0.4, 0.4)
        else:  # fingers across the thing's y axis, with the least turn of the wrist
            turn = natural + (yaw - natural + math.pi / 2) % math.pi - math.pi / 2
        lifted = level + self._random.uniform(0.10, 0.17)
        apart, to_x, to_y = max(FINGER_ROOM_M, thing.radius_m + 0.03), x, y
        for spot in [reachable_spot(self._random) for _ in range(40)]:  # near by, with room for the thing and the hand
            way = math.hypot(spot[0] - x, spot[1] - y)
            if 0.12 < way < 0.45 and self._clearance(np.array(spot), index) > apart:
                to_x, to_y = spot
                break
        carried, down = (to_x, to_y, lifted), (to_x, to_y, level + 0.003)
        turned = _natural_yaw(carried) + (turn - natural) * self._random.uniform(0, 1)
        opening = min(1.0, (thing.size[1] / 2 + 0.018) / OPEN_M)
        return [
            Step("reach", (x, y, above), turn, opening, index),
            Step("descend", grip, turn, opening, index),
            Step("close", grip, turn, 0.0, index),
            Step("lift", (x, y, lifted), turn, 0.0, index),
            Step("carry", carried, turned, 0.0, index),
            Step("lower", down, turned, 0.0, index),
            Step("open", down, turned, opening, index),
            Step("retreat", (to_x, to_y, above), turned, opening, index),
        ]

    def _push(self, index: int) -> list[Step]:
        """A thing is pushed with closed fingers, sideways to the arm, if there is room; no steps else."""
        (x, y, z), _ = self._pose(index)
        radius, low = self._things[index].radius_m, max(_LOWEST_M, min(z, 0.05))
        for turn in self._random.permutation([0.5 * math.pi, -0.5 * math.pi, 0.25 * math.pi, -0.25 * math.pi]).tolist():
            yaw = math.atan2(y - BASE[1], x - BASE[0]) + turn
            ahead = np.array([math.cos(yaw), math.sin(yaw)])
            before, after = np.array([x, y]) - (radius + 0.035) * ahead, np.array([x, y]) + (0.10 - radius) * ahead
            inside = is_reachable(*before) and is_reachable(*after)
            free = self._clearance(before, index) > 0.06 and self._clearance(after + radius * ahead, index) > 0.03
            if inside and free:
                (x, y), (to_x, to_y) = before.tolist(), after.tolist()
                return [
                    Step("reach", (x, y, low + 0.13), yaw, 0.1, index),
                    Step("descend", (x, y, low), yaw, 0.1, index),
                    Step("push", (to_x, to_y, low), yaw, 0.1, index),
                    Step("retreat", (to_x, to_y, low + 0.13), yaw, 0.1, index),
                ]
        return []

    def _clearance(self, spot: Doubles, but: int) -> float:
        """Distance from a point of the table to the nearest other loose thing's circle, metres."""
        gaps = [
            math.hypot(*(spot - np.array(self._pose(i)[0][:2]))) - thing.radius_m
            for i, thing in enumerate(self._things)
            if i != but
        ]
        return min(gaps, default=1.0)

    def _pose(self, index: int) -> tuple[Point, float]:
        """Place and yaw of a thing now."""
        body = self._bodies[index]
        x, y, z = self._data.xpos[body].tolist()
        turned = self._data.xmat[body].reshape(3, 3)
        return (x, y, z), math.atan2(turned[1, 0], turned[0, 0])


def _polar(place: Point) -> Doubles:
    """Azimuth, distance and height about the base: the arm's own way of moving."""
    x, y = place[0] - BASE[0], place[1] - BASE[1]
    return np.array([math.atan2(y, x), math.hypot(x, y), place[2]])


def _natural_yaw(place: Point) -> float:
    """The tool's yaw when the wrist is not turned: its x axis points back to the base."""
    return math.atan2(place[1] - BASE[1], place[0] - BASE[0]) + math.pi
