"""A sample's pictures from point clouds, made while training instead of kept: nothing but the data set is read.

As published: on the sphere both source and target are drawn from the points of all cameras; in driving the source is
the forward camera's own picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.datasets.dataset4d import Dataset4D
from gcd_train.datasets.ontology import VOID, Ontology
from gcd_train.datasets.pictures_of_draws import Bytes, Modality, PairPictures, stacked, trained_picture
from gcd_train.datasets.trajectories import Draw
from gcd_train.errors import DataError
from gcd_train.pointcloud import SplatOptions, published_picture, render_lens, splat, visibility
from gcd_train.scene_view import SceneView

SAME_POSE = 5e-3
"""Largest difference between the entries of two poses at which a dataset's own camera stands for a drawn one."""


@dataclass(frozen=True, slots=True)
class _Frame:
    source: Bytes
    target: Bytes
    target_classes: Bytes | None
    visible: NDArray[np.bool_] | None


class SplatPictures:
    """Draws points. Options: see `ViewPairs`. Raises DataError where classes are asked of a set without."""

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
        self._ontology = require_ontology(dataset) if modality == "classes" or class_ids else None
        self._dataset, (self._width, self._height) = dataset, size
        self._modality, self._class_ids, self._visible = modality, class_ids, visible
        self._options, self._device = SplatOptions(published=published), device

    def make(self, scene: str, draw: Draw) -> PairPictures:
        """See `Pictures`."""
        lens = self._dataset.lens(scene)
        place = list(self._dataset.cameras).index(self._dataset.source_camera)
        world_from_source, frames = draw.world_from_source, list[_Frame]()
        for number, world_from_target in zip(draw.frame_numbers, draw.world_from_target, strict=True):
            views = self._dataset.views(scene, number)
            if draw.start is None:
                world_from_source = views[place].world_from_camera
                source = trained_picture(views[place].rgb, self._width, self._height)
                seen = views[place]
            else:
                source = self._picture(views, world_from_source, lens)
                own = np.abs(views[place].world_from_camera - world_from_source).max() < SAME_POSE
                seen = views[place] if own else self._seen(views, world_from_source, lens) if self._visible else None
            frames.append(self._frame(source, seen, views, world_from_target, lens))
        return PairPictures(
            source=np.stack([frame.source for frame in frames]),
            target=np.stack([frame.target for frame in frames]),
            target_classes=stacked([frame.target_classes for frame in frames]),
            visible=stacked([frame.visible for frame in frames]),
            world_from_source=world_from_source,
        )

    def _frame(
        self,
        source: Bytes,
        seen: SceneView | None,
        views: Sequence[SceneView],
        world_from_target: NDArray[np.float64],
        lens: Intrinsics,
    ) -> _Frame:
        values = self._painted(views) if self._modality == "classes" else None
        visible = None
        if self._visible and seen is not None:
            visible = visibility(
                seen, world_from_target, lens, width=self._width, height=self._height, options=self._options
            )
        return _Frame(
            source=source,
            target=self._picture(views, world_from_target, lens, values),
            target_classes=self._target_ids(views, world_from_target, lens) if self._class_ids else None,
            visible=visible,
        )

    def _target_ids(
        self, views: Sequence[SceneView], world_from_target: NDArray[np.float64], lens: Intrinsics
    ) -> Bytes:
        """The class of the point that shows most in each pixel, `VOID` where none does: colours of edges are mixed, and
        read back as a third class."""
        smaller = render_lens(lens, self._width, self._height)
        labels = self._ids(views)
        drawn = splat(views, world_from_target, smaller, labels=labels, options=self._options, device=self._device)
        assert drawn.labels is not None
        return drawn.labels.masked_fill(~drawn.covered, VOID).byte().cpu().numpy()

    def _painted(self, views: Sequence[SceneView]) -> list[Bytes]:
        """Views in colours of their classes."""
        assert self._ontology is not None
        return [self._ontology.encode(ids) for ids in self._ids(views)]

    def _ids(self, views: Sequence[SceneView]) -> list[Bytes]:
        """Class ids of the views; of several in one colour, which pictures cannot tell apart, the lowest."""
        assert self._ontology is not None
        classes = [view.classes for view in views if view.classes is not None]
        if len(classes) < len(views):
            raise DataError("classes were asked for, but the scene lacks its layer semantic_segmentation_2d")
        return [self._ontology.merge(ids) for ids in classes]

    def _picture(
        self,
        views: Sequence[SceneView],
        world_from_camera: NDArray[np.float64],
        lens: Intrinsics,
        values: Sequence[Bytes] | None = None,
    ) -> Bytes:
        return published_picture(
            views,
            world_from_camera,
            lens,
            width=self._width,
            height=self._height,
            values=values,
            options=self._options,
            device=self._device,
        )

    def _seen(self, views: Sequence[SceneView], world_from_source: NDArray[np.float64], lens: Intrinsics) -> SceneView:
        """What a camera at a drawn source pose would have seen, with depth, from the points of all."""
        smaller = render_lens(lens, self._width, self._height)
        drawn = splat(views, world_from_source, smaller, options=self._options, device=self._device)
        return SceneView(
            rgb=(drawn.colour * 255).round().byte().cpu().numpy(),
            depth=drawn.depth.cpu().numpy(),
            classes=None,
            instances=None,
            world_from_camera=world_from_source,
            lens=smaller,
        )


def require_ontology(dataset: Dataset4D) -> Ontology:
    """The classes of a data set. Raises DataError if it has none."""
    if dataset.ontology is None:
        raise DataError("classes were asked of a data set that has none: Kubric-4D tells instances only")
    return dataset.ontology
