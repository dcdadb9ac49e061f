"""Where things lie in a ParallelDomain-4D scene folder.

    scene_000042/
        rgb/yaw-0/000000000000000075.png                        colour, 8 bit           compact: .webp
        depth/yaw-0/000000000000000075.npz                      array `data`, float32,  compact: .png, 16 bit, see
                                                                metres along the axis   depth_code
        semantic_segmentation_2d/yaw-0/000000000000000075.png   class id =              compact: the same colours, as
                                                                R + 256 G + 65536 B     a palette PNG
        instance_segmentation_2d/yaw-0/000000000000000075.png   instance id, alike
        calibration/*.json, ontology/*.json

Files are named by ten times the frame number plus five (frame 7: 75). Source: the ParallelDomain-4D data set of
Van Hoorick et al. 2024, as downloaded.
"""

import re
from pathlib import Path
from typing import Literal

Layer = Literal["rgb", "depth", "semantic_segmentation_2d", "instance_segmentation_2d"]

FRAMES = 50
FPS = 10.0
WIDTH, HEIGHT = 640, 480
HFOV_DEG = 85.0
SUFFIXES: dict[Layer, str] = {
    "rgb": "png",
    "depth": "npz",
    "semantic_segmentation_2d": "png",
    "instance_segmentation_2d": "png",
}
COMPACT_SUFFIXES: dict[Layer, str] = {
    "rgb": "webp",
    "depth": "png",
    "semantic_segmentation_2d": "png",
    "instance_segmentation_2d": "png",
}
CAMERAS = (*sorted(f"camera{number}" for number in range(16)), "yaw-0", "yaw-60", "yaw-neg-60")
"""The 19 cameras in the published order: 16 around the scene by name, then the vehicle's own."""
FORWARD = "yaw-0"
"""The camera that looks ahead: the source of every clip."""
DEPTH_KEY = "data"
"""Name of the array in a depth npz."""


def scene_name(number: int) -> str:
    """Folder of a scene, `scene_000042`."""
    return f"scene_{number:06d}"


def scene_number(name: str) -> int | None:
    """The number in a folder's name, None if it is no scene of this layout."""
    named = re.fullmatch(r"scene_(\d{6,})", name)
    return None if named is None else int(named[1])


def frame_stem(time: int) -> str:
    """File name without suffix of frame number `time`."""
    return f"{10 * time + 5:018d}"


def frame_time(stem: str) -> int | None:
    """Inverse of `frame_stem`; None if the file is no frame of this layout."""
    if not re.fullmatch(r"\d{18}", stem) or int(stem) % 10 != 5:
        return None
    return int(stem) // 10


def frame_path(scene: Path, camera: str, layer: Layer, time: int, *, compact: bool = False) -> Path:
    """One picture of a layer at frame number `time`, `scene_000042/rgb/yaw-0/000000000000000075.png`."""
    suffix = (COMPACT_SUFFIXES if compact else SUFFIXES)[layer]
    return scene / layer / camera / f"{frame_stem(time)}.{suffix}"


def calibration_folder(scene: Path) -> Path:
    """Holds one JSON with the cameras (its name is not fixed)."""
    return scene / "calibration"


def ontology_folder(scene: Path) -> Path:
    """Holds one JSON with the classes (its name is not fixed)."""
    return scene / "ontology"
