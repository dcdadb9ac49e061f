"""Where the two cameras of a live clip stand: a source that drives or stands, and a target around it.

The paper has one path a world. The live model takes any pose, so its clips have targets all around those paths: smooth
ones, ones that stand, and ones where every frame is a camera of its own.
"""

import math
import zlib
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.geometry import CameraMount, Spherical, look_at, path_progress, to_pose
from gcd_train.errors import RecipeError, RenderError
from gcd_train.scenes.description import Scene, rotations
from gcd_train.scenes.driving import driving_scene
from gcd_train.scenes.worlds import scene_world

Poses = NDArray[np.float64]
Random = np.random.Generator
LiveWorld = Literal["driving", "drop", "tabletop"]
TargetPath = Literal["mixed", "paper", "orbit60", "small"]
"""Which targets: the training's mixture, the paper's path over a road, orbits of 10 to 60 degrees, small moves."""

FRAMES = 14
CLIPS_PER_SCENE = {"driving": 1, "drop": 3, "tabletop": 3}
"""A simulated scene is filmed several times, a drive once."""
LIVE_SCENES: dict[LiveWorld, int] = {"driving": 1960, "drop": 224, "tabletop": 280}
"""So many scenes are about as many clips as the packaged model learned from."""
_WORLDS: dict[TargetPath, tuple[LiveWorld, ...]] = {
    "mixed": get_args(LiveWorld),
    "paper": ("driving",),
    "orbit60": ("drop", "tabletop"),
    "small": ("drop", "tabletop"),
}
METRES_A_UNIT = {"driving": 1.0, "drop": 1.0, "tabletop": 0.1}
FLOOR_Z_M = {"driving": 0.0, "drop": 0.0, "tabletop": -0.12}
"""Height of the plane on which the world stands: the road, the floor, the table."""
STAGE_HFOV_DEG = math.degrees(2 * math.atan(0.5))
DRIVING_HFOV_DEG = 85.0
_STAGE_STRIDE = 2
_SMALL_M, _SMALL_DEG = 0.15, 15.0
_CLEAR_UNITS = 1.0
"""Cameras keep this far from the sphere about any thing on a stage."""
_ATTEMPTS = 60


def worlds_of(path: TargetPath) -> tuple[LiveWorld, ...]:
    """The worlds in which there are targets of this kind."""
    return _WORLDS[path]


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveDraw:
    """What one clip films.

    steps: T time steps of the scene. source, target: world_from_camera [T, 4, 4], in the scene's units.
    source_hfov_deg, target_hfov_deg: of the two lenses. fps: of the clip.
    """

    steps: tuple[int, ...]
    source: Poses
    target: Poses
    source_hfov_deg: float
    target_hfov_deg: float
    fps: float


def live_scene(world: LiveWorld, seed: int, path: TargetPath) -> tuple[Scene, list[LiveDraw]]:
    """A scene and the draws of all its clips; the arguments decide everything.

    Raises:
        RenderError: the scene cannot be simulated, or leaves no room for cameras.
        RecipeError: this world has no such path.
    """
    if world not in worlds_of(path):
        raise RecipeError(f"{world} has no targets of the kind {path!r}; {', '.join(worlds_of(path))} have")
    salt = zlib.crc32(f"live {world} {path}".encode())
    if world == "driving":
        return _drive(seed, path, np.random.default_rng([seed, salt]))
    published = scene_world(world)
    scene = published.make(seed, published.frames)
    draws = [
        _stage_draw(scene, world, path, seed, np.random.default_rng([seed, clip, salt]))
        for clip in range(CLIPS_PER_SCENE[world])
    ]
    return scene, draws


def _drive(seed: int, path: TargetPath, random: Random) -> tuple[Scene, list[LiveDraw]]:
    paper = path == "paper" or random.random() < 0.3
    mount = CameraMount() if paper else _random_mount(random)
    # the paper's path is gradual where it is measured; in training it also stands at its goal, which is the live view
    move_time = FRAMES - 1 if path == "paper" else int(random.choice([0, FRAMES - 1], p=[0.6, 0.4]))
    scene = driving_scene(seed, frames=FRAMES, mount=mount, move_time=move_time)
    source, target = scene.cameras["source"], scene.cameras["target"]
    target_hfov = mount.hfov_deg
    if not paper:
        world_from_vehicle = source @ np.linalg.inv(mount.vehicle_from_camera.numpy())
        target = world_from_vehicle @ _around_vehicle(random, mount.vehicle_from_camera.numpy())
        target_hfov = _lens(random, mount.hfov_deg, 0.6)
    draw = LiveDraw(
        steps=tuple(range(FRAMES)),
        source=source,
        target=target,
        source_hfov_deg=mount.hfov_deg,
        target_hfov_deg=target_hfov,
        fps=10.0,
    )
    return scene, [draw]


def _random_mount(random: Random) -> CameraMount:
    """A forward camera behind the windscreen of a car, a van or a small lorry; half of them the paper's."""
    hfov_deg = _lens(random, DRIVING_HFOV_DEG, 0.4)
    if random.random() < 0.5:
        return CameraMount(hfov_deg=hfov_deg)
    return CameraMount(
        height_m=float(random.uniform(1.2, 2.1)),
        tilt_deg=float(random.uniform(-3.0, 9.0)),
        hfov_deg=hfov_deg,
    )


def _lens(random: Random, usual_deg: float, usually: float) -> float:
    return usual_deg if random.random() < usually else float(random.uniform(55.0, 110.0))


def _around_vehicle(random: Random, vehicle_from_source: Poses) -> Poses:
    """Targets in the vehicle's frame, [T, 4, 4]: up to 10 m up and 12 m back, 3 m aside; some stand, some jump."""
    kind = random.choice(["smooth", "stands", "leaves", "jumps"], p=[0.35, 0.3, 0.15, 0.2])
    if kind == "jumps":
        return np.stack([_looking(*_place(random)) for _ in range(FRAMES)])
    start, goal = _place(random), _place(random)
    if kind == "leaves":
        eye = vehicle_from_source[:3, 3]
        start = (eye, eye + 5.0 * vehicle_from_source[:3, 2])
    share = path_progress(FRAMES, 0 if kind == "stands" else FRAMES - 1, "sine").numpy()
    return np.stack([_looking(*(a + s * (b - a) for a, b in zip(start, goal, strict=True))) for s in share])


def _place(random: Random) -> tuple[Poses, Poses]:
    """A position and what is looked at from there, in the vehicle's frame, metres."""
    height = float(random.uniform(0.9, 10.0))
    low = height < 3.0  # within the vehicle's own lane, which others keep off
    eye = np.array([random.uniform(-1.0, 3.0) if low else random.uniform(-12.0, 4.0), random.uniform(-1, 1), height])
    if not low:
        eye[1] = random.uniform(-3.0, 3.0)
    ahead = math.exp(random.uniform(math.log(5.0), math.log(40.0)))
    return eye, np.array([eye[0] + ahead, random.uniform(-0.25, 0.25) * ahead, random.uniform(0.0, 1.5)])


def _looking(eye: Poses, at: Poses) -> Poses:
    return look_at(torch.from_numpy(np.asarray(eye)), torch.from_numpy(np.asarray(at))).numpy()


def _stage_draw(scene: Scene, world: LiveWorld, path: TargetPath, seed: int, random: Random) -> LiveDraw:
    """Source and target around a stage, clear of all things. Raises RenderError where nothing is."""
    last = scene.frames - 2
    for _ in range(_ATTEMPTS):
        first = int(random.integers(0, last - (FRAMES - 1) * _STAGE_STRIDE + 1))
        steps = tuple(range(first, first + FRAMES * _STAGE_STRIDE, _STAGE_STRIDE))
        start = _on_sphere(random)
        source = np.tile(to_pose(start).numpy(), (FRAMES, 1, 1))
        if path == "mixed" and random.random() < 0.3:  # a camera that is carried
            source = _sphere_path(random, start, 25.0)
        small = path == "small" or (path == "mixed" and random.random() < 0.25)
        target = _moved_little(random, source, METRES_A_UNIT[world]) if small else _orbit(random, start, path)
        lens = path == "mixed"
        source_hfov = _lens(random, STAGE_HFOV_DEG, 0.5) if lens else STAGE_HFOV_DEG
        draw = LiveDraw(
            steps=steps,
            source=source,
            target=target,
            source_hfov_deg=source_hfov,
            target_hfov_deg=_lens(random, source_hfov, 0.7) if lens else source_hfov,
            fps=12.0,
        )
        if _clear(scene, draw):
            return draw
    raise RenderError(f"{world} scene {seed}: no path leaves the cameras clear of all things; skip it")


def _on_sphere(random: Random) -> Spherical:
    sine = math.sin(math.radians(50.0))
    return Spherical(
        azimuth_deg=float(random.uniform(0.0, 360.0)),
        elevation_deg=math.degrees(math.asin(random.uniform(0.03, sine))),
        radius_m=float(random.uniform(11.0, 18.0)),
    )


def _orbit(random: Random, start: Spherical, path: TargetPath) -> Poses:
    """Orbits of up to 90 degrees from the source; in the training's mixture some stand and some jump."""
    most = 60.0 if path == "orbit60" else 90.0
    if path == "mixed":
        kind = random.choice(["gradual", "stands", "jumps"], p=[0.5, 0.3, 0.2])
        if kind == "jumps":
            return np.stack([to_pose(_goal(random, start, most)).numpy() for _ in range(FRAMES)])
        if kind == "stands":
            return np.tile(to_pose(_goal(random, start, most)).numpy(), (FRAMES, 1, 1))
    return _sphere_path(random, start, most)


def _sphere_path(random: Random, start: Spherical, most_deg: float) -> Poses:
    change = _goal(random, start, most_deg) - start
    shares = np.arange(FRAMES) / (FRAMES - 1)
    return np.stack(
        [
            to_pose(
                Spherical(
                    azimuth_deg=start.azimuth_deg + s * change.azimuth_deg,
                    elevation_deg=start.elevation_deg + s * change.elevation_deg,
                    radius_m=start.radius_m + s * change.radius_m,
                )
            ).numpy()
            for s in shares
        ]
    )


def _goal(random: Random, start: Spherical, most_deg: float) -> Spherical:
    side = random.choice([-1.0, 1.0])
    return replace(
        start,
        azimuth_deg=start.azimuth_deg + float(side * random.uniform(10.0 if most_deg > 30 else 0.0, most_deg)),
        elevation_deg=float(np.clip(start.elevation_deg + random.uniform(-30.0, 30.0), 1.0, 60.0)),
        radius_m=float(np.clip(start.radius_m + random.uniform(-3.0, 3.0), 10.5, 18.0)),
    )


def _moved_little(random: Random, source: Poses, metres_a_unit: float) -> Poses:
    """The source camera displaced by up to 15 cm and turned by up to 15 degrees: at once, or over the clip."""
    scale = _SMALL_M / metres_a_unit if metres_a_unit < 1.0 else 10 * _SMALL_M  # a stage of 15 m is ten times a table
    step = random.normal(size=3)
    step *= scale * random.uniform(0.2, 1.0) / np.linalg.norm(step)
    axis = random.normal(size=3)
    axis *= math.radians(_SMALL_DEG) * random.uniform(0.2, 1.0) / np.linalg.norm(axis)
    moving = random.random() < 0.5
    poses = source.copy()
    for t in range(FRAMES):
        share = t / (FRAMES - 1) if moving else 1.0
        half = share * axis / 2
        quaternion = np.concatenate([[math.cos(np.linalg.norm(half))], np.sinc(np.linalg.norm(half) / np.pi) * half])
        poses[t, :3, 3] += poses[t, :3, :3] @ (share * step)
        poses[t, :3, :3] = poses[t, :3, :3] @ rotations(quaternion)
    return poses


def _clear(scene: Scene, draw: LiveDraw) -> bool:
    steps = list(draw.steps)
    eyes = np.stack([draw.source[:, :3, 3], draw.target[:, :3, 3]])
    for thing in scene.objects:
        middle = thing.positions[steps] + rotations(thing.quaternions[steps]) @ np.array(thing.middle)
        reach = np.linalg.norm(thing.size) / 2 + _CLEAR_UNITS
        if bool((np.linalg.norm(eyes - middle, axis=-1) < reach).any()):
            return False
    return bool((eyes[..., 2] > scene_floor(scene) + 0.4).all())


def scene_floor(scene: Scene) -> float:
    """Height of the lowest sheet, scene units; cameras stay above it."""
    return min((float(sheet.corners[..., 2].min()) for sheet in scene.sheets), default=0.0)
