"""Live clips on disk, and the exact visibility of every target pixel.

A data folder holds `<world>/<seed>-<clip>.safetensors`, one file a clip, whole or not there:

    {source,target}.rgb      u8  [T, H, W, 3]     {source,target}.depth   u16 [T, H, W], see `decode_depth`
    {source,target}.labels   u8  [T, H, W]        {source,target}.instances u8 [T, H, W], 0 where nothing is counted
    {source,target}.moves    u8  [T, H, W], 1 where the thing moved since the frame before or moves until the next
    target.visibility        u8  [T, H, W]: 2 seen now, 1 seen before, 0 never seen
    {source,target}.pose     f64 [T, 4, 4], world_from_camera, metres

and in its metadata the lenses, the frame rate, the world, the height of its floor and the scene's facts.
"""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save_file
from torch import Tensor

from gcd_model.live.config import LIVE_CLASSES, SKY_M
from gcd_model.small_files import decode_json
from gcd_train.errors import DataError, RenderError
from gcd_train.files import whole
from gcd_train.live.draws import FLOOR_Z_M, METRES_A_UNIT, LiveDraw, LiveWorld, Poses, TargetPath, live_scene
from gcd_train.parallel import map_items, one_thread_each
from gcd_train.scenes.description import Scene
from gcd_train.scenes.frozen import freeze
from gcd_train.scenes.renderer import Renderer, Rendering

_NEAREST_M, _CODES = 0.02, 65534
_SPAN = float(np.log(SKY_M / _NEAREST_M))
_SAME_SURFACE = 0.02
"""Depths that differ by less than this share belong to one surface."""
_STANDS_M = 1e-3
"""A body whose pose changes by less than this a frame stands still, metres (and radians at a metre)."""
Array = NDArray[Any]
Item = TypeVar("Item")


def encode_depth(metres: Array) -> Array:
    """Depth in metres as u16 on a logarithmic scale, steps of 0.02 %; 0 stands for the sky."""
    code = 1 + np.log(np.clip(metres, _NEAREST_M, SKY_M) / _NEAREST_M) * ((_CODES - 1) / _SPAN)
    return np.where(metres > 0, np.rint(code), 0).astype(np.uint16)


def tensor_of(array: Array) -> Tensor:
    """The same numbers; of 16-bit codes, for which torch has few operations, the same bits."""
    return torch.from_numpy(array.view(np.int16) if array.dtype == np.uint16 else array)


def decode_depth(code: Tensor) -> Tensor:
    """Metres along the optical axis, float32, of codes as `tensor_of` gives them; SKY_M for the sky."""
    code = code.int() & 0xFFFF
    metres = _NEAREST_M * torch.exp((code - 1) * (_SPAN / (_CODES - 1)))
    return torch.where(code > 0, metres, SKY_M)


_STAGE_LABELS = {
    "drop": ("background", "object"),
    "tabletop": ("sky", "background", "background", "table", "robot", "robot", "object", "object"),
}
"""What the live model calls the classes of the stage worlds, by their ids; the driving world's names are its own."""


def live_labels(world: LiveWorld, labels: Array) -> Array:
    """Class ids of a world as ids of LIVE_CLASSES."""
    ids = {entry.name: number for number, entry in enumerate(LIVE_CLASSES)}
    names = _STAGE_LABELS.get(world)
    return labels if names is None else np.array([ids[name] for name in names], np.uint8)[labels]


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipSettings:
    """How clips are filmed. oversample: pixels drawn per pixel and side, see Renderer."""

    width: int = 192
    height: int = 128
    oversample: int = 2
    path: TargetPath = "mixed"


def generate_live(
    out: Path, world: LiveWorld, seeds: range, settings: ClipSettings, workers: int = 1
) -> tuple[int, list[str]]:
    """Film the scenes of `seeds`; those that are there are kept.

    Returns:
        How many scenes are there now, and a line for each that cannot be filmed.
    """
    folder = out / world
    folder.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if not (folder / f"{seed:07d}-0.safetensors").exists()]
    one_thread_each()
    outcomes = map_items(partial(film_scene, folder, world, settings), missing, workers=workers)
    failures = [str(outcome.error) for outcome in outcomes if outcome.error is not None]
    return len(seeds) - len(failures), failures


def film_scene(folder: Path, world: LiveWorld, settings: ClipSettings, seed: int) -> None:
    """Film all clips of one scene; the first one's file appears last. Raises RenderError."""
    scene, draws = live_scene(world, seed, settings.path)
    renderer = _renderer(settings.width, settings.height, settings.oversample)
    for number, draw in reversed(list(enumerate(draws))):
        arrays, facts = _film(renderer, scene, draw, world)
        path = folder / f"{seed:07d}-{number}.safetensors"
        with whole(path) as unfinished:
            save_file(arrays, unfinished, metadata={"facts": json.dumps(facts)})


@cache
def _renderer(width: int, height: int, oversample: int) -> Renderer:
    return Renderer(width, height, oversample=oversample)


def _film(
    renderer: Renderer, scene: Scene, draw: LiveDraw, world: LiveWorld
) -> tuple[dict[str, Array], dict[str, Any]]:
    steps, unit = list(draw.steps), METRES_A_UNIT[world]
    frozen = freeze(scene)
    cut = type(frozen)(
        vertices=frozen.vertices,
        poses=scene.poses[steps],
        focus=scene.focus[steps],
        hfov_deg=draw.source_hfov_deg,
        light=frozen.light,
        extent=frozen.extent,
    )
    cameras = {"source": draw.source, "target": draw.target}
    lenses = {"source": draw.source_hfov_deg, "target": draw.target_hfov_deg}
    views: dict[str, list[Rendering]] = {"source": [], "target": []}
    for _, name, view in renderer.views(cut, cameras, lenses):
        views[name].append(view)
    moves = _moving_bodies(cut.poses)
    arrays: dict[str, Array] = {}
    for name, frames in views.items():
        bodies = np.stack([frame.bodies for frame in frames])
        metric = cameras[name].copy()
        metric[:, :3, 3] *= unit
        arrays |= {
            f"{name}.rgb": np.stack([frame.rgb for frame in frames]),
            f"{name}.depth": encode_depth(np.stack([frame.depth for frame in frames]) * unit),
            f"{name}.labels": live_labels(world, np.stack([frame.classes for frame in frames])),
            f"{name}.instances": np.stack([frame.instances for frame in frames]),
            f"{name}.moves": moves[np.arange(len(frames))[:, None, None], bodies].astype(np.uint8),
            f"{name}.pose": metric,
        }
    arrays["target.visibility"] = visibility(views, cameras, lenses, cut.poses, SKY_M / unit)
    if (arrays["source.depth"] > 0).mean() < 0.05:
        raise RenderError(f"{world}: the source sees nothing but sky; skip it")
    facts = {
        **scene.facts,
        "world": world,
        "fps": draw.fps,
        "source_hfov_deg": draw.source_hfov_deg,
        "target_hfov_deg": draw.target_hfov_deg,
        "floor_z_m": FLOOR_Z_M[world],
    }
    return arrays, facts


def _moving_bodies(poses: Array) -> Array:
    """bool [T, B]: bodies [T, B, 3, 4] that move between a frame and the one before or after it."""
    step = np.abs(np.diff(poses, axis=0)).max((-1, -2)) > _STANDS_M  # [T-1, B]
    moves = np.zeros(poses.shape[:2], bool)
    moves[:-1] |= step
    moves[1:] |= step
    return moves


def visibility(
    views: dict[str, list[Rendering]], cameras: dict[str, Poses], hfov_deg: dict[str, float], bodies: Array, sky: float
) -> Array:
    """What the source knows of each target pixel: u8 [T, H, W]; 2 seen now, 1 seen before and not moved since, 0 never.

    A point counts as seen where the source's depth at its place is no nearer than the point itself.
    """
    frames = len(views["target"])
    rays = _rays(hfov_deg["target"], *views["target"][0].depth.shape)  # [HW, 3], z = 1
    states = np.zeros((frames, len(rays)), np.uint8)
    source_depths = [np.where(view.depth > 0, view.depth, np.float32(sky)) for view in views["source"]]
    world_points = [
        _transformed(cameras["target"][t], rays * np.where(view.depth > 0, view.depth, sky).reshape(-1, 1))
        for t, view in enumerate(views["target"])
    ]
    for t in range(frames):
        states[t] = 2 * _seen(world_points[t], cameras["source"][t], hfov_deg["source"], source_depths[t])
        owner = views["target"][t].bodies.reshape(-1)
        for before in range(t - 1, -1, -1):
            still = np.abs(bodies[before : t + 1] - bodies[t]).max((0, 2, 3)) <= _STANDS_M  # [B]
            asked = np.flatnonzero((states[t] == 0) & still[owner])
            seen = _seen(world_points[t][asked], cameras["source"][before], hfov_deg["source"], source_depths[before])
            states[t, asked[seen]] = 1
    return states.reshape(frames, *views["target"][0].depth.shape)


def _seen(points: Array, world_from_camera: Poses, hfov_deg: float, depth: Array) -> Array:
    """bool [N]: whether a camera with this depth picture sees the points [N, 3]."""
    height, width = depth.shape
    local = _transformed(np.linalg.inv(world_from_camera), points)
    ahead = local[:, 2] > 1e-3
    z = np.where(ahead, local[:, 2], 1.0)
    focal = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    u, v = local[:, 0] / z * focal + width / 2 - 0.5, local[:, 1] / z * focal + height / 2 - 0.5
    inside = ahead & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    left, top = np.floor(u[inside]).astype(int), np.floor(v[inside]).astype(int)
    left0, left1 = left.clip(0), (left + 1).clip(max=width - 1)
    top0, top1 = top.clip(0), (top + 1).clip(max=height - 1)
    farthest = np.maximum.reduce([depth[a, b] for a in (top0, top1) for b in (left0, left1)])
    seen = np.zeros(len(points), bool)
    seen[inside] = z[inside] <= farthest * (1 + _SAME_SURFACE)
    return seen


def _rays(hfov_deg: float, height: int, width: int) -> Array:
    focal = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    v, u = np.mgrid[:height, :width] + 0.5
    return np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)], -1).reshape(-1, 3)


def _transformed(a_from_b: Array, points: Array) -> Array:
    return points @ a_from_b[:3, :3].T + a_from_b[:3, 3]


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveClip:
    """A clip as it was filmed; arrays by the names in the module's docstring. facts: see there."""

    name: str
    arrays: dict[str, Array]
    facts: dict[str, Any]

    @property
    def frames(self) -> int:
        """T."""
        return self.arrays["source.rgb"].shape[0]

    def hfov_deg(self, camera: str) -> float:
        """Of "source" or "target"."""
        return float(self.facts[f"{camera}_hfov_deg"])

    def depth(self, camera: str) -> Array:
        """float32 [T, H, W], metres; SKY_M for the sky."""
        return decode_depth(tensor_of(self.arrays[f"{camera}.depth"])).numpy()


def clip_paths(folder: Path) -> list[Path]:
    """All clips of a data folder, in order. Raises DataError if there are none."""
    paths = sorted(folder.glob("*/*.safetensors"))
    if not paths:
        raise DataError(f"{folder} holds no live clips; make some with `gcd-train generate live {folder}`")
    return paths


def evenly(items: Sequence[Item], most: int) -> Sequence[Item]:
    """At most so many of them, evenly chosen."""
    return items[:: max(len(items) // most, 1)][:most]


def read_clip(path: Path, frames: slice = slice(None), names: Collection[str] | None = None) -> LiveClip:
    """Some frames of a clip; of some arrays, see the module. Raises DataError for a file that is no live clip."""
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        with safe_open(path, framework="numpy") as file:
            facts = decode_json(file.metadata()["facts"], dict[str, Any])
            wanted = file.keys() if names is None else names
            arrays = {name: file.get_slice(name)[frames] for name in wanted}
    except Exception as error:  # safetensors and json raise kinds of their own
        raise DataError(f"{path} is no live clip ({error}); film it again") from error
    if any(int(array.max()) >= len(LIVE_CLASSES) for name, array in arrays.items() if name.endswith("labels")):
        raise DataError(f"{path} holds class ids beyond {len(LIVE_CLASSES) - 1}; film it again with this version")
    return LiveClip(name=f"{path.parent.name}/{path.stem}", arrays=arrays, facts=facts)
