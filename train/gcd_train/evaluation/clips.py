"""The clips that predictors are measured on: pairs, and whole scenes with many cameras."""

import hashlib
import zipfile
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Literal, Self, TypeAlias

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.config import CameraControl, SemanticClass
from gcd_model.geometry import CameraMount, pose_trajectory, sphere_poses, to_pose
from gcd_train.data.dataset4d import Dataset4D, Ontology
from gcd_train.data.files import ZIP_FAULTS
from gcd_train.data.pairs import PairedClip, PairedClips
from gcd_train.data.paths import Control, Controls
from gcd_train.data.pictures import SAME_POSE, ViewPairs, nearest_resized, trained_lens, trained_picture
from gcd_train.data.sample import Bytes, Sample, SceneView
from gcd_train.data.splat import Number, splat
from gcd_train.data.splits import SceneControls
from gcd_train.data.visibility import depth_visibility, render_lens
from gcd_train.errors import DataError
from gcd_train.evaluation.predictors import FAR_M, CameraPair, SourceClip, own_views

SetKind: TypeAlias = Literal["kubric", "driving", "orbit", "anyview"]
"""Which tables clips belong to: Kubric-4D and scenes in its layout, driving, pairs seen along orbits, or episodes of
AnyViewBench, whose cameras may be anywhere."""


@dataclass(frozen=True, kw_only=True, slots=True)
class HeldOutClip:
    """One clip that methods are measured on: what they may see, and what is kept from them.

    key: unique in its set, and a file name: `scn02900.sample_00`. scene: errors are over scenes. seen: the source side.
    target: uint8 [T, H, W, 3] RGB. target_classes: uint8 [T, H, W], None where there are none. visible: bool [T, H, W],
    target pixels that the source camera saw too; None where nobody knows. change: azimuth and elevation in degrees and
    radius in metres from source to goal, None for paths that are not on the sphere. counted: bool [T], frames that have
    figures; None for all.
    """

    key: str
    scene: str
    seen: SourceClip
    target: Bytes
    target_classes: Bytes | None = None
    visible: NDArray[np.bool_] | None = None
    change: tuple[float, float, float] | None = None
    counted: NDArray[np.bool_] | None = None


@dataclass(frozen=True, kw_only=True)
class EvaluationSet(ABC):
    """Clips by key, the same whenever they are asked for, in any process.

    frames, height, width: T, H and W of each clip. identity: digest of what the clips are read from and how they were
    drawn. classes: the ontology, empty for none. painted: targets are painted in the colours of the classes, and all
    that counts is class maps. cameras: that a method may be given, the source and further ones of the scene. geometry:
    whether the source's depth is known, and where the ground is.
    """

    frames: int
    height: int
    width: int
    kind: SetKind
    identity: str
    classes: tuple[SemanticClass, ...] = ()
    painted: bool = False
    cameras: int = 1
    geometry: bool = True

    @property
    def camera(self) -> CameraControl:
        """How a network is told where the target camera goes: driving has one path, others one of each clip's own."""
        return "none" if self.kind == "driving" else "spherical"

    @property
    @abstractmethod
    def keys(self) -> tuple[str, ...]:
        """Names of the clips, in order."""

    def length(self, key: str, /) -> int:
        """Frames of a clip: T but for sets whose clips differ."""
        return self.frames

    @abstractmethod
    def clip(self, key: str, /) -> HeldOutClip:
        """Raises DataError, naming the file, where it cannot be read; nothing stands in for it."""


def cameras_of(clips: PairedClips, number: int) -> CameraPair:
    """Both cameras of a clip."""
    path, size = clips.trajectory(number), {"height": clips.height, "width": clips.width}
    if clips.mount is None:
        return CameraPair.orbit(path, hfov_deg=clips.hfov_deg, **size)
    return CameraPair.driving(clips.mount, frames=clips.frames, move_time=path.at_goal.index(True), **size)


def names_of(classes: Sequence[SemanticClass]) -> str:
    """An ontology in one line."""
    return ", ".join(each.name for each in classes) or "none"


@dataclass(frozen=True, kw_only=True)
class PairedSet(EvaluationSet):
    """Pairs by name: `driving-01000100`, the world and the clip's number.

    picked: where in a pixel its depth was taken, pixels from its middle towards the lower right corner.
    """

    clips: PairedClips
    picked: float = 0.0

    @classmethod
    def of(cls, clips: PairedClips, identity: str | None = None) -> Self:
        """The set of some clips. identity: by default that of their files. Raises DataError if a shard is damaged."""
        oversample = clips.world.oversample
        return cls(
            clips=clips,
            frames=clips.frames,
            height=clips.height,
            width=clips.width,
            kind="driving" if clips.camera == "none" else "orbit",
            identity=identity_of(clips) if identity is None else identity,
            classes=tuple(clips.classes),
            picked=(oversample // 2 + 0.5) / oversample - 0.5,
        )

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Of all clips by name; what is there again, in another folder, gets a number."""
        found, times = dict[str, int](), Counter[str]()
        for number in range(len(self.clips)):
            key = f"{self.clips.scene(number)[0]}-{self.clips.name(number)}"
            times[key] += 1
            found[key if times[key] == 1 else f"{key}.{times[key]}"] = number
        return found

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(self.numbers)

    def clip(self, key: str, /) -> HeldOutClip:
        """See EvaluationSet."""
        number = self.numbers[key]
        clip, classes, cameras = self.clips[number], bool(self.classes), cameras_of(self.clips, number)
        goal = self.clips.trajectory(number).goal_delta
        world, scene = self.clips.scene(number)
        return HeldOutClip(
            key=key,
            scene=f"{world}-{scene:08d}",
            seen=SourceClip(
                source=clip.source,
                source_depth=clip.source_depth,
                source_classes=clip.source_classes if classes else None,
                cameras=cameras,
                fps=self.clips.fps,
                key=key,
            ),
            target=clip.target,
            target_classes=clip.target_classes if classes else None,
            visible=seen_too(clip, cameras, picked=self.picked),
            change=None if goal is None else (goal.azimuth_deg, goal.elevation_deg, goal.radius_m),
        )


def chosen(
    clips: PairedClips, *, scenes: Collection[tuple[str, int]] | None = None, limit: int | None = None
) -> PairedClips:
    """Some of the clips, in their order.

    Args:
        scenes: only clips of these, each a world and a seed; None for all. limit: only the first so many scenes.
    Raises: DataError if no clip is left.
    """
    each = [clips.scene(number) for number in range(len(clips))]
    wanted = [scene for scene in dict.fromkeys(each) if scenes is None or scene in scenes][:limit]
    kept = [number for number, scene in enumerate(each) if scene in set(wanted)]
    if not kept:
        raise DataError(f"none of the {len(clips)} clips is of the split; generate its scenes, or give another --split")
    folders = tuple(clips.folders[number] for number in kept) if clips.folders else ()
    return replace(clips, places=tuple(clips.places[number] for number in kept), folders=folders)


def seen_too(clip: PairedClip, cameras: CameraPair, *, picked: float = 0.0) -> NDArray[np.bool_]:
    """Which target pixels show what the source camera saw at the same time, bool [T, H, W]; sky and sky are the same.

    Args:
        cameras: where the two really are. picked: see PairedSet; the rays of a lens that is moved by it go through the
            places where depth was taken, if they are counted as the pixels' middles.
    """
    source, target = (
        replace(lens, cx=lens.cx - picked, cy=lens.cy - picked) for lens in (cameras.source, cameras.target)
    )
    views = own_views(clip.source, clip.source_depth, None, source)
    depth = np.where(clip.target_depth > 0, clip.target_depth, np.float32(FAR_M))
    poses = cameras.source_from_target.numpy()
    return np.stack([depth_visibility(view, depth[t], poses[t], target) for t, view in enumerate(views)])


def identity_of(clips: PairedClips) -> str:
    """Digest of the worlds, and of every file of every clip by its checksum. Raises DataError."""
    digest, sums = hashlib.sha256(msgspec.json.encode(clips.worlds)), dict[Path, dict[str, list[int]]]()
    for path, name in clips.places:
        if path not in sums:
            sums[path] = {}
            try:
                with zipfile.ZipFile(path) as archive:
                    for file in sorted(archive.infolist(), key=lambda each: each.filename):
                        sums[path].setdefault(file.filename.partition("/")[0], []).append(file.CRC)
            except ZIP_FAULTS as error:
                raise DataError(f"{path} is damaged ({error}); delete it and generate again") from error
        digest.update(f"{name}{sums[path].get(name)}".encode())
    return digest.hexdigest()[:12]


@dataclass(frozen=True, kw_only=True)
class SceneSet(EvaluationSet):
    """Clips of whole scenes by name: `scn02900.sample_00`, the scene and its control.

    pairs: makes the pictures; it must tell what is visible, and class ids where targets are `painted`. controls: which
    clips there are.
    """

    pairs: ViewPairs
    controls: SceneControls

    @cached_property
    def _places(self) -> dict[str, tuple[str, str]]:
        scenes = self.dataset.scenes
        return {f"{scene}.{name}": (scene, name) for scene in scenes for name in self.controls.names(scene)}

    @property
    def dataset(self) -> Dataset4D:
        """Where scenes are read from."""
        return self.pairs.dataset

    @property
    def ontology(self) -> Ontology | None:
        """Of the data set, where class maps are wanted."""
        return self.dataset.ontology if self.painted else None

    @property
    def keys(self) -> tuple[str, ...]:
        """See EvaluationSet; scene by scene."""
        return tuple(self._places)

    def listed(self) -> Controls:
        """Frames and cameras of all clips, but for those of scenes that cannot be read."""
        found = dict[str, tuple[Control, ...]]()
        for scene, name in self._places.values():
            with suppress(DataError):
                control = self.controls.control(scene, name, self.dataset.frames(scene))
                found[scene] = (*found.get(scene, ()), control)
        return found

    def clip(self, key: str, /) -> HeldOutClip:
        """See EvaluationSet. Every picture is made anew from the scene's files."""
        scene, name = self._places[key]
        control = self.controls.control(scene, name, self.dataset.frames(scene))
        sample = self.pairs.controlled(scene, control)
        ids, ontology, deltas = sample.target_classes, self.ontology, sample.deltas
        return HeldOutClip(
            key=key,
            scene=scene,
            seen=self._source_side(key, sample),
            target=sample.target,
            target_classes=None if ids is None or ontology is None else ontology.places[ids],
            visible=sample.visible,
            change=None if deltas is None else msgspec.convert(deltas[-1].tolist(), tuple[float, float, float]),
        )

    def _source_side(self, key: str, sample: Sample) -> SourceClip:
        seen_by = [self.dataset.source_camera]
        views = [view for time in sample.frame_numbers for view in self.dataset.views(sample.scene, time, seen_by)]
        views = [replace(view, classes=self._places_of(view.classes)) for view in views]
        cameras = self._cameras(sample, views[0])
        apart = (cameras.ground_from_source - torch.from_numpy(views[0].world_from_camera)).abs().max()
        own = float(apart) < SAME_POSE
        ids = [view.classes for view in views if own and view.classes is not None]
        if sample.source_depth is not None:  # drawn with the picture, exactly
            depth = sample.source_depth
        elif own:
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
            points=views if own else (),
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
        if ids is None or self.ontology is None:
            return None
        return self.ontology.places[self.ontology.decode(self.ontology.encode(ids))]

    def _stacked(self, rows: Sequence[NDArray[Number]]) -> NDArray[Number]:
        return np.stack([nearest_resized(row, self.width, self.height) for row in rows])

    def _others(self, scene: str, times: Sequence[int], count: int) -> Sequence[Sequence[SceneView]]:
        """See SourceClip. The farthest from the source first, then always the one farthest from all before; the scene's
        own cameras before those that are drawn for it."""
        names = [name for name in self.dataset.cameras if name != self.dataset.source_camera]
        if not 0 <= count < self.cameras:
            raise DataError(
                f"{scene} has {self.cameras - 1} cameras beside the source, a method wants {count}; give it fewer views"
            )
        drawn = count - len(names)
        if drawn > 0:
            each = self.pairs.seen_from(scene, times, further_poses()[:drawn])
            further = [[views[place] for views in each] for place in range(drawn)]
            return [*self._others(scene, times, len(names)), *further]
        first = self.dataset.views(scene, times[0], [self.dataset.source_camera, *names])
        at, order = np.stack([view.world_from_camera[:3, 3] for view in first]), [0]
        while len(order) <= count:
            order.append(int(np.linalg.norm(at[:, None] - at[order], axis=-1).min(axis=1).argmax()))
        chosen = [names[place - 1] for place in order[1:]]
        each = [self.dataset.views(scene, time, chosen) for time in times] if chosen else []
        size = self.width, self.height

        def resized(view: SceneView) -> SceneView:
            classes = self._places_of(view.classes)
            return replace(
                view,
                rgb=trained_picture(view.rgb, *size),
                depth=nearest_resized(view.depth, *size),
                classes=None if classes is None else nearest_resized(classes, *size),
                instances=None,
                lens=trained_lens(view.lens, *size),
            )

        return [[resized(views[place]) for views in each] for place in range(count)]


FURTHER_CAMERAS = 48
"""Cameras that are drawn for an exact scene on Kubric-4D's stage where a method wants more than it has."""
_GOLDEN, _SILVER = 0.6180339887498949, 0.4142135623730951  # shares of a turn, and of the height, from one to the next


def further_poses() -> NDArray[np.float64]:
    """Where these stand, world_from_camera [48, 4, 4], 15 m from the middle of the stage as its own cameras, up to 50
    degrees high: as many to each area of the sphere, and any first few of them all around.
    """
    numbers = np.arange(FURTHER_CAMERAS)
    azimuths = 360.0 * (numbers * _GOLDEN % 1.0)
    elevations = np.rad2deg(np.arcsin(np.sin(np.deg2rad(50.0)) * (numbers * _SILVER % 1.0)))
    views = np.stack([azimuths, elevations, np.full(FURTHER_CAMERAS, 15.0)], axis=-1)
    return sphere_poses(torch.from_numpy(views)).numpy()
