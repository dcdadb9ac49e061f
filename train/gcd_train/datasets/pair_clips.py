"""Driving scenes of a 4D data set as the clips that the trainer takes."""

import hashlib
import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.config import CameraControl, SemanticClass
from gcd_model.geometry import CameraMount, Trajectory, driving_trajectory
from gcd_train.datasets.clip_frames import FrameSampling
from gcd_train.datasets.dataset4d import PairSample
from gcd_train.datasets.ontology import Ontology
from gcd_train.datasets.parallel_domain4d import ParallelDomain4D
from gcd_train.datasets.pictures_of_draws import trained_lens
from gcd_train.datasets.trajectories import DRIVING_FRAMES, DrivingSampling
from gcd_train.datasets.view_pairs import ViewPairs
from gcd_train.errors import DataError
from gcd_train.layouts.parallel_domain4d_names import scene_number

Bytes = NDArray[np.uint8]
_MOST_REPEATS = 1000


class DrivingClips:
    """A `ClipSource` of ParallelDomain-4D: source, target and classes along the one driving path.

    stride: of the frames; all clips share one, as the trainer takes one rate. clips_of_scene: how many each scene
    gives, up to 1000. exact: see `ViewPairs`; what was left out is in `pairs.skips`. Class ids are places in `classes`;
    pixels of no class count as void, or as the first class where the ontology has no void.
    Raises DataError for a set that is read without classes.
    """

    def __init__(
        self,
        dataset: ParallelDomain4D,
        size: tuple[int, int] = (384, 256),
        *,
        stride: int = 1,
        seed: int = 0,
        clips_of_scene: int = 1,
        exact: bool = False,
        frames: FrameSampling = DRIVING_FRAMES,
    ) -> None:
        if dataset.ontology is None:
            raise DataError("the trainer takes class maps too: open the set with classes=True")
        if not 1 <= clips_of_scene <= _MOST_REPEATS:
            raise DataError(f"a scene gives 1 to {_MOST_REPEATS} clips, got {clips_of_scene}")
        one_rate = FrameSampling(
            clip=frames.clip, strides=(stride,), latest_start=frames.latest_start, reach_last=frames.reach_last
        )
        self._dataset, self._ontology, self._size, self._stride = dataset, dataset.ontology, size, stride
        self._options = (size, stride, seed, exact)
        self.pairs = ViewPairs(
            dataset,
            DrivingSampling(frames=one_rate),
            seed,
            size,
            repeats=clips_of_scene,
            class_ids=True,
            exact=exact,
        )
        self._frames = frames.clip
        self._kept: tuple[int, PairSample] | None = None

    def __len__(self) -> int:
        return len(self.pairs)

    @property
    def classes(self) -> tuple[SemanticClass, ...]:
        """The ontology, without gaps in the ids."""
        return self._ontology.classes

    @property
    def fps(self) -> float:
        """Frames per second of the clips."""
        return self._dataset.fps / self._stride

    @property
    def camera(self) -> CameraControl:
        """All clips share one path."""
        return "none"

    @property
    def mount(self) -> CameraMount:
        """How the source camera of the first scene sits on the vehicle; its angle is that of the clips."""
        scene = self._dataset.scenes[0]
        pose = self._dataset.pose(scene, self._dataset.source_camera)
        forward, left, height = pose[:3, 3].tolist()
        return CameraMount(
            height_m=height,
            forward_m=forward,
            left_m=left,
            tilt_deg=math.degrees(math.asin(-float(pose[2, 2]))),
            hfov_deg=trained_lens(self._dataset.lens(scene), *self._size).hfov_deg,
        )

    @property
    def origin(self) -> str:
        """Names the scenes and the options."""
        told = msgspec.json.encode([self._dataset.scenes, self._options, [item.name for item in self._ontology.items]])
        return hashlib.sha256(told).hexdigest()[:8]

    def seed(self, number: int, /) -> int:
        """A thousand times the scene's number, and which of its clips."""
        repeat, place = divmod(number, len(self._dataset.scenes))
        return _MOST_REPEATS * (scene_number(self._dataset.scenes[place]) or 0) + repeat

    def trajectory(self, number: int, /) -> Trajectory:
        """The one path, up and back, seen from the source camera."""
        return driving_trajectory(frames=self._frames, move_time=self._frames - 1, mount=self.mount)

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """Source and target, u8 [T, H, W, 3] each."""
        sample = self._sample(number)
        return sample.source, sample.target

    def target_classes(self, number: int, /) -> Bytes:
        """Places in `classes` of the target, u8 [T, H, W]."""
        ids = self._sample(number).target_classes
        if ids is None:
            raise DataError("a sample came without classes")
        return _places(self._ontology)[ids]

    def _sample(self, number: int) -> PairSample:
        """The last one is kept: pictures and classes of a clip are asked for one after the other."""
        if self._kept is None or self._kept[0] != number:
            self._kept = number, self.pairs.sample(number)
        return self._kept[1]


def _places(ontology: Ontology) -> Bytes:
    listed = len(ontology.classes)
    return np.where(ontology.places < listed, ontology.places, np.uint8(0))
