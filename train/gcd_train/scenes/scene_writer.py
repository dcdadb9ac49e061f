"""Makes scenes of a world and writes them whole: pictures, metadata, geometry, manifest."""

import io
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from gcd_model.geometry import Intrinsics
from gcd_train.data import kubric4d, parallel_domain4d
from gcd_train.data.files import (
    GEOMETRY,
    MANIFEST,
    SceneFiles,
    SceneManifest,
    package_version,
    read_manifest,
)
from gcd_train.data.kubric4d import Kubric4DWriter
from gcd_train.data.parallel_domain4d import ParallelDomain4DWriter
from gcd_train.errors import DataError, TrainError
from gcd_train.files import new_folder, remove_leftovers
from gcd_train.parallel import Outcome, map_items, one_thread_each
from gcd_train.scenes.renderer import Renderer, require_drawing
from gcd_train.scenes.triangles import freeze
from gcd_train.scenes.worlds import SceneFormat, SceneWorld

GIVE_UP_AFTER = 5
"""Failures in a row after which a run stops: the disk is full, or nothing can be drawn."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneMade:
    """folder: where it lies. made: False if it was there already. size: bytes written. cpu_s: of drawing, writing."""

    folder: Path
    made: bool
    size: int = 0
    cpu_s: float = 0.0


def write_scene(root: Path, world: SceneWorld, form: SceneFormat, seed: int) -> SceneMade:
    """Draw and write the scene of a seed, unless it is there: the folder appears once everything is in it.

    Raises:
        DataError: a folder of this name holds something else.
        RenderError: nothing can be drawn on this machine.
        OSError: the disk is full, or cannot be written.
    """
    names = kubric4d if world.layout == "kubric4d" else parallel_domain4d
    place = root / names.scene_name(seed)
    header: dict[str, Any] = {
        "layout": world.layout,
        "world": world.name,
        "seed": seed,
        "edition": world.edition,
        "fps": world.fps,
        **asdict(form),
    }
    if place.exists():
        there = read_manifest(place)
        for name, wanted in header.items():
            if getattr(there, name) != wanted:
                raise DataError(
                    f"{place} is there already with {name} {getattr(there, name)}, wanted {wanted}; choose another "
                    "folder or remove it"
                )
        return SceneMade(folder=place, made=False)
    started = time.process_time()
    require_drawing()  # before a simulation of many seconds
    scene = world.make(seed, form.frames)
    with new_folder(root, place.name) as folder:
        files, vehicle = SceneFiles(folder), None
        lens = Intrinsics.from_hfov(scene.hfov_deg, form.width, form.height)
        if world.vehicle_from_camera is None:
            writer = Kubric4DWriter(files, scene, lens, seed=seed, fps=world.fps, compact=form.compact)
        else:
            rig = world.vehicle_from_camera()
            writer = ParallelDomain4DWriter(files, lens, rig, world.classes, compact=form.compact)
            camera, pose = next(iter(rig.items()))
            poses = (scene.cameras[camera] @ np.linalg.inv(pose)).tolist()
            vehicle = tuple(tuple(map(tuple, rows)) for rows in poses)
        frozen = freeze(scene)
        with Renderer(form.width, form.height, oversample=form.oversample) as renderer:
            for step, camera, drawn in renderer.views(frozen, scene.cameras):
                writer.add(step, camera, drawn)
        writer.finish()
        geometry = io.BytesIO()
        frozen.save(geometry)
        files.write(folder / GEOMETRY, geometry.getvalue())
        manifest = SceneManifest(
            **header,
            version=package_version(),
            hfov_deg=scene.hfov_deg,
            cameras=tuple(scene.cameras),
            files=dict(sorted(files.checksums.items())),
            world_from_vehicle=vehicle,
            facts=scene.facts,
        )
        files.write(folder / MANIFEST, msgspec.json.format(msgspec.json.encode(manifest), indent=1))
    return SceneMade(folder=place, made=True, size=files.size, cpu_s=time.process_time() - started)


@dataclass(slots=True)
class SceneRun:
    """An account of a run so far. failures: seed -> error. gave_up: stopped before its end, see `GIVE_UP_AFTER`."""

    written: int = 0
    there: int = 0
    size: int = 0
    cpu_s: float = 0.0
    failures: dict[int, str] = field(default_factory=dict[int, str])
    exit_code: int = 0
    in_a_row: int = 0

    @property
    def done(self) -> int:
        """Scenes with an outcome."""
        return self.written + self.there + len(self.failures)

    @property
    def gave_up(self) -> bool:
        """Whether too many failed in a row."""
        return self.in_a_row >= GIVE_UP_AFTER

    def add(self, outcome: Outcome[int, SceneMade]) -> None:
        """Count one scene."""
        try:
            made = outcome.unwrap()
        except TrainError as error:
            self.failures[outcome.item] = str(error)
            self.exit_code = error.exit_code
            self.in_a_row += 1
            return
        self.in_a_row = 0
        self.written += made.made
        self.there += not made.made
        self.size += made.size
        self.cpu_s += made.cpu_s

    def lines(self) -> list[str]:
        """What to tell at the end: a summary, and one line for each failure."""
        size = f", {self.size / 1e6:.1f} MB, {self.cpu_s:.1f} CPU s" if self.written else ""
        counts = f"{self.written} written{size}; {self.there} there already; {len(self.failures)} failed"
        reasons = [f"  seed {seed}: {why}" for seed, why in self.failures.items()]
        if self.gave_up:
            reasons.append(f"  gave up after {GIVE_UP_AFTER} failures in a row; run the same line again to go on")
        return [f"scenes: {counts}", *reasons]


def generate_scenes(
    root: Path,
    world: SceneWorld,
    form: SceneFormat,
    seeds: range,
    *,
    workers: int = 1,
    ray_address: str | None = None,
) -> Iterator[SceneRun]:
    """Make the scenes of `seeds` in the folder `root`; gives the account after every scene, the same object each time.

    Scenes that are there are kept, what a killed run left half done is removed. workers, ray_address: see `map_items`.
    Raises: RunError as `map_items`.
    """
    root = root.resolve()
    remove_leftovers(root)
    one_thread_each()
    run = SceneRun()
    for outcome in map_items(partial(write_scene, root, world, form), seeds, workers=workers, ray_address=ray_address):
        run.add(outcome)
        yield run
        if run.gave_up:
            return
