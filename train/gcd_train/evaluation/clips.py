"""The clips that predictors are measured on, and pairs of clips as such a set."""

import hashlib
import zipfile
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Protocol, Self, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.config import CameraControl, SemanticClass
from gcd_model.geometry import CameraMount
from gcd_train.data.files import ZIP_FAULTS
from gcd_train.data.pairs import PairedClip, PairedClips
from gcd_train.data.sample import Bytes
from gcd_train.errors import DataError
from gcd_train.evaluation.predictors import FAR_M, CameraPair, SourceClip, own_views
from gcd_train.pointcloud import depth_visibility

SetKind: TypeAlias = Literal["kubric", "driving", "orbit"]
"""Which tables clips belong to: Kubric-4D and scenes in its layout, driving, or pairs seen along orbits."""


@dataclass(frozen=True, kw_only=True, slots=True)
class HeldOutClip:
    """One clip that methods are measured on: what they may see, and what is kept from them.

    key: unique in its set, and a file name: `scn02900.sample_00`. scene: errors are over scenes. seen: the source side.
    target: uint8 [T, H, W, 3] RGB. target_classes: uint8 [T, H, W], None where there are none. visible: bool [T, H, W],
    target pixels that the source camera saw too; None where nobody knows. change: azimuth and elevation in degrees and
    radius in metres from source to goal, None for the one path of driving.
    """

    key: str
    scene: str
    seen: SourceClip
    target: Bytes
    target_classes: Bytes | None = None
    visible: NDArray[np.bool_] | None = None
    change: tuple[float, float, float] | None = None


class ClipFacts(Protocol):
    """What a model has to fit.

    camera: "none" for the one path of driving, "spherical" for a path of each clip's own. frames, height, width: T, H
    and W of each clip.
    """

    @property
    def frames(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def width(self) -> int: ...
    @property
    def camera(self) -> CameraControl: ...
    @property
    def classes(self) -> Sequence[SemanticClass]: ...


class EvaluationSet(ClipFacts, Protocol):
    """Clips by key, the same whenever they are asked for, in any process.

    fps: frames per second; of clips that differ, the highest. rates: all that clips may have, the highest first.
    identity: digest of what the clips are read from and how they were drawn.
    """

    @property
    def keys(self) -> Sequence[str]: ...
    @property
    def kind(self) -> SetKind: ...
    @property
    def fps(self) -> float: ...
    @property
    def rates(self) -> Sequence[float]: ...
    @property
    def identity(self) -> str: ...

    def clip(self, key: str, /) -> HeldOutClip:
        """Raises DataError, naming the file, where it cannot be read; nothing stands in for it."""
        ...


def cameras_of(clips: PairedClips, number: int, declared: CameraMount | None = None) -> CameraPair:
    """Both cameras of a clip.

    Args:
        declared: mount that is declared for the source camera of driving clips; None for the true one.
    """
    if clips.camera == "none":
        mount = declared or clips.mount or CameraMount()
        reached = clips.trajectory(number).at_goal.index(True)
        return CameraPair.driving(mount, frames=clips.frames, height=clips.height, width=clips.width, move_time=reached)
    return CameraPair.orbit(clips.trajectory(number), hfov_deg=clips.hfov_deg, height=clips.height, width=clips.width)


def source_side(clips: PairedClips, number: int, clip: PairedClip, declared: CameraMount | None) -> SourceClip:
    """What predictors may see of a clip. declared: see `cameras_of`."""
    return SourceClip(
        source=clip.source,
        source_depth=clip.source_depth,
        source_classes=clip.source_classes if clips.classes else None,
        cameras=cameras_of(clips, number, declared),
        fps=clips.fps,
    )


def class_grid(clips: ClipFacts) -> tuple[int, int]:
    """Height and width at which class maps are compared: half the pictures'."""
    return clips.height // 2, clips.width // 2


def require_same_kind(training: PairedClips, clips: PairedClips) -> None:
    """Raises DataError unless means over the training clips fit the held-out ones."""
    sizes = [(each.frames, each.height, each.width) for each in (training, clips)]
    if sizes[0] != sizes[1] or names_of(training.classes) != names_of(clips.classes):
        raise DataError(
            f"training and held-out clips must be of one kind, got T, H, W = {sizes[0]} and {sizes[1]}, "
            f"classes {names_of(training.classes)} and {names_of(clips.classes)}; generate both alike"
        )
    if training.camera != clips.camera:
        raise DataError(
            f"training and held-out clips must be of one kind, got camera control {training.camera!r} and "
            f"{clips.camera!r}; generate both alike"
        )


def names_of(classes: Sequence[SemanticClass]) -> str:
    """An ontology in one line."""
    return ", ".join(each.name for each in classes) or "none"


_DIGITS = 12


@dataclass(frozen=True, kw_only=True)
class PairedSet:
    """Pairs by name: `driving-01000100`, the world and the clip's number.

    clips: the pairs. declared: mount that methods are told for the source camera of driving clips, None for the true
    one. identity: see EvaluationSet. picked: where in a pixel its depth was taken, pixels from its middle towards the
    lower right corner.
    """

    clips: PairedClips
    identity: str
    declared: CameraMount | None = None
    picked: float = 0.0
    kind: SetKind = field(init=False)
    camera: CameraControl = field(init=False)
    classes: Sequence[SemanticClass] = field(init=False)
    frames: int = field(init=False)
    height: int = field(init=False)
    width: int = field(init=False)
    fps: float = field(init=False)
    rates: Sequence[float] = field(init=False)
    _numbers: dict[str, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("camera", "classes", "frames", "height", "width", "fps"):
            object.__setattr__(self, name, getattr(self.clips, name))
        object.__setattr__(self, "kind", "driving" if self.camera == "none" else "orbit")
        object.__setattr__(self, "rates", (self.fps,))
        object.__setattr__(self, "_numbers", {key: number for number, key in enumerate(_keys(self.clips))})

    @classmethod
    def of(cls, clips: PairedClips, *, declared: CameraMount | None = None) -> Self:
        """The set of some clips. Raises DataError if a shard is damaged."""
        oversample = clips.world.oversample
        return cls(
            clips=clips,
            identity=identity_of(clips, declared),
            declared=declared,
            picked=(oversample // 2 + 0.5) / oversample - 0.5,
        )

    @property
    def keys(self) -> Sequence[str]:
        """Names, in the order of the clips."""
        return tuple(self._numbers)

    def number(self, key: str, /) -> int:
        """Of the clip with this name. Raises DataError for another."""
        if key not in self._numbers:
            raise DataError(
                f"there is no clip {key}; there are {len(self._numbers)}, first {next(iter(self._numbers))}"
            )
        return self._numbers[key]

    def clip(self, key: str, /) -> HeldOutClip:
        """See EvaluationSet."""
        number = self.number(key)
        clip = self.clips[number]
        goal = self.clips.trajectory(number).goal_delta
        world, scene = self.clips.scene(number)
        return HeldOutClip(
            key=key,
            scene=f"{world}-{scene:08d}",
            seen=replace(source_side(self.clips, number, clip, self.declared), key=key),
            target=clip.target,
            target_classes=clip.target_classes if self.classes else None,
            visible=seen_too(clip, cameras_of(self.clips, number), picked=self.picked),
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


def _keys(clips: PairedClips) -> list[str]:
    """Names of all clips; what is there again, in another folder, gets a number."""
    keys, times = list[str](), Counter[str]()
    for number in range(len(clips)):
        key = f"{clips.scene(number)[0]}-{clips.name(number)}"
        times[key] += 1
        keys.append(key if times[key] == 1 else f"{key}.{times[key]}")
    return keys


def identity_of(clips: PairedClips, declared: CameraMount | None = None) -> str:
    """Digest of the worlds, of every file of every clip by its checksum, and of what is declared. Raises DataError."""
    digest = hashlib.sha256(msgspec.json.encode(clips.worlds))
    digest.update(repr(declared).encode())
    sums: dict[Path, dict[str, list[int]]] = {}
    for path, name in clips.places:
        if path not in sums:
            sums[path] = _checksums(path)
        digest.update(f"{name}{sums[path].get(name)}".encode())
    return digest.hexdigest()[:_DIGITS]


def _checksums(shard: Path) -> dict[str, list[int]]:
    """Of the files of each clip, as the shard's directory tells them."""
    sums: dict[str, list[int]] = {}
    try:
        with zipfile.ZipFile(shard) as archive:
            for file in sorted(archive.infolist(), key=lambda each: each.filename):
                sums.setdefault(file.filename.partition("/")[0], []).append(file.CRC)
    except ZIP_FAULTS as error:
        raise DataError(f"{shard} is damaged ({error}); delete it and generate again") from error
    return sums
