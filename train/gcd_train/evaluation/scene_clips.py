"""Whole scenes with many cameras as clips: Kubric-4D, ParallelDomain-4D, and ours in their layouts."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.config import CameraControl, SemanticClass
from gcd_model.geometry import CameraMount, center_crop_box, pose_trajectory, to_pose
from gcd_train.data.dataset4d import Dataset4D, Ontology
from gcd_train.data.pictures import SAME_POSE, trained_lens, trained_picture
from gcd_train.data.sample import Bytes, Sample, SceneView
from gcd_train.data.splits import Control
from gcd_train.data.views import ViewPairs
from gcd_train.errors import DataError
from gcd_train.evaluation.clips import HeldOutClip, SetKind
from gcd_train.evaluation.predictors import CameraPair, SourceClip
from gcd_train.evaluation.protocol import ClipControls
from gcd_train.pointcloud import render_lens, splat

Number = TypeVar("Number", bound=np.generic)


@dataclass(frozen=True, kw_only=True)
class SceneSet:
    """Clips of whole scenes by name: `scn02900.sample_00`, the scene and its control.

    pairs: makes the pictures; it must tell what is visible, and class ids where `classes` are wanted. controls: which
    clips there are. frames, height, width: T, H and W of the clips. semantic: class maps are wanted. kind, identity:
    see EvaluationSet.
    """

    pairs: ViewPairs
    controls: ClipControls
    frames: int
    height: int
    width: int
    kind: SetKind
    identity: str
    semantic: bool = False
    _places: dict[str, tuple[str, str]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        places = {
            f"{scene}.{name}": (scene, name) for scene in self.dataset.scenes for name in self.controls.names(scene)
        }
        object.__setattr__(self, "_places", places)

    @property
    def dataset(self) -> Dataset4D:
        """Where scenes are read from."""
        return self.pairs.dataset

    @property
    def keys(self) -> Sequence[str]:
        """Names, scene by scene."""
        return tuple(self._places)

    @property
    def fps(self) -> float:
        """See EvaluationSet."""
        return self.rates[0]

    @property
    def rates(self) -> Sequence[float]:
        """As networks are told them, from the strides of all scenes."""
        strides = {stride for scene in self.dataset.scenes for stride in self.controls.strides(scene)}
        each = [Control(name="", frame_start=0, frame_skip=stride) for stride in strides]
        return sorted({control.fps(self.dataset.fps) for control in each}, reverse=True)

    @property
    def camera(self) -> CameraControl:
        """How a network is told where the target camera goes: driving has one path."""
        return "none" if self.kind == "driving" else "spherical"

    @property
    def classes(self) -> Sequence[SemanticClass]:
        """The ontology, where class maps are wanted."""
        return self._ontology.classes if self._ontology is not None else ()

    def clip(self, key: str, /) -> HeldOutClip:
        """See EvaluationSet. Every picture is made anew from the scene's files."""
        if key not in self._places:
            raise DataError(
                f"there is no clip {key}; there are {len(self._places)}, first {next(iter(self._places), '-')}"
            )
        scene, name = self._places[key]
        control = self.controls.control(scene, name, self.dataset.frames(scene))
        sample = self.pairs.controlled(scene, control)
        ids, ontology = sample.target_classes, self._ontology
        return HeldOutClip(
            key=key,
            scene=scene,
            seen=self._source_side(key, sample),
            target=sample.target,
            target_classes=None if ids is None or ontology is None else ontology.places[ids],
            visible=sample.visible,
            change=None
            if sample.deltas is None
            else msgspec.convert(sample.deltas[-1].tolist(), tuple[float, float, float]),
        )

    @property
    def _ontology(self) -> Ontology | None:
        return self.dataset.ontology if self.semantic else None

    def _source_side(self, key: str, sample: Sample) -> SourceClip:
        seen_by = [self.dataset.source_camera]
        views = [view for time in sample.frame_numbers for view in self.dataset.views(sample.scene, time, seen_by)]
        views = [replace(view, classes=self._places_of(view.classes)) for view in views]
        cameras = self._cameras(sample, views[0])
        apart = (cameras.ground_from_source - torch.from_numpy(views[0].world_from_camera)).abs().max()
        own = float(apart) < SAME_POSE
        ids = [view.classes for view in views if own and view.classes is not None]
        if own:
            depth = self._stacked([view.depth for view in views])
        else:  # from the points of all cameras
            pose, lens = cameras.ground_from_source.numpy(), cameras.source
            seen = (splat(self.dataset.views(sample.scene, time), pose, lens) for time in sample.frame_numbers)
            depth = np.stack([each.depth.cpu().numpy() for each in seen])
        return SourceClip(
            source=sample.source,
            source_depth=depth,
            source_classes=self._stacked(ids) if ids else None,
            cameras=cameras,
            fps=sample.fps,
            key=key,
            others=partial(self._others, sample.scene, sample.frame_numbers),
            points=partial(tuple[SceneView, ...], views) if own else None,
        )

    def _cameras(self, sample: Sample, first: SceneView) -> CameraPair:
        """Both cameras, in the scene's world or, in driving, in the vehicle's frame."""
        lens = render_lens(self.dataset.lens(sample.scene), self.width, self.height)
        path = pose_trajectory(torch.from_numpy(sample.source_from_target))
        if sample.start is None or sample.deltas is None:
            return CameraPair(
                ground_from_source=torch.from_numpy(first.world_from_camera),
                source=trained_lens(first.lens, self.width, self.height),
                target=lens,
                trajectory=path,
                mount=CameraMount(),
            )
        path = replace(path, delta=torch.from_numpy(sample.deltas), source=sample.start)
        return CameraPair(ground_from_source=to_pose(sample.start), source=lens, target=lens, trajectory=path)

    def _places_of(self, ids: Bytes | None) -> Bytes | None:
        """Places in the ontology; of those that share a colour, or have none, as they come back from a picture."""
        if ids is None or self._ontology is None:
            return None
        return self._ontology.places[self._ontology.decode(self._ontology.encode(ids))]

    def _stacked(self, rows: Sequence[NDArray[Number]]) -> NDArray[Number]:
        return np.stack([nearest_resized(row, self.width, self.height) for row in rows])

    def _others(self, scene: str, times: Sequence[int], count: int) -> Sequence[Sequence[SceneView]]:
        """See OtherViews. Far from the source and from each other, the farthest first."""
        names = [name for name in self.dataset.cameras if name != self.dataset.source_camera]
        if not 0 <= count <= len(names):
            raise DataError(
                f"{scene} has {len(names)} cameras beside the source, a method wants {count}; give it fewer views"
            )
        first = self.dataset.views(scene, times[0], [self.dataset.source_camera, *names])
        order = far_apart(np.stack([view.world_from_camera[:3, 3] for view in first]))
        chosen = [names[place - 1] for place in order[1 : count + 1]]
        each = [self.dataset.views(scene, time, chosen) for time in times] if chosen else []
        return [[self._other(views[place]) for views in each] for place in range(count)]

    def _other(self, view: SceneView) -> SceneView:
        """At the clips' size."""
        classes = self._places_of(view.classes)
        return SceneView(
            rgb=trained_picture(view.rgb, self.width, self.height),
            depth=nearest_resized(view.depth, self.width, self.height),
            classes=None if classes is None else nearest_resized(classes, self.width, self.height),
            instances=None,
            world_from_camera=view.world_from_camera,
            lens=trained_lens(view.lens, self.width, self.height),
        )


def far_apart(places: NDArray[np.float64]) -> list[int]:
    """An order of places [N, 3] that begins with the first and goes on with the one farthest from all before."""
    order = [0]
    while len(order) < len(places):
        nearest = np.linalg.norm(places[:, None] - places[order], axis=-1).min(axis=1)
        order.append(int(nearest.argmax()))
    return order


def nearest_resized(values: NDArray[Number], width: int, height: int) -> NDArray[Number]:
    """What must not be averaged, in the size and crop of `trained_picture`: [H, W] -> [height, width]."""
    left, top, across, along = center_crop_box(values.shape[1], values.shape[0], width / height)
    rows = top + ((np.arange(height) + 0.5) * along / height).astype(np.intp)
    columns = left + ((np.arange(width) + 0.5) * across / width).astype(np.intp)
    return values[rows[:, None], columns]
