"""Writes scenes as Kubric-4D has them: see `kubric4d_names` for the files, `kubric4d_metadata` for the JSON."""

from typing import Any

import msgspec
import numpy as np

from gcd_model.geometry import Intrinsics
from gcd_train.errors import DataError
from gcd_train.layouts import encodings, kubric4d_names
from gcd_train.layouts.camera_facts import ray_lengths
from gcd_train.layouts.depth_code import with_sky
from gcd_train.layouts.instance_tracks import InstanceTracks
from gcd_train.layouts.kubric4d_metadata import view_metadata
from gcd_train.layouts.kubric4d_names import Layer
from gcd_train.layouts.scene_files import SceneFiles
from gcd_train.scenes.description import Floats, Scene
from gcd_train.scenes.renderer import Rendering

_PALETTE = encodings.instance_palette()
_IDS = 256
_WEBP_QUALITY = 85


class Kubric4DWriter:
    """One scene, view by view as they are drawn, in any order; `finish` adds the metadata.

    Camera n of the scene is view n. Depth is the distance to the camera centre, in compact scenes along the axis, 30 km
    for the sky. Object k of `Scene.objects`, by instance, has the id k + 1 in the segmentation, so that the list in the
    metadata fits; ids of what is no object follow.
    """

    def __init__(self, files: SceneFiles, scene: Scene, lens: Intrinsics, *, seed: int, fps: float, compact: bool):
        self._files, self._scene, self._lens, self._compact = files, scene, lens, compact
        self._facts = {"seed": seed, "fps": fps}
        self._views = {name: view for view, name in enumerate(scene.cameras)}
        self._tracks = [InstanceTracks(scene.frames) for _ in self._views]
        self._objects = tuple(sorted(scene.objects, key=lambda thing: thing.instance))
        self._ids = segment_ids(tuple(thing.instance for thing in self._objects))
        self._rays = ray_lengths(lens)

    def add(self, time: int, camera: str, drawn: Rendering) -> None:
        """Write colour, distance and segmentation of one view."""
        view = self._views[camera]
        ids = self._ids[drawn.instances]
        self._tracks[view].add(time, ids)
        self._write(view, "segmentation", time, encodings.indexed_png(ids, _PALETTE))
        if self._compact:
            self._write(view, "rgba", time, encodings.webp(drawn.rgb, quality=_WEBP_QUALITY))
            self._write(view, "depth", time, encodings.depth_png(with_sky(drawn.depth)))
        else:
            self._write(view, "rgba", time, encodings.rgba_png(drawn.rgb))
            self._write(view, "depth", time, encodings.float_tiff(distance_of(drawn.depth, self._rays)))

    def finish(self) -> None:
        """Write the metadata of every view; view 0 alone has the collisions, of which our worlds tell none."""
        for camera, view in self._views.items():
            told = view_metadata(self._scene, camera, self._objects, self._tracks[view], self._lens, self._facts)
            if view == 0:
                told["collisions"] = []
            if self._compact:  # half of the file, and it follows from size, positions and quaternions
                told["instances"] = [without_boxes(instance) for instance in told["instances"]]
            self._files.write(kubric4d_names.metadata_path(self._files.folder, view), msgspec.json.encode(told))

    def _write(self, view: int, layer: Layer, time: int, data: bytes) -> None:
        path = kubric4d_names.frame_path(self._files.folder, view, layer, time, compact=self._compact)
        self._files.write(path, data)


def without_boxes(instance: dict[str, Any]) -> dict[str, Any]:
    """An instance's metadata without its boxes in the world."""
    return {name: value for name, value in instance.items() if name != "bboxes_3d"}


def distance_of(depth: Floats, rays: Floats) -> Floats:
    """Depth along the axis, 0 for the sky, as distance to the camera centre. rays: see `ray_lengths`. All [H, W]."""
    return with_sky(depth * rays)


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
