"""What the trainer asks of a set of clips."""

from collections.abc import Sequence
from typing import Protocol, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.class_head import SemanticClass
from gcd_model.geometry import CameraMount
from gcd_train.errors import DataError

Bytes: TypeAlias = NDArray[np.uint8]


class ClipSource(Protocol):
    """Pairs of a source and a target clip, by number. `PairedClips` is one."""

    def __len__(self) -> int:
        """Clips there are."""
        ...

    @property
    def classes(self) -> Sequence[SemanticClass]:
        """The ontology of the class maps."""
        ...

    @property
    def fps(self) -> float:
        """Frames per second."""
        ...

    @property
    def mount(self) -> CameraMount:
        """How the source camera really sits on the vehicle."""
        ...

    @property
    def origin(self) -> str:
        """Names the world and its options, whatever number of clips there is."""
        ...

    def seed(self, number: int, /) -> int:
        """What a clip was made from: names it, also when the set has grown since."""
        ...

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """Source and target, uint8 [T, H, W, 3] each."""
        ...

    def target_classes(self, number: int, /) -> Bytes:
        """Class ids of the target, uint8 [T, H, W]."""
        ...


def to_network(frames: Bytes | Tensor) -> Tensor:
    """Frames as the networks take them: uint8 [T, H, W, 3] -> float32 [T, 3, H, W] in [-1, 1]."""
    rows = frames if isinstance(frames, Tensor) else torch.from_numpy(np.ascontiguousarray(frames))
    return rows.permute(0, 3, 1, 2).float().div_(127.5).sub_(1)


class KeptClips:
    """Some of the clips, each decoded once and kept in memory, 2 H W 3 T bytes a clip."""

    def __init__(self, clips: ClipSource, numbers: Sequence[int]) -> None:
        self._clips, self._numbers = clips, tuple(numbers)
        self._kept: dict[int, tuple[Bytes, Bytes]] = {}

    def __len__(self) -> int:
        return len(self._numbers)

    @property
    def classes(self) -> Sequence[SemanticClass]:
        """The ontology of the class maps."""
        return self._clips.classes

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self._clips.fps

    @property
    def mount(self) -> CameraMount:
        """How the source camera really sits on the vehicle."""
        return self._clips.mount

    @property
    def origin(self) -> str:
        """Names the world and its options."""
        return self._clips.origin

    def seed(self, number: int, /) -> int:
        """What a clip was made from."""
        return self._clips.seed(self._numbers[number])

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """Source and target, uint8 [T, H, W, 3] each."""
        if number not in self._kept:
            self._kept[number] = self._clips.rgb(self._numbers[number])
        return self._kept[number]

    def target_classes(self, number: int, /) -> Bytes:
        """Class ids of the target, uint8 [T, H, W]; not kept."""
        return self._clips.target_classes(self._numbers[number])


def numbers_of(clips: ClipSource, seeds: Sequence[int]) -> list[int]:
    """Where the clips of these seeds are now. Raises DataError if one is gone."""
    places = {clips.seed(number): number for number in range(len(clips))}
    gone = [seed for seed in seeds if seed not in places]
    if gone:
        raise DataError(f"{len(gone)} clips this run began with are gone, first seed {gone[0]}; give the same --data")
    return [places[seed] for seed in seeds]
