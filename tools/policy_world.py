"""The table of the policy study: things of four colours, a robot that follows the target of its tool, a camera.

Everything is in metres and in the frame of the table: x away from the robot, z up, the surface at z = 0.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gcd_model.geometry import Intrinsics, look_at
from gcd_train.live.filming import FLOOR_Z_M, METRES_A_UNIT
from gcd_train.scenes.description import Colour, Doubles, Part, Point, Scene, pick, rotations, shaded, with_world
from gcd_train.scenes.drop.world import HFOV_DEG
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.tabletop.arm import (
    BASE,
    FINGER_ROOM_M,
    JOINTS,
    OPEN_M,
    STEP_S,
    arm_links,
    build_model,
    random_arm,
)
from gcd_train.scenes.tabletop.scene import TABLE_EXTENT, drawn, random_light, room
from gcd_train.scenes.tabletop.simulation import Simulation
from gcd_train.scenes.tabletop.things import (
    FLATS,
    Placed,
    Setting,
    TableThing,
    TabletopClass,
    plain,
    random_table,
    random_thing,
)
from gcd_train.scenes.triangles import freeze

Random = np.random.Generator
COLOURS: dict[str, Colour] = {
    "red": (0.80, 0.16, 0.14),
    "yellow": (0.95, 0.80, 0.20),
    "green": (0.22, 0.58, 0.27),
    "blue": (0.20, 0.26, 0.60),
}
WIDTH, HEIGHT = 192, 128
LENS = Intrinsics.from_hfov(HFOV_DEG, WIDTH, HEIGHT)
CAMERA: Doubles = look_at(
    torch.tensor([0.02 + 1.1 * math.cos(math.radians(30)), 0.0, 0.08 + 1.1 * math.sin(math.radians(30))]),
    torch.tensor([0.02, 0.0, 0.08]),
).numpy()
"""table_from_camera [4, 4] of the camera that the policy learned with: across the table, 30 degrees above it."""
DECISIONS, PERIOD_S, SPEED_M_S = 24, 0.2, 0.5
"""An episode has so many decisions at most, one every period; the tool moves at most this fast."""
LIFTED_M = 0.05
_THINGS, _TRIES = 3, 1000
_SPAN_M, _AZIMUTH = (0.30, 0.50), 0.5
"""Where things stand about the robot's base: distance, and the largest angle to either side, radians."""
_BLOCK_AT, _BLOCK_M = (0.02, 0.0), (0.36, 0.60)
"""Middle and sides of the block on which all things stand if they are raised."""
BLOCK_CORNERS = [(_BLOCK_AT[0] + _BLOCK_M[0] / 2, side * _BLOCK_M[1] / 2) for side in (-1, 1)]
"""The two that the camera sees in front, x and y in metres."""
_ARM_SEED, _TICK = 0, 4
_TRAVEL_M, _NEAR_M, _AT_M, _LIFT_M = 0.20, 0.06, 0.012, 0.13
_NOTHING_M = 0.01
_UNITS = 1 / METRES_A_UNIT["tabletop"]


class Move(NamedTuple):
    """How far a camera was moved and turned; into which direction, the episode's seed decides."""

    shift_m: float
    turn_deg: float

    def __str__(self) -> str:
        told = (f"{100 * self.shift_m:g} cm" if self.shift_m else "", f"{self.turn_deg:g}°" if self.turn_deg else "")
        return " and ".join(filter(None, told))

    def camera(self, seed: int) -> Doubles:
        """table_from_camera [4, 4]."""
        step, axis = (each / np.linalg.norm(each) for each in np.random.default_rng([seed, 0xCA]).normal(size=(2, 3)))
        move = np.eye(4)
        move[:3, :3], move[:3, 3] = (
            Rotation.from_rotvec(self.turn_deg * axis, degrees=True).as_matrix(),
            self.shift_m * step,
        )
        return CAMERA @ move


@dataclass(frozen=True, slots=True)
class Action:
    """place: where the tool shall go, [3]. opening: of each finger, metres; closed: it grips instead."""

    place: Doubles
    opening: float
    closed: bool


class Robot(Simulation):
    """The tabletop world's arm and its controller, told where to bring its tool."""

    def __init__(self, setting: Setting, start: Point, raised_m: float) -> None:
        self.model, self._travel_m = build_model(setting), raised_m + _TRAVEL_M
        super().__init__(self.model, setting.things, np.random.default_rng(0), SPEED_M_S)
        self._place, self._closed = np.asarray(start), False
        for _ in range(30):
            self._joints = self._solved(self._place, _yaw(self._place))
        self._data.qpos[self._at] = (*self._joints, OPEN_M, OPEN_M)
        self._command(self._joints)
        self._mujoco.mj_step(self.model, self._data, round(0.3 / STEP_S))
        self._mujoco.mj_forward(self.model, self._data)
        self._stood = [self._pose(index)[0][2] for index in range(len(setting.things))]

    def act(self, action: Action) -> None:
        """One period: the tool goes straight towards its place."""
        ticks = round(PERIOD_S / (_TICK * STEP_S))
        way = action.place - self._place
        step = way * min(1.0, SPEED_M_S * PERIOD_S / max(float(np.linalg.norm(way)), 1e-9)) / ticks
        self._opening, self._closed = (0.0 if action.closed else action.opening / OPEN_M), action.closed
        for _ in range(ticks):
            self._place = self._place + step
            self._joints = self._solved(self._place, _yaw(self._place))
            self._command(self._joints)
            self._mujoco.mj_step(self.model, self._data, _TICK)
        self._mujoco.mj_forward(self.model, self._data)

    @property
    def state(self) -> Doubles:
        """What a robot knows of itself: the tool's place, how far the fingers are open, whether it grips. [5]"""
        opening = float(self._data.qpos[self._at[len(JOINTS) :]].mean())
        return np.array([*self._data.site_xpos[self._site], opening, float(self._closed)])

    def lifted_m(self, index: int) -> float:
        """By how much a thing has risen."""
        return self._pose(index)[0][2] - self._stood[index]

    @property
    def empty_handed(self) -> bool:
        """Whether the fingers closed on nothing."""
        return self._closed and self.state[3] < _NOTHING_M

    def expert(self, index: int) -> Action:
        """What the world's own controller would do to take a thing: over it, down, close, lift; as feedback."""
        thing, (x, y, _) = self._things[index], self._pose(index)[0]
        tool = self._data.site_xpos[self._site]
        level = self._stood[index] + thing.grip_z
        opening = min(OPEN_M, thing.size[1] / 2 + 0.018)
        if self._closed:
            return Action(np.array([x, y, level + _LIFT_M]), opening, True)
        away = math.hypot(tool[0] - x, tool[1] - y)
        if away < _AT_M and abs(tool[2] - level) < 1.5 * _AT_M:
            return Action(np.array([x, y, level]), opening, True)
        above = max(level + 0.1, self._travel_m) - level
        return Action(np.array([x, y, level + above * min(max((away - 0.01) / _NEAR_M, 0.0), 1.0)]), opening, False)

    def poses(self) -> np.ndarray:
        """world_from_body of every body of the scene as it is drawn, [B, 3, 4]."""
        places = self._data.xpos + np.array([0.0, 0.0, FLOOR_Z_M["tabletop"]])
        return with_world(rotations(self._data.xquat)[None], _UNITS * places[None])[0]


class Bench:
    """One episode's table: things, robot, and pictures of one camera. Close it.

    highest_m: the things stand on a block, whose height is drawn up to this; 0: they stand on the table.
    """

    def __init__(self, seed: int, renderer: Renderer, camera: Doubles = CAMERA, highest_m: float = 0.0) -> None:
        random = np.random.default_rng([seed, 0xB0])
        setting, self.colours = _setting(random)
        self.target = int(random.integers(len(setting.things)))
        self.raised_m = 0.0
        if highest_m:
            setting, self.raised_m = _raised(setting, np.random.default_rng([seed, 0xB1]), highest_m)
        start = *_spot(random), self.raised_m + random.uniform(0.2, 0.32)
        self.robot = Robot(setting, start, self.raised_m)
        scene = _scene(setting, self.robot.model, random)
        self._poses, self._next = scene.poses, 0
        world_from_camera = camera.copy()
        world_from_camera[:3, 3] = _UNITS * (camera[:3, 3] + (0, 0, FLOOR_Z_M["tabletop"]))
        cameras = {"camera": np.broadcast_to(world_from_camera, (scene.frames, 4, 4))}
        self._views: Iterator[tuple[int, str, Rendering]] = renderer.views(freeze(scene), cameras)

    @property
    def instruction(self) -> int:
        """Number of the colour to take."""
        return self.colours[self.target]

    def look(self) -> tuple[np.ndarray, np.ndarray]:
        """What the camera sees now: uint8 [H, W, 3], and metres [H, W]. Once a decision, and once more."""
        self._poses[self._next] = self.robot.poses()  # the renderer reads a time step when it draws it
        self._next += 1
        view = next(self._views)[2]
        return view.rgb, view.depth / _UNITS

    @property
    def done(self) -> bool:
        """Whether the thing is lifted."""
        return self.robot.lifted_m(self.target) > LIFTED_M

    def close(self) -> None:
        self._views.close()


def _setting(random: Random) -> tuple[Setting, list[int]]:
    """A table with three things that may be taken from any side, each of one colour, and the colours' numbers."""
    numbers, placed = random.permutation(len(COLOURS))[:_THINGS].tolist(), list[Placed]()
    for tries in count():
        if len(placed) == _THINGS:
            break
        if tries % _TRIES == _TRIES - 1:  # these leave no room for another one
            placed.clear()
        thing, (x, y) = random_thing(random, 2 * OPEN_M - 0.022), _spot(random)
        room_m = thing.radius_m + FINGER_ROOM_M - 0.02
        gaps = [math.dist((x, y), each.place[:2]) - each.thing.radius_m for each in placed]
        if thing.any_yaw and all(gap > room_m for gap in gaps):
            painted = _painted(thing, list(COLOURS.values())[numbers[len(placed)]])
            placed.append(Placed(thing=painted, place=(x, y, thing.size[2] / 2 + 0.002), yaw=0.0))
    arm = random_arm(np.random.default_rng(_ARM_SEED))
    return Setting(arm=arm, table=random_table(random), clutter=(), things=tuple(placed)), numbers


def _raised(setting: Setting, random: Random, highest_m: float) -> tuple[Setting, float]:
    """The same things on a block of a random height, and that height."""
    high = random.uniform(0.0, highest_m)
    block = Part(
        *("box", (*_BLOCK_AT, high / 2), (*_BLOCK_M, high), plain(pick(random, FLATS), 0.2), TabletopClass.TABLE)
    )
    things = (replace(each, place=(*each.place[:2], each.place[2] + high)) for each in setting.things)
    return replace(setting, table=(*setting.table, block), things=tuple(things)), high


def _painted(thing: TableThing, colour: Colour) -> TableThing:
    """One colour all over, lids and caps a little darker."""
    paints = [plain(shaded(colour, 0.85 if index else 1.0), 0.3) for index in range(len(thing.parts))]
    parts = (replace(part, paint=paint) for part, paint in zip(thing.parts, paints, strict=True))
    return replace(thing, parts=tuple(parts))


def _spot(random: Random) -> tuple[float, float]:
    radius, azimuth = random.uniform(*_SPAN_M), random.uniform(-_AZIMUTH, _AZIMUTH)
    return BASE[0] + radius * math.cos(azimuth), BASE[1] + radius * math.sin(azimuth)


def _yaw(place: Doubles) -> float:
    """Of the tool, radians: its x axis points back to the base."""
    return math.atan2(place[1] - BASE[1], place[0] - BASE[0]) + math.pi


def _scene(setting: Setting, model: object, random: Random) -> Scene:
    """As the tabletop world draws it, with room for every decision's poses."""
    walls, floor = room(random)
    parts = [piece.of(instance=0, body=1) for part in setting.table for piece in drawn(part)]
    things = [(each.thing, model.body(f"thing_{index}").id) for index, each in enumerate(setting.things)]
    for thing, body in (*things, *((link, body) for link, body, _ in arm_links(model))):
        parts += [piece.of(instance=0, body=1 + body) for part in thing.parts for piece in drawn(part)]
    frames = DECISIONS + 1
    return Scene(
        parts=(*walls, *parts),
        sheets=(floor,),
        poses=np.zeros((frames, 1 + model.nbody, 3, 4), np.float32),
        focus=np.tile(np.array([[0.0, 0.0, 1.0]], np.float32), (frames, 1)),
        cameras={},
        hfov_deg=HFOV_DEG,
        light=random_light(random),
        extent=replace(TABLE_EXTENT, shadow_pixels=1024),
    )
