"""What the trainer asks of a set of clips."""

from collections.abc import Sequence
from typing import Protocol, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.config import CameraControl, SemanticClass
from gcd_model.geometry import CameraMount, Trajectory
from gcd_train.errors import DataError

Bytes: TypeAlias = NDArray[np.uint8]


class ClipSource(Protocol):
    """Pairs of a source and a target clip, by number. `PairedClips` is one."""

    def __len__(self) -> int:
        """Clips there are."""
        ...

    @property
    def classes(self) -> Sequence[SemanticClass]:
        """The ontology of the class maps; empty where the world has none."""
        ...

    @property
    def fps(self) -> float:
        """Frames per second."""
        ...

    @property
    def camera(self) -> CameraControl:
        """How a network is told where the target camera goes: "none" where all clips share one path."""
        ...

    @property
    def mount(self) -> CameraMount | None:
        """How the source camera really sits on the vehicle; None in a world without one."""
        ...

    @property
    def origin(self) -> str:
        """Names the world and its options, whatever number of clips there is."""
        ...

    def seed(self, number: int, /) -> int:
        """What a clip was made from: names it, also when the set has grown since."""
        ...

    def trajectory(self, number: int, /) -> Trajectory:
        """The target camera's path, seen from the source camera; T poses."""
        ...

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """Source and target, uint8 [T, H, W, 3] each."""
        ...

    def target_classes(self, number: int, /) -> Bytes:
        """Class ids of the target, uint8 [T, H, W]; zeros where the world has no classes."""
        ...


def to_network(frames: Bytes | Tensor) -> Tensor:
    """Frames as the networks take them: uint8 [T, H, W, 3] -> float32 [T, 3, H, W] in [-1, 1]."""
    rows = frames if isinstance(frames, Tensor) else torch.from_numpy(np.ascontiguousarray(frames))
    return rows.permute(0, 3, 1, 2).float().div_(127.5).sub_(1)


class SomeClips:
    """Some of the clips, by their numbers, as they are."""

    def __init__(self, clips: ClipSource, numbers: Sequence[int]) -> None:
        self._clips, self._numbers = clips, tuple(numbers)

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
    def camera(self) -> CameraControl:
        """How a network is told where the target camera goes."""
        return self._clips.camera

    @property
    def mount(self) -> CameraMount | None:
        """How the source camera really sits on the vehicle; None in a world without one."""
        return self._clips.mount

    @property
    def origin(self) -> str:
        """Names the world and its options."""
        return self._clips.origin

    def seed(self, number: int, /) -> int:
        """What a clip was made from."""
        return self._clips.seed(self._numbers[number])

    def trajectory(self, number: int, /) -> Trajectory:
        """The target camera's path, seen from the source camera; T poses."""
        return self._clips.trajectory(self._numbers[number])

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """Source and target, uint8 [T, H, W, 3] each."""
        return self._clips.rgb(self._numbers[number])

    def target_classes(self, number: int, /) -> Bytes:
        """Class ids of the target, uint8 [T, H, W]."""
        return self._clips.target_classes(self._numbers[number])


class KeptClips(SomeClips):
    """Some of the clips, each decoded once and kept in memory, 2 H W 3 T bytes a clip; classes are not kept."""

    def __init__(self, clips: ClipSource, numbers: Sequence[int]) -> None:
        super().__init__(clips, numbers)
        self._kept: dict[int, tuple[Bytes, Bytes]] = {}

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """Source and target, uint8 [T, H, W, 3] each."""
        if number not in self._kept:
            self._kept[number] = super().rgb(number)
        return self._kept[number]


class PaintedClips(SomeClips):
    """The clips with the target painted in the colours of its classes: what a semantic model learns to draw.

    Raises DataError for clips of a world without classes.
    """

    def __init__(self, clips: ClipSource) -> None:
        super().__init__(clips, range(len(clips)))
        if not clips.classes:
            raise DataError("a semantic model needs classes, and these clips have none; generate driving pairs")
        self._colours = np.array([kind.colour for kind in clips.classes], np.uint8)

    @property
    def origin(self) -> str:
        """Names the world, its options, and that its targets are painted: latents of these are others."""
        return f"{super().origin}-painted"

    def rgb(self, number: int, /) -> tuple[Bytes, Bytes]:
        """The source as it is and the target in class colours, uint8 [T, H, W, 3] each."""
        source, _ = super().rgb(number)
        return source, self._colours[self.target_classes(number)]


def numbers_of(clips: ClipSource, seeds: Sequence[int]) -> list[int]:
    """Where the clips of these seeds are now. Raises DataError if one is gone."""
    places = {clips.seed(number): number for number in range(len(clips))}
    gone = [seed for seed in seeds if seed not in places]
    if gone:
        raise DataError(f"{len(gone)} clips this run began with are gone, first seed {gone[0]}; give the same --data")
    return [places[seed] for seed in seeds]
