"""Where things lie in a Kubric-4D scene folder.

    scn00042/
        scn00042_p0_v3.json                 metadata of view 3 (0..15)
        frames_p0_v3/rgba_00007.png         colour with alpha, 8 bit            compact: .webp, no alpha
        frames_p0_v3/depth_00007.tiff       float32, distance to the camera     compact: .png, 16 bit, depth along the
                                                                                axis (!), see depth_code
        frames_p0_v3/segmentation_00007.png palette, instance number            compact: the same

Along the axis, flat ground is equally far all along a row of pixels, which halves the size of a compact scene.
Source: the Kubric-4D data set of Van Hoorick et al. 2024, as downloaded.
"""

import re
from pathlib import Path
from typing import Literal

Layer = Literal["rgba", "depth", "segmentation"]

VIEWS = 16
FRAMES = 60
FPS = 24.0
WIDTH, HEIGHT = 576, 384
SUFFIXES: dict[Layer, str] = {"rgba": "png", "depth": "tiff", "segmentation": "png"}
COMPACT_SUFFIXES: dict[Layer, str] = {"rgba": "webp", "depth": "png", "segmentation": "png"}
CAMERAS = tuple(f"view{view}" for view in range(VIEWS))
"""What our worlds call the published views, by their number."""


def scene_name(number: int) -> str:
    """Folder of a scene, `scn00042`."""
    return f"scn{number:05d}"


def scene_number(name: str) -> int | None:
    """The number in a folder's name, None if it is no scene of this layout."""
    named = re.fullmatch(r"scn(\d{5,})", name)
    return None if named is None else int(named[1])


def metadata_path(scene: Path, view: int) -> Path:
    """JSON of one view of a scene folder, `scn00042/scn00042_p0_v3.json`."""
    return scene / f"{scene.name}_p0_v{view}.json"


def frames_folder(scene: Path, view: int) -> Path:
    """Folder with the pictures of one view, `scn00042/frames_p0_v3`."""
    return scene / f"frames_p0_v{view}"


def frame_path(scene: Path, view: int, layer: Layer, time: int, *, compact: bool = False) -> Path:
    """One picture of a layer at frame number `time`, `scn00042/frames_p0_v3/rgba_00007.png`."""
    suffix = (COMPACT_SUFFIXES if compact else SUFFIXES)[layer]
    return frames_folder(scene, view) / f"{layer}_{time:05d}.{suffix}"
