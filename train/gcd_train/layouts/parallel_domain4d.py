"""ParallelDomain-4D scene folders: where things lie, and what writes them.

    scene_000042/
        rgb/yaw-0/000000000000000075.png                        colour, 8 bit           compact: .webp
        depth/yaw-0/000000000000000075.npz                      array `data`, float32,  compact: .png, 16 bit, see
                                                                metres along the axis   STREET_DEPTH
        semantic_segmentation_2d/yaw-0/000000000000000075.png   class id =              compact: the same colours, as
                                                                R + 256 G + 65536 B     a palette PNG
        instance_segmentation_2d/yaw-0/000000000000000075.png   instance id, alike
        calibration/*.json, ontology/*.json

Files are named by ten times the frame number plus five (frame 7: 75). Poses are told in the vehicle's frame (x ahead,
y left, z up), where all 19 cameras stand still. Source: the ParallelDomain-4D data set of Van Hoorick et al. 2024, as
downloaded.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np

from gcd_model.geometry import Intrinsics
from gcd_train.layouts import encodings
from gcd_train.layouts.encodings import Doubles, quaternions, with_sky
from gcd_train.layouts.manifest import SceneFiles

if TYPE_CHECKING:
    from gcd_train.scenes.driving import OntologyItem
    from gcd_train.scenes.renderer import Rendering

Layer = Literal["rgb", "depth", "semantic_segmentation_2d", "instance_segmentation_2d"]

FRAMES = 50
FPS = 10.0
WIDTH, HEIGHT = 640, 480
CAMERAS = (*sorted(f"camera{number}" for number in range(16)), "yaw-0", "yaw-60", "yaw-neg-60")
"""The 19 cameras in the published order: 16 around the scene by name, then the vehicle's own."""
FORWARD = "yaw-0"
"""The camera that looks ahead: the source of every clip."""
DEPTH_KEY = "data"
"""Name of the array in a depth npz."""
_SUFFIXES = {"rgb": "png", "depth": "npz"}
_COMPACT_SUFFIXES = {"rgb": "webp", "depth": "png"}
_VOID_ID = 255
_WEBP_QUALITY = 80


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
    suffix = (_COMPACT_SUFFIXES if compact else _SUFFIXES).get(layer, "png")
    return scene / layer / camera / f"{frame_stem(time)}.{suffix}"


def calibration_folder(scene: Path) -> Path:
    """Holds one JSON with the cameras (its name is not fixed)."""
    return scene / "calibration"


def ontology_folder(scene: Path) -> Path:
    """Holds one JSON with the classes (its name is not fixed)."""
    return scene / "ontology"


class ParallelDomain4DWriter:
    """One scene, view by view as they are drawn, in any order; `finish` adds calibration and ontology.

    Depth is along the axis, 30 km for the sky. Classes are those of `classes`, void where it has none.
    """

    def __init__(
        self,
        files: SceneFiles,
        lens: Intrinsics,
        vehicle_from_camera: Mapping[str, Doubles],
        classes: "Sequence[OntologyItem]",
        *,
        compact: bool,
    ) -> None:
        self._files, self._compact = files, compact
        self._calibration = calibration(vehicle_from_camera, lens)
        self._ontology = ontology(classes)
        self._class_ids = np.full(256, _VOID_ID, np.uint8)
        self._class_ids[[item.label for item in classes]] = [item.id for item in classes]

    def add(self, time: int, camera: str, drawn: "Rendering") -> None:
        """Write colour, depth, classes and instances of one view."""
        depth = with_sky(drawn.depth)
        id_png = encodings.packed_id_png if self._compact else encodings.id_png
        if self._compact:
            self._write(camera, "rgb", time, encodings.webp(drawn.rgb, quality=_WEBP_QUALITY))
            self._write(camera, "depth", time, encodings.street_depth_png(depth))
        else:
            self._write(camera, "rgb", time, encodings.rgb_png(drawn.rgb))
            self._write(camera, "depth", time, encodings.float_npz(depth, DEPTH_KEY))
        self._write(camera, "semantic_segmentation_2d", time, id_png(self._class_ids[drawn.classes]))
        self._write(camera, "instance_segmentation_2d", time, id_png(drawn.instances))

    def finish(self) -> None:
        """Write what holds for the whole scene."""
        folder = self._files.folder
        self._files.write(calibration_folder(folder) / "calibration.json", msgspec.json.encode(self._calibration))
        self._files.write(ontology_folder(folder) / "ontology.json", msgspec.json.encode(self._ontology))

    def _write(self, camera: str, layer: Layer, time: int, data: bytes) -> None:
        self._files.write(frame_path(self._files.folder, camera, layer, time, compact=self._compact), data)


def calibration(vehicle_from_camera: Mapping[str, Doubles], lens: Intrinsics) -> dict[str, Any]:
    """Parallel lists of names, intrinsics in pixels and extrinsics: where each camera sits on the vehicle."""
    inside = {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy, "skew": 0.0, "fov": 0.0, "fisheye": 0}
    inside |= {f"k{number}": 0.0 for number in range(1, 7)} | {"p1": 0.0, "p2": 0.0}
    extrinsics = [
        {
            "rotation": dict(zip(("qw", "qx", "qy", "qz"), quaternions(pose[:3, :3]).tolist(), strict=True)),
            "translation": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
        }
        for pose in vehicle_from_camera.values()
    ]
    return {"names": list(vehicle_from_camera), "intrinsics": [inside] * len(extrinsics), "extrinsics": extrinsics}


def ontology(classes: "Sequence[OntologyItem]") -> dict[str, Any]:
    """Names and colours by id, and 255 for what has no class."""
    rows = [(kind.id, kind.name, kind.colour, kind.is_thing) for kind in classes]
    return {
        "items": [
            {
                "id": number,
                "name": name,
                "color": dict(zip("rgb", colour, strict=True)),
                "isthing": is_thing,
                "supercategory": "",
            }
            for number, name, colour, is_thing in [*rows, (_VOID_ID, "Void", (0, 0, 0), False)]
        ]
    }
