"""Worlds that are made in a millisecond, without physics: two boxes on the ground, and a stage with one that slides."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from gcd_train.data.files import SceneManifest, read_manifest
from gcd_train.errors import DataError
from gcd_train.scenes.description import Light, Paint, Part, Pattern, Scene, SceneObject, Sheet, square, upright
from gcd_train.scenes.drop.world import HFOV_DEG, orbit_cameras
from gcd_train.scenes.worlds import SCENE_WORLDS, SceneWorld

RED, GREEN = 9, 4
"""Instance ids; out of order, so that renumbering shows."""
LIGHT = Light(
    sun_to=(0.0, 0.0, 1.0),
    sun=(1.0, 1.0, 1.0),
    sky=(0.4, 0.4, 0.4),
    ground=(0.2, 0.2, 0.2),
    horizon=(0.7, 0.8, 0.9),
    zenith=(0.3, 0.5, 0.8),
    fog_m=1e6,
    cloud=0.0,
    exposure=1.0,
)


def box_scene(seed: int, frames: int) -> Scene:
    """A red box that stands, a green one that slides and turns, ground, sky; in seed n that one is n / 10 m further to
    the left.
    """
    slide = np.zeros((frames, 3, 4), np.float32)
    slide[:, 1] = (2.0, -1.5, 1.0, 0.0)
    slide[:, 2, 0], slide[:, 2, 1], slide[:, 2, 3] = 0.5 * np.arange(frames), 2.0 + seed / 10, 0.3 * np.arange(frames)
    slide[:, 2, 2] = 0.5
    cameras = orbit_cameras(frames)
    return Scene(
        parts=(
            Part("box", (0, 0, 0), (2, 2, 2), Paint((0.9, 0.1, 0.1)), 5, instance=RED, body=1),
            Part("box", (0, 0, 0), (1, 3, 1), Paint((0.1, 0.9, 0.1)), 8, instance=GREEN, body=2),
            Part("sphere", (0, 0, 0), (600, 600, 600), Paint((0, 0, 0), pattern=Pattern.SKY), 0),
        ),
        sheets=(Sheet(square(40.0, 0.0), Paint((0.4, 0.4, 0.4)), 1),),
        poses=upright(slide),
        focus=np.zeros((frames, 3), np.float32),
        cameras={"view0": cameras["view1"], "view1": cameras["view4"]},
        hfov_deg=HFOV_DEG,
        light=LIGHT,
        facts={"seed": seed},
        objects=(
            box_object("red box", RED, 1, (2.0, 2.0, 2.0), slide[:, 1]),
            box_object("green box", GREEN, 2, (1.0, 3.0, 1.0), slide[:, 2]),
        ),
    )


def odd_box_scene(seed: int, frames: int) -> Scene:
    """Fails for odd seeds."""
    if seed % 2:
        raise DataError(f"seed {seed} is odd")
    return box_scene(seed, frames)


def box_world(make: object = box_scene) -> SceneWorld:
    return SceneWorld(name="boxes", make=make, frames=2, width=48, height=32)  # pyright: ignore[reportArgumentType]


def checked(scene: Path) -> SceneManifest:
    """Of a scene folder that is as it was written."""
    manifest = read_manifest(scene)
    digests = {name: hashlib.sha256((scene / name).read_bytes()).hexdigest() for name in manifest.files}
    assert digests == manifest.files
    return manifest


def box_object(name: str, instance: int, body: int, size: tuple[float, float, float], path: np.ndarray) -> SceneObject:
    frames, half = len(path), path[:, 3] / 2
    turns = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], -1).astype(np.float64)
    return SceneObject(
        name=name,
        parts=(),
        instance=instance,
        body=body,
        label=body,
        size=size,
        dynamic=body == 2,
        mass_kg=2.0,
        friction=0.5,
        restitution=0.1,
        positions=path[:, :3].astype(np.float64),
        quaternions=turns,
        velocities=np.zeros((frames, 3)),
        angular_velocities=np.zeros((frames, 3)),
    )


def stage(seed: int, frames: int) -> Scene:
    """A floor with a box that slides over it; no physics."""
    path = np.zeros((frames, 2, 4), np.float32)
    path[:, 1, 0] = np.arange(frames) + seed
    floor = Part("box", (0, 0, -0.5), (60, 60, 1), Paint((0.5, 0.4, 0.3)), 1)
    box = Part("box", (0, 0, 1), (2, 2, 2), Paint((0.2, 0.3, 0.8)), 2, instance=7, body=1)
    return Scene(
        parts=(floor, box),
        sheets=(),
        poses=upright(path),
        focus=np.zeros((frames, 3), np.float32),
        cameras=orbit_cameras(frames),
        hfov_deg=HFOV_DEG,
        light=LIGHT,
    )


STAGE = replace(SCENE_WORLDS["drop"], name="stage", make=stage)
"""In Kubric-4D's layout."""
