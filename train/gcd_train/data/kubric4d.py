"""Reader of Kubric-4D, as published and downloaded or as `gcd-train generate` writes it.

Sixteen cameras stand still around a scene; depth is stored as distance to the camera's centre, in compact scenes along
the optical axis. There are instances but no classes. Folders and names: `gcd_train.layouts.kubric4d`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.errors import ModelError
from gcd_model.geometry import Intrinsics
from gcd_model.small_files import decode_json
from gcd_train.data.dataset4d import KEPT_SCENES, Dataset4D, pose_from_quaternion, scene_names
from gcd_train.data.files import (
    MOST_TEXT,
    FileFault,
    Recent,
    one_of,
    read,
    read_colour,
    read_depth,
    read_palette_indices,
    require_size,
)
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError
from gcd_train.layouts import kubric4d as names
from gcd_train.pointcloud import planar_from_distance

_PLANAR = f".{names.COMPACT_SUFFIXES['depth']}"
"""Depth files of compact scenes tell depth along the axis, the published ones the distance."""
_BLENDER_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
"""Blender's camera has x right, y up and looks along -z."""


class _SceneFacts(msgspec.Struct, frozen=True):
    """Others' file: what else stands in it (collisions, instances) is not needed to read pictures."""

    resolution: tuple[int, int]
    num_frames: int | None = None


class _CameraFacts(msgspec.Struct, frozen=True):
    positions: tuple[tuple[float, float, float], ...]
    quaternions: tuple[tuple[float, float, float, float], ...]
    K: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class _Metadata(msgspec.Struct, frozen=True):
    scene: _SceneFacts
    camera: _CameraFacts


@dataclass(frozen=True, slots=True)
class _View:
    """One camera. poses: f64 [T, 4, 4] world_from_camera."""

    path: Path
    lens: Intrinsics
    poses: NDArray[np.float64]


class Kubric4D(Dataset4D):
    """See Dataset4D.

    root: the folder with `scn00000` and so on; gaps in the numbers are fine.
    published: turn distance into depth by the published approximation instead of exactly.
    instances: read the instance numbers too, where the layer is there.
    cameras: which views there are, `view0` to `view15` by default.
    """

    fps = names.FPS

    def __init__(
        self,
        root: Path,
        scenes: Sequence[str],
        *,
        cameras: Sequence[str] = names.CAMERAS,
        published: bool = False,
        instances: bool = False,
    ) -> None:
        super().__init__(root, scenes, cameras, "view4" if "view4" in cameras else cameras[0])
        self._published, self._instances = published, instances
        self._views = Recent(self._read_views, KEPT_SCENES)

    @classmethod
    def open(
        cls,
        root: Path | str,
        *,
        cameras: Sequence[str] = names.CAMERAS,
        published: bool = False,
        instances: bool = False,
    ) -> Self:
        """Every scene of a folder, by number. Raises DataError if there is none."""
        scenes = scene_names(Path(root), names.scene_number, "scn00000")
        return cls(Path(root), scenes, cameras=cameras, published=published, instances=instances)

    def frames(self, scene: str) -> int:
        """See Dataset4D."""
        return min(len(view.poses) for view in self._views(scene).values())

    def lens(self, scene: str) -> Intrinsics:
        """See Dataset4D."""
        return self._views(scene)[self.source_camera].lens

    def pose(self, scene: str, camera: str, time: int = 0) -> NDArray[np.float64]:
        """See Dataset4D."""
        return self._views(scene)[camera].poses[time]

    def views(self, scene: str, time: int, cameras: Sequence[str] | None = None) -> list[SceneView]:
        """See Dataset4D."""
        known = self._views(scene)
        return [self._view(scene, camera, known[camera], time) for camera in cameras or self.cameras]

    def _view(self, scene: str, camera: str, view: _View, time: int) -> SceneView:
        if not 0 <= time < len(view.poses):
            raise FileFault(view.path, f"tells of {len(view.poses)} frames, wanted frame {time}")
        lens = view.lens
        colour_path = self._path(scene, camera, "rgba", time)
        rgb = read_colour(colour_path)
        require_size(colour_path, rgb, lens.height, lens.width, view.path.name)
        depth_path = self._path(scene, camera, "depth", time)
        depth = read_depth(depth_path)
        require_size(depth_path, depth, lens.height, lens.width, view.path.name)
        if depth_path.suffix != _PLANAR:
            depth = planar_from_distance(depth, lens, published=self._published)
        return SceneView(
            rgb=rgb,
            depth=depth,
            classes=None,
            instances=self._instance_numbers(scene, camera, view, time),
            world_from_camera=view.poses[time],
            lens=lens,
        )

    def _instance_numbers(self, scene: str, camera: str, view: _View, time: int) -> NDArray[np.uint16] | None:
        """None where the layer was not downloaded at all; a single missing file is a fault."""
        if not self._instances:
            return None
        path = names.frame_path(self.folder(scene), _number(camera), "segmentation", time)
        if not path.exists() and not any(path.parent.glob("segmentation_*")):
            return None
        indices = read_palette_indices(path)
        require_size(path, indices, view.lens.height, view.lens.width, view.path.name)
        return indices.astype(np.uint16)

    def _path(self, scene: str, camera: str, layer: names.Layer, time: int) -> Path:
        folder, view = self.folder(scene), _number(camera)
        published = names.frame_path(folder, view, layer, time)
        return one_of(published, names.frame_path(folder, view, layer, time, compact=True))

    def _read_views(self, scene: str) -> dict[str, _View]:
        folder = self.folder(scene)
        views = {camera: _read_view(names.metadata_path(folder, _number(camera))) for camera in self.cameras}
        _require_one_size(list(views.values()))
        return views


def _number(camera: str) -> int:
    if not (camera.startswith("view") and camera[4:].isdecimal()):
        raise DataError(f"Kubric-4D's cameras are called view0 to view15, got {camera!r}")
    return int(camera[4:])


def _require_one_size(views: list[_View]) -> None:
    first = views[0]
    for view in views:
        if (view.lens.width, view.lens.height) != (first.lens.width, first.lens.height):
            raise FileFault(
                view.path,
                f"tells of {view.lens.width} x {view.lens.height} pixels, {first.path.name} of {first.lens.width} x "
                f"{first.lens.height}: sizes are mixed",
            )


def _read_view(path: Path) -> _View:
    try:
        metadata = decode_json(read(path, MOST_TEXT), _Metadata)
        lens = _lens(metadata)
    except ModelError as error:
        raise FileFault(path, f"is damaged or lacks what Kubric-4D tells of a view ({error})") from error
    camera, told = metadata.camera, metadata.scene.num_frames
    frames = min(len(camera.positions), len(camera.quaternions))
    if frames < 1 or (told is not None and frames < told):
        raise FileFault(path, f"tells where the camera is in {frames} frames of {told or 'at least one'}")
    positions = np.array(camera.positions[:told], np.float64)
    try:
        poses = pose_from_quaternion(np.array(camera.quaternions[:told], np.float64), positions)
    except DataError as error:
        raise FileFault(path, f"holds no usable camera pose: {error}") from error
    poses[:, :3, :3] = poses[:, :3, :3] @ _BLENDER_FROM_CAMERA
    return _View(path, lens, poses)


def _lens(metadata: _Metadata) -> Intrinsics:
    """The stored matrix is in shares of the picture, with signs of Blender's axes."""
    width, height = metadata.scene.resolution
    across, along, _ = metadata.camera.K
    return Intrinsics(
        fx=abs(across[0]) * width,
        fy=abs(along[1]) * height,
        cx=abs(across[2]) * width,
        cy=abs(along[2]) * height,
        width=width,
        height=height,
    )
