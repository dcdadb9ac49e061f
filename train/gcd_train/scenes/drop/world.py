"""The drop world: one seed, one clip, as Kubric-4D makes its scenes, with things and pictures of our own.

Source: Van Hoorick et al. 2024 (GCD), Kubric-4D: 6 to 16 things that have settled and 1 to 6 that are thrown, 60 frames
at 24 per second, sixteen cameras that stand still at 15 m from the point (0, 0, 1): four at an elevation of 45 degrees,
twelve at 5.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.geometry import sphere_poses
from gcd_train.errors import DataError, RenderError
from gcd_train.scenes.description import ORBIT, Floats, Part, Scene, SceneObject, rotations
from gcd_train.scenes.drop.labels import DropLabel
from gcd_train.scenes.drop.looks import random_light, random_surroundings
from gcd_train.scenes.drop.physics import Tracks, UnsoundSceneError, simulate
from gcd_train.scenes.drop.things import Thing, random_thing

FPS = 24.0
HFOV_DEG = math.degrees(2 * math.atan(0.5))
RADIUS_M = 15.0
_ATTEMPTS = 12
_SIDES_M = (1.0, 2.75)


def drop_scene(seed: int, *, frames: int = 60) -> Scene:
    """A scene that depends on nothing but its arguments.

    Args:
        seed: 0 or more.
        frames: time steps at 24 Hz.
    Raises:
        DataError: no frame is asked for.
        RenderError: MuJoCo is not installed, or no attempt at this seed gave a sound simulation.
    """
    if frames < 1:
        raise DataError(f"a clip has at least one frame, got {frames}; ask for 1 or more")
    reasons: list[str] = []
    for attempt in range(_ATTEMPTS):
        random = np.random.default_rng([seed, 0xD209, attempt])
        things = _random_things(random)
        settled = [i for i, thing in enumerate(things) if not thing.dynamic]
        try:
            tracks = simulate(things, random, frames=frames, fps=FPS)
            tracks.require_sound(settled)
            _require_free_cameras(things, tracks)
        except UnsoundSceneError as error:
            reasons.append(str(error))
            continue
        return _scene(things, tracks, np.random.default_rng([seed, 0x100C]), {"seed": seed, "attempts": attempt + 1})
    raise RenderError(f"drop scene {seed}: no sound simulation in {_ATTEMPTS} attempts ({'; '.join(reasons)}); skip it")


def orbit_cameras(frames: int) -> dict[str, NDArray[np.float64]]:
    """Kubric-4D's cameras, "view0" to "view15", which stand still: world_from_camera [T, 4, 4]."""
    ring = [(90.0 * k, 45.0, RADIUS_M) for k in range(4)] + [(15.0 + 30.0 * k, 5.0, RADIUS_M) for k in range(12)]
    poses = sphere_poses(torch.tensor(ring, dtype=torch.float64)).numpy()
    return {f"view{i}": np.tile(pose, (frames, 1, 1)) for i, pose in enumerate(poses)}


def _random_things(random: np.random.Generator) -> list[Thing]:
    """6 to 16 that settle, then 1 to 6 that are thrown."""
    settled, thrown = int(random.integers(6, 17)), int(random.integers(1, 7))
    sides = random.uniform(*_SIDES_M, size=settled + thrown)
    return [random_thing(random, side_m=float(side), dynamic=i >= settled) for i, side in enumerate(sides)]


def _require_free_cameras(things: list[Thing], tracks: Tracks) -> None:
    """Raises UnsoundSceneError if something comes so near to a camera that it could stand inside or fill the view."""
    cameras = np.stack([poses[0, :3, 3] for poses in orbit_cameras(1).values()])
    reach = np.array([np.linalg.norm(thing.size) / 2 for thing in things]) + ORBIT.near_m
    away = np.linalg.norm(tracks.positions[:, :, None] - cameras, axis=-1).min((0, 2))  # [N]
    if (away < reach).any():
        raise UnsoundSceneError(f"a {things[int((away - reach).argmin())].name} reaches a camera")


def _scene(things: list[Thing], tracks: Tracks, random: np.random.Generator, facts: dict[str, float | str]) -> Scene:
    frames = len(tracks.positions)
    surroundings, dome, floor = random_surroundings(random)
    thrown = sum(thing.dynamic for thing in things)
    return Scene(
        parts=(dome, *_parts(things)),
        sheets=(floor,),
        poses=_poses(tracks),
        focus=np.zeros((frames, 3), np.float32),
        cameras=orbit_cameras(frames),
        hfov_deg=HFOV_DEG,
        light=random_light(random),
        facts={**facts, "surroundings": surroundings, "settled": len(things) - thrown, "thrown": thrown},
        objects=tuple(_object(thing, i, tracks) for i, thing in enumerate(things)),
        extent=ORBIT,
    )


def _parts(things: list[Thing]) -> list[Part]:
    """Thing i is instance and body i + 1."""
    return [part.of(instance=i + 1, body=i + 1) for i, thing in enumerate(things) for part in thing.parts]


def _poses(tracks: Tracks) -> Floats:
    """World_from_body [T, 1 + N, 3, 4]; body 0 is the world itself."""
    moving = np.concatenate([rotations(tracks.quaternions), tracks.positions[..., None]], -1)
    still = np.broadcast_to(np.eye(4)[:3], (len(moving), 1, 3, 4))
    return np.concatenate([still, moving], 1).astype(np.float32)


def _object(thing: Thing, i: int, tracks: Tracks) -> SceneObject:
    return SceneObject(
        name=thing.name,
        instance=i + 1,
        body=i + 1,
        label=DropLabel.OBJECT,
        size=thing.size,
        dynamic=thing.dynamic,
        mass_kg=thing.mass_kg,
        friction=thing.friction,
        restitution=thing.restitution,
        positions=tracks.positions[:, i],
        quaternions=tracks.quaternions[:, i],
        velocities=tracks.velocities[:, i],
        angular_velocities=tracks.angular_velocities[:, i],
    )
