"""A picture of scene folders: one row a scene, read back from its files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model.small_files import read_json
from gcd_train.data.files import read_npz
from gcd_train.errors import DataError
from gcd_train.layouts import kubric4d_names, parallel_domain4d_names
from gcd_train.layouts.depth_code import stored_depth
from gcd_train.layouts.manifest import MANIFEST, SceneManifest, read_manifest

Picture = NDArray[np.uint8]

_WIDTH = 320
_MOST_ROWS = 8


def write_scene_sheet(scenes: Sequence[Path], out: Path) -> None:
    """First, middle and last frame of one camera, another camera, depth and labels, of the first 8 scenes, as PNG.

    Raises:
        DataError: none of the scenes is there, or a picture cannot be read.
        OSError: the sheet cannot be written.
    """
    there = [scene for scene in scenes if (scene / MANIFEST).exists()][:_MOST_ROWS]
    if not there:
        raise DataError(f"there is no finished scene to draw into {out.name}; look at the failures above")
    rows = [np.concatenate(_row(scene), axis=1) for scene in there]
    _, data = cv2.imencode(".png", np.concatenate([row for row in rows if row.shape == rows[0].shape]))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(data.tobytes())


def _row(scene: Path) -> list[Picture]:
    manifest = read_manifest(scene)
    middle, last = manifest.frames // 2, manifest.frames - 1
    if manifest.layout == "kubric4d":
        shots = [(view, time) for view, time in ((4, 0), (4, middle), (4, last), (0, last), (9, last))]
        shots = [(view if view < len(manifest.cameras) else 0, time) for view, time in shots]
        paths = [_kubric(scene, manifest, view, "rgba", time) for view, time in shots]
        view = shots[0][0]
        depth, labels = (_kubric(scene, manifest, view, layer, last) for layer in ("depth", "segmentation"))
        return [*map(_colour, paths), _nearness(depth), _colour(labels)]
    forward = parallel_domain4d_names.FORWARD
    shots = [(forward, 0), (forward, middle), (forward, last), ("yaw-60", last), ("camera0", last)]
    paths = [_driving(scene, manifest, camera, "rgb", time) for camera, time in shots]
    depth = _driving(scene, manifest, forward, "depth", last)
    labels = _driving(scene, manifest, forward, "semantic_segmentation_2d", last)
    return [*map(_colour, paths), _nearness(depth), _classes(labels, scene)]


def _kubric(scene: Path, manifest: SceneManifest, view: int, layer: kubric4d_names.Layer, time: int) -> Path:
    return kubric4d_names.frame_path(scene, view, layer, time, compact=manifest.compact)


def _driving(
    scene: Path, manifest: SceneManifest, camera: str, layer: parallel_domain4d_names.Layer, time: int
) -> Path:
    return parallel_domain4d_names.frame_path(scene, camera, layer, time, compact=manifest.compact)


def _read(path: Path, flag: int) -> NDArray[np.generic]:
    picture = cv2.imread(str(path), flag)
    if picture is None:
        raise DataError(f"{path} cannot be read; delete the scene and generate it again")
    return picture


def _small(picture: Picture) -> Picture:
    height = round(_WIDTH * picture.shape[0] / picture.shape[1])
    return np.asarray(cv2.resize(picture, (_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)


def _colour(path: Path) -> Picture:
    return _small(np.asarray(_read(path, cv2.IMREAD_COLOR_BGR), np.uint8))


def _nearness(path: Path) -> Picture:
    """Grey goes with one over depth; the nearest is white."""
    metres = _metres(path)
    near = np.float32(np.percentile(metres, 2))
    grey = (255 * near / np.maximum(metres, near)).astype(np.uint8)
    return _small(np.repeat(grey[..., None], 3, -1))


def _metres(path: Path) -> NDArray[np.float32]:
    if path.suffix == ".npz":
        return read_npz(path)[parallel_domain4d_names.DEPTH_KEY].astype(np.float32)
    stored = _read(path, cv2.IMREAD_UNCHANGED)
    metres = stored_depth(stored) if path.suffix == ".png" else np.asarray(stored, np.float32)
    if metres is None:
        raise DataError(f"{path} holds no depth codes, but {stored.dtype} {list(stored.shape)}; remove the scene")
    return metres


def _classes(path: Path, scene: Path) -> Picture:
    ids = np.asarray(_read(path, cv2.IMREAD_COLOR_BGR), np.uint8)[..., 2]
    palette = np.zeros((256, 3), np.uint8)
    for ontology in parallel_domain4d_names.ontology_folder(scene).glob("*.json"):
        for item in read_json(ontology, dict[str, Any])["items"]:
            palette[item["id"]] = [item["color"][channel] for channel in "bgr"]
    return _small(palette[ids])
