"""The worlds there are, by name, as whole scenes in the published layouts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import CameraMount
from gcd_train.errors import RecipeError
from gcd_train.layouts import kubric4d, parallel_domain4d
from gcd_train.scenes.description import Scene
from gcd_train.scenes.driving import ONTOLOGY, OntologyItem, driving_drive, vehicle_from_camera

Layout = Literal["kubric4d", "parallel_domain4d"]


class WorldOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the source camera really sits, for studies of a wrong mount. height_m, tilt_deg: see CameraMount."""

    height_m: float = CameraMount().height_m
    tilt_deg: float = CameraMount().tilt_deg


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneWorld:
    """A world of whole scenes, seen by all cameras of a published data set.

    make: the scene of a seed with so many frames; nothing else decides what is drawn. edition: rises whenever `make`
    draws another scene for the same seed. frames, fps, width, height: as published. classes, vehicle_from_camera: of
    layouts that have them; the latter gives [4, 4] by camera.
    """

    name: str
    layout: Layout
    make: Callable[[int, int], Scene]
    edition: int
    frames: int
    fps: float
    width: int
    height: int
    classes: tuple[OntologyItem, ...] = ()
    vehicle_from_camera: Callable[[], dict[str, NDArray[np.float64]]] | None = None

    def scene_name(self, seed: int) -> str:
        """The folder in which the scene of a seed lies: its number is the seed."""
        names = kubric4d if self.layout == "kubric4d" else parallel_domain4d
        return names.scene_name(seed)


def _drop(seed: int, frames: int) -> Scene:
    from gcd_train.scenes.drop import drop_scene  # its physics is an extra

    return drop_scene(seed, frames=frames)


def _tabletop(seed: int, frames: int) -> Scene:
    from gcd_train.scenes.tabletop import tabletop_scene  # its physics is an extra

    return tabletop_scene(seed, frames=frames)


def _drive(seed: int, frames: int) -> Scene:
    return driving_drive(seed, frames=frames)


def _on_a_stage(name: str, make: Callable[[int, int], Scene], edition: int) -> SceneWorld:
    """A world with Kubric-4D's cameras and layout."""
    return SceneWorld(
        name=name,
        layout="kubric4d",
        make=make,
        edition=edition,
        frames=kubric4d.FRAMES,
        fps=kubric4d.FPS,
        width=kubric4d.WIDTH,
        height=kubric4d.HEIGHT,
    )


SCENE_WORLDS: dict[str, SceneWorld] = {
    "drop": _on_a_stage("drop", _drop, edition=1),
    "tabletop": _on_a_stage("tabletop", _tabletop, edition=1),
    "driving": SceneWorld(
        name="driving",
        layout="parallel_domain4d",
        make=_drive,
        edition=2,  # the first is that of the pairs
        frames=parallel_domain4d.FRAMES,
        fps=parallel_domain4d.FPS,
        width=parallel_domain4d.WIDTH,
        height=parallel_domain4d.HEIGHT,
        classes=ONTOLOGY,
        vehicle_from_camera=vehicle_from_camera,
    ),
}
"""Worlds of whole scenes."""


def scene_world(name: str) -> SceneWorld:
    """A world by its name. Raises RecipeError: no such world."""
    if name not in SCENE_WORLDS:
        raise RecipeError(f"there is no world {name!r}; choose one of {', '.join(SCENE_WORLDS)}")
    return SCENE_WORLDS[name]
