"""A longer scene as a video file, as its source camera sees it: what the package ships to replay."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Spherical, to_pose
from gcd_train.errors import DataError
from gcd_train.scenes.driving import FPS, driving_scene
from gcd_train.scenes.frozen import FrozenScene, freeze
from gcd_train.scenes.pair_world import STAGE_HFOV_DEG
from gcd_train.scenes.renderer import Renderer
from gcd_train.scenes.worlds import scene_world

STAGE_SOURCE = Spherical(azimuth_deg=0.0, elevation_deg=20.0, radius_m=15.0)
"""Where the camera stands that films what happens on a stage."""
_STAGE_STRIDE = 2  # a world on a stage runs at 24 Hz, its pairs and its films at 12


def write_film(out: Path, seed: int, *, world: str = "driving", frames: int, width: int, height: int) -> None:
    """Render the source view of a scene into an MP4 file (MPEG-4 part 2).

    world: "driving", 10 frames a second, or one on a stage, 12 a second seen from `STAGE_SOURCE`.
    Raises: RecipeError for an unknown world; RenderError where nothing can be drawn; DataError if the file cannot be
        written.
    """
    scene, camera, rate_hz = filmed(world, seed, frames)
    out.parent.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(out), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, (width, height))
    if not video.isOpened():
        raise DataError(f"{out} cannot be written; give a path ending in .mp4 in a folder that takes files")
    with Renderer(width, height, oversample=2) as renderer:
        for _, _, view in renderer.views(scene, {"source": camera}):
            video.write(view.rgb[..., ::-1])
    video.release()


def filmed(world: str, seed: int, frames: int) -> tuple[FrozenScene, NDArray[np.float64], float]:
    """What a film shows: the scene at its time steps, world_from_camera [T, 4, 4], and frames a second.

    Raises: RecipeError for an unknown world.
    """
    return _drive(seed, frames) if world == "driving" else _stage(world, seed, frames)


def _drive(seed: int, frames: int) -> tuple[FrozenScene, NDArray[np.float64], float]:
    scene = driving_scene(seed, frames=frames)
    return freeze(scene), scene.cameras["source"], FPS


def _stage(name: str, seed: int, frames: int) -> tuple[FrozenScene, NDArray[np.float64], float]:
    world = scene_world(name)
    scene = world.make(seed, frames * _STAGE_STRIDE)
    cut = replace(
        freeze(scene),
        poses=scene.poses[::_STAGE_STRIDE],
        focus=scene.focus[::_STAGE_STRIDE],
        hfov_deg=STAGE_HFOV_DEG,
    )
    return cut, np.tile(to_pose(STAGE_SOURCE).numpy(), (frames, 1, 1)), world.fps / _STAGE_STRIDE
