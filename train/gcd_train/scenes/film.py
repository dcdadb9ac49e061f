"""A longer drive as a video file, as the forward camera sees it: what the package ships to replay."""

from dataclasses import replace
from pathlib import Path

import cv2

from gcd_train.errors import DataError
from gcd_train.scenes.driving import FPS, driving_scene
from gcd_train.scenes.renderer import Renderer


def write_film(out: Path, seed: int, *, frames: int, width: int, height: int) -> None:
    """Render the source view of a driving scene into an MP4 file (MPEG-4 part 2).

    Raises: RenderError where nothing can be drawn; DataError if the file cannot be written.
    """
    scene = driving_scene(seed, frames=frames)
    with Renderer(width, height, oversample=2) as renderer:
        views = renderer.render(replace(scene, cameras={"source": scene.cameras["source"]}))["source"]
    out.parent.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(out), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (width, height))
    if not video.isOpened():
        raise DataError(f"{out} cannot be written; give a path ending in .mp4 in a folder that takes files")
    for view in views:
        video.write(view.rgb[..., ::-1])
    video.release()
