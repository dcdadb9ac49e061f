"""The tabletop world: one seed, one clip of an arm at work, seen by Kubric-4D's sixteen cameras.

One unit of the scene is a decimetre, so that Kubric-4D's bounds (cameras 12 to 18 units about (0, 0, 1)) fit a table;
the physics behind it runs in metres.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Extent, Part, Point, Scene, SceneObject, rotations
from gcd_train.scenes.drop import HFOV_DEG, orbit_cameras
from gcd_train.scenes.tabletop.arm import BASE, Model, arm_links, build_model
from gcd_train.scenes.tabletop.furniture import TABLE_Z_M, UNITS_A_METRE, random_light, room
from gcd_train.scenes.tabletop.simulation import Motion, Simulation
from gcd_train.scenes.tabletop.tasks import random_setting
from gcd_train.scenes.tabletop.things import Placed, Setting, TabletopClass, Thing

_EXTENT = Extent(near_m=0.2, far_m=150.0, shadow_radius_m=12.0, shadow_depth_m=40.0, shadow_pixels=2048)
_TABLE = 1
"""The scene's body that carries table, clutter and, one number further each, the bodies of the physics model."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Episode:
    """A clip of the tabletop world with what a robot would have logged.

    scene: in decimetres. motion: in metres, in the frame of the table. wrist: [T, 4, 4], world_from_camera of a camera
    in the hand, decimetres. world_from_base: [4, 4], decimetres. task: in words.
    """

    scene: Scene
    motion: Motion
    wrist: Floats
    world_from_base: Floats
    task: str


def tabletop_scene(seed: int, *, frames: int = 60) -> Scene:
    """A scene that depends on nothing but its arguments.

    Args:
        seed: 0 or more.
        frames: time steps at 24 Hz.
    Raises:
        RenderError: MuJoCo is not installed.
    """
    return tabletop_episode(seed, frames=frames).scene


def tabletop_episode(seed: int, *, frames: int = 60, skipped_s: float | None = None) -> Episode:
    """As `tabletop_scene`, with the robot's log.

    skipped_s: how much of the work has passed when the clip begins; by default up to 1.4 s, drawn from the seed.
    """
    random = np.random.default_rng([seed, 0x7AB])
    setting = random_setting(random)
    model = build_model(setting)
    drawn_s, speed = float(random.uniform(0, 1.4)), float(random.uniform(0.5, 0.9))
    motion = Simulation(model, setting.things, random, speed).run(frames, drawn_s if skipped_s is None else skipped_s)
    world_from_table = _table_pose(float(random.uniform(-math.pi, math.pi)))
    walls, sheets = room(random)
    task, counted = _in_words(motion, setting), _counted(model, setting)
    scene = Scene(
        parts=(*walls, *_parts(setting, counted)),
        sheets=sheets,
        poses=_poses(motion, world_from_table),
        focus=np.tile(np.array([[0.0, 0.0, 1.0]], np.float32), (frames, 1)),
        cameras=orbit_cameras(frames),
        hfov_deg=HFOV_DEG,
        light=random_light(random),
        facts=_facts(seed, setting, motion) | {"task": task},
        objects=tuple(each.as_object(i, motion, world_from_table) for i, each in enumerate(counted, start=1)),
        extent=_EXTENT,
    )
    return Episode(
        scene=scene,
        motion=motion,
        wrist=_in_units(world_from_table @ motion.tool @ _hand_from_camera()),
        world_from_base=_world_from_base(world_from_table),
        task=task,
    )


@dataclass(frozen=True, slots=True)
class _Counted:
    """A thing, a link or a piece of clutter; its instance is its number from 1 on.

    body: of the physics model. stands: where on the table, of clutter, which has no body of its own.
    """

    thing: Thing
    label: TabletopClass
    body: int
    stands: Placed | None = None

    def parts(self, instance: int) -> Iterator[Part]:
        """Its parts, in scene units."""
        for part in self.thing.parts:
            for piece in _drawn(part):
                counted = piece.of(instance=instance, body=_TABLE + self.body)
                if self.stands is not None:
                    x, y, z = _scaled(self.stands.place)
                    counted = counted.placed(x, y, z, self.stands.yaw)
                yield counted

    def as_object(self, instance: int, motion: Motion, world_from_table: Floats) -> SceneObject:
        """What metadata tells of it."""
        turn = world_from_table[:3, :3]
        if self.stands is None:
            positions = _moved(world_from_table, motion.positions[:, self.body])
            quaternions, velocities = motion.quaternions[:, self.body], motion.velocities[:, self.body] @ turn.T
            angular_velocities = motion.angular_velocities[:, self.body] @ turn.T
        else:
            frames, half = len(motion.steps), self.stands.yaw / 2
            positions = np.tile(_moved(world_from_table, np.asarray(self.stands.place)), (frames, 1))
            quaternions = np.tile([math.cos(half), 0.0, 0.0, math.sin(half)], (frames, 1))
            velocities = angular_velocities = np.zeros((frames, 3))
        return SceneObject(
            name=self.thing.name if self.stands is None else f"clutter/{self.thing.name}",
            instance=instance,
            body=_TABLE + self.body,
            label=self.label,
            size=_scaled(self.thing.size),
            middle=_scaled(self.thing.middle),
            dynamic=self.stands is None,
            mass_kg=self.thing.mass_kg,
            friction=self.thing.friction,
            restitution=0.0,
            positions=UNITS_A_METRE * positions,
            quaternions=_turned(world_from_table, quaternions),
            velocities=UNITS_A_METRE * velocities,
            angular_velocities=angular_velocities,
        )


def _counted(model: Model, setting: Setting) -> list[_Counted]:
    """Things, links and clutter."""
    things = [
        _Counted(placed.thing, TabletopClass.OBJECT, body)
        for placed, body in zip(setting.things, model.things, strict=True)
    ]
    links = [_Counted(link, label, body) for link, body, label in arm_links(model)]
    return [*things, *links, *(_Counted(each.thing, TabletopClass.CLUTTER, 0, each) for each in setting.clutter)]


def _parts(setting: Setting, counted: list[_Counted]) -> Iterator[Part]:
    """The table, and all that is counted, in scene units."""
    for part in setting.table:
        yield from (piece.of(instance=0, body=_TABLE) for piece in _drawn(part))
    for instance, each in enumerate(counted, start=1):
        yield from each.parts(instance)


def _drawn(part: Part) -> Iterator[Part]:
    """What is drawn of a part, in scene units; a capsule is a cylinder and two spheres."""
    scaled = replace(part, centre=_scaled(part.centre), size=_scaled(part.size), grain_m=part.grain_m * UNITS_A_METRE)
    if part.shape != "capsule":
        yield scaled
        return
    yield replace(scaled, shape="cylinder")
    centre, half = np.asarray(part.centre), part.size[2] / 2
    along = rotations(np.asarray(part.turn))[:, 2]
    for end in (centre - half * along, centre + half * along):
        x, y, z = end.tolist()
        yield replace(scaled, shape="sphere", centre=_scaled((x, y, z)), size=(scaled.size[0],) * 3)


def _poses(motion: Motion, world_from_table: Floats) -> NDArray[np.float32]:
    """world_from_body [T, 1 + B, 3, 4]: the world, then the physics model's bodies, its own world being the table."""
    frames, bodies = motion.positions.shape[:2]
    poses = np.zeros((frames, 1 + bodies, 3, 4))
    poses[:, 0, :, :3] = np.eye(3)
    poses[:, 1:, :, :3] = world_from_table[:3, :3] @ rotations(motion.quaternions)
    poses[:, 1:, :, 3] = UNITS_A_METRE * _moved(world_from_table, motion.positions)
    return poses.astype(np.float32)


def _table_pose(yaw: float) -> Floats:
    """world_from_table [4, 4]: turned about the vertical, metres."""
    turn = np.eye(4)
    turn[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    turn[2, 3] = TABLE_Z_M
    return turn


def _world_from_base(world_from_table: Floats) -> Floats:
    """[4, 4], decimetres."""
    table_from_base = np.eye(4)
    table_from_base[:3, 3] = BASE
    return _in_units(world_from_table @ table_from_base)


def upright_base() -> Floats:
    """world_from_base [4, 4] of an arm whose table is not turned, decimetres."""
    return _world_from_base(_table_pose(0.0))


def _hand_from_camera() -> Floats:
    """A camera before the palm that looks past the fingers: in the tool's frame, metres."""
    eye, target = np.array([-0.11, 0.0, -0.17]), np.array([0.0, 0.0, 0.02])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.array([0.0, 1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], -1)
    pose[:3, 3] = eye
    return pose


def _in_units(poses: Floats) -> Floats:
    """Metres to decimetres."""
    scaled = poses.copy()
    scaled[..., :3, 3] *= UNITS_A_METRE
    return scaled


def _scaled(point: Point) -> Point:
    return point[0] * UNITS_A_METRE, point[1] * UNITS_A_METRE, point[2] * UNITS_A_METRE


def _moved(world_from_table: Floats, points: Floats) -> Floats:
    """Points [..., 3] of the table's frame in the world."""
    return points @ world_from_table[:3, :3].T + world_from_table[:3, 3]


def _turned(world_from_table: Floats, quaternions: Floats) -> Floats:
    """What each becomes after the table's turn; w, x, y, z."""
    half = math.atan2(world_from_table[1, 0], world_from_table[0, 0]) / 2
    c, s = math.cos(half), math.sin(half)
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)


def _facts(seed: int, setting: Setting, motion: Motion) -> dict[str, float | str]:
    return {
        "seed": seed,
        "arm": "primitive",
        "arm_licence": "Apache-2.0 (part of gcd-node)",
        "metres_a_unit": 1 / UNITS_A_METRE,
        "objects": len(setting.things),
        "clutter": len(setting.clutter),
        "grasps": len(motion.grasps),
        "grasps_held": sum(grasp.held for grasp in motion.grasps),
        "steps": " ".join(step for step, _ in groupby(motion.steps)),
    }


def _in_words(motion: Motion, setting: Setting) -> str:
    verbs = {"lift": "pick up the {} and place it elsewhere", "push": "push the {} aside"}
    told = [verbs[name].format(setting.things[index].thing.name) for name, index in motion.tasks]
    return ", then ".join(told) or "move over the table"
