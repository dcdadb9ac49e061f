"""Reader of ParallelDomain-4D, as published and downloaded or as `gcd-train generate` writes it.

Cameras ride on a vehicle; poses are given in the vehicle's frame (x ahead, y left, z up), which the views call their
world. Depth is stored along the optical axis. Folders and names: `gcd_train.layouts.parallel_domain4d`.
"""

import logging
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.datasets.calibration import CameraCalibration, read_calibration
from gcd_train.datasets.ontology import Ontology, read_ontology
from gcd_train.datasets.picture_files import one_of, read_colour, read_depth, read_ids, require_size
from gcd_train.datasets.skips import FileFault
from gcd_train.errors import DataError
from gcd_train.layouts import parallel_domain4d as names
from gcd_train.scene_view import SceneView

Bytes = NDArray[np.uint8]
_LOG = logging.getLogger(__name__)
_KEPT_SCENES = 64
_U8, _U16 = 255, 65535


@dataclass(frozen=True, slots=True)
class _Scene:
    """What does not change over the time of a scene."""

    cameras: dict[str, CameraCalibration]
    width: int
    height: int
    frames: int


class ParallelDomain4D:
    """Scenes of a folder. Reads when asked; one object for each process or thread.

    root: the folder with `scene_000000` and so on; gaps in the numbers are fine.
    classes, instances: read these layers too, where they are there.
    cameras: which there are, the 19 published ones by default; all must be there at a time step.
    The ontology is that of the first scene; a scene with another one is at fault.
    """

    def __init__(
        self,
        root: Path,
        scenes: Sequence[str],
        *,
        cameras: Sequence[str] = names.CAMERAS,
        source_camera: str = names.FORWARD,
        classes: bool = True,
        instances: bool = False,
        ontology: Ontology | None = None,
    ) -> None:
        self._root, self.scenes, self.cameras = root, tuple(scenes), tuple(cameras)
        if source_camera not in self.cameras:
            raise DataError(f"the source camera {source_camera} is none of {', '.join(self.cameras)}")
        self.source_camera = source_camera
        self._classes, self._instances, self.ontology = classes, instances, ontology
        self._kept: OrderedDict[str, _Scene] = OrderedDict()

    @classmethod
    def open(
        cls,
        root: Path | str,
        *,
        cameras: Sequence[str] = names.CAMERAS,
        source_camera: str = names.FORWARD,
        classes: bool = True,
        instances: bool = False,
    ) -> Self:
        """Every scene of a folder, by number, with the ontology of the first that has a readable one.

        Raises: DataError if there is no scene, or classes are wanted and no scene has an ontology.
        """
        root = Path(root)
        try:
            found = [path.name for path in root.iterdir() if names.scene_number(path.name) is not None]
        except OSError as error:
            raise DataError(f"{root} cannot be read ({error}); give the folder that holds scene_000000") from error
        if not found:
            raise DataError(f"{root} holds no ParallelDomain-4D scene; give the folder that holds scene_000000 etc.")
        found.sort(key=lambda name: names.scene_number(name) or 0)
        ontology = _first_ontology(root, found) if classes else None
        if ontology is not None and ontology.duplicates:
            _LOG.warning("%s: classes of one colour are merged in decoding: %s", root, "; ".join(ontology.merged_names))
        return cls(
            root,
            found,
            cameras=cameras,
            source_camera=source_camera,
            classes=classes,
            instances=instances,
            ontology=ontology,
        )

    def only(self, scenes: Sequence[str]) -> Self:
        """The same set, reduced to these scenes and in their order. Raises DataError if none is left."""
        if not scenes:
            raise DataError(f"no scene of the list or split is in {self._root}; look at how its scenes are named")
        return type(self)(
            self._root,
            scenes,
            cameras=self.cameras,
            source_camera=self.source_camera,
            classes=self._classes,
            instances=self._instances,
            ontology=self.ontology,
        )

    @property
    def fps(self) -> float:
        """Frames per second."""
        return names.FPS

    @property
    def palette(self) -> Bytes | None:
        """u8 [256, 3], RGB colour by class id; None without classes."""
        return None if self.ontology is None else self.ontology.palette

    def folder(self, scene: str) -> Path:
        """Where the scene lies."""
        return self._root / scene

    def frames(self, scene: str) -> int:
        """Time steps, up to the last picture of the source camera; some may be missing. Raises FileFault."""
        return self._scene(scene).frames

    def lens(self, scene: str) -> Intrinsics:
        """Of the source camera. Raises FileFault."""
        known = self._scene(scene)
        return known.cameras[self.source_camera].lens(known.width, known.height)

    def pose(self, scene: str, camera: str) -> NDArray[np.float64]:
        """vehicle_from_camera, f64 [4, 4], metres; it does not change. Raises FileFault."""
        return self._scene(scene).cameras[camera].vehicle_from_camera

    def views(self, scene: str, time: int, cameras: Sequence[str] | None = None) -> list[SceneView]:
        """What the cameras saw at a time step. Raises FileFault naming the file at fault."""
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
        return SceneView(
            rgb=rgb,
            depth=depth,
            classes=self._class_ids(scene, known, camera, time) if self._classes else None,
            instances=self._instance_ids(scene, known, camera, time) if self._instances else None,
            world_from_camera=known.cameras[camera].vehicle_from_camera,
            lens=known.cameras[camera].lens(known.width, known.height),
        )

    def _class_ids(self, scene: str, known: _Scene, camera: str, time: int) -> Bytes | None:
        ids = self._ids(scene, known, camera, "semantic_segmentation_2d", time, _U8)
        return None if ids is None else ids.astype(np.uint8)

    def _instance_ids(self, scene: str, known: _Scene, camera: str, time: int) -> NDArray[np.uint16] | None:
        ids = self._ids(scene, known, camera, "instance_segmentation_2d", time, _U16)
        return None if ids is None else ids.astype(np.uint16)

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

    def _scene(self, scene: str) -> _Scene:
        if scene not in self._kept:
            self._kept[scene] = self._read_scene(scene)
            while len(self._kept) > _KEPT_SCENES:
                self._kept.popitem(last=False)
        return self._kept[scene]

    def _read_scene(self, scene: str) -> _Scene:
        folder = self.folder(scene)
        cameras = read_calibration(names.calibration_folder(folder), self.cameras)
        if self.ontology is not None and (folder / "semantic_segmentation_2d").is_dir():
            self._require_same_ontology(names.ontology_folder(folder))
        pictures = _pictures(folder / "rgb" / self.source_camera)
        height, width = _size(pictures)
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


def _size(pictures: list[Path]) -> tuple[int, int]:
    """Height and width of the first picture that can be read. Raises FileFault of the first if none can."""
    first: FileFault | None = None
    for path in pictures:
        try:
            picture = read_colour(path)
        except FileFault as fault:
            first = first or fault
        else:
            return picture.shape[0], picture.shape[1]
    raise first or FileFault(pictures[0].parent, "holds no picture")


def _first_ontology(root: Path, scenes: Sequence[str]) -> Ontology:
    first: FileFault | None = None
    for scene in scenes:
        try:
            return read_ontology(names.ontology_folder(root / scene))
        except FileFault as fault:
            first = first or fault
    raise DataError(f"no scene has a readable ontology, first: {first}; read the set without classes instead")
