"""Views that any other method has made, read from files: how it enters a table without its code."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from gcd_model.colours import nearest_classes
from gcd_model.config import SemanticClass
from gcd_train.baselines.predictor import Prediction, SourceClip, to_pictures
from gcd_train.baselines.saved_layouts import SavedDraw, find_draws
from gcd_train.errors import DataError


@dataclass(frozen=True, kw_only=True, slots=True)
class SavedFrames:
    """The frames that a folder holds for each clip; see `find_draws` for how they may lie there.

    name: of the method. folder: with all clips. painted: the classes in whose colours the frames are painted; then each
    pixel counts as the class of the nearest colour, and as nothing else. Empty for photographs. privileged: whether the
    method was given depth, or further cameras.
    """

    name: str
    folder: Path
    painted: tuple[SemanticClass, ...] = ()
    privileged: bool = False

    @classmethod
    def open(cls, name: str, folder: Path, *, painted: Sequence[SemanticClass] = (), privileged: bool = False) -> Self:
        """Raises DataError if there is no such folder."""
        if not folder.is_dir():
            raise DataError(f"the frames of {name} should lie in {folder}, which is no folder; give NAME=FOLDER")
        return cls(name=name, folder=folder, painted=tuple(painted), privileged=privileged)

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor; each sample that was saved is a draw.

        Raises:
            DataError: there is nothing for this clip, or something of another length or size; nothing is resized.
            FileFault: a file is damaged.
        """
        draws = [self._prediction(_read(draw, clip)) for draw in find_draws(self.folder, clip.key)]
        return replace(draws[0], more=tuple(draws[1:]))

    def _prediction(self, video: Tensor) -> Prediction:
        return Prediction(classes=nearest_classes(video, self.painted)) if self.painted else Prediction(video=video)


def _read(draw: SavedDraw, clip: SourceClip) -> Tensor:
    """float32 [T, 3, H, W] in [0, 1]. Raises DataError."""
    frames, lens = draw.frames(), clip.cameras.target
    if len(frames) != len(clip.source):
        raise DataError(f"{draw.path} holds {len(frames)} frames, clip {clip.key} has {len(clip.source)}; save all")
    for number, frame in enumerate(frames):
        if frame.shape != (lens.height, lens.width, 3):
            raise DataError(
                f"{draw.path}: frame {number} is {frame.shape[1]} x {frame.shape[0]}, the target {lens.width} x "
                f"{lens.height}; save them in that size"
            )
    return torch.cat([to_pictures(frame[None]) for frame in frames])
