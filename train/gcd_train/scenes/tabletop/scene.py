"""The tabletop world: one seed, one clip of an arm at work, seen by Kubric-4D's sixteen cameras.

One unit of the scene is a decimetre, so that Kubric-4D's bounds (cameras 12 to 18 units about (0, 0, 1)) fit a table;
the physics behind it runs in metres.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Extent, Scene, rotations
from gcd_train.scenes.drop import HFOV_DEG, orbit_cameras
from gcd_train.scenes.tabletop.arm import random_arm
from gcd_train.scenes.tabletop.furniture import random_clutter, random_light, random_table, room
from gcd_train.scenes.tabletop.layout import random_things
from gcd_train.scenes.tabletop.model import BASE, Model, build_model
from gcd_train.scenes.tabletop.objects import UNITS_A_METRE, Setting, moved, objects, parts
from gcd_train.scenes.tabletop.simulation import Motion, Simulation
from gcd_train.scenes.tabletop.things import Placed

TABLE_M = -0.12
"""Height of the table's surface in the world, metres: arm and things are then in the middle of the pictures."""
_EXTENT = Extent(near_m=0.2, far_m=150.0, shadow_radius_m=12.0, shadow_depth_m=40.0, shadow_pixels=2048)

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Episode:
    """A clip of the tabletop world with what a robot would have logged.

    scene: in decimetres. joint_names, state, action: [T, J], radians and metres: where joints and fingers are and are
    told to be. wrist: [T, 4, 4], world_from_camera of a camera in the hand, decimetres. world_from_base: [4, 4],
    decimetres. task: in words. motion: in metres, in the frame of the table.
    """

    scene: Scene
    joint_names: tuple[str, ...]
    state: Floats
    action: Floats
    wrist: Floats
    world_from_base: Floats
    task: str
    motion: Motion


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
    robot = random_arm(random)
    table, clutter = random_table(random), random_clutter(random)
    things = random_things(random, robot, clutter)
    model = build_model(robot, table, clutter, things)
    drawn_s, speed = float(random.uniform(0, 1.4)), float(random.uniform(0.5, 0.9))
    motion = Simulation(model, things, random, speed).run(frames, drawn_s if skipped_s is None else skipped_s)
    world_from_table = _table_pose(float(random.uniform(-math.pi, math.pi)))
    scene = _scene(seed, model, motion, world_from_table, Setting(table, clutter, things), random)
    return Episode(
        scene=scene,
        joint_names=(*robot.joints, *robot.fingers),
        state=motion.state,
        action=motion.action,
        wrist=_in_units(world_from_table @ motion.tool @ _hand_from_camera()),
        world_from_base=_in_units(world_from_table @ _table_from_base()),
        task=_in_words(motion, things),
        motion=motion,
    )


def _scene(
    seed: int, model: Model, motion: Motion, world_from_table: Floats, setting: Setting, random: np.random.Generator
) -> Scene:
    frames = len(motion.steps)
    walls, sheets = room(random, TABLE_M, UNITS_A_METRE)
    return Scene(
        parts=(*walls, *parts(model, setting)),
        sheets=sheets,
        poses=_poses(motion, world_from_table),
        focus=np.tile(np.array([[0.0, 0.0, 1.0]], np.float32), (frames, 1)),
        cameras=orbit_cameras(frames),
        hfov_deg=HFOV_DEG,
        light=random_light(random),
        facts=_facts(seed, model, motion, setting),
        objects=tuple(objects(model, motion, world_from_table, setting)),
        extent=_EXTENT,
    )


def _poses(motion: Motion, world_from_table: Floats) -> NDArray[np.float32]:
    """world_from_body [T, 1 + B, 3, 4]: the world, then the physics model's bodies, its own world being the table."""
    frames, bodies = motion.positions.shape[:2]
    poses = np.zeros((frames, 1 + bodies, 3, 4))
    poses[:, 0, :, :3] = np.eye(3)
    poses[:, 1:, :, :3] = world_from_table[:3, :3] @ rotations(motion.quaternions)
    poses[:, 1:, :, 3] = UNITS_A_METRE * moved(world_from_table, motion.positions)
    return poses.astype(np.float32)


def _table_pose(yaw: float) -> Floats:
    """world_from_table [4, 4]: turned about the vertical, metres."""
    turn = np.eye(4)
    turn[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    turn[2, 3] = TABLE_M
    return turn


def _table_from_base() -> Floats:
    base = np.eye(4)
    base[:3, 3] = BASE
    return base


def upright_base() -> Floats:
    """world_from_base [4, 4] of an arm whose table is not turned, decimetres."""
    return _in_units(_table_pose(0.0) @ _table_from_base())


def _in_units(poses: Floats) -> Floats:
    """Metres to decimetres."""
    scaled = poses.copy()
    scaled[..., :3, 3] *= UNITS_A_METRE
    return scaled


def _hand_from_camera() -> Floats:
    """A camera before the palm that looks past the fingers: in the tool's frame, metres."""
    eye, target = np.array([-0.11, 0.0, -0.17]), np.array([0.0, 0.0, 0.02])
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.array([0.0, 1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], -1)
    pose[:3, 3] = eye
    return pose


def _facts(seed: int, model: Model, motion: Motion, setting: Setting) -> dict[str, float | str]:
    return {
        "seed": seed,
        "arm": "primitive",
        "arm_licence": "Apache-2.0 (part of gcd-node)",
        "metres_a_unit": 1 / UNITS_A_METRE,
        "objects": len(setting.things),
        "clutter": len(setting.clutter),
        "grasps": len(motion.grasps),
        "grasps_held": sum(grasp.held for grasp in motion.grasps),
        "steps": " ".join(_runs(motion.steps)),
        "task": _in_words(motion, setting.things),
    }


def _runs(steps: Sequence[str]) -> list[str]:
    """The steps in order, each once while it lasts."""
    return [step for step, last in zip(steps, ("", *steps), strict=False) if step != last]


def _in_words(motion: Motion, things: list[Placed]) -> str:
    verbs = {"lift": "pick up the {} and place it elsewhere", "push": "push the {} aside"}
    told = [verbs[name].format(things[index].thing.name) for name, index in motion.tasks]
    return ", then ".join(told) or "move over the table"
