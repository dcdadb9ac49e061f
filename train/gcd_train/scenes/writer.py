"""Clips on disk: shards that appear whole, written by several processes, resumable.

A data folder holds `world.json` (what it is) and `shard-<first seed>.zip` files. In a shard every clip has
`<seed>/scene.json` and one PNG per camera and kind, all frames one below the other: colour as RGB, depth as 16 bit in
1/256 metre (0: sky), classes and instances as 8 bit.
"""

import json
import os
import re
import time
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from gcd_model.config import DRIVING_CLASSES, SemanticClass
from gcd_train.errors import DataError
from gcd_train.map_items import map_items, one_thread_each
from gcd_train.scenes.description import Scene
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.worlds import WORLDS, WorldOptions

DEPTH_UNIT_M = 1 / 256
_ABANDONED_S = 3600.0  # no shard takes so long
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


class World(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a data folder says about itself; all its shards were made alike.

    format: of this layout. oversample: see Renderer. options: what the generator was told.
    """

    name: str
    width: int
    height: int
    frames: int
    fps: float
    hfov_deg: float
    oversample: int
    clips_per_shard: int
    options: WorldOptions = WorldOptions()
    classes: tuple[SemanticClass, ...] = DRIVING_CLASSES
    format: int = 1


@dataclass(frozen=True, kw_only=True, slots=True)
class Progress:
    """done, total: clips, counting what was there before."""

    done: int
    total: int


def generate(out: Path, world: World, seeds: range, workers: int, ray_address: str | None = None) -> Iterator[Progress]:
    """Make the clips of `seeds`; finished shards of an earlier run are kept. workers, ray_address: see `map_items`.

    Raises:
        DataError: the folder holds another kind of data.
        RenderError: nothing can be drawn on this machine. RunError: anything else that ends a shard.
    """
    out.mkdir(parents=True, exist_ok=True)
    _agree(out, world)
    missing = _missing_shards(out, seeds, world.clips_per_shard)
    done = len(seeds) - sum(map(len, missing))
    yield Progress(done=done, total=len(seeds))
    one_thread_each()
    for made in _written(out, world, missing, workers, ray_address):
        done += made
        yield Progress(done=done, total=len(seeds))


def _missing_shards(out: Path, seeds: range, size: int) -> list[range]:
    """Runs of at most `size` seeds of which no finished shard has any; what killed workers left is removed."""
    there: set[int] = set()
    for path in out.glob("shard-*.zip"):
        named = re.fullmatch(r"shard-(\d+)-(\d+)", path.stem)
        if named is None:
            raise DataError(f"{path} is no shard of this program; take it out of the folder")
        first, count = (int(number) for number in named.groups())
        there.update(range(first, first + count))
    for leftover in out.glob("shard-*.partial"):
        if time.time() - leftover.stat().st_mtime > _ABANDONED_S:
            leftover.unlink()
    shards: list[range] = []
    for seed in seeds:
        if seed in there:
            continue
        grows = shards and shards[-1].stop == seed and len(shards[-1]) < size
        if grows:
            shards[-1] = range(shards[-1].start, seed + 1)
        else:
            shards.append(range(seed, seed + 1))
    return shards


def _written(out: Path, world: World, shards: list[range], workers: int, ray_address: str | None) -> Iterator[int]:
    """How many clips each shard added, as it is finished; the first that fails ends the run."""
    outcomes = map_items(partial(write_shard, out.resolve(), world), shards, workers=workers, ray_address=ray_address)
    for outcome in outcomes:
        outcome.unwrap()
        yield len(outcome.item)


def shard_path(out: Path, seeds: range) -> Path:
    """Where the clips of these seeds lie: the name tells the first and how many."""
    return out / f"shard-{seeds[0]:08d}-{len(seeds)}.zip"


def write_shard(out: Path, world: World, seeds: range) -> None:
    """Render and store a run of clips; the file appears under its name once it is complete."""
    path = shard_path(out, seeds)
    partial = path.with_suffix(f".{os.getpid()}.partial")
    try:
        with (
            Renderer(world.width, world.height, oversample=world.oversample) as renderer,
            zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive,
        ):
            for seed in seeds:
                scene = WORLDS[world.name](seed, world.frames, world.options)
                _store(archive, f"{seed:08d}", scene, renderer.render(scene))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _agree(out: Path, world: World) -> None:
    """Write `world.json`, or make sure that the one that is there says the same."""
    path = out / "world.json"
    if not path.exists():
        partial = path.with_suffix(".partial")
        partial.write_bytes(msgspec.json.format(msgspec.json.encode(world)))
        partial.replace(path)
    elif read_world(out) != world:
        raise DataError(f"{out} holds clips of another world or size (see its world.json); choose another folder")


def read_world(folder: Path) -> World:
    """What a data folder says about itself. Raises DataError."""
    path = folder / "world.json"
    if not path.is_file():
        raise DataError(
            f"{folder} is no data folder: it has no world.json; make one with `gcd-train generate driving --pairs`"
        )
    try:
        return msgspec.json.decode(path.read_bytes(), type=World)
    except msgspec.MsgspecError as error:
        raise DataError(f"{path} cannot be read: {error}; make the folder anew with this version") from error


def _store(archive: zipfile.ZipFile, name: str, scene: Scene, views: dict[str, list[Rendering]]) -> None:
    facts = {**scene.facts, "hfov_deg": scene.hfov_deg}
    poses = {camera: np.round(poses, 6).tolist() for camera, poses in scene.cameras.items()}
    archive.writestr(f"{name}/scene.json", json.dumps({"facts": facts, "world_from_camera": poses}))
    for camera, frames in views.items():
        for kind, strip in _strips(frames).items():
            encoded, data = cv2.imencode(".png", strip, _PNG)
            if not encoded:
                raise DataError(f"clip {name}: OpenCV could not write {camera}.{kind} as PNG")
            archive.writestr(f"{name}/{camera}.{kind}.png", data.tobytes())


def _strips(frames: list[Rendering]) -> dict[str, Any]:
    """Every kind of picture, all frames one below the other, as OpenCV wants them."""
    depth = np.concatenate([frame.depth for frame in frames])
    return {
        "rgb": np.concatenate([frame.rgb for frame in frames])[..., ::-1],
        "depth": np.rint(depth / DEPTH_UNIT_M).clip(0, 65535).astype(np.uint16),
        "classes": np.concatenate([frame.classes for frame in frames]),
        "instances": np.concatenate([frame.instances for frame in frames]),
    }
