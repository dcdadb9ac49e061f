"""The worlds there are, by name."""

from collections.abc import Callable

import msgspec

from gcd_model.geometry import CameraMount
from gcd_train.scenes.description import Scene
from gcd_train.scenes.driving import driving_scene


class WorldOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the source camera really sits, for studies of a wrong mount. height_m, tilt_deg: see CameraMount."""

    height_m: float = CameraMount().height_m
    tilt_deg: float = CameraMount().tilt_deg


def _driving(seed: int, frames: int, options: WorldOptions) -> Scene:
    mount = CameraMount(height_m=options.height_m, tilt_deg=options.tilt_deg)
    return driving_scene(seed, frames=frames, mount=mount)


WORLDS: dict[str, Callable[[int, int, WorldOptions], Scene]] = {"driving": _driving}
