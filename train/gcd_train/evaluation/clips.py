"""The clips of an evaluation, whatever they are read from: pairs in shards, or scenes with many cameras."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gcd_model.config import CameraControl, SemanticClass
from gcd_train.baselines import SourceClip
from gcd_train.datasets.clip_source import Bytes

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
