"""What training data consists of: a camera's view of a scene, a sample, a batch of them, a set of clips by number."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.conditioning import splatted
from gcd_model.config import CameraControl, SemanticClass, SplatDepth
from gcd_model.errors import ModelError
from gcd_model.geometry import Intrinsics, Spherical, Trajectory, pose_trajectory
from gcd_model.live.eyes import estimated_depth
from gcd_train.data.encodings import Bytes
from gcd_train.data.files import FileFault, Skipped, Skips
from gcd_train.data.paths import generator
from gcd_train.errors import DataError, RecipeError, RenderError, TrainError

_TRIES, _NAMED = 100, 5


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
    None where not asked for. target_depth: f32 [T, H, W] metres, with `visible` of a target that was drawn exactly.
    lens: of both sides' pictures. source_depth: f32 [T, H, W], metres along the axis, 0 where nothing is known or for
    the sky; None where not asked for. skipped: what was tried before and left out.
    """

    source: Bytes
    target: Bytes
    source_from_target: NDArray[np.float64]
    fps: float
    scene: str
    frame_numbers: tuple[int, ...]
    lens: Intrinsics
    source_depth: NDArray[np.float32] | None = None
    target_classes: Bytes | None = None
    start: Spherical | None = None
    deltas: NDArray[np.float64] | None = None
    visible: NDArray[np.bool_] | None = None
    target_depth: NDArray[np.float32] | None = None
    skipped: tuple[Skipped, ...] = ()

    @property
    def trajectory(self) -> Trajectory:
        """The target camera's path, seen from the source camera."""
        path = pose_trajectory(torch.from_numpy(self.source_from_target))
        return path if self.deltas is None else replace(path, delta=torch.from_numpy(self.deltas), source=self.start)


def splat_of(sample: Sample, video: Tensor, splat: SplatDepth) -> Tensor | None:
    """What the target camera sees of the source's points, see `splatted`; None for a model that is not shown it.

    video: the source as the networks take it, clean.
    """
    if splat == "none":
        return None
    if splat == "estimated":
        metres = estimated_depth(video, sample.lens)
    else:
        assert sample.source_depth is not None, "data without depth are refused when they are opened"
        metres = torch.from_numpy(sample.source_depth).to(video.device)
    return splatted(video, metres, sample.lens, sample.trajectory)


class Samples(Protocol):
    """Samples by number: `DrawnSamples`, `Clips`.

    Any number from 0 up may be asked for; after its length a drawn set repeats its scenes with other draws.
    """

    @property
    def skips(self) -> Skips:
        """What could not be read."""
        ...

    def __len__(self) -> int:
        """Samples that are drawn before a scene comes again more often than another."""
        ...

    def sample(self, index: int, /) -> Sample:
        """The sample of a number, the same in any process. Raises DataError if too many in a row cannot be read."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class SampleBatch:
    """B samples of T frames. source, target: u8 [B, T, H, W, 3]. samples: the same, without these."""

    source: Tensor
    target: Tensor
    samples: tuple[Sample, ...]

    def pin_memory(self) -> "SampleBatch":
        """The pictures in page-locked memory, as a loader wants to hand them over to CUDA."""
        return replace(self, source=self.source.pin_memory(), target=self.target.pin_memory())


def collate(samples: Sequence[Sample]) -> SampleBatch:
    """Samples as one batch, for a DataLoader; the main process gives their `skipped` to its own `Skips.extend`."""
    sizes = {picture.shape for sample in samples for picture in (sample.source, sample.target)}
    if len(sizes) > 1:
        raise DataError(f"samples of one batch must have one size, got {sorted(sizes)}")
    none = np.zeros(0, np.uint8)
    return SampleBatch(
        source=torch.from_numpy(np.stack([sample.source for sample in samples])),
        target=torch.from_numpy(np.stack([sample.target for sample in samples])),
        samples=tuple(
            replace(sample, source=none, target=none, target_classes=None, visible=None, target_depth=None)
            for sample in samples
        ),
    )


def to_network(frames: Bytes | Tensor) -> Tensor:
    """Frames as the networks take them: uint8 [T, H, W, 3] -> float32 [T, 3, H, W] in [-1, 1]."""
    rows = frames if isinstance(frames, Tensor) else torch.from_numpy(np.ascontiguousarray(frames))
    return rows.permute(0, 3, 1, 2).float().div_(127.5).sub_(1)


class DrawnSamples(ABC):
    """Samples by number. The same (seed, index) gives the same sample, in any order, in any process.

    A sample that cannot be read is counted in `skips` and replaced by another, at most 100 times.
    """

    def __init__(self, seed: int, count: int) -> None:
        self.seed, self._count, self.skips = seed, count, Skips()

    @abstractmethod
    def _made(self, number: int, random: np.random.Generator) -> Sample:
        """The sample of a number."""

    @abstractmethod
    def _place(self, number: int) -> tuple[str, Path]:
        """Its scene, and the folder or file that is named for a fault that names none."""

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Sample:
        """As `sample`, for a loader. Raises IndexError beyond the end."""
        if not 0 <= index < len(self):
            raise IndexError(f"{index} is beyond the {len(self)} samples")
        return self.sample(index)

    def sample(self, index: int, /) -> Sample:
        """The sample of a number or, where it cannot be read, of the first of a hundred stand-ins that can.

        Raises:
            DataError: a hundred in a row cannot be read; it names the last faults.
            RenderError, RecipeError: no other would do better.
        """
        skipped: list[Skipped] = []
        for attempt in range(_TRIES + 1):
            number = index if attempt == 0 else int(generator(self.seed, index, attempt).integers(len(self)))
            try:
                return replace(self._made(number, generator(self.seed, number)), skipped=tuple(skipped))
            except (RenderError, RecipeError):
                raise
            except (TrainError, ModelError, OSError) as error:
                scene, file = self._place(number)
                reason = str(error)
                if isinstance(error, FileFault):
                    file, reason = error.path, error.reason
                elif isinstance(error, OSError) and error.filename:
                    file = Path(str(error.filename))
                skipped.append(self.skips.add(scene, file, reason))
        last = "; ".join(map(str, skipped[-_NAMED:]))
        raise DataError(f"{len(skipped)} samples in a row cannot be read, the last: {last}")


class Clips(ABC):
    """A set of clips that always are the same ones: what is encoded, measured on, and learned from one by one.

    fps: of all clips. camera: how a network is told where the target camera goes, "none" where all clips share one
    path. classes: the ontology of the class maps, empty where there are none. origin: names the set and its options,
    whatever number of clips there is. seeds: what each clip was made from: names it, also when the set has grown since.
    """

    fps: float
    camera: CameraControl
    classes: tuple[SemanticClass, ...] = ()
    origin: str
    seeds: Sequence[int]

    def __len__(self) -> int:
        return len(self.seeds)

    @property
    def skips(self) -> Skips:
        """Nothing: a clip that cannot be read is an error."""
        return Skips()

    @abstractmethod
    def sample(self, number: int, /) -> Sample:
        """A clip; the same ones again after the set's length. Raises DataError if it cannot be read."""


@dataclass(eq=False, kw_only=True)
class MadeClips(Clips):
    """Clips that a function makes by number."""

    make: Callable[[int], Sample]
    seeds: Sequence[int]
    fps: float
    camera: CameraControl
    origin: str
    classes: tuple[SemanticClass, ...] = ()

    def sample(self, number: int, /) -> Sample:
        """See Clips."""
        return self.make(number)


def painted(clips: Clips) -> Clips:
    """The clips with the target painted in the colours of its classes: what a semantic model learns to draw.

    Raises DataError for clips of a world without classes.
    """
    if not clips.classes:
        raise DataError("a semantic model needs classes, and these clips have none; generate driving pairs")
    colours = np.array([kind.colour for kind in clips.classes], np.uint8)
    return MadeClips(
        make=partial(_painted, clips, colours),
        seeds=clips.seeds,
        fps=clips.fps,
        camera=clips.camera,
        classes=clips.classes,
        origin=f"{clips.origin}-painted",  # latents of these are others
    )


def _painted(clips: Clips, colours: Bytes, number: int) -> Sample:
    sample = clips.sample(number)
    return replace(sample, target=colours[sample.target_classes])


def numbers_of(clips: Clips, seeds: Sequence[int]) -> list[int]:
    """Where the clips of these seeds are now. Raises DataError if one is gone."""
    places = {seed: number for number, seed in enumerate(clips.seeds)}
    gone = [seed for seed in seeds if seed not in places]
    if gone:
        raise DataError(f"{len(gone)} clips this run began with are gone, first seed {gone[0]}; give the same --data")
    return [places[seed] for seed in seeds]


# Videos without a camera's way: what a network learns from that continues a picture, before it learns of views. Each
# side of a pair is a video; its first frame, repeated, is the condition, the video itself the target.
# Source: Blattmann et al. 2023 (SVD), image-to-video, which Van Hoorick et al. 2024 (GCD) start from.

_PART_SEEDS = 10**15
"""Names of the second set's clips count from here: no clip's own number is as large."""


class VideoSamples:
    """Samples of a data set as videos: sample 2n is what the source camera saw of its sample n, 2n + 1 the target."""

    def __init__(self, samples: Samples) -> None:
        self._samples, self.skips = samples, samples.skips

    def __len__(self) -> int:
        return 2 * len(self._samples)

    def sample(self, index: int, /) -> Sample:
        """The video of a number; the camera of the view is its own. Raises DataError as `Samples.sample`."""
        pair = self._samples.sample(index // 2)
        video = pair.target if index % 2 else pair.source
        return replace(
            pair,
            source=np.repeat(video[:1], len(video), axis=0),
            target=video,
            source_from_target=np.tile(np.eye(4), (len(video), 1, 1)),
            target_classes=None,
            start=None,
            deltas=None,
            visible=None,
        )


def video_clips(parts: Sequence[Clips]) -> Clips:
    """Both sides of all pairs of some sets, which take turns; their frame rate is the first set's.

    A video's seed is twice its pair's, one more for the target's side.
    """
    places = [
        (part, 2 * clip + side)
        for clip in range(max(map(len, parts)))
        for part, clips in enumerate(parts)
        if clip < len(clips)
        for side in (0, 1)
    ]
    return MadeClips(
        make=partial(_video, [VideoSamples(part) for part in parts], places),
        seeds=[part * _PART_SEEDS + 2 * parts[part].seeds[number // 2] + number % 2 for part, number in places],
        fps=parts[0].fps,
        camera="none",
        origin="-".join(("videos", *(part.origin for part in parts))),
    )


def _video(parts: Sequence[VideoSamples], places: Sequence[tuple[int, int]], number: int) -> Sample:
    part, index = places[number % len(places)]
    return parts[part].sample(index)
