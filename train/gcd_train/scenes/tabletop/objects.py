"""Everything of a tabletop scene that is counted: how it is drawn, and what metadata tells of it."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Part, SceneObject
from gcd_train.scenes.tabletop.classes import CLASS_NAMES, TabletopClass
from gcd_train.scenes.tabletop.drawn import bounding_box, parts_of, solids_of_body
from gcd_train.scenes.tabletop.model import Model
from gcd_train.scenes.tabletop.simulation import Motion
from gcd_train.scenes.tabletop.things import Placed, Solid, Thing

UNITS_A_METRE = 10.0
_TABLE = 1
"""The scene's body that carries table, clutter and, one number further each, the bodies of the physics model."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Setting:
    """What stands and lies there, and where."""

    table: tuple[Solid, ...]
    clutter: list[Placed]
    things: list[Placed]


def parts(model: Model, setting: Setting) -> Iterator[Part]:
    """Table, things, links and clutter, in scene units."""
    for solid in setting.table:
        yield from parts_of(solid, UNITS_A_METRE, label=TabletopClass.TABLE, instance=0, body=_TABLE)
    for thing, instance, body in _numbered(model, setting):
        for solid in thing.solids:
            yield from parts_of(solid, UNITS_A_METRE, label=TabletopClass.OBJECT, instance=instance, body=body)
    for link, instance, body, label in _links(model, len(setting.things)):
        for solid in link:
            yield from parts_of(solid, UNITS_A_METRE, label=label, instance=instance, body=body)
    first = 1 + len(setting.things) + len(model.links)
    for instance, placed in enumerate(setting.clutter, start=first):
        for solid in placed.thing.solids:
            for part in parts_of(solid, UNITS_A_METRE, label=TabletopClass.CLUTTER, instance=instance, body=_TABLE):
                x, y, z = (UNITS_A_METRE * number for number in placed.place)
                yield part.placed(x, y, z, placed.yaw)


def _numbered(model: Model, setting: Setting) -> Iterator[tuple[Thing, int, int]]:
    """Things with their instance and body: 1, 2, ..."""
    for index, placed in enumerate(setting.things):
        yield placed.thing, 1 + index, _TABLE + model.things[index]


def _links(model: Model, things: int) -> Iterator[tuple[list[Solid], int, int, TabletopClass]]:
    """Links with their instance (after the things), body and class."""
    gripper = len(model.links) - model.arm.gripper_links
    for index, body in enumerate(model.links):
        label = TabletopClass.GRIPPER if index >= gripper else TabletopClass.ROBOT_ARM
        yield solids_of_body(model.mujoco, model.model, body), 1 + things + index, _TABLE + body, label


def objects(model: Model, motion: Motion, world: Floats, setting: Setting) -> Iterator[SceneObject]:
    """Things, links and clutter, instance by instance. world: world_from_table [4, 4], metres."""
    for thing, instance, body in _numbered(model, setting):
        kept = _Kept(thing.name, instance, body, TabletopClass.OBJECT, thing.size, thing.mass_kg, thing.friction)
        yield _object(kept, motion, world)
    spoken = tuple(model.arm.links.values())
    for index, (solids, instance, body, label) in enumerate(_links(model, len(setting.things))):
        mass = float(model.model.body_mass[body - _TABLE])
        middle, size = bounding_box(solids)
        kept = _Kept(_asset(label, spoken[index]), instance, body, label, size, mass, 0.8, middle)
        yield _object(kept, motion, world)
    first = 1 + len(setting.things) + len(model.links)
    for instance, placed in enumerate(setting.clutter, start=first):
        yield _standing(placed, instance, motion, world)


def _asset(label: TabletopClass, name: str) -> str:
    """A name that tells the class too, for layouts that keep no classes: robot_arm/upper_arm, gripper/palm."""
    return f"{CLASS_NAMES[label]}/{name}".replace(" ", "_")


@dataclass(frozen=True, slots=True)
class _Kept:
    name: str
    instance: int
    body: int
    label: TabletopClass
    size_m: tuple[float, float, float]
    mass_kg: float
    friction: float
    middle_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


def _object(kept: _Kept, motion: Motion, world: Floats) -> SceneObject:
    number = kept.body - _TABLE
    turn = world[:3, :3]
    return _scene_object(
        kept,
        positions=moved(world, motion.positions[:, number]),
        quaternions=_turned_quaternions(world, motion.quaternions[:, number]),
        velocities=motion.velocities[:, number] @ turn.T,
        angular=motion.angular_velocities[:, number] @ turn.T,
        dynamic=True,
    )


def _standing(placed: Placed, instance: int, motion: Motion, world: Floats) -> SceneObject:
    thing, frames = placed.thing, len(motion.steps)
    kept = _Kept(
        _asset(TabletopClass.CLUTTER, thing.name),
        instance,
        _TABLE,
        TabletopClass.CLUTTER,
        thing.size,
        thing.mass_kg,
        thing.friction,
    )
    own = np.array([math.cos(placed.yaw / 2), 0.0, 0.0, math.sin(placed.yaw / 2)])
    return _scene_object(
        kept,
        positions=np.tile(moved(world, np.asarray(placed.place)), (frames, 1)),
        quaternions=_turned_quaternions(world, np.tile(own, (frames, 1))),
        velocities=np.zeros((frames, 3)),
        angular=np.zeros((frames, 3)),
        dynamic=False,
    )


def _scene_object(
    kept: _Kept, *, positions: Floats, quaternions: Floats, velocities: Floats, angular: Floats, dynamic: bool
) -> SceneObject:
    x, y, z = (UNITS_A_METRE * metres for metres in kept.size_m)
    right, ahead, up = (UNITS_A_METRE * metres for metres in kept.middle_m)
    return SceneObject(
        name=kept.name,
        instance=kept.instance,
        body=kept.body,
        label=kept.label,
        size=(x, y, z),
        middle=(right, ahead, up),
        dynamic=dynamic,
        mass_kg=kept.mass_kg,
        friction=kept.friction,
        restitution=0.0,
        positions=UNITS_A_METRE * positions,
        quaternions=quaternions,
        velocities=UNITS_A_METRE * velocities,
        angular_velocities=angular,
    )


def moved(pose: Floats, points: Floats) -> Floats:
    """Points [..., 3] of the table's frame in the world."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def _turned_quaternions(world: Floats, quaternions: Floats) -> Floats:
    """What each becomes after the table's turn; w, x, y, z."""
    half = math.atan2(world[1, 0], world[0, 0]) / 2
    c, s = math.cos(half), math.sin(half)
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)
