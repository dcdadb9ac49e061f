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

from gcd_model.geometry import CameraMount, Intrinsics, Spherical, look_at, path_progress, to_pose
from gcd_model.live.config import LIVE_CLASSES, SKY_M
from gcd_train.data.splat import tangents
from gcd_train.errors import RecipeError, RenderError
from gcd_train.files import whole
from gcd_train.live.clips import CAMERAS, Array, Poses, encode_depth
from gcd_train.parallel import map_items, one_thread_each
from gcd_train.scenes.description import Scene, rotations
from gcd_train.scenes.driving import driving_scene
from gcd_train.scenes.frozen import freeze
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.worlds import scene_world

Random = np.random.Generator
LiveWorld = Literal["driving", "drop", "tabletop"]
TargetPath = Literal["mixed", "paper", "orbit60", "small"]
"""Which targets: the training's mixture, the paper's path over a road, orbits of 10 to 60 degrees, small moves."""

FRAMES = 14
CLIPS_PER_SCENE = {"driving": 1, "drop": 3, "tabletop": 3}
"""A simulated scene is filmed several times, a drive once."""
LIVE_SCENES: dict[LiveWorld, int] = {"driving": 1960, "drop": 224, "tabletop": 280}
"""So many scenes are about as many clips as the packaged model learned from."""
WORLDS: dict[TargetPath, tuple[LiveWorld, ...]] = {
    "mixed": get_args(LiveWorld),
    "paper": ("driving",),
    "orbit60": ("drop", "tabletop"),
    "small": ("drop", "tabletop"),
}
"""In which there are targets of a kind."""
METRES_A_UNIT = {"driving": 1.0, "drop": 1.0, "tabletop": 0.1}
FLOOR_Z_M = {"driving": 0.0, "drop": 0.0, "tabletop": -0.12}
"""Height of the plane on which the world stands: the road, the floor, the table."""
_STAGE_LABELS = {
    "drop": ("background", "object"),
    "tabletop": ("sky", "background", "background", "table", "robot", "robot", "object", "object"),
}
"""What the live model calls the classes of the stage worlds, by their ids; the driving world's names are its own."""
_STAGE_HFOV_DEG = math.degrees(2 * math.atan(0.5))
_DRIVING_HFOV_DEG = 85.0
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
    unit = METRES_A_UNIT[world]
    cut = replace(freeze(scene), poses=scene.poses[draw.steps], focus=scene.focus[draw.steps])
    views: dict[str, list[Rendering]] = {name: [] for name in CAMERAS}
    for _, name, view in renderer.views(cut, draw.cameras, draw.hfov_deg):
        views[name].append(view)
    step = np.abs(np.diff(cut.poses, axis=0)).max((-1, -2)) > _STANDS_M  # [T-1, B]
    moves = np.pad(step, ((1, 0), (0, 0))) | np.pad(step, ((0, 1), (0, 0)))  # since the frame before, or until the next
    arrays: dict[str, Array] = {}
    for name, frames in views.items():
        metric = draw.cameras[name].copy()
        metric[:, :3, 3] *= unit
        bodies = np.stack([frame.bodies for frame in frames])
        arrays |= {
            f"{name}.rgb": np.stack([frame.rgb for frame in frames]),
            f"{name}.depth": encode_depth(np.stack([frame.depth for frame in frames]) * unit),
            f"{name}.labels": _live_labels(world, np.stack([frame.classes for frame in frames])),
            f"{name}.instances": np.stack([frame.instances for frame in frames]),
            f"{name}.moves": moves[np.arange(len(frames))[:, None, None], bodies].astype(np.uint8),
            f"{name}.pose": metric,
        }
    height, width = views["target"][0].depth.shape
    lenses = {name: Intrinsics.from_hfov(angle, width, height) for name, angle in draw.hfov_deg.items()}
    arrays["target.visibility"] = visibility(views, draw.cameras, lenses, cut.poses, SKY_M / unit)
    if (arrays["source.depth"] > 0).mean() < 0.05:
        raise RenderError(f"{world}: the source sees nothing but sky; skip it")
    return arrays


def _live_labels(world: LiveWorld, labels: Array) -> Array:
    """Class ids of a world as ids of LIVE_CLASSES."""
    ids = {entry.name: number for number, entry in enumerate(LIVE_CLASSES)}
    names = _STAGE_LABELS.get(world)
    return labels if names is None else np.array([ids[name] for name in names], np.uint8)[labels]


def visibility(
    views: dict[str, list[Rendering]],
    cameras: dict[str, Poses],
    lenses: dict[str, Intrinsics],
    bodies: Array,
    sky: float,
) -> Array:
    """What the source knows of each target pixel: u8 [T, H, W]; 2 seen now, 1 seen before and not moved since, 0 never.

    A point counts as seen where the source's depth at its place is no nearer than the point itself.
    """
    depths = {name: [np.where(view.depth > 0, view.depth, np.float32(sky)) for view in views[name]] for name in CAMERAS}
    right, down = np.meshgrid(*tangents(lenses["target"], 0.5))
    rays = np.stack([right, down, np.ones_like(right)], axis=-1)  # [H, W, 3]
    states = np.zeros((len(depths["target"]), rays[..., 0].size), np.uint8)
    for t, (depth, pose) in enumerate(zip(depths["target"], cameras["target"], strict=True)):
        points = _transformed(pose, (rays * depth[..., None]).reshape(-1, 3))
        states[t] = 2 * _seen(points, cameras["source"][t], lenses["source"], depths["source"][t])
        owner = views["target"][t].bodies.reshape(-1)
        for before in range(t - 1, -1, -1):
            still = np.abs(bodies[before : t + 1] - bodies[t]).max((0, 2, 3)) <= _STANDS_M  # [B]
            asked = np.flatnonzero((states[t] == 0) & still[owner])
            seen = _seen(points[asked], cameras["source"][before], lenses["source"], depths["source"][before])
            states[t, asked[seen]] = 1
    return states.reshape(-1, *rays.shape[:2])


def _seen(points: Array, world_from_camera: Poses, lens: Intrinsics, depth: Array) -> Array:
    """bool [N]: whether a camera with this depth picture sees the points [N, 3]."""
    local = _transformed(np.linalg.inv(world_from_camera), points)
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


def _transformed(a_from_b: Array, points: Array) -> Array:
    return points @ a_from_b[:3, :3].T + a_from_b[:3, 3]


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
    cameras, hfov_deg = {name: scene.cameras[name] for name in CAMERAS}, dict.fromkeys(CAMERAS, mount.hfov_deg)
    if not paper:
        vehicle_from_source = mount.vehicle_from_camera.numpy()
        world_from_vehicle = cameras["source"] @ np.linalg.inv(vehicle_from_source)
        cameras["target"] = world_from_vehicle @ _around_vehicle(random, vehicle_from_source)
        hfov_deg["target"] = _lens(random, mount.hfov_deg, 0.6)
    return scene, [LiveDraw(steps=list(range(FRAMES)), cameras=cameras, hfov_deg=hfov_deg, fps=10.0)]


def _random_mount(random: Random) -> CameraMount:
    """A forward camera behind the windscreen of a car, a van or a small lorry; half of them the paper's."""
    hfov_deg = _lens(random, _DRIVING_HFOV_DEG, 0.4)
    if random.random() < 0.5:
        return CameraMount(hfov_deg=hfov_deg)
    height_m, tilt_deg = float(random.uniform(1.2, 2.1)), float(random.uniform(-3.0, 9.0))
    return CameraMount(height_m=height_m, tilt_deg=tilt_deg, hfov_deg=hfov_deg)


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
    span = FRAMES * _STAGE_STRIDE
    for _ in range(_ATTEMPTS):
        first = int(random.integers(0, scene.frames - 1 - span + _STAGE_STRIDE))
        start = _on_sphere(random)
        source = np.tile(to_pose(start).numpy(), (FRAMES, 1, 1))
        if path == "mixed" and random.random() < 0.3:  # a camera that is carried
            source = _sphere_path(random, start, 25.0)
        small = path == "small" or (path == "mixed" and random.random() < 0.25)
        target = _moved_little(random, source, METRES_A_UNIT[world]) if small else _orbit(random, start, path)
        hfov_deg = dict.fromkeys(CAMERAS, _STAGE_HFOV_DEG)
        if path == "mixed":
            hfov_deg["source"] = _lens(random, _STAGE_HFOV_DEG, 0.5)
            hfov_deg["target"] = _lens(random, hfov_deg["source"], 0.7)
        draw = LiveDraw(
            steps=list(range(first, first + span, _STAGE_STRIDE)),
            cameras={"source": source, "target": target},
            hfov_deg=hfov_deg,
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

    def at(share: float) -> Spherical:
        return Spherical(
            azimuth_deg=start.azimuth_deg + share * change.azimuth_deg,
            elevation_deg=start.elevation_deg + share * change.elevation_deg,
            radius_m=start.radius_m + share * change.radius_m,
        )

    return np.stack([to_pose(at(share)).numpy() for share in np.arange(FRAMES) / (FRAMES - 1)])


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
    """Whether the cameras keep off all things, and above the lowest sheet."""
    eyes = np.stack([poses[:, :3, 3] for poses in draw.cameras.values()])
    floor = min((float(sheet.corners[..., 2].min()) for sheet in scene.sheets), default=0.0)
    return scene.clear_of_things(eyes, draw.steps) and bool((eyes[..., 2] > floor + 0.4).all())
