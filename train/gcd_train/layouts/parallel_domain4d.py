"""Writes scenes as ParallelDomain-4D has them: see `parallel_domain4d_names` for the files.

Poses are told in the vehicle's frame (x ahead, y left, z up), where all 19 cameras stand still.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from gcd_model.geometry import Intrinsics
from gcd_train.layouts import encodings
from gcd_train.layouts.camera_facts import Doubles, quaternions
from gcd_train.layouts.depth_code import with_sky
from gcd_train.layouts.parallel_domain4d_names import Layer, calibration_folder, frame_path, ontology_folder
from gcd_train.layouts.scene_files import SceneFiles
from gcd_train.scenes.driving import OntologyItem
from gcd_train.scenes.renderer import Rendering

_VOID_ID = 255
_WEBP_QUALITY = 80


class ParallelDomain4DWriter:
    """One scene, view by view as they are drawn, in any order; `finish` adds calibration and ontology.

    Depth is along the axis, 30 km for the sky. Classes are those of `classes`, void where it has none.
    """

    def __init__(
        self,
        files: SceneFiles,
        lens: Intrinsics,
        vehicle_from_camera: Mapping[str, Doubles],
        classes: Sequence[OntologyItem],
        *,
        compact: bool,
    ) -> None:
        self._files, self._compact = files, compact
        self._calibration = calibration(vehicle_from_camera, lens)
        self._ontology = ontology(classes)
        self._class_ids = np.full(256, _VOID_ID, np.uint8)
        self._class_ids[[item.label for item in classes]] = [item.id for item in classes]

    def add(self, time: int, camera: str, drawn: Rendering) -> None:
        """Write colour, depth, classes and instances of one view."""
        depth = with_sky(drawn.depth)
        id_png = encodings.packed_id_png if self._compact else encodings.id_png
        if self._compact:
            self._write(camera, "rgb", time, encodings.webp(drawn.rgb, quality=_WEBP_QUALITY))
            self._write(camera, "depth", time, encodings.street_depth_png(depth))
        else:
            self._write(camera, "rgb", time, encodings.rgb_png(drawn.rgb))
            self._write(camera, "depth", time, encodings.float_npz(depth))
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
    return {
        "names": list(vehicle_from_camera),
        "intrinsics": [inside] * len(vehicle_from_camera),
        "extrinsics": [_extrinsics(pose) for pose in vehicle_from_camera.values()],
    }


def ontology(classes: Sequence[OntologyItem]) -> dict[str, Any]:
    """Names and colours by id, and 255 for what has no class."""
    items = [_item(kind.id, kind.name, kind.colour, kind.is_thing) for kind in classes]
    return {"items": [*items, _item(_VOID_ID, "Void", (0, 0, 0), is_thing=False)]}


def _item(number: int, name: str, colour: tuple[int, int, int], is_thing: bool) -> dict[str, Any]:
    red, green, blue = colour
    shade = {"r": red, "g": green, "b": blue}
    return {"id": number, "name": name, "color": shade, "isthing": is_thing, "supercategory": ""}


def _extrinsics(pose: Doubles) -> dict[str, dict[str, float]]:
    turn = quaternions(pose[:3, :3]).tolist()
    return {
        "rotation": dict(zip(("qw", "qx", "qy", "qz"), turn, strict=True)),
        "translation": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
    }
