"""Pairs of clips: drawn, and stored in shards that appear whole, written by several processes, resumable.

The source camera stands or drives as the world has it, the target goes its path. A data folder holds `world.json` (what
it is) and `shard-<first seed>-<clips>.zip` files. In a shard every clip has `<seed>/scene.json` and one PNG per camera
and kind, all frames one below the other: colour as RGB, depth as 16 bit in 1/256 metre (0: sky), instances and, where
the world has an ontology, classes as 8 bit.
"""

import json
import re
import time
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import CameraMount
from gcd_train.data.paths import Draw, FrameSampling, OrbitSampling
from gcd_train.errors import DataError, RenderError
from gcd_train.files import whole
from gcd_train.parallel import map_items, one_thread_each
from gcd_train.scenes.description import Scene
from gcd_train.scenes.driving.world import driving_scene
from gcd_train.scenes.renderer import Renderer, Rendering, stacked
from gcd_train.scenes.triangles import freeze
from gcd_train.scenes.worlds import DEPTH_UNIT_M, SCENE_WORLDS, Orbit, World, agree

_ABANDONED_S = 3600.0  # no shard takes so long
_ATTEMPTS = 100


def generate(out: Path, world: World, seeds: range, workers: int, ray_address: str | None = None) -> Iterator[int]:
    """Make the clips of `seeds`: yields how many there are by now. Finished shards of an earlier run are kept.

    workers, ray_address: see `map_items`.
    Raises:
        DataError: the folder holds another kind of data.
        RenderError: nothing can be drawn on this machine. RunError: anything else that ends a shard.
    """
    out.mkdir(parents=True, exist_ok=True)
    agree(out, world)
    missing = _missing_shards(out, seeds, world.clips_per_shard)
    done = len(seeds) - sum(map(len, missing))
    yield done
    one_thread_each()
    write = partial(write_shard, out.resolve(), world)
    for outcome in map_items(write, missing, workers=workers, ray_address=ray_address):
        outcome.unwrap()  # the first that fails ends the run
        done += len(outcome.item)
        yield done


def _missing_shards(out: Path, seeds: range, size: int) -> list[range]:
    """Runs of at most `size` seeds of which no finished shard has any; what killed workers left is removed."""
    there: set[int] = set()
    for path in out.glob("shard-*.zip"):
        named = re.fullmatch(r"shard-(\d+)-(\d+)", path.stem)
        if named is None:
            raise DataError(f"{path} is no shard of this program; take it out of the folder")
        first, count = (int(number) for number in named.groups())
        there.update(range(first, first + count))
    for leftover in out.glob("*shard-*.partial"):
        if time.time() - leftover.stat().st_mtime > _ABANDONED_S:
            leftover.unlink()
    shards: list[range] = []
    for seed in sorted(set(seeds) - there):
        if shards and shards[-1].stop == seed and len(shards[-1]) < size:
            shards[-1] = range(shards[-1].start, seed + 1)
        else:
            shards.append(range(seed, seed + 1))
    return shards


def shard_path(out: Path, seeds: range) -> Path:
    """Where the clips of these seeds lie: the name tells the first and how many."""
    return out / f"shard-{seeds[0]:08d}-{len(seeds)}.zip"


def write_shard(out: Path, world: World, seeds: range) -> None:
    """Render and store a run of clips; the file appears under its name once it is complete."""
    with (
        whole(shard_path(out, seeds)) as unfinished,
        Renderer(world.width, world.height, oversample=world.oversample) as renderer,
        zipfile.ZipFile(unfinished, "w", zipfile.ZIP_STORED) as archive,
    ):
        for scene_seed, group in groupby(seeds, key=world.scene_of):
            for seed, facts, views in _drawn_clips(renderer, world, scene_seed, list(group)):
                archive.writestr(f"{seed:08d}/scene.json", json.dumps(facts))
                for name, strip in _strips(views, classes=world.camera == "fixed"):
                    _, data = cv2.imencode(".png", strip, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                    archive.writestr(f"{seed:08d}/{name}.png", data.tobytes())


def _strips(views: dict[str, Rendering], *, classes: bool) -> Iterator[tuple[str, NDArray[Any]]]:
    for camera, view in views.items():
        depth = np.rint(view.depth / DEPTH_UNIT_M).clip(0, 65535).astype(np.uint16)
        strips = {"rgb": view.rgb[..., ::-1], "depth": depth, "instances": view.instances}
        if classes:
            strips["classes"] = view.classes
        yield from ((f"{camera}.{kind}", strip.reshape(-1, *strip.shape[2:])) for kind, strip in strips.items())


def _drawn_clips(
    renderer: Renderer, world: World, scene_seed: int, seeds: list[int]
) -> Iterator[tuple[int, dict[str, Any], dict[str, Rendering]]]:
    """Number, metadata and views of clips of a scene, in one pass: their time steps follow each other, so it is
    simulated and sent to the renderer once.

    Raises: RenderError: the scene cannot be simulated or drawn, or leaves no room for a camera.
    """
    draws: list[Draw] = []
    if world.camera == "fixed":
        mount = CameraMount(height_m=world.options.height_m, tilt_deg=world.options.tilt_deg)
        scene = driving_scene(scene_seed, frames=world.frames, mount=mount, move_time=world.move_time)
        cut, cameras = freeze(scene), scene.cameras
    else:
        published = SCENE_WORLDS[world.name]
        scene = published.make(scene_seed, published.frames)
        draws = [orbit_draw(scene, world, seed) for seed in seeds]
        numbers = np.concatenate([draw.frame_numbers for draw in draws])
        cameras = {
            "source": np.concatenate([np.tile(draw.world_from_source, (world.frames, 1, 1)) for draw in draws]),
            "target": np.concatenate([draw.world_from_target for draw in draws]),
        }
        cut = replace(freeze(scene), poses=scene.poses[numbers], focus=scene.focus[numbers], hfov_deg=world.hfov_deg)
    with closing(renderer.views(cut, cameras)) as drawn:
        for clip, seed in enumerate(seeds):
            steps = slice(clip * world.frames, (clip + 1) * world.frames)
            views = stacked(islice(drawn, len(cameras) * world.frames))
            poses = {name: np.round(rows[steps], 6).tolist() for name, rows in cameras.items()}
            facts: dict[str, Any] = {"facts": {**scene.facts, "hfov_deg": cut.hfov_deg}, "world_from_camera": poses}
            if draws:
                facts["orbit"] = msgspec.to_builtins(_orbit(draws[clip]))
            yield seed, facts, views


def orbit_draw(scene: Scene, world: World, seed: int) -> Draw:
    """Time steps and camera path of a clip: the first one drawn that leaves the cameras clear of all things.

    Raises: RenderError if things are in the way wherever the cameras stand.
    """
    sampling = OrbitSampling(frames=FrameSampling(clip=world.frames, strides=(world.stride,)))
    scene_seed, clip = divmod(seed, world.clips_per_scene)
    salt = zlib.crc32(world.name.encode())  # else all worlds would be seen along the same paths
    for attempt in range(_ATTEMPTS):
        random = np.random.default_rng([scene_seed, clip, attempt, salt])
        draw = sampling.draw(random, scene.frames, world.fps * world.stride)
        still = np.tile(draw.world_from_source[:3, 3], (len(draw.frame_numbers), 1))
        if scene.clear_of_things(np.stack([still, draw.world_from_target[:, :3, 3]]), draw.frame_numbers):
            return draw
    raise RenderError(f"{world.name} scene {scene_seed}: no path leaves the cameras clear of all things; skip it")


def _orbit(draw: Draw) -> Orbit:
    assert draw.start is not None
    assert draw.deltas is not None
    start = (draw.start.azimuth_deg, draw.start.elevation_deg, draw.start.radius_m)
    return Orbit(start=start, change=tuple(draw.deltas[-1].tolist()), frame_numbers=draw.frame_numbers)
