"""The running world: the controller follows the planned steps, the physics answers, frames are kept."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from gcd_train.errors import RenderError
from gcd_train.scenes.description import Doubles as Floats
from gcd_train.scenes.description import Tracks
from gcd_train.scenes.tabletop.arm import BASE, HOME, OPEN_M, STEP_S, Model
from gcd_train.scenes.tabletop.tasks import Planner, Step
from gcd_train.scenes.tabletop.things import Placed

FPS = 24.0
_STEPS_A_TICK = 4
_TICK_S = _STEPS_A_TICK * STEP_S
_TICKS_A_FRAME = round(1 / (FPS * _TICK_S))
_SETTLE_S = 0.5
_LEAD_S = 0.03
"""Joints are told where to be a little later, since they follow with this delay."""
_SLIP_M = 0.03


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


@dataclass(frozen=True, kw_only=True, slots=True)
class Motion:
    """What happened, a row a frame; metres, radians, seconds, in the frame of the table.

    tracks: of all bodies of the model. tool: [T, 4, 4], table_from_tool. state, action: [T, J + 2], joints and fingers:
    where they are and where they are told to be. steps: name of the step of each frame.
    """

    tracks: Tracks
    tool: Floats
    state: Floats
    action: Floats
    steps: tuple[str, ...]
    grasps: tuple[Grasp, ...]
    tasks: tuple[tuple[str, int], ...]


class Simulation:
    """One run. `model`: built of `things`; `speed`: of the tool, metres a second."""

    def __init__(self, model: Model, things: tuple[Placed, ...], random: np.random.Generator, speed: float) -> None:
        self._m, self._data = model, model.mujoco.MjData(model.model)
        self._solver, self._joints = _ToolSolver(model), np.asarray(HOME)
        self._planner = Planner(model, self._data, things, random, speed)
        self._opening = 1.0
        self._watch = _Watch(model, self._data)
        self._rows: list[tuple[Floats, ...]] = []
        self._names: list[str] = []

    def run(self, frames: int, skipped_s: float) -> Motion:
        """Let things settle, let `skipped_s` of work pass unseen, then keep `frames`.

        Raises: RenderError if the physics became unstable.
        """
        m, data = self._m, self._data
        data.qpos[m.joints], data.qpos[m.fingers] = self._joints, OPEN_M
        self._command(self._joints)
        m.mujoco.mj_step(m.model, data, round(_SETTLE_S / STEP_S))
        first = round(skipped_s / _TICK_S)
        self._watch.clock = -first * _TICK_S
        for tick, step in enumerate(self._followed()):
            if tick >= first and (tick - first) % _TICKS_A_FRAME == 0:
                self._keep(step)
            if len(self._names) == frames:
                break
            m.mujoco.mj_step(m.model, data, _STEPS_A_TICK)
            self._watch.tick()
        self._watch.end()
        faults = m.mujoco.mjtWarning  # MuJoCo starts a diverging simulation anew and only counts that
        kinds = (faults.mjWARN_BADQPOS, faults.mjWARN_BADQVEL, faults.mjWARN_BADQACC)
        if any(data.warning[int(kind)].number for kind in kinds):
            raise RenderError("the physics of this tabletop scene became unstable; leave its seed out")
        positions, quaternions, rates, tool, state, action = (np.stack(rows) for rows in zip(*self._rows, strict=True))
        tracks = Tracks(
            positions=positions, quaternions=quaternions, velocities=rates[..., 3:], angular_velocities=rates[..., :3]
        )
        return Motion(
            tracks=tracks,
            tool=tool,
            state=state,
            action=action,
            steps=tuple(self._names),
            grasps=tuple(self._watch.grasps),
            tasks=tuple(self._watch.tasks),
        )

    def _followed(self) -> Iterator[Step]:
        """The step in force at every tick, for ever; the actuators have their targets when it is yielded."""
        m = self._m
        here = _polar(self._data.site_xpos[m.site])
        yaw = math.atan2(*self._data.site_xmat[m.site][[3, 0]].tolist())
        for step in self._planner.steps():
            self._watch.begin(step)
            goal, turn = _polar(np.asarray(step.place)), yaw + (step.yaw - yaw + math.pi) % (2 * math.pi) - math.pi
            opening = self._opening
            ticks = max(1, math.ceil(step.seconds / _TICK_S))
            for tick in range(1, ticks + 1):
                share = tick / ticks
                share = share**3 * (10 - 15 * share + 6 * share**2)  # minimum jerk: at rest at both ends
                self._opening = opening + share * (step.opening - opening)
                place = _from_polar(here + share * (goal - here))
                before = self._joints
                self._joints = self._solver.solve(before, place, yaw + share * (turn - yaw))
                self._command(self._joints + (self._joints - before) * (_LEAD_S / _TICK_S))
                yield step
            here, yaw = goal, turn

    def _command(self, joints: Floats) -> None:
        m = self._m
        self._data.ctrl[m.controls] = joints
        self._data.ctrl[m.grips] = self._opening * OPEN_M

    def _keep(self, step: Step) -> None:
        m, data = self._m, self._data
        m.mujoco.mj_forward(m.model, data)
        rates = np.zeros((m.model.nbody, 6))
        for body in range(m.model.nbody):
            m.mujoco.mj_objectVelocity(m.model, data, m.mujoco.mjtObj.mjOBJ_BODY, body, rates[body], 0)
        tool = np.eye(4)
        tool[:3, :3], tool[:3, 3] = data.site_xmat[m.site].reshape(3, 3), data.site_xpos[m.site]
        state = data.qpos[np.concatenate([m.joints, m.fingers])].copy()
        action = np.concatenate([self._joints, data.ctrl[m.grips]])
        self._rows.append((data.xpos.copy(), data.xquat.copy(), rates, tool, state, action))
        self._names.append(step.name)


class _Watch:
    """Looks at whether what was grasped follows the hand."""

    def __init__(self, model: Model, data: Any) -> None:
        self._m, self._data = model, data
        self.clock = 0.0
        self.grasps: list[Grasp] = []
        self.tasks: list[tuple[str, int]] = []
        self._thing, self._offset = -1, np.zeros(3)
        self._low, self._lifted, self._slip = 0.0, math.nan, 0.0

    def begin(self, step: Step) -> None:
        """A step begins: at the lift the fingers have closed, at the opening the grasp ends."""
        if step.name == "lift":
            self._thing, self._slip, self._lifted = step.thing, 0.0, math.nan
            self._offset, self._low = self._in_hand(), self._height()
        if step.name == "carry":
            self._lifted = self._height() - self._low
        if step.name in ("lift", "push") and self.clock > -0.3:
            self.tasks.append((step.name, step.thing))
        if step.name == "open":
            self.end()

    def tick(self) -> None:
        """A tick has passed."""
        self.clock += _TICK_S
        if self._thing >= 0:
            self._slip = max(self._slip, float(np.linalg.norm(self._in_hand() - self._offset)))

    def end(self) -> None:
        """The grasp is over; one that never got to the end of the lift does not count."""
        if self._thing >= 0 and not math.isnan(self._lifted):
            self.grasps.append(Grasp(thing=self._thing, lifted=self._lifted, slip=self._slip))
        self._thing = -1

    def _in_hand(self) -> Floats:
        """The thing's origin in the tool's frame."""
        data, site = self._data, self._m.site
        turned = data.site_xmat[site].reshape(3, 3)
        return turned.T @ (data.xpos[self._m.things[self._thing]] - data.site_xpos[site])

    def _height(self) -> float:
        return float(self._data.xpos[self._m.things[self._thing]][2])


def _polar(place: Floats) -> Floats:
    """Azimuth, distance and height about the base: the arm's own way of moving."""
    x, y = place[0] - BASE[0], place[1] - BASE[1]
    return np.array([math.atan2(y, x), math.hypot(x, y), place[2]])


def _from_polar(polar: Floats) -> Floats:
    azimuth, radius, height = polar
    return np.array([BASE[0] + radius * math.cos(azimuth), BASE[1] + radius * math.sin(azimuth), height])


_ROUNDS, _DAMPING, _LARGEST_TURN, _HOMING = 2, 0.03, 0.25, 0.02


class _ToolSolver:
    """Damped least squares on the arm's Jacobian, from wherever the joints were last.

    Source: Buss and Kim, "Selectively damped least squares for inverse kinematics" (2005), section 2: the plain damped
    form, with the pull towards the home pose in the null space.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self._data = model.mujoco.MjData(model.model)
        self._home = np.asarray(HOME)
        self._limits = model.model.jnt_range[model.model.dof_jntid[model.rates]].T

    def solve(self, joints: Floats, place: Floats, yaw: float) -> Floats:
        """Joint angles [J] nearer to the tool at `place` [3], pointing down, its x axis at `yaw` radians."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        wanted = np.array([[cos, sin, 0.0], [sin, -cos, 0.0], [0.0, 0.0, -1.0]])  # the tool's axes as columns
        for _ in range(_ROUNDS):
            error, jacobian = self._seen_from(joints, place, wanted)
            square = jacobian @ jacobian.T + _DAMPING**2 * np.eye(6)
            pull = _HOMING * (self._home - joints)
            move = pull + jacobian.T @ np.linalg.solve(square, error - jacobian @ pull)
            joints = np.clip(joints + np.clip(move, -_LARGEST_TURN, _LARGEST_TURN), *self._limits)
        return joints

    def _seen_from(self, joints: Floats, place: Floats, wanted: Floats) -> tuple[Floats, Floats]:
        """What is missing in place and turn [6], and the Jacobian [6, J]."""
        m, model, data = self._model, self._model.model, self._data
        data.qpos[m.joints] = joints
        m.mujoco.mj_kinematics(model, data)
        m.mujoco.mj_comPos(model, data)
        jacobian = np.zeros((6, model.nv))
        m.mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], m.site)
        turned = data.site_xmat[m.site].reshape(3, 3)
        twist = 0.5 * np.cross(turned, wanted, axis=0).sum(1)
        return np.concatenate([place - data.site_xpos[m.site], twist]), jacobian[:, m.rates]
