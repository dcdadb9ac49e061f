"""The worlds there are, by name, as whole scenes in the published layouts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gcd_train.data import kubric4d, parallel_domain4d
from gcd_train.errors import RecipeError
from gcd_train.scenes.description import Scene
from gcd_train.scenes.driving import EDITION, ONTOLOGY, OntologyItem, driving_drive, vehicle_from_camera

Layout = Literal["kubric4d", "parallel_domain4d"]


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
    layout: Layout = "kubric4d"
    frames: int = kubric4d.FRAMES
    fps: float = kubric4d.FPS
    width: int = kubric4d.WIDTH
    height: int = kubric4d.HEIGHT
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


SCENE_WORLDS: dict[str, SceneWorld] = {
    "drop": SceneWorld(name="drop", make=_drop),
    "tabletop": SceneWorld(name="tabletop", make=_tabletop),
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


def scene_world(name: str) -> SceneWorld:
    """A world by its name. Raises RecipeError: no such world."""
    if name not in SCENE_WORLDS:
        raise RecipeError(f"there is no world {name!r}; choose one of {', '.join(SCENE_WORLDS)}")
    return SCENE_WORLDS[name]
