"""Samples of a data set as the clips that stages and validation take: by number, each always the same."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.config import CameraControl, SemanticClass
from gcd_model.geometry import CameraMount, Trajectory, pose_trajectory
from gcd_train.datasets.dataset4d import PairSample
from gcd_train.datasets.ontology import Ontology
from gcd_train.sample_loader import Samples

Bytes = NDArray[np.uint8]


class SampleClips:
    """A `ClipSource` of the first `count` samples.

    camera: how the network is told where the target camera goes. fps: of all clips. origin: names set and options.
    ontology: of samples with class ids; None for others.
    """

    def __init__(
        self,
        samples: Samples,
        count: int,
        *,
        camera: CameraControl,
        fps: float,
        origin: str,
        ontology: Ontology | None = None,
    ) -> None:
        self._samples, self._count, self._ontology = samples, count, ontology
        self._camera: CameraControl = camera
        self._fps, self._origin = fps, origin
        self._last: tuple[int, PairSample] | None = None

    def __len__(self) -> int:
        return self._count

    @property
    def classes(self) -> tuple[SemanticClass, ...]:
        """Of the class ids, none where the samples have none."""
        return () if self._ontology is None else self._ontology.classes

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self._fps

    @property
    def camera(self) -> CameraControl:
        """How a network is told where the target camera goes."""
        return self._camera

    @property
    def mount(self) -> CameraMount | None:
        """None: nobody says it."""
        return None

    @property
    def origin(self) -> str:
        """Names the set and its options."""
        return self._origin

    def seed(self, number: int, /) -> int:
        """The sample's number."""
        return number

    def trajectory(self, number: int, /) -> Trajectory:
        """The target camera's path, seen from the source camera. Raises DataError if the sample cannot be read."""
        sample = self._sample(number)
        path = pose_trajectory(torch.from_numpy(sample.source_from_target))
        return (
            path if sample.deltas is None else replace(path, delta=torch.from_numpy(sample.deltas), source=sample.start)
        )

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """Source and target, u8 [T, H, W, 3] each. Raises DataError if the sample cannot be read."""
        sample = self._sample(number)
        return sample.source, sample.target

    def target_classes(self, number: int, /) -> Bytes:
        """Places in `classes`, u8 [T, H, W]; zeros where the samples have no class ids."""
        sample = self._sample(number)
        if self._ontology is None or sample.target_classes is None:
            return np.zeros(sample.target.shape[:3], np.uint8)
        return self._ontology.places[sample.target_classes]

    def _sample(self, number: int) -> PairSample:
        """The last one is kept: pictures and path of a clip are asked for one after the other."""
        if self._last is None or self._last[0] != number:
            self._last = number, self._samples.sample(number)
        return self._last[1]
