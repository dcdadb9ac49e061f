"""What a folder of pairs of clips says about itself, and how its clips are numbered."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

from gcd_model.config import DRIVING_CLASSES, SemanticClass
from gcd_model.errors import FileError
from gcd_model.geometry import CameraMount
from gcd_model.small_files import read_json
from gcd_train.errors import DataError, RecipeError
from gcd_train.files import write_whole
from gcd_train.scenes.driving import EDITION as DRIVING_EDITION
from gcd_train.scenes.driving import FPS as DRIVING_FPS
from gcd_train.scenes.driving import HFOV_DEG as DRIVING_HFOV_DEG
from gcd_train.scenes.worlds import SceneWorld

DEPTH_UNIT_M = 1 / 256
"""Depth is stored in these, as 16 bit."""
STAGE_HFOV_DEG = math.degrees(2 * math.atan(0.5))
"""Kubric-4D's lens, as the worlds on its stage have it."""

Numbers: TypeAlias = tuple[float, float, float]
CameraWay: TypeAlias = Literal["gradual", "direct"]
"""How the target camera reaches its goal: over the whole clip, or it stands there from the first frame on."""


class WorldOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the source camera really sits, for studies of a wrong mount. height_m, tilt_deg: see CameraMount."""

    height_m: float = CameraMount().height_m
    tilt_deg: float = CameraMount().tilt_deg


class Orbit(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a clip of an orbit world was cut from its scene.

    start: azimuth and elevation in degrees and radius in metres of the source. change: the same of target minus source,
    at the end of the way. frame_numbers: the scene's time steps.
    """

    start: Numbers
    change: Numbers
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

    def seeds_of(self, first_scene: int, clips: int) -> range:
        """Numbers of so many clips, from the first one of a scene on."""
        first = first_scene * self.clips_per_scene
        return range(first, first + clips)


@dataclass(frozen=True, kw_only=True, slots=True)
class PairForm:
    """How pairs of clips are drawn and stored. width, height: pixels. oversample: see Renderer."""

    width: int = 192
    height: int = 128
    frames: int = 14
    oversample: int = 2
    clips_per_shard: int = 8


def driving_world(form: PairForm, mount: WorldOptions, path: CameraWay = "gradual") -> World:
    """Pairs of the forward camera and the path to the view from above.

    mount: where the source camera really sits. path: how the target camera gets there.
    Raises: PoseError if that is no mount.
    """
    CameraMount(height_m=mount.height_m, tilt_deg=mount.tilt_deg)  # refuses what is none before anything is made
    return World(
        name="driving",
        width=form.width,
        height=form.height,
        frames=form.frames,
        fps=DRIVING_FPS,
        hfov_deg=DRIVING_HFOV_DEG,
        oversample=form.oversample,
        clips_per_shard=form.clips_per_shard,
        options=mount,
        edition=DRIVING_EDITION,
        path=path,
    )


def orbit_world(scenes: SceneWorld, form: PairForm, *, stride: int = 2, clips_per_scene: int = 3) -> World:
    """Pairs of clips of a world on Kubric-4D's stage: the source stands, the target goes over the sphere.

    Raises:
        RecipeError: this world has no stage, or its scenes are too short for such clips.
    """
    if scenes.layout != "kubric4d":
        raise RecipeError(f"the world {scenes.name} has no stage to go round; choose drop or tabletop")
    if (form.frames - 1) * stride + 2 > scenes.frames:  # its last frame stays out of reach, see `FrameSampling`
        raise RecipeError(
            f"a {scenes.name} scene has {scenes.frames} time steps, too few for {form.frames} frames at stride "
            f"{stride}; ask for up to {(scenes.frames - 2) // stride + 1}"
        )
    return World(
        name=scenes.name,
        width=form.width,
        height=form.height,
        frames=form.frames,
        fps=scenes.fps / stride,
        hfov_deg=STAGE_HFOV_DEG,
        oversample=form.oversample,
        clips_per_shard=form.clips_per_shard,
        classes=(),
        camera="orbit",
        clips_per_scene=clips_per_scene,
        edition=scenes.edition,
        stride=stride,
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
