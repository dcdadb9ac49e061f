"""The worlds there are, as whole scenes in the published layouts and as pairs of clips: what a folder of pairs says
about itself, and how its clips are numbered.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gcd_model.config import DRIVING_CLASSES, SemanticClass
from gcd_model.errors import FileError
from gcd_model.geometry import CameraMount
from gcd_model.small_files import read_json
from gcd_train.data import kubric4d, parallel_domain4d
from gcd_train.errors import DataError, RecipeError
from gcd_train.files import write_whole
from gcd_train.scenes.description import Scene
from gcd_train.scenes.driving.classes import ONTOLOGY, OntologyItem
from gcd_train.scenes.driving.world import EDITION, driving_drive, vehicle_from_camera
from gcd_train.scenes.driving.world import HFOV_DEG as DRIVING_HFOV_DEG
from gcd_train.scenes.drop.world import HFOV_DEG as STAGE_HFOV_DEG
from gcd_train.scenes.drop.world import drop_scene
from gcd_train.scenes.tabletop.scene import tabletop_scene


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneWorld:
    """A world of whole scenes, seen by all cameras of a published data set, by default Kubric-4D's.

    make: the scene of a seed with so many frames; nothing else decides what is drawn. edition: rises whenever `make`
    draws another scene for the same seed. frames, fps, width, height: as published. classes, vehicle_from_camera: of
    layouts that have them; the latter gives [4, 4] by camera.
    """

    name: str
    make: Callable[[int, int], Scene]
    edition: int = 1
    layout: Literal["kubric4d", "parallel_domain4d"] = "kubric4d"
    frames: int = kubric4d.FRAMES
    fps: float = kubric4d.FPS
    width: int = kubric4d.WIDTH
    height: int = kubric4d.HEIGHT
    classes: tuple[OntologyItem, ...] = ()
    vehicle_from_camera: Callable[[], dict[str, NDArray[np.float64]]] | None = None


SCENE_WORLDS: dict[str, SceneWorld] = {
    "drop": SceneWorld(name="drop", make=drop_scene),
    "tabletop": SceneWorld(name="tabletop", make=tabletop_scene),
    "driving": SceneWorld(
        name="driving",
        make=driving_drive,
        edition=EDITION,
        layout="parallel_domain4d",
        frames=parallel_domain4d.FRAMES,
        fps=parallel_domain4d.FPS,
        width=parallel_domain4d.WIDTH,
        height=parallel_domain4d.HEIGHT,
        classes=ONTOLOGY,
        vehicle_from_camera=vehicle_from_camera,
    ),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneFormat:
    """How scenes and pairs are drawn and stored; by default as pairs are.

    width, height: pixels. oversample: see `Renderer`. compact: of scenes, WebP and depth codes.
    """

    width: int = 192
    height: int = 128
    frames: int = 14
    oversample: int = 2
    compact: bool = False


# pairs of clips

DEPTH_UNIT_M = 1 / 256
"""Depth is stored in these, as 16 bit."""

CameraWay: TypeAlias = Literal["gradual", "direct"]
"""How the target camera reaches its goal: over the whole clip, or it stands there from the first frame on."""


class WorldOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the source camera sits. height_m, tilt_deg: see CameraMount."""

    height_m: float = CameraMount().height_m
    tilt_deg: float = CameraMount().tilt_deg


_STRIDE = 2
"""Time steps of a stage from one frame of a clip to the next."""


class Orbit(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a clip of an orbit world was cut from its scene.

    start: azimuth and elevation in degrees and radius in metres of the source. change: the same of target minus source,
    at the end of the way. frame_numbers: the scene's time steps.
    """

    start: tuple[float, float, float]
    change: tuple[float, float, float]
    frame_numbers: tuple[int, ...]


class World(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a data folder says about itself; all its shards were made alike.

    width, height, frames, fps, hfov_deg: of the clips. oversample: see Renderer. options: what the generator was told.
    classes: the ontology, empty where the world has none. format: of this layout. camera: "fixed", the path that the
    world itself gives its target camera, or "orbit", a path over the sphere that is drawn for each clip.
    clips_per_scene: how many clips are cut from what was simulated once; clip k of scene s has the number
    s * clips_per_scene + k. edition: of the world, see `SceneWorld`. stride: time steps of the scene from one frame of
    the clip to the next. path: how the target camera of a "fixed" world reaches its goal.
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
    camera: Literal["fixed", "orbit"] = "fixed"
    clips_per_scene: Annotated[int, Meta(ge=1)] = 1
    edition: Annotated[int, Meta(ge=1)] = 1
    stride: Annotated[int, Meta(ge=1)] = 1
    path: CameraWay = "gradual"

    @property
    def move_time(self) -> int:
        """The frame in which the target camera is at its goal."""
        return 0 if self.path == "direct" else self.frames - 1

    def scene_of(self, seed: int) -> int:
        """The seed of the scene that a clip was cut from."""
        return seed // self.clips_per_scene


def pair_world(
    scenes: SceneWorld,
    form: SceneFormat,
    *,
    clips_per_shard: int = 8,
    path: CameraWay = "gradual",
    clips_per_scene: int = 3,
) -> World:
    """Pairs of clips of a world: of driving the forward camera and the path to the view from above, of a world on
    Kubric-4D's stage a source that stands and a target that goes over the sphere.

    path: of driving, how the target camera gets to its goal. clips_per_scene: of a stage.

    Raises RecipeError where the scenes are too short for such clips.
    """
    shared: dict[str, Any] = {"name": scenes.name, "edition": scenes.edition, "clips_per_shard": clips_per_shard}
    shared |= {name: getattr(form, name) for name in ("width", "height", "frames", "oversample")}
    if scenes.layout == "parallel_domain4d":
        return World(**shared, fps=scenes.fps, hfov_deg=DRIVING_HFOV_DEG, path=path)
    if (form.frames - 1) * _STRIDE + 2 > scenes.frames:  # its last frame stays out of reach, see `FrameSampling`
        raise RecipeError(
            f"a {scenes.name} scene has {scenes.frames} time steps, too few for {form.frames} frames at stride "
            f"{_STRIDE}; ask for up to {(scenes.frames - 2) // _STRIDE + 1}"
        )
    return World(
        **shared,
        fps=scenes.fps / _STRIDE,
        hfov_deg=STAGE_HFOV_DEG,
        classes=(),
        camera="orbit",
        clips_per_scene=clips_per_scene,
        stride=_STRIDE,
    )


def read_world(folder: Path) -> World:
    """What a data folder says about itself. Raises DataError."""
    path = folder / "world.json"
    if not path.exists():
        raise DataError(
            f"{folder} is no data folder: it has no world.json; make one with `gcd-train generate WORLD DIR --pairs`"
        )
    try:
        return read_json(path, World)
    except FileError as error:
        raise DataError(f"{path} {error}; make the folder anew with this version") from error


def agree(folder: Path, world: World) -> None:
    """Write `world.json`, or make sure that the one that is there says the same. Raises DataError."""
    path = folder / "world.json"
    if not path.exists():
        write_whole(path, msgspec.json.format(msgspec.json.encode(world)))
    elif read_world(folder) != world:
        raise DataError(f"{folder} holds clips of another world or size (see its world.json); choose another folder")
