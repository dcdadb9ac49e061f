"""The pictures of a drawn sample, made while training instead of kept: from points, or exactly from our own geometry.

As published, from the points of all cameras: on the sphere both source and target; in driving the source is the forward
camera's own picture. Exactly: only scenes made by `gcd-train generate` keep their geometry; there are no holes, no
blur, and hardly a byte to read.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics, center_crop_box, relative_pose
from gcd_train.data.dataset4d import VOID, Dataset4D
from gcd_train.data.encodings import Doubles, Number
from gcd_train.data.files import GEOMETRY, MANIFEST, FileFault, Recent, read_manifest
from gcd_train.data.paths import Control, Draw, Sampling
from gcd_train.data.sample import Bytes, DrawnSamples, Sample, SceneView
from gcd_train.data.splat import splat
from gcd_train.data.visibility import depth_visibility, published_tensor, quantised, render_lens, visibility
from gcd_train.errors import DataError, RenderError

if TYPE_CHECKING:
    from gcd_train.scenes.renderer import Renderer, Rendering
    from gcd_train.scenes.triangles import FrozenScene

Modality = Literal["rgb", "classes"]

SAME_POSE = 5e-3
"""Largest difference between the entries of two poses at which a dataset's own camera stands for a drawn one."""
_SOURCE, _TARGET = "source", "target"


@dataclass(frozen=True, kw_only=True, slots=True)
class PictureOptions:
    """What is made of a draw.

    size: width and height, pixels. modality: the target in colour, or painted by class. class_ids: also the target's
    classes. visible: also what of the target the source camera saw. depth: also the source's. exact: from the geometry
    our own scenes keep, instead of from points. published: points as released, with its approximations; open Kubric-4D
    with `published` too then. device: where points are drawn.
    """

    size: tuple[int, int] = (384, 256)
    modality: Modality = "rgb"
    class_ids: bool = False
    visible: bool = False
    depth: bool = field(default=False, repr=False)  # sets of clips are named by what changes their pictures
    exact: bool = False
    published: bool = False
    device: str | None = None


class Pictures(ABC):
    """Makes the pictures of draws. Raises DataError where classes are asked of a set without."""

    def __init__(self, dataset: Dataset4D, options: PictureOptions) -> None:
        self._ontology = dataset.ontology if options.modality == "classes" or options.class_ids else None
        if self._ontology is None and (options.modality == "classes" or options.class_ids):
            raise DataError("classes were asked of a data set that has none: Kubric-4D has instances only")
        self._dataset, self._options, (self._width, self._height) = dataset, options, options.size

    def sample(self, scene: str, draw: Draw) -> Sample:
        """Source, target and what else the options ask for. Raises DataError, FileFault: a file is missing, damaged or
        does not fit."""
        made = self._drawn(scene, draw)
        poses = map(torch.from_numpy, (made.world_from_source, draw.world_from_target))
        return Sample(
            source=np.stack(made.source),
            target=np.stack(made.target),
            target_classes=np.stack(made.classes) if self._options.class_ids else None,
            source_from_target=relative_pose(*poses).numpy(),
            start=draw.start,
            deltas=draw.deltas,
            fps=draw.fps,
            scene=scene,
            frame_numbers=draw.frame_numbers,
            visible=np.stack(made.visible) if self._options.visible else None,
            target_depth=np.stack(made.depth) if made.depth else None,
            lens=render_lens(self._dataset.lens(scene), self._width, self._height),
            source_depth=np.stack(made.source_depth) if self._options.depth else None,
        )

    @abstractmethod
    def _drawn(self, scene: str, draw: Draw) -> "_Drawn":
        """Frame by frame."""


@dataclass(kw_only=True, slots=True)
class _Drawn:
    """T frames each, where they are asked for. world_from_source: where the source camera really stood."""

    world_from_source: Doubles
    source: list[Bytes] = field(default_factory=list[Bytes])
    target: list[Bytes] = field(default_factory=list[Bytes])
    classes: list[Bytes] = field(default_factory=list[Bytes])
    visible: list[NDArray[np.bool_]] = field(default_factory=list[NDArray[np.bool_]])
    depth: list[NDArray[np.float32]] = field(default_factory=list[NDArray[np.float32]])
    source_depth: list[NDArray[np.float32]] = field(default_factory=list[NDArray[np.float32]])


class SplatPictures(Pictures):
    """Draws points."""

    def _drawn(self, scene: str, draw: Draw) -> _Drawn:
        options, lens, read = self._options, self._dataset.lens(scene), Recent(partial(self._dataset.views, scene), 1)
        place = list(self._dataset.cameras).index(self._dataset.source_camera)
        made, how = _Drawn(world_from_source=draw.world_from_source), (options.published, options.device)
        picture = partial(published_tensor, lens=lens, size=options.size, published=how[0], device=how[1])
        points = partial(splat, lens=render_lens(lens, *options.size), published=how[0], device=how[1])
        for number, world_from_target in zip(draw.frame_numbers, draw.world_from_target, strict=True):
            views = read(number)
            own = seen = views[place]
            if draw.start is None:
                made.world_from_source = own.world_from_camera
                made.source.append(trained_picture(own.rgb, *options.size))
            else:
                made.source.append(quantised(picture(views, draw.world_from_source), published=how[0]))
                apart = np.abs(own.world_from_camera - draw.world_from_source).max() >= SAME_POSE
                if apart and (options.visible or options.depth):
                    # what a camera at the drawn pose would have seen, with depth, from the points of all
                    there = points(views, draw.world_from_source)
                    depth, smaller = there.depth.cpu().numpy(), render_lens(lens, *options.size)
                    seen = _view(there.picture, depth, draw.world_from_source, smaller)
            if options.depth:
                made.source_depth.append(nearest_resized(seen.depth, *options.size))
            painted = None
            if self._ontology is not None and options.modality == "classes":
                painted = [self._ontology.encode(ids) for ids in self._ids(views)]
            made.target.append(quantised(picture(views, world_from_target, values=painted), published=how[0]))
            if options.class_ids:
                # of the point that shows most in each pixel: colours of edges are mixed, and read back as a third class
                ids = points(views, world_from_target, labels=self._ids(views))
                made.classes.append(ids.labels.masked_fill(~ids.covered, VOID).byte().cpu().numpy())
            if options.visible:
                made.visible.append(visibility(seen, world_from_target, lens, options.size, published=how[0]))
        return made

    def _ids(self, views: Sequence[SceneView]) -> list[Bytes]:
        """Class ids of the views; of several in one colour, which pictures cannot tell apart, the lowest."""
        assert self._ontology is not None
        classes = [view.classes for view in views if view.classes is not None]
        if len(classes) < len(views):
            raise DataError("classes were asked for, but the scene lacks its layer semantic_segmentation_2d")
        return [self._ontology.merge(ids) for ids in classes]


class ExactPictures(Pictures):
    """Draws geometry; options `published` and `device` mean nothing here.

    A renderer is made when the first sample is, in the process that makes it. Raises RenderError without the extra
    `scenes` or a headless OpenGL.
    """

    def __init__(self, dataset: Dataset4D, options: PictureOptions) -> None:
        super().__init__(dataset, options)
        self._renderer: tuple[int, Renderer] | None = None
        renderer_kind()  # what is not installed is said now, not sample by sample

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_renderer": None}  # an OpenGL context cannot go to another process

    def _drawn(self, scene: str, draw: Draw) -> _Drawn:
        from gcd_train.scenes.driving.classes import class_ids as published_ids

        folder, numbers = self._dataset.folder(scene), list(draw.frame_numbers)
        lens = render_lens(self._dataset.lens(scene), self._width, self._height)
        still, renderer = frames_of(folder, numbers, lens), self._own_renderer()
        geometry_from_world = geometry_poses(folder, numbers)
        cameras = {
            _SOURCE: geometry_from_world @ draw.world_from_source,
            _TARGET: geometry_from_world @ draw.world_from_target,
        }
        drawn: dict[str, list[Rendering]] = {name: [] for name in cameras}
        for _, name, rendering in renderer.views(still, cameras):
            drawn[name].append(rendering)
        source, target = ([each.rgb for each in drawn[name]] for name in (_SOURCE, _TARGET))
        depth = [each.depth for each in drawn[_SOURCE]]
        made = _Drawn(world_from_source=draw.world_from_source, source=source, target=target, source_depth=depth)
        if self._ontology is not None:
            made.classes = [self._ontology.merge(published_ids(each.classes)) for each in drawn[_TARGET]]
            if self._options.modality == "classes":
                made.target = [self._ontology.encode(ids) for ids in made.classes]
        if self._options.visible:  # where the source saw the very surface of the target
            made.depth = [each.depth for each in drawn[_TARGET]]
            each = zip(drawn[_SOURCE], cameras[_SOURCE], drawn[_TARGET], cameras[_TARGET], strict=True)
            made.visible = [
                depth_visibility(_view(near.rgb, near.depth, at, lens), far.depth, aimed, lens)
                for near, at, far, aimed in each
            ]
        return made

    def seen_from(self, scene: str, numbers: Sequence[int], poses: Doubles) -> list[list[SceneView]]:
        """What cameras that stand still would see of a scene at these times: a view of each for every time.

        poses: f64 [C, 4, 4], world_from_camera.
        """
        folder, lens = self._dataset.folder(scene), render_lens(self._dataset.lens(scene), self._width, self._height)
        still, moved = frames_of(folder, list(numbers), lens), geometry_poses(folder, numbers)
        cameras = {f"drawn{place}": moved @ pose for place, pose in enumerate(poses)}
        seen = [[] for _ in numbers]
        for step, name, rendering in self._own_renderer().views(still, cameras):
            pose = poses[int(name.removeprefix("drawn"))]
            seen[step].append(_view(rendering.rgb, rendering.depth, pose, lens))
        return seen

    def _own_renderer(self) -> "Renderer":
        """Of this process: an OpenGL context does not survive a fork."""
        if self._renderer is None or self._renderer[0] != os.getpid():
            self._renderer = os.getpid(), renderer_kind()(self._width, self._height)
        return self._renderer[1]


def pictures_of(dataset: Dataset4D, options: PictureOptions) -> Pictures:
    """What makes a set's pictures. Raises DataError where classes are asked of a set without."""
    return (ExactPictures if options.exact else SplatPictures)(dataset, options)


class ViewPairs(DrawnSamples):
    """Samples of a data set in a published layout.

    dataset: where pictures come from. sampling: frames and paths, for one `paths.MAX90` or `DRIVING`. options: what is
    made of them. repeats: the set counts as so many times its scenes; scene of index i is i mod the number of scenes.

    Safe in the workers of a loader: give it to `torch.utils.data.DataLoader(pairs, collate_fn=collate)`; where this
    process has drawn with OpenGL before, with `multiprocessing_context="spawn"`.
    """

    def __init__(
        self,
        dataset: Dataset4D,
        sampling: Sampling,
        seed: int = 0,
        options: PictureOptions | None = None,
        *,
        repeats: int = 400,
    ) -> None:
        if not dataset.scenes:
            raise DataError("a data set without scenes has no pairs; look at its folder, split and list")
        super().__init__(seed, repeats * len(dataset.scenes))
        self.dataset, self.sampling = dataset, sampling
        self._pictures = pictures_of(dataset, options or PictureOptions())

    def controlled(self, scene: str, control: Control) -> Sample:
        """The sample of a scene that a control list asks for.

        Raises: DataError, FileFault: it cannot be read; nothing stands in for it.
        """
        draw = self.sampling.controlled(control, self.dataset.frames(scene), self.dataset.fps)
        return self._pictures.sample(scene, draw)

    def seen_from(self, scene: str, numbers: Sequence[int], poses: Doubles) -> list[list[SceneView]]:
        """See ExactPictures; of scenes that have no geometry there is nothing to draw. Raises DataError."""
        if not isinstance(self._pictures, ExactPictures):
            raise DataError(f"{scene} is drawn from points, which show no more than its own cameras; use --exact")
        return self._pictures.seen_from(scene, numbers, poses)

    def _made(self, number: int, random: np.random.Generator) -> Sample:
        scene, _ = self._place(number)
        draw = self.sampling.draw(random, self.dataset.frames(scene), self.dataset.fps)
        return self._pictures.sample(scene, draw)

    def _place(self, number: int) -> tuple[str, Path]:
        scene = self.dataset.scenes[number % len(self.dataset.scenes)]
        return scene, self.dataset.folder(scene)


def trained_picture(rgb: Bytes, width: int, height: int) -> Bytes:
    """A camera's picture at the trained size: centre crop to its shape, then bilinear resize, as published."""
    left, top, across, along = center_crop_box(rgb.shape[1], rgb.shape[0], width / height)
    cropped = rgb[top : top + along, left : left + across]
    return cv2.resize(cropped, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False)


def nearest_resized(values: NDArray[Number], width: int, height: int) -> NDArray[Number]:
    """What must not be averaged, in the size and crop of `trained_picture`: [H, W] -> [height, width]."""
    left, top, across, along = center_crop_box(values.shape[1], values.shape[0], width / height)
    rows = top + ((np.arange(height) + 0.5) * along / height).astype(np.intp)
    columns = left + ((np.arange(width) + 0.5) * across / width).astype(np.intp)
    return values[rows[:, None], columns]


def trained_lens(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """The lens of `trained_picture`'s result, for a picture of this lens."""
    return lens.cropped(*center_crop_box(lens.width, lens.height, width / height)).resized(width, height)


def renderer_kind() -> "type[Renderer]":
    """The renderer, an extra. Raises RenderError where it is not installed."""
    try:
        from gcd_train.scenes.renderer import Renderer
    except ImportError as error:
        raise RenderError(f"exact targets are drawn and need pip install 'gcd-node[scenes]' ({error})") from error
    return Renderer


def _view(rgb: Bytes, depth: NDArray[np.float32], world_from_camera: Doubles, lens: Intrinsics) -> SceneView:
    return SceneView(rgb=rgb, depth=depth, classes=None, instances=None, world_from_camera=world_from_camera, lens=lens)


def frames_of(folder: Path, numbers: Sequence[int], lens: Intrinsics) -> "FrozenScene":
    """A scene's kept geometry at these times only, for a camera with this lens. Raises DataError if it is damaged."""
    from gcd_train.scenes.triangles import FrozenScene

    frozen = FrozenScene.load(folder / GEOMETRY)
    if max(numbers) >= frozen.frames:
        raise FileFault(folder / GEOMETRY, f"tells of {frozen.frames} frames, wanted frame {max(numbers)}")
    return replace(frozen, poses=frozen.poses[numbers], focus=frozen.focus[numbers], hfov_deg=lens.hfov_deg)


def geometry_poses(folder: Path, numbers: Sequence[int]) -> Doubles:
    """f64 [T, 4, 4]: from the frame that poses are given in (the vehicle's, in driving) to that of the geometry."""
    known = read_manifest(folder).world_from_vehicle
    if known is None:
        return np.broadcast_to(np.eye(4), (len(numbers), 4, 4))
    poses = np.array(known, np.float64)
    if max(numbers) >= len(poses):
        raise FileFault(folder / MANIFEST, f"tells where the vehicle is in {len(poses)} frames, not {max(numbers) + 1}")
    return poses[list(numbers)]
