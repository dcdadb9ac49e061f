"""The tabletop world: one seed, one clip of an arm at work, seen by Kubric-4D's sixteen cameras.

One unit of the scene is a decimetre, so that Kubric-4D's bounds (cameras 12 to 18 units about (0, 0, 1)) fit a table;
the physics behind it runs in metres.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np

from gcd_train.scenes.description import (
    Colour,
    Doubles,
    Extent,
    Light,
    Paint,
    Part,
    Pattern,
    Point,
    Scene,
    SceneObject,
    Sheet,
    Tracks,
    moved,
    pick,
    rigid,
    rotations,
    shaded,
    square,
    towards,
    with_world,
    yawed,
)
from gcd_train.scenes.drop.world import HFOV_DEG, orbit_cameras
from gcd_train.scenes.tabletop.arm import BASE, arm_links, build_model, random_setting
from gcd_train.scenes.tabletop.simulation import Motion, Simulation
from gcd_train.scenes.tabletop.things import FLATS, FLOOR_M, WOODS, Setting, TabletopClass

UNITS_A_METRE = 10.0
TABLE_EXTENT = Extent(near_m=0.2, far_m=150.0, shadow_radius_m=12.0, shadow_depth_m=40.0, shadow_pixels=2048)
_TABLE = 1
"""The scene's body that carries table, clutter and, one number further each, the bodies of the physics model."""
_TABLE_Z_M = -0.12
"""Height of the table's surface in the world: arm and things are then in the middle of the pictures."""
_WALL, _WALL_TOP = 36.0, 19.0  # units
_WALLS: tuple[Colour, ...] = ((0.85, 0.83, 0.78), (0.68, 0.74, 0.76), (0.78, 0.70, 0.62), (0.60, 0.64, 0.58))
_TABLE_FROM_BASE = np.eye(4)
_TABLE_FROM_BASE[:3, 3] = BASE
_EYE, _RIGHT = np.array([-0.11, 0.0, -0.17]), np.array([0.0, 1.0, 0.0])
_AHEAD = (np.array([0.0, 0.0, 0.02]) - _EYE) / np.linalg.norm(np.array([0.0, 0.0, 0.02]) - _EYE)
_HAND_FROM_CAMERA = np.eye(4)
"""A camera before the palm that looks past the fingers: in the tool's frame, metres."""
_HAND_FROM_CAMERA[:3] = np.stack([_RIGHT, np.cross(_AHEAD, _RIGHT), _AHEAD, _EYE], -1)


@dataclass(frozen=True, kw_only=True, slots=True)
class Episode:
    """A clip of the tabletop world with what a robot would have logged.

    scene: in decimetres. motion: in metres, in the frame of the table. wrist: [T, 4, 4], world_from_camera of a camera
    in the hand, decimetres. world_from_base: [4, 4], decimetres. task: in words.
    """

    scene: Scene
    motion: Motion
    wrist: Doubles
    world_from_base: Doubles
    task: str


def tabletop_scene(seed: int, frames: int = 60) -> Scene:
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
    drawn_s, speed = random.uniform(0, 1.4), random.uniform(0.5, 0.9)
    motion = Simulation(model, setting.things, random, speed).run(frames, drawn_s if skipped_s is None else skipped_s)
    world_from_table = _table_pose(random.uniform(-math.pi, math.pi))
    walls, floor = room(random)
    verbs = {"lift": "pick up the {} and place it elsewhere", "push": "push the {} aside"}
    done = [verbs[name].format(setting.things[index].thing.name) for name, index in motion.tasks]
    task = ", then ".join(done) or "move over the table"
    parts, objects = _counted(model, setting, motion, world_from_table)
    turns = world_from_table[:3, :3] @ rotations(motion.tracks.quaternions)
    scene = Scene(
        parts=(*walls, *parts),
        sheets=(floor,),
        poses=with_world(turns, UNITS_A_METRE * moved(world_from_table, motion.tracks.positions)),
        focus=np.tile(np.array([[0.0, 0.0, 1.0]], np.float32), (frames, 1)),
        cameras=orbit_cameras(frames),
        hfov_deg=HFOV_DEG,
        light=random_light(random),
        facts={
            "seed": seed,
            "arm": "primitive",
            "arm_licence": "Apache-2.0 (part of gcd-node)",
            "metres_a_unit": 1 / UNITS_A_METRE,
            "objects": len(setting.things),
            "clutter": len(setting.clutter),
            "grasps": len(motion.grasps),
            "grasps_held": sum(grasp.held for grasp in motion.grasps),
            "steps": " ".join(step for step, _ in groupby(motion.steps)),
            "task": task,
        },
        objects=tuple(objects),
        extent=TABLE_EXTENT,
    )
    return Episode(
        scene=scene,
        motion=motion,
        wrist=_in_units(world_from_table @ motion.tool @ _HAND_FROM_CAMERA),
        world_from_base=_in_units(world_from_table @ _TABLE_FROM_BASE),
        task=task,
    )


def _counted(
    model: Any, setting: Setting, motion: Motion, world_from_table: Doubles
) -> tuple[list[Part], list[SceneObject]]:
    """The table's parts; those of things, links and clutter, and what metadata tells of them, in scene units.

    Their instances are their numbers from 1 on. Clutter is drawn as parts of the table's body.
    """
    parts = [piece.of(instance=0, body=_TABLE) for part in setting.table for piece in drawn(part)]
    objects: list[SceneObject] = []
    tracks, turn = motion.tracks, world_from_table[:3, :3]
    tracks = Tracks(
        positions=UNITS_A_METRE * moved(world_from_table, tracks.positions),
        quaternions=yawed(tracks.quaternions, math.atan2(turn[1, 0], turn[0, 0])),
        velocities=UNITS_A_METRE * (tracks.velocities @ turn.T),
        angular_velocities=tracks.angular_velocities @ turn.T,
    )
    rows = [
        (each.thing, model.body(f"thing_{i}").id, TabletopClass.OBJECT, None) for i, each in enumerate(setting.things)
    ]
    rows += [(*link, None) for link in arm_links(model)]
    rows += [(each.thing, body, TabletopClass.CLUTTER, each) for body, each in enumerate(setting.clutter, start=1)]
    for instance, (thing, track, label, stands) in enumerate(rows, start=1):
        body = _TABLE + track if stands is None else _TABLE
        pieces = [piece.of(instance=instance, body=body) for part in thing.parts for piece in drawn(part)]
        if stands is not None:
            pieces = [piece.placed(*_scaled(stands.place), stands.yaw) for piece in pieces]
        parts += pieces
        sized = replace(thing, size=_scaled(thing.size), middle=_scaled(thing.middle))
        objects.append(SceneObject.of(sized, tracks, track, instance=instance, body=body, label=label))
    return parts, objects


def drawn(part: Part) -> Iterator[Part]:
    """What is drawn of a part, in scene units; a capsule is a cylinder and two spheres."""
    paint = replace(part.paint, grain_m=part.paint.grain_m * UNITS_A_METRE)
    scaled = replace(part, centre=_scaled(part.centre), size=_scaled(part.size), paint=paint)
    if part.shape != "capsule":
        yield scaled
        return
    yield replace(scaled, shape="cylinder")
    centre, half = np.asarray(part.centre), part.size[2] / 2
    along = rotations(np.asarray(part.turn))[:, 2]
    for end in (centre - half * along, centre + half * along):
        x, y, z = end.tolist()
        yield replace(scaled, shape="sphere", centre=_scaled((x, y, z)), size=(scaled.size[0],) * 3)


def _table_pose(yaw: float) -> Doubles:
    """world_from_table [4, 4]: turned about the vertical, metres."""
    return rigid(np.array([[0.0, 0.0, _TABLE_Z_M, yaw]]))[0]


def upright_base() -> Doubles:
    """world_from_base [4, 4] of an arm whose table is not turned, decimetres."""
    return _in_units(_table_pose(0.0) @ _TABLE_FROM_BASE)


def _in_units(poses: Doubles) -> Doubles:
    """Metres to decimetres."""
    scaled = poses.copy()
    scaled[..., :3, 3] *= UNITS_A_METRE
    return scaled


def _scaled(point: Point) -> Point:
    return point[0] * UNITS_A_METRE, point[1] * UNITS_A_METRE, point[2] * UNITS_A_METRE


def room(random: np.random.Generator) -> tuple[list[Part], Sheet]:
    """Four walls with the sky above them, and the floor, in scene units; lower than the sun at the table."""
    low, colour = (FLOOR_M + _TABLE_Z_M) * UNITS_A_METRE, pick(random, _WALLS)
    middle, height = (low + _WALL_TOP) / 2, _WALL_TOP - low
    paint = Paint(colour, (0.9 * colour[0], 0.9 * colour[1], 0.92 * colour[2]), Pattern.CLOUDY, 5.0)
    parts: list[Part] = []
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        size = (1.0 if x else 2 * _WALL, 1.0 if y else 2 * _WALL, height)
        parts.append(Part("box", (x * _WALL, y * _WALL, middle), size, paint, TabletopClass.WALL))
    for side in range(4):  # cupboards, pictures and doors along the walls, so that the background tells where it is
        for along in np.arange(-0.75, 0.76, 0.5) + random.uniform(-0.12, 0.12, 4):
            wide, deep, high = (random.uniform(*sides) for sides in ((5, 11), (0.6, 4.5), (6, 22)))
            red, green, blue = (random.uniform(0.2, most) for most in (0.85, 0.8, 0.8))
            lift, grey = 0.0 if deep > 1.5 else 8.0, 0.5 * (red + green)
            colour = ((red + grey) / 2, (green + grey) / 2, (blue + grey) / 2)
            pattern = pick(random, (Pattern.PLAIN, Pattern.WOOD, Pattern.STRIPES))
            centre = (float(along) * _WALL, _WALL - 0.5 - deep / 2, low + lift + high / 2)
            panel = Paint(colour, (0.4, 0.35, 0.3), pattern, 2.0)
            part = Part("box", centre, (wide, deep, high), panel, TabletopClass.WALL)
            parts.append(part.placed(0.0, 0.0, 0.0, side * math.pi / 2))
    size = (-5.5 * _WALL, 5.5 * _WALL, 5.5 * _WALL)  # its inside faces the cameras, hence the negative size
    parts.append(Part("ball", (0, 0, 0), size, Paint((1, 1, 1), pattern=Pattern.SKY), TabletopClass.SKY))
    pattern = pick(random, (Pattern.PLANKS, Pattern.TERRAZZO, Pattern.CHECKER, Pattern.CLOUDY))
    colour = pick(random, WOODS if pattern == Pattern.PLANKS else FLATS)
    return parts, Sheet(square(_WALL, low), Paint(colour, shaded(colour, 0.8), pattern, 3.0, 0.1), TabletopClass.FLOOR)


def random_light(random: np.random.Generator) -> Light:
    """A lamp high above, as parallel light, and the bright room around it."""
    height, round_ = random.uniform(0.85, 1.35), random.uniform(0, 2 * math.pi)
    warm, strength = random.uniform(0.0, 0.3), random.uniform(0.8, 1.5)
    fill = random.uniform(0.55, 0.85)
    return Light(
        sun_to=towards(height, round_),
        sun=(strength, strength * (1 - 0.4 * warm), strength * (1 - 0.8 * warm)),
        sky=(fill, fill * (1 - 0.1 * warm), fill * (1 - 0.2 * warm)),
        ground=(0.45 * fill, 0.43 * fill, 0.40 * fill),
        horizon=(0.72, 0.72, 0.70),
        zenith=(0.80, 0.80, 0.79),
        fog_m=4000.0,
        cloud=0.0,
        exposure=random.uniform(1.1, 1.5),
    )
