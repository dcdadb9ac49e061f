"""What training data consists of: a camera's view of a scene, a sample, a batch of them, a set of clips by number."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.config import CameraControl, SemanticClass
from gcd_model.geometry import CameraMount, Intrinsics, Spherical, Trajectory, pose_trajectory
from gcd_train.data.files import Skipped, Skips
from gcd_train.errors import DataError

Bytes: TypeAlias = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneView:
    """One camera's picture of one moment of a scene, and where the camera was.

    rgb: u8 [H, W, 3]. depth: f32 [H, W], metres along the optical axis, 0 where nothing is known. classes: u8 [H, W],
    ids of the ontology, None where the set has none. instances: u16 [H, W], 0 for what is not counted, None where the
    set has none. world_from_camera: f64 [4, 4]; x right, y down, z ahead; the world is right-handed with z up, metres.
    lens: pixels.
    """

    rgb: Bytes
    depth: NDArray[np.float32]
    classes: Bytes | None
    instances: NDArray[np.uint16] | None
    world_from_camera: NDArray[np.float64]
    lens: Intrinsics


@dataclass(frozen=True, kw_only=True, slots=True)
class Sample:
    """One clip of T frames of H x W.

    source, target: u8 [T, H, W, 3] RGB; the target is palette-coloured where the modality is classes.
    target_classes: u8 [T, H, W] class ids, None where not asked for. source_from_target: f64 [T, 4, 4], metres.
    start: the source camera on the sphere, and deltas: f64 [T, 3] azimuth and elevation in degrees and radius in
    metres, target minus source; None for paths that are not on the sphere. fps: of the clip, after the stride.
    scene: its name. frame_numbers: of the scene, T. visible: bool [T, H, W], target pixels that the source camera saw,
    None where not asked for. skipped: what was tried before and left out. bytes_read: of files.
    """

    source: Bytes
    target: Bytes
    source_from_target: NDArray[np.float64]
    fps: float
    scene: str
    frame_numbers: tuple[int, ...]
    target_classes: Bytes | None = None
    start: Spherical | None = None
    deltas: NDArray[np.float64] | None = None
    visible: NDArray[np.bool_] | None = None
    skipped: tuple[Skipped, ...] = ()
    bytes_read: int = 0

    @property
    def trajectory(self) -> Trajectory:
        """The target camera's path, seen from the source camera."""
        path = pose_trajectory(torch.from_numpy(self.source_from_target))
        return path if self.deltas is None else replace(path, delta=torch.from_numpy(self.deltas), source=self.start)


class Samples(Protocol):
    """Samples by number: `ViewPairs`, `LeRobotPairs`.

    Any number from 0 up may be asked for; the set repeats its scenes after its length, with other draws.
    skips: what could not be read.
    """

    skips: Skips

    def __len__(self) -> int:
        """Samples that are drawn before a scene comes again more often than another."""
        ...

    def sample(self, index: int, /) -> Sample:
        """The sample of a number, the same in any process. Raises DataError if too many in a row cannot be read."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class SampleBatch:
    """Several samples of T frames.

    source, target: u8 [B, T, H, W, 3]. source_from_target: f64 [B, T, 4, 4]. deltas: f64 [B, T, 3], None in driving.
    fps: f32 [B]. scenes: B names. skipped: of all of them.
    """

    source: Tensor
    target: Tensor
    source_from_target: Tensor
    deltas: Tensor | None
    fps: Tensor
    scenes: tuple[str, ...]
    skipped: tuple[Skipped, ...]

    @property
    def paths(self) -> list[Trajectory]:
        """Of the target cameras, seen from the source cameras."""
        paths = [pose_trajectory(poses) for poses in self.source_from_target]
        if self.deltas is None:
            return paths
        return [replace(path, delta=delta) for path, delta in zip(paths, self.deltas, strict=True)]

    def pin_memory(self) -> "SampleBatch":
        """The pictures in page-locked memory, as a loader wants to hand them over to CUDA."""
        return replace(self, source=self.source.pin_memory(), target=self.target.pin_memory())


def collate(samples: Sequence[Sample]) -> SampleBatch:
    """Samples as one batch, for a DataLoader; the main process gives `skipped` to its own `Skips.extend`."""
    deltas = [sample.deltas for sample in samples if sample.deltas is not None]
    return SampleBatch(
        source=_stacked([sample.source for sample in samples]),
        target=_stacked([sample.target for sample in samples]),
        source_from_target=_stacked([sample.source_from_target for sample in samples]),
        deltas=_stacked(deltas) if len(deltas) == len(samples) else None,
        fps=torch.tensor([sample.fps for sample in samples]),
        scenes=tuple(sample.scene for sample in samples),
        skipped=tuple(skipped for sample in samples for skipped in sample.skipped),
    )


def _stacked(rows: Sequence[NDArray[np.generic]]) -> Tensor:
    sizes = {row.shape for row in rows}
    if len(sizes) > 1:
        raise DataError(f"samples of one batch must have one size, got {sorted(sizes)}")
    return torch.from_numpy(np.stack(rows))


def to_network(frames: Bytes | Tensor) -> Tensor:
    """Frames as the networks take them: uint8 [T, H, W, 3] -> float32 [T, 3, H, W] in [-1, 1]."""
    rows = frames if isinstance(frames, Tensor) else torch.from_numpy(np.ascontiguousarray(frames))
    return rows.permute(0, 3, 1, 2).float().div_(127.5).sub_(1)


class ClipSource(ABC):
    """A set of clips that always are the same ones: what is encoded, measured on, and learned from one by one.

    fps: of all clips. camera: how a network is told where the target camera goes, "none" where all clips share one
    path. mount: how the source camera sits on the vehicle, None without one. classes: the ontology of the class maps,
    empty where there are none. origin: names the set and its options, whatever number of clips there is.
    """

    fps: float
    camera: CameraControl
    mount: CameraMount | None = None
    classes: tuple[SemanticClass, ...] = ()
    origin: str
    _last: tuple[int, Sample] | None = None

    @abstractmethod
    def __len__(self) -> int:
        """Clips there are."""

    @abstractmethod
    def sample(self, number: int, /) -> Sample:
        """All of a clip. Raises DataError if it cannot be read."""

    def seed(self, number: int, /) -> int:
        """What a clip was made from: names it, also when the set has grown since."""
        return number

    def trajectory(self, number: int, /) -> Trajectory:
        """The target camera's path, seen from the source camera; T poses. Raises DataError as `sample`."""
        return self._kept_sample(number).trajectory

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """Source and target, uint8 [T, H, W, 3] each. Raises DataError as `sample`."""
        sample = self._kept_sample(number)
        return sample.source, sample.target

    def target_classes(self, number: int, /) -> Bytes:
        """Places in `classes` of the target, uint8 [T, H, W]; zeros where there are none. Raises as `sample`."""
        sample = self._kept_sample(number)
        return np.zeros(sample.target.shape[:3], np.uint8) if sample.target_classes is None else sample.target_classes

    def _kept_sample(self, number: int) -> Sample:
        """Pictures, path and classes of a clip are asked for one after the other: the last one is kept."""
        if self._last is None or self._last[0] != number:
            self._last = number, self.sample(number)
        return self._last[1]


class RepeatedClips:
    """A set of clips as samples: the same ones again after its length."""

    def __init__(self, clips: ClipSource) -> None:
        self._clips, self.skips = clips, Skips()

    def __len__(self) -> int:
        return len(self._clips)

    def sample(self, index: int, /) -> Sample:
        """The clip of a number. Raises DataError if it cannot be read."""
        return self._clips.sample(index % len(self._clips))


class SampleClips(ClipSource):
    """The first `count` samples of a set.

    places: by class id the place in `classes`; None for samples without class ids. The other options: see `ClipSource`.
    """

    def __init__(
        self,
        samples: Samples,
        count: int,
        *,
        camera: CameraControl,
        fps: float,
        origin: str,
        classes: tuple[SemanticClass, ...] = (),
        places: Bytes | None = None,
    ) -> None:
        self._samples, self._count, self._places = samples, count, places
        self.camera, self.fps, self.origin, self.classes = camera, fps, origin, classes

    def __len__(self) -> int:
        return self._count

    def sample(self, number: int, /) -> Sample:
        """See ClipSource."""
        sample = self._samples.sample(number)
        if self._places is None or sample.target_classes is None:
            return replace(sample, target_classes=None)
        return replace(sample, target_classes=self._places[sample.target_classes])


class SomeClips(ClipSource):
    """Some of the clips, by their numbers, as they are. keep: hold decoded pictures in memory, 2 H W 3 T bytes each."""

    def __init__(self, clips: ClipSource, numbers: Sequence[int], *, keep: bool = False) -> None:
        self._clips, self._numbers, self._keep = clips, tuple(numbers), keep
        self.fps, self.camera, self.mount = clips.fps, clips.camera, clips.mount
        self.classes, self.origin = tuple(clips.classes), clips.origin
        self._pictures: dict[int, tuple[Bytes, Bytes]] = {}

    def __len__(self) -> int:
        return len(self._numbers)

    def sample(self, number: int, /) -> Sample:
        """See ClipSource."""
        return self._clips.sample(self._numbers[number])

    def seed(self, number: int, /) -> int:
        """See ClipSource."""
        return self._clips.seed(self._numbers[number])

    def trajectory(self, number: int, /) -> Trajectory:
        """See ClipSource."""
        return self._clips.trajectory(self._numbers[number])

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """See ClipSource."""
        if number in self._pictures:
            return self._pictures[number]
        pictures = self._clips.rgb(self._numbers[number])
        if self._keep:
            self._pictures[number] = pictures
        return pictures

    def target_classes(self, number: int, /) -> Bytes:
        """See ClipSource."""
        return self._clips.target_classes(self._numbers[number])


class PaintedClips(SomeClips):
    """The clips with the target painted in the colours of its classes: what a semantic model learns to draw.

    Raises DataError for clips of a world without classes.
    """

    def __init__(self, clips: ClipSource) -> None:
        super().__init__(clips, range(len(clips)))
        if not clips.classes:
            raise DataError("a semantic model needs classes, and these clips have none; generate driving pairs")
        self._colours = np.array([kind.colour for kind in clips.classes], np.uint8)
        self.origin = f"{clips.origin}-painted"  # latents of these are others

    def sample(self, number: int, /) -> Sample:
        """See ClipSource."""
        return replace(super().sample(number), target=self._colours[self.target_classes(number)])

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """See ClipSource."""
        source, _ = super().rgb(number)
        return source, self._colours[self.target_classes(number)]


def numbers_of(clips: ClipSource, seeds: Sequence[int]) -> list[int]:
    """Where the clips of these seeds are now. Raises DataError if one is gone."""
    places = {clips.seed(number): number for number in range(len(clips))}
    gone = [seed for seed in seeds if seed not in places]
    if gone:
        raise DataError(f"{len(gone)} clips this run began with are gone, first seed {gone[0]}; give the same --data")
    return [places[seed] for seed in seeds]


# Videos without a camera's way: what a network learns from that continues a picture, before it learns of views. Each
# side of a pair is a video; its first frame, repeated, is the condition, the video itself the target.
# Source: Blattmann et al. 2023 (SVD), image-to-video, which Van Hoorick et al. 2024 (GCD) start from.

_PART_SEEDS = 10**15
"""Names of the second set's clips count from here: no clip's own number is as large."""


class VideoClips(ClipSource):
    """Both sides of all pairs of some sets, which take turns; their frame rate is the first set's."""

    camera: CameraControl = "none"

    def __init__(self, parts: Sequence[ClipSource]) -> None:
        self._parts, self.fps = tuple(parts), parts[0].fps
        self.origin = "-".join(("videos", *(part.origin for part in parts)))
        self._places = [
            (part, clip, side)
            for clip in range(max(map(len, parts)))
            for part, clips in enumerate(parts)
            if clip < len(clips)
            for side in (0, 1)
        ]

    def __len__(self) -> int:
        return len(self._places)

    def seed(self, number: int, /) -> int:
        """Twice the pair's own number, one more for the target's side."""
        part, clip, side = self._places[number]
        return part * _PART_SEEDS + 2 * self._parts[part].seed(clip) + side

    def sample(self, number: int, /) -> Sample:
        """See ClipSource."""
        part, clip, side = self._places[number]
        video, fps = self._parts[part].rgb(clip)[side], self._parts[part].fps
        return _continued(video, fps, f"clip {self.seed(number)}", tuple(range(len(video))))


class VideoSamples:
    """Samples of a data set as videos: sample 2n is what the source camera saw of its sample n, 2n + 1 the target."""

    def __init__(self, samples: Samples) -> None:
        self._samples, self.skips = samples, samples.skips

    def __len__(self) -> int:
        return 2 * len(self._samples)

    def sample(self, index: int, /) -> Sample:
        """The video of a number. Raises DataError as `Samples.sample`."""
        pair = self._samples.sample(index // 2)
        video = pair.target if index % 2 else pair.source
        made = _continued(video, pair.fps, pair.scene, pair.frame_numbers)
        return replace(made, skipped=pair.skipped, bytes_read=pair.bytes_read)


def _continued(video: Bytes, fps: float, scene: str, frame_numbers: tuple[int, ...]) -> Sample:
    """A video and its first frame; the camera of the view is the video's own."""
    return Sample(
        source=np.repeat(video[:1], len(video), axis=0),
        target=video,
        source_from_target=np.tile(np.eye(4), (len(video), 1, 1)),
        fps=fps,
        scene=scene,
        frame_numbers=frame_numbers,
    )
