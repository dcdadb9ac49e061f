"""ParallelDomain-4D scene folders, as published and downloaded or as `gcd-train generate` writes them: names, reader,
writer.

    scene_000042/
        rgb/yaw-0/000000000000000075.png                        colour, 8 bit           compact: .webp
        depth/yaw-0/000000000000000075.npz                      array `data`, float32,  compact: .png, 16 bit, see
                                                                metres along the axis   STREET_DEPTH
        semantic_segmentation_2d/yaw-0/000000000000000075.png   class id =              compact: the same colours, as
                                                                R + 256 G + 65536 B     a palette PNG
        instance_segmentation_2d/yaw-0/000000000000000075.png   instance id, alike
        calibration/*.json, ontology/*.json

Files are named by ten times the frame number plus five (frame 7: 75). Poses are given in the vehicle's frame (x ahead,
y left, z up), where all 19 cameras stand still; the views call it their world.
Source: the ParallelDomain-4D data set of Van Hoorick et al. 2024, as downloaded.
"""

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.errors import FileError, ModelError
from gcd_model.geometry import Intrinsics
from gcd_model.small_files import decode_json
from gcd_train.data import encodings
from gcd_train.data.dataset4d import (
    KEPT_SCENES,
    VOID,
    Dataset4D,
    Ontology,
    pose_from_quaternion,
    read_ontology,
    scene_names,
)
from gcd_train.data.encodings import Doubles, quaternions, read_colour, read_depth, read_ids, sized, with_sky
from gcd_train.data.files import MOST_TEXT, FileFault, Recent, SceneFiles, one_of, read
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError

if TYPE_CHECKING:
    from gcd_train.scenes.driving.classes import OntologyItem
    from gcd_train.scenes.renderer import Rendering

_LOG = logging.getLogger(__name__)
Id = TypeVar("Id", np.uint8, np.uint16)

Layer = Literal["rgb", "depth", "semantic_segmentation_2d", "instance_segmentation_2d"]

FRAMES = 50
FPS = 10.0
WIDTH, HEIGHT = 640, 480
CAMERAS = (*sorted(f"camera{number}" for number in range(16)), "yaw-0", "yaw-60", "yaw-neg-60")
"""The 19 cameras in the published order: 16 around the scene by name, then the vehicle's own."""
FORWARD = "yaw-0"
"""The camera that looks ahead: the source of every clip."""
_SUFFIXES = {"rgb": "png", "depth": "npz"}
_COMPACT_SUFFIXES = {"rgb": "webp", "depth": "png"}
WEBP_QUALITY = 80


def scene_name(number: int) -> str:
    """Folder of a scene, `scene_000042`."""
    return f"scene_{number:06d}"


def frame_stem(time: int) -> str:
    """File name without suffix of frame number `time`."""
    return f"{10 * time + 5:018d}"


def frame_time(stem: str) -> int | None:
    """Inverse of `frame_stem`; None if the file is no frame of this layout."""
    return int(stem) // 10 if re.fullmatch(r"\d{17}5", stem) else None


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


@dataclass(frozen=True, slots=True)
class _Scene:
    """What does not change over the time of a scene. cameras: lens, and vehicle_from_camera f64 [4, 4], metres."""

    cameras: Mapping[str, tuple[Intrinsics, Doubles]]
    frames: int


class ParallelDomain4D(Dataset4D):
    """See Dataset4D.

    root: the folder with `scene_000000` and so on; gaps in the numbers are fine. scenes: by default all there are, with
    the ontology of the first that has a readable one, if classes are wanted. cameras: which there are, by default the
    19 published ones. classes, instances: read these layers too, where they are there. ontology: the classes of scenes
    that are named; one with other classes is at fault.
    Raises DataError: there is no scene, no such source camera, or classes are wanted and no scene has an ontology.
    """

    fps = FPS

    def __init__(
        self,
        root: Path | str,
        scenes: Sequence[str] | None = None,
        *,
        cameras: Sequence[str] = CAMERAS,
        classes: bool = True,
        instances: bool = False,
        ontology: Ontology | None = None,
        source_camera: str = FORWARD,
    ) -> None:
        root = Path(root)
        found = scene_names(root, "parallel_domain4d") if scenes is None else scenes
        super().__init__(root, found, cameras, source_camera)
        if source_camera not in self.cameras:
            raise DataError(f"the source camera {source_camera} is none of {', '.join(self.cameras)}")
        if scenes is None and classes:
            ontology = _first_ontology(root, found)
            if ontology.duplicates:
                names = {item.id: item.name for item in ontology.items}
                merged = "; ".join(", ".join(f"{names[i]} ({i})" for i in group) for group in ontology.duplicates)
                _LOG.warning("%s: classes of one colour are merged in decoding: %s", root, merged)
        self._classes, self._instances, self.ontology = classes, instances, ontology
        self._scene = Recent(self._read_scene, KEPT_SCENES)

    def frames(self, scene: str) -> int:
        """Time steps, up to the last picture of the source camera; some may be missing. Raises FileFault."""
        return self._scene(scene).frames

    def lens(self, scene: str) -> Intrinsics:
        """See Dataset4D."""
        return self._scene(scene).cameras[self.source_camera][0]

    def pose(self, scene: str, camera: str, time: int = 0) -> Doubles:
        """vehicle_from_camera; it does not change with time. Raises FileFault."""
        return self._scene(scene).cameras[camera][1]

    def view(self, scene: str, camera: str, time: int) -> SceneView:
        """See Dataset4D."""
        folder, (lens, pose) = self.folder(scene), self._scene(scene).cameras[camera]
        colour, depth = (
            one_of(*(frame_path(folder, camera, layer, time, compact=compact) for compact in (False, True)))
            for layer in ("rgb", "depth")
        )
        size = (lens.height, lens.width, f"{self.source_camera}'s first picture")
        rgb, metres = sized(colour, read_colour(colour), *size), sized(depth, read_depth(depth), *size)
        classes = instances = None
        if self._classes:
            classes = self._ids(folder, camera, "semantic_segmentation_2d", time, np.uint8)
        if self._instances:
            instances = self._ids(folder, camera, "instance_segmentation_2d", time, np.uint16)
        return SceneView(rgb=rgb, depth=metres, classes=classes, instances=instances, world_from_camera=pose, lens=lens)

    def _ids(self, folder: Path, camera: str, layer: Layer, time: int, kind: type[Id]) -> NDArray[Id] | None:
        """None where the layer was not downloaded at all; a single missing file is a fault."""
        if not (folder / layer).is_dir():
            return None
        path, lens, most = frame_path(folder, camera, layer, time), self.lens(folder.name), np.iinfo(kind).max
        ids = sized(path, read_ids(path), lens.height, lens.width, f"{self.source_camera}'s first picture")
        if int(ids.max()) > most:
            raise FileFault(path, f"holds id {int(ids.max())}, beyond {most}: is it another layer?")
        return ids.astype(kind)

    def _read_scene(self, scene: str) -> _Scene:
        folder = self.folder(scene)
        pictures = _pictures(folder / "rgb" / self.source_camera)
        height, width = read_colour(pictures[0]).shape[:2]
        cameras = read_calibration(calibration_folder(folder), self.cameras, width, height)
        if self.ontology is not None and (folder / "semantic_segmentation_2d").is_dir():
            found = read_ontology(ontology_folder(folder))
            if found.items != self.ontology.items:
                other = sorted({item.name for item in found.items} ^ {item.name for item in self.ontology.items})
                differ = f"by {', '.join(other[:5])}" if other else "in ids or colours"
                raise FileFault(
                    ontology_folder(folder), f"holds the wrong ontology: it differs from the first scene's {differ}"
                )
        return _Scene(cameras, 1 + max(frame_time(path.stem) or 0 for path in pictures))


def _pictures(folder: Path) -> list[Path]:
    """Frames of a camera in order. Raises FileFault if there is none."""
    try:
        found = sorted(path for path in folder.iterdir() if frame_time(path.stem) is not None)
    except OSError as error:
        raise FileFault(folder, f"is missing: a view cannot be read ({error})") from error
    if not found:
        raise FileFault(folder, "holds no picture: download or generate the scene again")
    return found


def _first_ontology(root: Path, scenes: Sequence[str]) -> Ontology:
    first: FileFault | None = None
    for scene in scenes:
        try:
            return read_ontology(ontology_folder(root / scene))
        except FileFault as fault:
            first = first or fault
    raise DataError(f"no scene has a readable ontology, first: {first}; read the set without classes instead")


class _File(msgspec.Struct, frozen=True):
    """Others' file; lists are parallel. What is no camera (velodyne) may have null or empty entries."""

    names: list[str]
    intrinsics: list[dict[str, Any] | None]
    extrinsics: list[dict[str, Any] | None]


def read_calibration(
    folder: Path, cameras: Sequence[str], width: int, height: int
) -> dict[str, tuple[Intrinsics, Doubles]]:
    """Lens and vehicle_from_camera of these cameras, from however many JSON files of a scene's `calibration` folder.

    width, height: of the pictures, pixels.
    Raises: FileFault if there is no file, one is damaged or of other pictures, or a camera is in none.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise FileFault(folder, "holds no JSON: where the cameras are is unknown; download the scene again")
    found: dict[str, tuple[Intrinsics, Doubles]] = {}
    for path in paths:
        try:
            file = decode_json(read(path, MOST_TEXT), _File)
        except FileError as error:
            raise FileFault(path, f"is no calibration: it {error}") from error
        if not len(file.names) == len(file.intrinsics) == len(file.extrinsics):
            raise FileFault(path, "is damaged: its lists of names, intrinsics and extrinsics differ in length")
        for name, lens, pose in zip(file.names, file.intrinsics, file.extrinsics, strict=True):
            if name in cameras and name not in found:
                found[name] = _lens(path, lens or {}, width, height), _pose(path, pose or {})
    lacking = [camera for camera in cameras if camera not in found]
    if lacking:
        raise FileFault(paths[0], f"lacks {len(lacking)} of {len(cameras)} cameras, first: {lacking[0]}")
    return found


def _pose(path: Path, pose: Mapping[str, Any]) -> Doubles:
    rotation = _first(path, pose, ("rotation", "orientation"))
    translation = _first(path, pose, ("translation", "position"))
    quaternion = [_number(path, rotation, (f"q{axis}", axis)) for axis in "wxyz"]
    position = [_number(path, translation, (axis,)) for axis in "xyz"]
    try:
        return pose_from_quaternion(np.array(quaternion), np.array(position))
    except DataError as error:
        raise FileFault(path, f"holds no usable camera pose: {error}") from error


def _lens(path: Path, lens: Mapping[str, Any], width: int, height: int) -> Intrinsics:
    fx, fy, cx, cy = (_number(path, lens, (name,)) for name in ("fx", "fy", "cx", "cy"))
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise FileFault(
            path,
            f"says that the optical axis meets the picture at ({cx:g}, {cy:g}), outside of the {width} x {height} "
            "pixels that pictures have: they were resized or the file is another scene's",
        )
    try:
        return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
    except ModelError as error:
        raise FileFault(path, f"holds an impossible lens: {error}") from error


def _first(path: Path, pose: Mapping[str, Any], spellings: Sequence[str]) -> Mapping[str, Any]:
    for spelling in spellings:
        if isinstance(pose.get(spelling), dict):
            return pose[spelling]
    raise FileFault(path, f"holds a camera without {' or '.join(spellings)}")


def _number(path: Path, numbers: Mapping[str, Any], spellings: Sequence[str]) -> float:
    for spelling in spellings:
        value = numbers.get(spelling)
        if isinstance(value, int | float) and math.isfinite(value):
            return float(value)
    raise FileFault(path, f"holds a camera without a number for {' or '.join(spellings)}")


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
        self._class_ids = np.full(256, VOID, np.uint8)
        self._class_ids[[item.label for item in classes]] = [item.id for item in classes]

    def add(self, time: int, camera: str, drawn: "Rendering") -> None:
        """Write colour, depth, classes and instances of one view."""
        depth = with_sky(drawn.depth)
        id_png = encodings.packed_id_png if self._compact else encodings.id_png
        if self._compact:
            self._write(camera, "rgb", time, encodings.webp(drawn.rgb, quality=WEBP_QUALITY))
            self._write(camera, "depth", time, encodings.street_depth_png(depth))
        else:
            self._write(camera, "rgb", time, encodings.colour_png(drawn.rgb))
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
            for number, name, colour, is_thing in [*rows, (VOID, "Void", (0, 0, 0), False)]
        ]
    }
