"""Reader of ParallelDomain-4D, as published and downloaded or as `gcd-train generate` writes it.

Cameras ride on a vehicle; poses are given in the vehicle's frame (x ahead, y left, z up), which the views call their
world. Depth is stored along the optical axis. Folders and names: `gcd_train.layouts.parallel_domain4d`.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.errors import FileError, ModelError
from gcd_model.geometry import Intrinsics
from gcd_model.small_files import decode_json
from gcd_train.data.dataset4d import KEPT_SCENES, Dataset4D, Ontology, pose_from_quaternion, read_ontology, scene_names
from gcd_train.data.files import (
    MOST_TEXT,
    FileFault,
    Recent,
    one_of,
    read,
    read_colour,
    read_depth,
    read_ids,
    require_size,
)
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError
from gcd_train.layouts import parallel_domain4d as names

_LOG = logging.getLogger(__name__)
_U8, _U16 = 255, 65535


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraCalibration:
    """One camera on the vehicle. fx, fy, cx, cy: pixels. vehicle_from_camera: f64 [4, 4], metres."""

    path: Path
    fx: float
    fy: float
    cx: float
    cy: float
    vehicle_from_camera: NDArray[np.float64]

    def lens(self, width: int, height: int) -> Intrinsics:
        """For pictures of this size. Raises FileFault for a lens that no picture of this size has."""
        if not (0 <= self.cx <= width and 0 <= self.cy <= height):
            raise FileFault(
                self.path,
                f"says that the optical axis meets the picture at ({self.cx:g}, {self.cy:g}), outside of the "
                f"{width} x {height} pixels that pictures have: they were resized or the file is another scene's",
            )
        try:
            return Intrinsics(fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, width=width, height=height)
        except ModelError as error:
            raise FileFault(self.path, f"holds an impossible lens: {error}") from error


@dataclass(frozen=True, slots=True)
class _Scene:
    """What does not change over the time of a scene."""

    cameras: dict[str, CameraCalibration]
    width: int
    height: int
    frames: int


class ParallelDomain4D(Dataset4D):
    """See Dataset4D.

    root: the folder with `scene_000000` and so on; gaps in the numbers are fine.
    classes, instances: read these layers too, where they are there. cameras: which there are, the 19 published ones by
    default. The ontology is that of the first scene; a scene with another one is at fault.
    """

    fps = names.FPS

    def __init__(
        self,
        root: Path,
        scenes: Sequence[str],
        *,
        cameras: Sequence[str] = names.CAMERAS,
        classes: bool = True,
        instances: bool = False,
        ontology: Ontology | None = None,
        source_camera: str = names.FORWARD,
    ) -> None:
        super().__init__(root, scenes, cameras, source_camera)
        if self.source_camera not in self.cameras:
            raise DataError(f"the source camera {self.source_camera} is none of {', '.join(self.cameras)}")
        self._classes, self._instances, self.ontology = classes, instances, ontology
        self._scene = Recent(self._read_scene, KEPT_SCENES)

    @classmethod
    def open(
        cls,
        root: Path | str,
        *,
        cameras: Sequence[str] = names.CAMERAS,
        classes: bool = True,
        instances: bool = False,
        source_camera: str = names.FORWARD,
    ) -> Self:
        """Every scene of a folder, by number, with the ontology of the first that has a readable one.

        Raises: DataError if there is no scene, or classes are wanted and no scene has an ontology.
        """
        found = scene_names(Path(root), names.scene_number, "scene_000000")
        ontology = _first_ontology(Path(root), found) if classes else None
        if ontology is not None and ontology.duplicates:
            _LOG.warning("%s: classes of one colour are merged in decoding: %s", root, "; ".join(ontology.merged_names))
        return cls(
            Path(root),
            found,
            cameras=cameras,
            classes=classes,
            instances=instances,
            ontology=ontology,
            source_camera=source_camera,
        )

    def frames(self, scene: str) -> int:
        """Time steps, up to the last picture of the source camera; some may be missing. Raises FileFault."""
        return self._scene(scene).frames

    def lens(self, scene: str) -> Intrinsics:
        """See Dataset4D."""
        known = self._scene(scene)
        return known.cameras[self.source_camera].lens(known.width, known.height)

    def pose(self, scene: str, camera: str, time: int = 0) -> NDArray[np.float64]:
        """vehicle_from_camera; it does not change with time. Raises FileFault."""
        return self._scene(scene).cameras[camera].vehicle_from_camera

    def views(self, scene: str, time: int, cameras: Sequence[str] | None = None) -> list[SceneView]:
        """See Dataset4D."""
        known = self._scene(scene)
        return [self._view(scene, known, camera, time) for camera in cameras or self.cameras]

    def _view(self, scene: str, known: _Scene, camera: str, time: int) -> SceneView:
        told = f"{self.source_camera}'s first picture"
        colour_path = self._path(scene, camera, "rgb", time)
        rgb = read_colour(colour_path)
        require_size(colour_path, rgb, known.height, known.width, told)
        depth_path = self._path(scene, camera, "depth", time)
        depth = read_depth(depth_path, names.DEPTH_KEY)
        require_size(depth_path, depth, known.height, known.width, told)
        classes = instances = None
        if self._classes:
            classes = self._ids(scene, known, camera, "semantic_segmentation_2d", time, _U8)
        if self._instances:
            instances = self._ids(scene, known, camera, "instance_segmentation_2d", time, _U16)
        return SceneView(
            rgb=rgb,
            depth=depth,
            classes=None if classes is None else classes.astype(np.uint8),
            instances=None if instances is None else instances.astype(np.uint16),
            world_from_camera=known.cameras[camera].vehicle_from_camera,
            lens=known.cameras[camera].lens(known.width, known.height),
        )

    def _ids(
        self, scene: str, known: _Scene, camera: str, layer: names.Layer, time: int, most: int
    ) -> NDArray[np.int32] | None:
        """None where the layer was not downloaded at all; a single missing file is a fault."""
        if not (self.folder(scene) / layer).is_dir():
            return None
        path = names.frame_path(self.folder(scene), camera, layer, time)
        ids = read_ids(path)
        require_size(path, ids, known.height, known.width, f"{self.source_camera}'s first picture")
        if int(ids.max()) > most:
            raise FileFault(path, f"holds id {int(ids.max())}, beyond {most}: is it another layer?")
        return ids

    def _path(self, scene: str, camera: str, layer: names.Layer, time: int) -> Path:
        folder = self.folder(scene)
        published = names.frame_path(folder, camera, layer, time)
        return one_of(published, names.frame_path(folder, camera, layer, time, compact=True))

    def _read_scene(self, scene: str) -> _Scene:
        folder = self.folder(scene)
        cameras = read_calibration(names.calibration_folder(folder), self.cameras)
        if self.ontology is not None and (folder / "semantic_segmentation_2d").is_dir():
            self._require_same_ontology(names.ontology_folder(folder))
        pictures = _pictures(folder / "rgb" / self.source_camera)
        height, width = read_colour(pictures[0]).shape[:2]
        return _Scene(cameras, width, height, 1 + max(names.frame_time(path.stem) or 0 for path in pictures))

    def _require_same_ontology(self, folder: Path) -> None:
        found, wanted = read_ontology(folder), self.ontology
        if wanted is not None and found.items != wanted.items:
            other = sorted({item.name for item in found.items} ^ {item.name for item in wanted.items})
            differ = f"by {', '.join(other[:5])}" if other else "in ids or colours"
            raise FileFault(folder, f"holds the wrong ontology: it differs from the first scene's {differ}")


def _pictures(folder: Path) -> list[Path]:
    """Frames of a camera in order. Raises FileFault if there is none."""
    try:
        found = sorted(path for path in folder.iterdir() if names.frame_time(path.stem) is not None)
    except OSError as error:
        raise FileFault(folder, f"is missing: a view cannot be read ({error})") from error
    if not found:
        raise FileFault(folder, "holds no picture: download or generate the scene again")
    return found


def _first_ontology(root: Path, scenes: Sequence[str]) -> Ontology:
    first: FileFault | None = None
    for scene in scenes:
        try:
            return read_ontology(names.ontology_folder(root / scene))
        except FileFault as fault:
            first = first or fault
    raise DataError(f"no scene has a readable ontology, first: {first}; read the set without classes instead")


_ROTATIONS, _TRANSLATIONS = ("rotation", "orientation"), ("translation", "position")


class _File(msgspec.Struct, frozen=True):
    """Others' file; lists are parallel. What is no camera (velodyne) may have null or empty entries."""

    names: list[str]
    intrinsics: list[dict[str, Any] | None]
    extrinsics: list[dict[str, Any] | None]


def read_calibration(folder: Path, cameras: Sequence[str]) -> dict[str, CameraCalibration]:
    """These cameras of a scene's `calibration` folder, from however many JSON files they are in.

    Raises: FileFault if there is no file, one is damaged, or a camera is in none.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise FileFault(folder, "holds no JSON: where the cameras are is unknown; download the scene again")
    found: dict[str, CameraCalibration] = {}
    for path in paths:
        wanted = [camera for camera in cameras if camera not in found]
        if wanted:
            found |= _cameras_of(path, wanted)
    lacking = [camera for camera in cameras if camera not in found]
    if lacking:
        raise FileFault(paths[0], f"lacks {len(lacking)} of {len(cameras)} cameras, first: {lacking[0]}")
    return found


def _cameras_of(path: Path, wanted: Sequence[str]) -> dict[str, CameraCalibration]:
    try:
        file = decode_json(read(path, MOST_TEXT), _File)
        if not len(file.names) == len(file.intrinsics) == len(file.extrinsics):
            raise FileFault(path, "is damaged: its lists of names, intrinsics and extrinsics differ in length")
        places = {name: place for place, name in enumerate(file.names) if name in wanted}
        return {name: _camera(path, file.intrinsics[at], file.extrinsics[at]) for name, at in places.items()}
    except FileError as error:
        raise FileFault(path, f"is no calibration: it {error}") from error


def _camera(path: Path, lens: Mapping[str, Any] | None, pose: Mapping[str, Any] | None) -> CameraCalibration:
    rotation = _first(path, pose or {}, _ROTATIONS)
    translation = _first(path, pose or {}, _TRANSLATIONS)
    quaternion = [_number(path, rotation, (f"q{axis}", axis)) for axis in "wxyz"]
    position = [_number(path, translation, (axis,)) for axis in "xyz"]
    try:
        matrix = pose_from_quaternion(np.array(quaternion), np.array(position))
    except DataError as error:
        raise FileFault(path, f"holds no usable camera pose: {error}") from error
    fx, fy, cx, cy = (_number(path, lens or {}, (name,)) for name in ("fx", "fy", "cx", "cy"))
    return CameraCalibration(path=path, fx=fx, fy=fy, cx=cx, cy=cy, vehicle_from_camera=matrix)


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
