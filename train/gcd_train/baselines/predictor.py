"""The one protocol of everything that is evaluated: a clip in, its target view out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_train.baselines.cameras import CameraPair
from gcd_train.datasets.clip_source import Bytes
from gcd_train.scene_view import SceneView

OtherViews = Callable[[int], Sequence[Sequence[SceneView]]]
"""The T views of each of so many further cameras of the scene. Raises DataError if it has fewer."""

SourcePoints = Callable[[], Sequence[SceneView]]
"""The T views of the source camera as the data set holds them. Raises DataError where one cannot be read."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceClip:
    """What a predictor may look at: the source side of a clip, and where it is to be seen from.

    source: uint8 [T, H, W, 3] RGB. source_depth: float32 [T, H, W], metres along the optical axis, 0 for the sky; for
    privileged predictors only. source_classes: uint8 [T, H, W]; None where the world has no ontology.
    cameras: of the clip, the source's as it is declared. fps: frames per second.
    key: names the clip in its set; frames that others have made are found by it.
    others: what further cameras of the scene saw, for predictors that are given them; None where there is one camera.
    points: the source views at their full size, for privileged predictors only, with ids as in `source_classes`; None
    where `source` is all there is.
    """

    source: Bytes
    source_depth: NDArray[np.float32]
    source_classes: Bytes | None
    cameras: CameraPair
    fps: float
    key: str = ""
    others: OtherViews | None = None
    points: SourcePoints | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Prediction:
    """A view as it is measured.

    video: float32 [T, 3, H, W] in [0, 1], or None. classes: uint8 [T, H, W], 255 for no class, or None. more: further
    draws of the same view, of methods that draw.
    """

    video: Tensor | None = None
    classes: Tensor | None = None
    more: "tuple[Prediction, ...]" = ()

    @property
    def draws(self) -> "tuple[Prediction, ...]":
        """All draws, this one first."""
        return (self, *self.more)


class Predictor(Protocol):
    """Makes the target view of a clip from its source alone, or, where `privileged`, from its exact depth too."""

    @property
    def name(self) -> str: ...
    @property
    def privileged(self) -> bool: ...
    def predict(self, clip: SourceClip) -> Prediction: ...


def to_pictures(frames: Bytes) -> Tensor:
    """uint8 [T, H, W, 3] -> float32 [T, 3, H, W] in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(frames)).permute(0, 3, 1, 2).float() / 255.0


def to_labels(classes: Bytes | None) -> Tensor | None:
    """A class map as a tensor, uint8 [T, H, W]; None for none."""
    return None if classes is None else torch.from_numpy(np.ascontiguousarray(classes))
