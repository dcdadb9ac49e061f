"""A sample's pictures drawn from the geometry that our own scenes keep: no holes, no blur, and hardly a byte to read.

Only scenes made by `gcd-train generate` have it.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.datasets.dataset4d import Dataset4D
from gcd_train.datasets.picture_files import count_read
from gcd_train.datasets.pictures_of_draws import Modality, PairPictures
from gcd_train.datasets.skips import FileFault
from gcd_train.datasets.splat_pictures import require_ontology
from gcd_train.datasets.trajectories import Draw
from gcd_train.layouts.manifest import GEOMETRY, MANIFEST, read_manifest
from gcd_train.pointcloud import depth_visibility, render_lens
from gcd_train.scene_view import SceneView
from gcd_train.scenes.driving.classes import class_ids as published_ids
from gcd_train.scenes.frozen import FrozenScene
from gcd_train.scenes.renderer import Renderer, Rendering

_SOURCE, _TARGET = "source", "target"


class ExactPictures:
    """Draws geometry. Options: see `ViewPairs`; `published` and `device` mean nothing here.

    A renderer is made when the first sample is, in the process that makes it.
    """

    def __init__(
        self,
        dataset: Dataset4D,
        size: tuple[int, int],
        *,
        modality: Modality = "rgb",
        class_ids: bool = False,
        visible: bool = False,
        published: bool = False,
        device: str | None = None,
    ) -> None:
        del published, device
        self._ontology = require_ontology(dataset) if modality == "classes" or class_ids else None
        self._dataset, (self._width, self._height) = dataset, size
        self._modality, self._class_ids, self._visible = modality, class_ids, visible
        self._renderer: tuple[int, Renderer] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_renderer": None}  # an OpenGL context cannot go to another process

    def make(self, scene: str, draw: Draw) -> PairPictures:
        """See `Pictures`. Raises RenderError without a headless OpenGL."""
        folder, numbers = self._dataset.folder(scene), list(draw.frame_numbers)
        lens = render_lens(self._dataset.lens(scene), self._width, self._height)
        still = _frames_of(folder, numbers, lens)
        geometry_from_world = _geometry_from_world(folder, numbers)
        cameras = {
            _SOURCE: geometry_from_world @ draw.world_from_source,
            _TARGET: geometry_from_world @ draw.world_from_target,
        }
        drawn: dict[str, list[Rendering]] = {name: [] for name in cameras}
        for _, name, rendering in self._own_renderer().views(still, cameras):
            drawn[name].append(rendering)
        target = np.stack([each.rgb for each in drawn[_TARGET]])
        ids: NDArray[np.uint8] | None = None
        if self._ontology is not None:
            ids = self._ontology.merge(np.stack([published_ids(each.classes) for each in drawn[_TARGET]]))
            target = self._ontology.encode(ids) if self._modality == "classes" else target
        return PairPictures(
            source=np.stack([each.rgb for each in drawn[_SOURCE]]),
            target=target,
            target_classes=ids if self._class_ids else None,
            visible=_visibility(drawn, cameras, lens) if self._visible else None,
            world_from_source=draw.world_from_source,
        )

    def _own_renderer(self) -> Renderer:
        """Of this process: an OpenGL context does not survive a fork."""
        if self._renderer is None or self._renderer[0] != os.getpid():
            self._renderer = os.getpid(), Renderer(self._width, self._height)
        return self._renderer[1]


def _frames_of(folder: Path, numbers: Sequence[int], lens: Intrinsics) -> FrozenScene:
    """The scene at these times only, for a camera with this lens."""
    path = folder / GEOMETRY
    frozen = FrozenScene.load(path)
    count_read(path)
    if max(numbers) >= frozen.frames:
        raise FileFault(path, f"tells of {frozen.frames} frames, wanted frame {max(numbers)}")
    return replace(frozen, poses=frozen.poses[numbers], focus=frozen.focus[numbers], hfov_deg=lens.hfov_deg)


def _geometry_from_world(folder: Path, numbers: Sequence[int]) -> NDArray[np.float64]:
    """f64 [T, 4, 4]: from the frame that poses are told in (the vehicle's, in driving) to that of the geometry."""
    told = read_manifest(folder).world_from_vehicle
    if told is None:
        return np.broadcast_to(np.eye(4), (len(numbers), 4, 4))
    poses = np.array(told, np.float64)
    if max(numbers) >= len(poses):
        raise FileFault(folder / MANIFEST, f"tells where the vehicle is in {len(poses)} frames, not {max(numbers) + 1}")
    return poses[list(numbers)]


def _visibility(
    drawn: dict[str, list[Rendering]], cameras: dict[str, NDArray[np.float64]], lens: Intrinsics
) -> NDArray[np.bool_]:
    """Where the source saw the very surface of the target."""
    masks: list[NDArray[np.bool_]] = []
    for step, (source, target) in enumerate(zip(drawn[_SOURCE], drawn[_TARGET], strict=True)):
        view = SceneView(
            rgb=source.rgb,
            depth=source.depth,
            classes=None,
            instances=None,
            world_from_camera=cameras[_SOURCE][step],
            lens=lens,
        )
        masks.append(depth_visibility(view, target.depth, cameras[_TARGET][step], lens))
    return np.stack(masks)
