"""Makes one scene of a world and writes it whole: pictures, metadata, geometry, manifest."""

import io
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np

from gcd_model.geometry import Intrinsics
from gcd_train.errors import DataError, RecipeError
from gcd_train.layouts.kubric4d import Kubric4DWriter
from gcd_train.layouts.manifest import GEOMETRY, MANIFEST, Matrix, SceneManifest, package_version, read_manifest
from gcd_train.layouts.parallel_domain4d import ParallelDomain4DWriter
from gcd_train.layouts.scene_files import SceneFiles
from gcd_train.layouts.scene_folder import new_scene
from gcd_train.scenes.description import Scene
from gcd_train.scenes.frozen import FrozenScene, freeze
from gcd_train.scenes.renderer import Renderer, Rendering, require_drawing
from gcd_train.scenes.worlds import SceneWorld

_FREE_TO_DIFFER = {"version", "files", "world_from_vehicle", "hfov_deg", "cameras", "facts"}


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneFormat:
    """How scenes are drawn and stored. oversample: see `Renderer`. compact: WebP and depth codes."""

    width: int
    height: int
    frames: int
    oversample: int = 2
    compact: bool = False

    def __post_init__(self) -> None:
        if min(self.width, self.height, self.frames, self.oversample) < 1:
            raise RecipeError(f"sizes, frames and oversampling must be at least 1, got {self}")

    @classmethod
    def of(cls, world: SceneWorld, *, oversample: int = 2, compact: bool = False) -> "SceneFormat":
        """As the world's published data set."""
        return cls(width=world.width, height=world.height, frames=world.frames, oversample=oversample, compact=compact)


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneMade:
    """folder: where it lies. made: False if it was there already. size: bytes written. cpu_s: of drawing, writing."""

    folder: Path
    made: bool
    size: int = 0
    cpu_s: float = 0.0


class LayoutWriter(Protocol):
    """Takes a scene's views in any order."""

    def add(self, time: int, camera: str, drawn: Rendering) -> None:
        """One view."""
        ...

    def finish(self) -> None:
        """After the last view."""
        ...


def write_scene(root: Path, world: SceneWorld, form: SceneFormat, seed: int) -> SceneMade:
    """Draw and write the scene of a seed, unless it is there: the folder appears once everything is in it.

    Raises:
        DataError: a folder of this name holds something else.
        RenderError: nothing can be drawn on this machine.
        OSError: the disk is full, or cannot be written.
    """
    place = root / world.scene_name(seed)
    if place.exists():
        _require_alike(place, world, form, seed)
        return SceneMade(folder=place, made=False)
    started = time.process_time()
    require_drawing()  # before a simulation of many seconds
    scene = world.make(seed, form.frames)
    with new_scene(root, place.name) as folder:
        files = SceneFiles(folder)
        manifest = _manifest(world, form, seed, scene)
        frozen = freeze(scene)
        _write_views(_writer(files, world, form, seed, scene), scene, frozen, form)
        files.write(folder / GEOMETRY, _geometry(frozen))
        told = msgspec.structs.replace(manifest, files=dict(sorted(files.checksums.items())))
        files.write(folder / MANIFEST, msgspec.json.format(msgspec.json.encode(told), indent=1))
    return SceneMade(folder=place, made=True, size=files.size, cpu_s=time.process_time() - started)


def _write_views(writer: LayoutWriter, scene: Scene, frozen: FrozenScene, form: SceneFormat) -> None:
    with Renderer(form.width, form.height, oversample=form.oversample) as renderer:
        for step, camera, drawn in renderer.views(frozen, scene.cameras):
            writer.add(step, camera, drawn)
    writer.finish()


def _writer(
    files: SceneFiles,
    world: SceneWorld,
    form: SceneFormat,
    seed: int,
    scene: Scene,
) -> LayoutWriter:
    lens = Intrinsics.from_hfov(scene.hfov_deg, form.width, form.height)
    if world.vehicle_from_camera is None:
        return Kubric4DWriter(files, scene, lens, seed=seed, fps=world.fps, compact=form.compact)
    rig = world.vehicle_from_camera()
    return ParallelDomain4DWriter(files, lens, rig, world.classes, compact=form.compact)


def _manifest(world: SceneWorld, form: SceneFormat, seed: int, scene: Scene | None) -> SceneManifest:
    """Without the files. No scene: for comparing what does not depend on it."""
    return SceneManifest(
        layout=world.layout,
        world=world.name,
        seed=seed,
        version=package_version(),
        edition=world.edition,
        frames=form.frames,
        fps=world.fps,
        width=form.width,
        height=form.height,
        oversample=form.oversample,
        compact=form.compact,
        hfov_deg=scene.hfov_deg if scene else 0.0,
        cameras=tuple(scene.cameras) if scene else (),
        files={},
        world_from_vehicle=_vehicle_path(world, scene) if scene else None,
        facts=scene.facts if scene else {},
    )


def _vehicle_path(world: SceneWorld, scene: Scene) -> tuple[Matrix, ...] | None:
    if world.vehicle_from_camera is None:
        return None
    camera, pose = next(iter(world.vehicle_from_camera().items()))
    return tuple(tuple(map(tuple, rows)) for rows in (scene.cameras[camera] @ np.linalg.inv(pose)).tolist())


def _require_alike(place: Path, world: SceneWorld, form: SceneFormat, seed: int) -> None:
    there, wanted = read_manifest(place), _manifest(world, form, seed, None)
    for field in there.__struct_fields__:
        came, needed = getattr(there, field), getattr(wanted, field)
        if field not in _FREE_TO_DIFFER and came != needed:
            raise DataError(
                f"{place} is there already with {field} {came}, wanted {needed}; choose another folder or remove it"
            )


def _geometry(frozen: FrozenScene) -> bytes:
    file: Any = io.BytesIO()
    frozen.save(file)
    return file.getvalue()
