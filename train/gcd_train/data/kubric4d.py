"""Kubric-4D scene folders, as published and downloaded or as `gcd-train generate` writes them: names, reader, writer.

    scn00042/
        scn00042_p0_v3.json                 metadata of view 3 (0..15)
        frames_p0_v3/rgba_00007.png         colour with alpha, 8 bit            compact: .webp, no alpha
        frames_p0_v3/depth_00007.tiff       float32, distance to the camera     compact: .png, 16 bit, depth along the
                                                                                axis (!), see STAGE_DEPTH
        frames_p0_v3/segmentation_00007.png palette, instance number            compact: the same

Sixteen cameras stand still around a scene; there are instances but no classes. Along the axis, flat ground is equally
far all along a row of pixels, which halves the size of a compact scene.
Source: the Kubric-4D data set of Van Hoorick et al. 2024, as downloaded.
"""

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.errors import ModelError
from gcd_model.geometry import Intrinsics
from gcd_model.small_files import decode_json
from gcd_train.data import encodings
from gcd_train.data.dataset4d import KEPT_SCENES, Dataset4D, pose_from_quaternion, scene_names
from gcd_train.data.encodings import (
    Doubles,
    quaternions,
    read_colour,
    read_depth,
    read_palette_indices,
    sized,
    with_sky,
)
from gcd_train.data.files import MOST_TEXT, FileFault, Recent, SceneFiles, one_of, read
from gcd_train.data.sample import SceneView
from gcd_train.data.splat import ray_lengths
from gcd_train.errors import DataError
from gcd_train.scenes.description import Scene, SceneObject, rotations

if TYPE_CHECKING:
    from gcd_train.scenes.renderer import Rendering

Layer = Literal["rgba", "depth", "segmentation"]
Json = dict[str, Any]

VIEWS = 16
FRAMES = 60
FPS = 24.0
WIDTH, HEIGHT = 576, 384
SUFFIXES: dict[Layer, str] = {"rgba": "png", "depth": "tiff", "segmentation": "png"}
COMPACT_SUFFIXES: dict[Layer, str] = {"rgba": "webp", "depth": "png", "segmentation": "png"}
CAMERAS = tuple(f"view{view}" for view in range(VIEWS))
"""The published views by their number."""
_PLANAR = ".png"
"""Depth of compact scenes goes along the axis; published depth is the distance."""
STEP_RATE_HZ = 480
"""Of the physics of both worlds in this layout."""

WEBP_QUALITY = 85
_IDS = 256
_GRAVITY_M_S2, _SENSOR_MM = 9.81, 32.0
_DIGITS = 5  # decimals of metres and shares: hundredths of a millimetre
_PALETTE = encodings.instance_palette()
_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])  # axes x right, y up, looking along -z


def scene_name(number: int) -> str:
    """Folder of a scene, `scn00042`."""
    return f"scn{number:05d}"


def metadata_path(scene: Path, camera: str) -> Path:
    """JSON of `view3` of a scene folder, `scn00042/scn00042_p0_v3.json`."""
    return scene / f"{scene.name}_p0_v{camera.removeprefix('view')}.json"


def frame_path(scene: Path, camera: str, layer: Layer, time: int, *, compact: bool = False) -> Path:
    """One picture of a layer of `view3` at frame number `time`, `scn00042/frames_p0_v3/rgba_00007.png`."""
    suffix = (COMPACT_SUFFIXES if compact else SUFFIXES)[layer]
    return scene / f"frames_p0_v{camera.removeprefix('view')}" / f"{layer}_{time:05d}.{suffix}"


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
    poses: Doubles


class Kubric4D(Dataset4D):
    """See Dataset4D.

    root: the folder with `scn00000` and so on; gaps in the numbers are fine. scenes: by default all there are.
    cameras: which views there are. published: turn distance into depth by the published approximation instead of
    exactly. instances: read the instance numbers too, where the layer is there.
    Raises DataError if there is no scene, or no such camera can be.
    """

    fps = FPS

    def __init__(
        self,
        root: Path | str,
        scenes: Sequence[str] | None = None,
        *,
        cameras: Sequence[str] = CAMERAS,
        published: bool = False,
        instances: bool = False,
    ) -> None:
        wrong = [camera for camera in cameras if re.fullmatch(r"view\d+", camera) is None]
        if wrong:
            raise DataError(f"Kubric-4D's cameras are called view0 to view15, got {wrong[0]!r}")
        found = scene_names(Path(root), "kubric4d") if scenes is None else scenes
        super().__init__(Path(root), found, cameras, "view4" if "view4" in cameras else cameras[0])
        self._published, self._instances = published, instances
        self._views = Recent(self._read_views, KEPT_SCENES)

    def frames(self, scene: str) -> int:
        """See Dataset4D."""
        return min(len(view.poses) for view in self._views(scene).values())

    def lens(self, scene: str) -> Intrinsics:
        """See Dataset4D."""
        return self._views(scene)[self.source_camera].lens

    def pose(self, scene: str, camera: str, time: int = 0) -> Doubles:
        """See Dataset4D."""
        return self._views(scene)[camera].poses[time]

    def view(self, scene: str, camera: str, time: int) -> SceneView:
        """See Dataset4D."""
        folder, view = self.folder(scene), self._views(scene)[camera]
        if not 0 <= time < len(view.poses):
            raise FileFault(view.path, f"tells of {len(view.poses)} frames, wanted frame {time}")
        colour, far = (
            one_of(*(frame_path(folder, camera, layer, time, compact=compact) for compact in (False, True)))
            for layer in ("rgba", "depth")
        )
        size = (view.lens.height, view.lens.width, view.path.name)
        rgb, depth = sized(colour, read_colour(colour), *size), sized(far, read_depth(far), *size)
        instances = None
        path = frame_path(folder, camera, "segmentation", time)
        if self._instances and (path.exists() or any(path.parent.glob("segmentation_*"))):  # else not downloaded at all
            instances = sized(path, read_palette_indices(path), *size).astype(np.uint16)
        return SceneView(
            rgb=rgb,
            depth=depth if far.suffix == _PLANAR else depth / ray_lengths(view.lens, published=self._published),
            classes=None,
            instances=instances,
            world_from_camera=view.poses[time],
            lens=view.lens,
        )

    def _read_views(self, scene: str) -> dict[str, _View]:
        views = {camera: _read_view(metadata_path(self.folder(scene), camera)) for camera in self.cameras}
        first, *others = views.values()
        for view in others:
            if (view.lens.width, view.lens.height) != (first.lens.width, first.lens.height):
                raise FileFault(
                    view.path,
                    f"tells of {view.lens.width} x {view.lens.height} pixels, {first.path.name} of "
                    f"{first.lens.width} x {first.lens.height}: sizes are mixed",
                )
        return views


def _read_view(path: Path) -> _View:
    try:
        metadata = decode_json(read(path, MOST_TEXT), _Metadata)
        width, height = metadata.scene.resolution
        # shares of the picture, signs of Blender's axes
        (fx, _, cx), (_, fy, cy), _ = np.abs(metadata.camera.K).tolist()
        lens = Intrinsics(fx=fx * width, fy=fy * height, cx=cx * width, cy=cy * height, width=width, height=height)
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
    poses[:, :3, :3] = poses[:, :3, :3] @ _BLENDER[:3, :3]
    return _View(path, lens, poses)


class Kubric4DWriter:
    """One scene, view by view as they are drawn, in any order; `finish` adds the metadata.

    Camera n of the scene is view n. Depth is the distance to the camera centre, in compact scenes along the axis, 30 km
    for the sky. Object k of `Scene.objects`, by instance, has the id k + 1 in the segmentation, so that the list in the
    metadata fits; ids of what is no object follow.
    """

    def __init__(self, files: SceneFiles, scene: Scene, lens: Intrinsics, *, seed: int, fps: float, compact: bool):
        self._files, self._scene, self._lens, self._compact = files, scene, lens, compact
        self._seed, self._fps = seed, fps
        self._views = dict(zip(scene.cameras, CAMERAS, strict=False))
        self._tracks = {view: InstanceTracks(scene.frames) for view in self._views.values()}
        self._objects = tuple(sorted(scene.objects, key=lambda thing: thing.instance))
        self._ids = segment_ids(tuple(thing.instance for thing in self._objects))
        self._rays = ray_lengths(lens)

    def add(self, time: int, camera: str, drawn: "Rendering") -> None:
        """Write colour, distance and segmentation of one view."""
        view = self._views[camera]
        ids = self._ids[drawn.instances]
        self._tracks[view].add(time, ids)
        self._write(view, "segmentation", time, encodings.indexed_png(ids, _PALETTE))
        if self._compact:
            self._write(view, "rgba", time, encodings.webp(drawn.rgb, quality=WEBP_QUALITY))
            self._write(view, "depth", time, encodings.depth_png(with_sky(drawn.depth)))
        else:
            self._write(view, "rgba", time, encodings.colour_png(drawn.rgb, alpha=True))
            self._write(view, "depth", time, encodings.float_tiff(with_sky(drawn.depth * self._rays)))

    def finish(self) -> None:
        """Write the metadata of every view; view 0 alone has the collisions, of which our worlds tell none."""
        for camera, view in self._views.items():
            poses = self._scene.cameras[camera]
            told = view_metadata(self._scene, poses, self._objects, self._tracks[view], self._lens, self._fps)
            told["random_seed"] = self._seed
            if view == CAMERAS[0]:
                told["collisions"] = []
            if self._compact:  # half of the file, and it follows from size, positions and quaternions
                for instance in told["instances"]:
                    del instance["bboxes_3d"]
            self._files.write(metadata_path(self._files.folder, view), msgspec.json.encode(told))

    def _write(self, view: str, layer: Layer, time: int, data: bytes) -> None:
        self._files.write(frame_path(self._files.folder, view, layer, time, compact=self._compact), data)


def segment_ids(instances: tuple[int, ...]) -> encodings.Bytes:
    """u8 [256]: the id in the segmentation for each of the renderer's instance ids.

    The given ones become 1, 2, ...; others follow in their order; without any given all stay as they are.
    Raises: DataError for an instance that is given twice, or is not within 1..255.
    """
    if len(set(instances)) < len(instances) or not all(0 < number < _IDS for number in instances):
        raise DataError(f"objects need distinct instance ids from 1 to 255, got {list(instances)}")
    others = [number for number in range(1, _IDS) if number not in set(instances)]
    table = np.zeros(_IDS, np.uint8)
    table[[*instances, *others]] = np.arange(1, _IDS)
    return table


class InstanceTracks:
    """What one camera saw of every instance: pixel counts [T, 256] and boxes [T, 256, 4].

    A box is its first row, first column, and the row and column after its last, in pixels, all 0 where the instance is
    not seen.
    """

    def __init__(self, frames: int) -> None:
        self.pixels = np.zeros((frames, _IDS), np.int64)
        self.boxes = np.zeros((frames, _IDS, 4), np.int64)

    def add(self, time: int, ids: NDArray[np.uint8]) -> None:
        """One picture [H, W]."""
        self.pixels[time] = np.bincount(ids.reshape(-1), minlength=_IDS)
        for number in np.flatnonzero(self.pixels[time]):
            here = ids == number
            rows, columns = np.flatnonzero(here.any(axis=1)), np.flatnonzero(here.any(axis=0))
            self.boxes[time, number] = rows[0], columns[0], rows[-1] + 1, columns[-1] + 1


def view_metadata(
    scene: Scene, poses: Doubles, objects: tuple[SceneObject, ...], tracks: InstanceTracks, lens: Intrinsics, fps: float
) -> Json:
    """Everything the published file tells of one view, but for the seed.

    poses: of its camera, [T, 4, 4]. objects: number k has the id k + 1 in the segmentation and in `tracks`.
    """
    instances = [_instance(thing, k + 1, tracks, poses, lens) for k, thing in enumerate(objects)]
    background = scene.facts.get("surroundings", "procedural")
    return {
        "scene": {
            "resolution": [lens.width, lens.height],
            "frame_rate": fps,
            "step_rate": STEP_RATE_HZ,
            "gravity": [0.0, 0.0, -_GRAVITY_M_S2 / float(scene.facts.get("metres_a_unit", 1.0))],
            "num_frames": scene.frames,
            "background": background,
            "num_instances": len(objects),
            "num_valo_instances": int((tracks.pixels[:, 1 : len(objects) + 1].sum(0) > 0).sum()),
        },
        "camera": camera_metadata(poses, lens),
        "instances": instances,
        "dome": {"asset_id": background},
    }


def camera_metadata(poses: Doubles, lens: Intrinsics) -> Json:
    """Of a camera with poses [T, 4, 4]: angles in radians, Blender's axes, K for pictures of size 1 x 1.

    With Blender's axes a point in front has a negative z: K turns it over, [[fx, 0, -cx], [0, -fy, -cy], [0, 0, -1]].
    R is the pose of the first frame, world from camera.
    """
    placed = poses @ _BLENDER
    fx, fy = lens.fx / lens.width, lens.fy / lens.height
    cx, cy = lens.cx / lens.width, lens.cy / lens.height
    return {
        "focal_length": _SENSOR_MM * fx,
        "sensor_width": _SENSOR_MM,
        "field_of_view": 2 * math.atan(lens.width / 2 / lens.fx),
        "positions": placed[:, :3, 3].tolist(),
        "quaternions": quaternions(placed[:, :3, :3]).tolist(),
        "K": [[fx, 0.0, -cx], [0.0, -fy, -cy], [0.0, 0.0, -1.0]],
        "R": placed[0].tolist(),
    }


def _instance(thing: SceneObject, number: int, tracks: InstanceTracks, poses: Doubles, lens: Intrinsics) -> Json:
    shown = np.flatnonzero(tracks.pixels[:, number])
    scale = np.array([lens.height, lens.width, lens.height, lens.width])
    box = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * thing.size + thing.middle  # [8, 3]
    corners = np.einsum("tij,kj->tki", rotations(thing.quaternions), box) + thing.positions[:, None]
    return {
        "asset_id": thing.name,
        "label": thing.label,
        "dynamic": thing.dynamic,
        "size": _rounded(np.asarray(thing.size)),
        "middle": _rounded(np.asarray(thing.middle)),
        "mass": thing.mass_kg,
        "friction": thing.friction,
        "restitution": thing.restitution,
        "positions": _rounded(thing.positions),
        "quaternions": _rounded(thing.quaternions),
        "velocities": _rounded(thing.velocities),
        "angular_velocities": _rounded(thing.angular_velocities),
        "image_positions": _rounded(project(thing.positions, poses, lens)),
        "bboxes_3d": _rounded(corners),
        "visibility": tracks.pixels[:, number].tolist(),
        "bboxes": _rounded(tracks.boxes[shown, number] / scale),
        "bbox_frames": shown.tolist(),
    }


def project(points: Doubles, world_from_camera: Doubles, lens: Intrinsics) -> Doubles:
    """Where a camera with poses [T, 4, 4] sees world points [T, 3]: shares of width and height, [T, 2].

    Points behind it get odd places.
    """
    camera_from_world = np.linalg.inv(world_from_camera)
    local = np.einsum("tij,tj->ti", camera_from_world[:, :3, :3], points) + camera_from_world[:, :3, 3]
    depth = np.where(np.abs(local[:, 2]) < 1e-9, 1e-9, local[:, 2])
    x, y = lens.fx * local[:, 0] / depth + lens.cx, lens.fy * local[:, 1] / depth + lens.cy
    return np.stack([x / lens.width, y / lens.height], -1)


def _rounded(numbers: Doubles) -> Any:
    return np.round(numbers, _DIGITS).tolist()
