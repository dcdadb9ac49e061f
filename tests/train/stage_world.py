"""A world of a floor and a sliding box, for our own writers and renderer: no physics."""

from dataclasses import replace

import numpy as np

from gcd_train.scenes.description import Light, Paint, Part, Scene, upright
from gcd_train.scenes.drop import HFOV_DEG, orbit_cameras
from gcd_train.scenes.worlds import SCENE_WORLDS

LIGHT = Light(
    sun_to=(0.0, 0.0, 1.0),
    sun=(1.0, 1.0, 1.0),
    sky=(0.4, 0.4, 0.4),
    ground=(0.2, 0.2, 0.2),
    horizon=(0.7, 0.8, 0.9),
    zenith=(0.3, 0.5, 0.8),
    fog_m=1e6,
    cloud=0.0,
    exposure=1.0,
)


def stage(seed: int, frames: int) -> Scene:
    """A floor with a box that slides over it; no physics."""
    path = np.zeros((frames, 2, 4), np.float32)
    path[:, 1, 0] = np.arange(frames) + seed
    floor = Part("box", (0, 0, -0.5), (60, 60, 1), Paint((0.5, 0.4, 0.3)), 1)
    box = Part("box", (0, 0, 1), (2, 2, 2), Paint((0.2, 0.3, 0.8)), 2, instance=7, body=1)
    return Scene(
        parts=(floor, box),
        sheets=(),
        poses=upright(path),
        focus=np.zeros((frames, 3), np.float32),
        cameras=orbit_cameras(frames),
        hfov_deg=HFOV_DEG,
        light=LIGHT,
    )


STAGE = replace(SCENE_WORLDS["drop"], name="stage", make=stage)
"""In Kubric-4D's layout."""
