"""Films live clips: where the two cameras stand, what they see, and the exact visibility of every target pixel.

The paper has one path a world. The live model takes any pose, so its clips have targets all around those paths: smooth
ones, ones that stand, and ones where every frame is a camera of its own.
"""

import json
import math
import zlib
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from safetensors.numpy import save_file

from gcd_model.geometry import CameraMount, Intrinsics, path_progress, sphere_poses
from gcd_model.live.config import LIVE_CLASSES, SKY_M
from gcd_train.data.splat import tangents
from gcd_train.errors import RecipeError, RenderError
from gcd_train.files import whole
from gcd_train.live.clips import CAMERAS, Array, Poses, encode_depth
from gcd_train.parallel import map_items, one_thread_each
from gcd_train.scenes.description import Scene, moved, rotations
from gcd_train.scenes.driving.world import HFOV_DEG as _DRIVING_HFOV_DEG
from gcd_train.scenes.driving.world import driving_scene, looking
from gcd_train.scenes.drop.world import HFOV_DEG as _STAGE_HFOV_DEG
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.triangles import freeze
from gcd_train.scenes.worlds import SCENE_WORLDS

Random = np.random.Generator
LiveWorld = Literal["driving", "drop", "tabletop"]
TargetPath = Literal["mixed", "paper", "orbit60", "small"]
"""Which targets: the training's mixture, the paper's path over a road, orbits of 10 to 60 degrees, small moves."""

FRAMES = 14
LIVE_SCENES: dict[LiveWorld, int] = {"driving": 1960, "drop": 224, "tabletop": 280}
"""So many scenes are about as many clips as the packaged model learned from."""
WORLDS: dict[TargetPath, tuple[LiveWorld, ...]] = {
    "mixed": get_args(LiveWorld),
    "paper": ("driving",),
    "orbit60": ("drop", "tabletop"),
    "small": ("drop", "tabletop"),
}
"""In which there are targets of a kind."""
_CLIPS_A_STAGE = 3
"""A simulated scene is filmed several times, a drive once."""
METRES_A_UNIT = {"driving": 1.0, "drop": 1.0, "tabletop": 0.1}
FLOOR_Z_M = {"driving": 0.0, "drop": 0.0, "tabletop": -0.12}
"""Height of the plane on which the world stands: the road, the floor, the table."""
_LABELS = {
    "driving": tuple(entry.name for entry in LIVE_CLASSES),
    "drop": ("background", "object"),
    "tabletop": ("sky", "background", "background", "table", "robot", "robot", "object", "object"),
}
"""What the live model calls the classes of the worlds, by their ids; the driving world's names are its own."""
_STAGE_STRIDE = 2
_SMALL_M, _SMALL_DEG = 0.15, 15.0
_ATTEMPTS = 60
_SAME_SURFACE = 0.02
"""Depths that differ by less than this share belong to one surface."""
_STANDS_M = 1e-3
"""A body whose pose changes by less than this a frame stands still, metres (and radians at a metre)."""


def generate_live(
    out: Path,
    world: LiveWorld,
    seeds: range,
    *,
    path: TargetPath = "mixed",
    size: tuple[int, int] = (192, 128),
    workers: int = 1,
) -> tuple[int, list[str]]:
    """Film the scenes of `seeds`; those that are there are kept.

    size: width and height, pixels.
    Returns:
        How many scenes are there now, and a line for each that cannot be filmed.
    """
    folder = out / world
    folder.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if not (folder / f"{seed:07d}-0.safetensors").exists()]
    one_thread_each()
    outcomes = map_items(partial(_film_scene, folder, world, path, size), missing, workers=workers)
    failures = [str(outcome.error) for outcome in outcomes if outcome.error is not None]
    return len(seeds) - len(failures), failures


def _film_scene(folder: Path, world: LiveWorld, path: TargetPath, size: tuple[int, int], seed: int) -> None:
    """Film all clips of one scene; the first one's file appears last. Raises RenderError."""
    scene, draws = live_scene(world, seed, path)
    for number, draw in reversed(list(enumerate(draws))):
        arrays = _film(_renderer(size), scene, draw, world)
        lenses = {f"{name}_hfov_deg": angle for name, angle in draw.hfov_deg.items()}
        facts = {**scene.facts, "world": world, "fps": draw.fps, **lenses, "floor_z_m": FLOOR_Z_M[world]}
        with whole(folder / f"{seed:07d}-{number}.safetensors") as unfinished:
            save_file(arrays, unfinished, metadata={"facts": json.dumps(facts)})


@cache
def _renderer(size: tuple[int, int]) -> Renderer:
    return Renderer(*size, oversample=2)


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveDraw:
    """What one clip films, by "source" and "target".

    steps: T time steps of the scene. cameras: world_from_camera [T, 4, 4], in the scene's units. hfov_deg: of the
    lenses. fps: of the clip.
    """

    steps: list[int]
    cameras: dict[str, Poses]
    hfov_deg: dict[str, float]
    fps: float


def _film(renderer: Renderer, scene: Scene, draw: LiveDraw, world: LiveWorld) -> dict[str, Array]:
    unit, ids = METRES_A_UNIT[world], {entry.name: number for number, entry in enumerate(LIVE_CLASSES)}
    labels = np.array([ids[name] for name in _LABELS[world]], np.uint8)
    cut = replace(freeze(scene), poses=scene.poses[draw.steps], focus=scene.focus[draw.steps])
    views = renderer.render(cut, draw.cameras, draw.hfov_deg)
    step = np.abs(np.diff(cut.poses, axis=0)).max((-1, -2)) > _STANDS_M  # [T-1, B]
    moves = np.pad(step, ((1, 0), (0, 0))) | np.pad(step, ((0, 1), (0, 0)))  # since the frame before, or until the next
    arrays: dict[str, Array] = {}
    for name, view in views.items():
        metric = draw.cameras[name].copy()
        metric[:, :3, 3] *= unit
        arrays |= {
            f"{name}.rgb": view.rgb,
            f"{name}.depth": encode_depth(view.depth * unit),
            f"{name}.labels": labels[view.classes],
            f"{name}.instances": view.instances,
            f"{name}.moves": moves[np.arange(FRAMES)[:, None, None], view.bodies].astype(np.uint8),
            f"{name}.pose": metric,
        }
    _, height, width = views["target"].depth.shape
    lenses = {name: Intrinsics.from_hfov(angle, width, height) for name, angle in draw.hfov_deg.items()}
    arrays["target.visibility"] = visibility(views, draw.cameras, lenses, cut.poses, SKY_M / unit)
    if (arrays["source.depth"] > 0).mean() < 0.05:
        raise RenderError(f"{world}: the source sees nothing but sky; skip it")
    return arrays


def visibility(
    views: dict[str, Rendering],
    cameras: dict[str, Poses],
    lenses: dict[str, Intrinsics],
    bodies: Array,
    sky: float,
) -> Array:
    """What the source knows of each target pixel: u8 [T, H, W]; 2 seen now, 1 seen before and not moved since, 0 never.

    A point counts as seen where the source's depth at its place is no nearer than the point itself.
    """
    depths = {name: np.where(view.depth > 0, view.depth, np.float32(sky)) for name, view in views.items()}
    right, down = np.meshgrid(*tangents(lenses["target"], 0.5))
    rays = np.stack([right, down, np.ones_like(right)], axis=-1)  # [H, W, 3]
    states = np.zeros((len(depths["target"]), rays[..., 0].size), np.uint8)
    for t, (depth, pose) in enumerate(zip(depths["target"], cameras["target"], strict=True)):
        points = moved(pose, (rays * depth[..., None]).reshape(-1, 3))
        states[t] = 2 * _seen(points, cameras["source"][t], lenses["source"], depths["source"][t])
        owner = views["target"].bodies[t].reshape(-1)
        for before in range(t - 1, -1, -1):
            still = np.abs(bodies[before : t + 1] - bodies[t]).max((0, 2, 3)) <= _STANDS_M  # [B]
            asked = np.flatnonzero((states[t] == 0) & still[owner])
            seen = _seen(points[asked], cameras["source"][before], lenses["source"], depths["source"][before])
            states[t, asked[seen]] = 1
    return states.reshape(-1, *rays.shape[:2])


def _seen(points: Array, world_from_camera: Poses, lens: Intrinsics, depth: Array) -> Array:
    """bool [N]: whether a camera with this depth picture sees the points [N, 3]."""
    local = moved(np.linalg.inv(world_from_camera), points)
    ahead = local[:, 2] > 1e-3
    z = np.where(ahead, local[:, 2], 1.0)
    u, v = local[:, 0] / z * lens.fx + lens.cx - 0.5, local[:, 1] / z * lens.fy + lens.cy - 0.5
    inside = ahead & (u > -0.5) & (u < lens.width - 0.5) & (v > -0.5) & (v < lens.height - 0.5)
    left, top = np.floor(u[inside]).astype(int), np.floor(v[inside]).astype(int)
    columns = left.clip(0), (left + 1).clip(max=lens.width - 1)
    rows = top.clip(0), (top + 1).clip(max=lens.height - 1)
    farthest = np.maximum.reduce([depth[row, column] for row in rows for column in columns])
    seen = np.zeros(len(points), bool)
    seen[inside] = z[inside] <= farthest * (1 + _SAME_SURFACE)
    return seen


def live_scene(world: LiveWorld, seed: int, path: TargetPath) -> tuple[Scene, list[LiveDraw]]:
    """A scene and the draws of all its clips; the arguments decide everything.

    Raises:
        RenderError: the scene cannot be simulated, or leaves no room for cameras.
        RecipeError: this world has no such path.
    """
    if world not in WORLDS[path]:
        raise RecipeError(f"{world} has no targets of the kind {path!r}; {', '.join(WORLDS[path])} have")
    salt = zlib.crc32(f"live {world} {path}".encode())
    if world == "driving":
        return _drive(seed, path, np.random.default_rng([seed, salt]))
    published = SCENE_WORLDS[world]
    scene = published.make(seed, published.frames)
    draws = [
        _stage_draw(scene, world, path, seed, np.random.default_rng([seed, clip, salt]))
        for clip in range(_CLIPS_A_STAGE)
    ]
    return scene, draws


def _drive(seed: int, path: TargetPath, random: Random) -> tuple[Scene, list[LiveDraw]]:
    paper, mount = path == "paper" or random.random() < 0.3, CameraMount()
    if not paper:  # a forward camera behind the windscreen of a car, a van or a small lorry; half of them the paper's
        mount = CameraMount(hfov_deg=_lens(random, _DRIVING_HFOV_DEG, 0.4))
        if random.random() >= 0.5:
            mount = replace(mount, height_m=random.uniform(1.2, 2.1), tilt_deg=random.uniform(-3.0, 9.0))
    # the paper's path is gradual where it is measured; in training it also stands at its goal, which is the live view
    move_time = FRAMES - 1 if path == "paper" else int(random.choice([0, FRAMES - 1], p=[0.6, 0.4]))
    scene = driving_scene(seed, frames=FRAMES, mount=mount, move_time=move_time)
    cameras, hfov_deg = {name: scene.cameras[name] for name in CAMERAS}, dict.fromkeys(CAMERAS, mount.hfov_deg)
    if not paper:
        vehicle_from_source = mount.vehicle_from_camera.numpy()
        world_from_vehicle = cameras["source"] @ np.linalg.inv(vehicle_from_source)
        cameras["target"] = world_from_vehicle @ _around_vehicle(random, vehicle_from_source)
        hfov_deg["target"] = _lens(random, mount.hfov_deg, 0.6)
    return scene, [LiveDraw(steps=list(range(FRAMES)), cameras=cameras, hfov_deg=hfov_deg, fps=10.0)]


def _lens(random: Random, usual_deg: float, usually: float) -> float:
    return usual_deg if random.random() < usually else random.uniform(55.0, 110.0)


def _around_vehicle(random: Random, vehicle_from_source: Poses) -> Poses:
    """Targets in the vehicle's frame, [T, 4, 4]: up to 10 m up and 12 m back, 3 m aside; some stand, some jump."""
    kind = random.choice(["smooth", "stands", "leaves", "jumps"], p=[0.35, 0.3, 0.15, 0.2])
    if kind == "jumps":
        return np.stack([looking(*_place(random)) for _ in range(FRAMES)])
    start, goal = _place(random), _place(random)
    if kind == "leaves":
        eye = vehicle_from_source[:3, 3]
        start = (eye, eye + 5.0 * vehicle_from_source[:3, 2])
    share = path_progress(FRAMES, 0 if kind == "stands" else FRAMES - 1, "sine").numpy()
    return np.stack([looking(*(a + s * (b - a) for a, b in zip(start, goal, strict=True))) for s in share])


def _place(random: Random) -> tuple[Poses, Poses]:
    """A position and what is looked at from there, in the vehicle's frame, metres."""
    height = random.uniform(0.9, 10.0)
    low = height < 3.0  # within the vehicle's own lane, which others keep off
    eye = np.array([random.uniform(-1.0, 3.0) if low else random.uniform(-12.0, 4.0), random.uniform(-1, 1), height])
    if not low:
        eye[1] = random.uniform(-3.0, 3.0)
    ahead = math.exp(random.uniform(math.log(5.0), math.log(40.0)))
    return eye, np.array([eye[0] + ahead, random.uniform(-0.25, 0.25) * ahead, random.uniform(0.0, 1.5)])


def _stage_draw(scene: Scene, world: LiveWorld, path: TargetPath, seed: int, random: Random) -> LiveDraw:
    """Source and target around a stage, clear of all things. Raises RenderError where nothing is."""
    span = FRAMES * _STAGE_STRIDE
    floor = min((float(sheet.corners[..., 2].min()) for sheet in scene.sheets), default=0.0)
    for _ in range(_ATTEMPTS):
        first = int(random.integers(0, scene.frames - 1 - span + _STAGE_STRIDE))
        azimuth_deg, sine = random.uniform(0.0, 360.0), random.uniform(0.03, math.sin(math.radians(50.0)))
        start = np.array([azimuth_deg, math.degrees(math.asin(sine)), random.uniform(11.0, 18.0)])
        source = _on_sphere(np.tile(start, (FRAMES, 1)))
        if path == "mixed" and random.random() < 0.3:  # a camera that is carried
            source = _sphere_path(random, start, 25.0)
        small = path == "small" or (path == "mixed" and random.random() < 0.25)
        target = _moved_little(random, source, METRES_A_UNIT[world]) if small else _orbit(random, start, path)
        hfov_deg = dict.fromkeys(CAMERAS, _STAGE_HFOV_DEG)
        if path == "mixed":
            hfov_deg["source"] = _lens(random, _STAGE_HFOV_DEG, 0.5)
            hfov_deg["target"] = _lens(random, hfov_deg["source"], 0.7)
        steps = list(range(first, first + span, _STAGE_STRIDE))
        eyes = np.stack([source[:, :3, 3], target[:, :3, 3]])
        if scene.clear_of_things(eyes, steps) and (eyes[..., 2] > floor + 0.4).all():  # above the lowest sheet, too
            return LiveDraw(steps=steps, cameras={"source": source, "target": target}, hfov_deg=hfov_deg, fps=12.0)
    raise RenderError(f"{world} scene {seed}: no path leaves the cameras clear of all things; skip it")


def _on_sphere(places: Array) -> Poses:
    """Poses [T, 4, 4] at azimuth and elevation in degrees and radius, [T, 3]."""
    return sphere_poses(torch.from_numpy(places)).numpy()


def _orbit(random: Random, start: Array, path: TargetPath) -> Poses:
    """Orbits of up to 90 degrees from the source; in the training's mixture some stand and some jump."""
    most = 60.0 if path == "orbit60" else 90.0
    kind = random.choice(["gradual", "stands", "jumps"], p=[0.5, 0.3, 0.2]) if path == "mixed" else "gradual"
    if kind == "gradual":
        return _sphere_path(random, start, most)
    goals = [_goal(random, start, most) for _ in range(FRAMES if kind == "jumps" else 1)]
    return _on_sphere(np.broadcast_to(goals, (FRAMES, 3)).copy())


def _sphere_path(random: Random, start: Array, most_deg: float) -> Poses:
    change = _goal(random, start, most_deg) - start
    return _on_sphere(start + (np.arange(FRAMES) / (FRAMES - 1))[:, None] * change)


def _goal(random: Random, start: Array, most_deg: float) -> Array:
    side = random.choice([-1.0, 1.0])
    azimuth_deg = start[0] + side * random.uniform(10.0 if most_deg > 30 else 0.0, most_deg)
    elevation_deg = np.clip(start[1] + random.uniform(-30.0, 30.0), 1.0, 60.0)
    return np.array([azimuth_deg, elevation_deg, np.clip(start[2] + random.uniform(-3.0, 3.0), 10.5, 18.0)])


def _moved_little(random: Random, source: Poses, metres_a_unit: float) -> Poses:
    """The source camera displaced by up to 15 cm and turned by up to 15 degrees: at once, or over the clip."""
    scale = _SMALL_M / metres_a_unit if metres_a_unit < 1.0 else 10 * _SMALL_M  # a stage of 15 m is ten times a table
    step = random.normal(size=3)
    step *= scale * random.uniform(0.2, 1.0) / np.linalg.norm(step)
    axis = random.normal(size=3)
    axis *= math.radians(_SMALL_DEG) * random.uniform(0.2, 1.0) / np.linalg.norm(axis)
    moving = random.random() < 0.5
    poses = source.copy()
    for t, pose in enumerate(poses):
        share = t / (FRAMES - 1) if moving else 1.0
        half = share * axis / 2
        quaternion = np.concatenate([[math.cos(np.linalg.norm(half))], np.sinc(np.linalg.norm(half) / np.pi) * half])
        pose[:3, 3] += pose[:3, :3] @ (share * step)
        pose[:3, :3] = pose[:3, :3] @ rotations(quaternion)
    return poses
