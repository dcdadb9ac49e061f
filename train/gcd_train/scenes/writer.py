"""Clips on disk: shards that appear whole, written by several processes, resumable.

A data folder holds `world.json` (what it is) and `shard-<first seed>.zip` files. In a shard every clip has
`<seed>/scene.json` and one PNG per camera and kind, all frames one below the other: colour as RGB, depth as 16 bit in
1/256 metre (0: sky), instances and, where the world has an ontology, classes as 8 bit.
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

from gcd_train.errors import DataError
from gcd_train.parallel import map_items, one_thread_each
from gcd_train.scenes.pair_scenes import DrawnClip, drawn_clips
from gcd_train.scenes.pair_world import DEPTH_UNIT_M, World, agree
from gcd_train.scenes.renderer import Renderer, Rendering

_ABANDONED_S = 3600.0  # no shard takes so long
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


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
    agree(out, world)
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
            for clip in drawn_clips(renderer, world, seeds):
                _store(archive, clip)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _store(archive: zipfile.ZipFile, clip: DrawnClip) -> None:
    name = f"{clip.seed:08d}"
    poses = {camera: np.round(poses, 6).tolist() for camera, poses in clip.cameras.items()}
    told: dict[str, Any] = {"facts": {**clip.facts, "hfov_deg": clip.hfov_deg}, "world_from_camera": poses}
    if clip.orbit is not None:
        told["orbit"] = msgspec.to_builtins(clip.orbit)
    archive.writestr(f"{name}/scene.json", json.dumps(told))
    for camera, frames in clip.views.items():
        for kind, strip in _strips(frames, classes=clip.orbit is None).items():
            encoded, data = cv2.imencode(".png", strip, _PNG)
            if not encoded:
                raise DataError(f"clip {name}: OpenCV could not write {camera}.{kind} as PNG")
            archive.writestr(f"{name}/{camera}.{kind}.png", data.tobytes())


def _strips(frames: list[Rendering], *, classes: bool) -> dict[str, Any]:
    """Every kind of picture, all frames one below the other, as OpenCV wants them."""
    depth = np.concatenate([frame.depth for frame in frames])
    strips: dict[str, Any] = {
        "rgb": np.concatenate([frame.rgb for frame in frames])[..., ::-1],
        "depth": np.rint(depth / DEPTH_UNIT_M).clip(0, 65535).astype(np.uint16),
        "instances": np.concatenate([frame.instances for frame in frames]),
    }
    if classes:
        strips["classes"] = np.concatenate([frame.classes for frame in frames])
    return strips
