"""Frames that a run keeps as PNG: for galleries, read back by `SavedFrames`, and for the contact sheet."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypeAlias

import cv2
import numpy as np
import torch
from torch import Tensor

from gcd_model.colours import palette
from gcd_model.config import SemanticClass
from gcd_train.datasets.clip_source import Bytes
from gcd_train.errors import RunError
from gcd_train.evaluation.clips import HeldOutClip
from gcd_train.evaluation.predictors import Prediction, to_labels
from gcd_train.evaluation.store import write_whole

KeptViews: TypeAlias = Literal["none", "last", "all"]
"""Which frames are kept: none, the last of each clip, or all."""

SHOWN_FRAMES = 6
"""Frames that a row of a sheet has at most."""


def write_views(
    folder: Path, clip: HeldOutClip, prediction: Prediction, which: KeptViews, classes: Sequence[SemanticClass]
) -> None:
    """Write `source/`, `target/` and `sample_0/` and so on, each frame under its number from 0000.png on.

    A method that makes class maps alone has them painted there; one that makes both has `classes_0/` and
    `target_classes/` beside. The target is written last: where it is whole, all is. classes: the ontology. Raises
    RunError if a file cannot be written.
    """
    strips = {"source": clip.seen.source}
    for number, draw in enumerate(prediction.draws):
        labels = None if draw.classes is None or not classes else painted(draw.classes, classes)
        if draw.video is not None:
            strips[f"sample_{number}"] = to_bytes(draw.video)
        if labels is not None:
            strips[f"sample_{number}" if draw.video is None else f"classes_{number}"] = labels
    true = to_labels(clip.target_classes)
    if true is not None and classes and "classes_0" in strips:
        strips["target_classes"] = painted(true, classes)
    strips["target"] = clip.target
    for name, frames in strips.items():
        for t in _wanted(which, len(frames)):
            write_whole(folder / name / f"{t:04d}.png", png(frames[t]))


def has_views(folder: Path, which: KeptViews, frames: int) -> bool:
    """Whether all that `write_views` writes of a clip of so many frames is there."""
    if which == "none":
        return True
    strips = {place.name: {path.name for path in place.iterdir()} for place in folder.glob("*/")}
    wanted = {f"{t:04d}.png" for t in _wanted(which, frames)}
    return "target" in strips and all(wanted <= there for there in strips.values())


def _wanted(which: KeptViews, frames: int) -> range:
    return {"none": range(0), "last": range(frames - 1, frames), "all": range(frames)}[which]


def write_rows(place: Path, prediction: Prediction, classes: Sequence[SemanticClass]) -> None:
    """Keep what a method has on the contact sheet: `KEY.png` of its pictures, `KEY.classes.png` of its class maps.

    place: of both, without a suffix.
    """
    if prediction.classes is not None and classes:
        write_whole(Path(f"{place}.classes.png"), png(_beside(painted(prediction.classes, classes))))
    if prediction.video is not None:
        write_whole(Path(f"{place}.png"), png(_beside(to_bytes(prediction.video))))


def has_rows(place: Path) -> bool:
    """Whether a method has any row at this place."""
    return any(Path(f"{place}{suffix}").exists() for suffix in (".png", ".classes.png"))


def read_row(path: Path, width: int) -> Bytes:
    """Frames [N, H, W, 3] of a row. Raises RunError if it is damaged."""
    picture = cv2.imread(str(path))
    if picture is None or picture.shape[1] % width:
        raise RunError(f"{path} is damaged; delete it, and run the same line again")
    rows = np.ascontiguousarray(picture[..., ::-1]).astype(np.uint8)
    return rows.reshape(len(rows), -1, width, 3).swapaxes(0, 1)


def shown_frames(count: int) -> list[int]:
    """Those of so many frames that a row of a sheet shows, evenly among them."""
    return np.linspace(0, count - 1, min(SHOWN_FRAMES, count)).round().astype(int).tolist()


def _beside(frames: Bytes) -> Bytes:
    return np.concatenate([frames[t] for t in shown_frames(len(frames))], axis=1)


def painted(labels: Tensor, classes: Sequence[SemanticClass]) -> Bytes:
    """Class ids uint8 [T, H, W] in colours, uint8 [T, H, W, 3]; what is of no class is black."""
    colours = torch.zeros(256, 3, dtype=torch.uint8)
    known = palette(tuple(classes))
    colours[: len(known)] = known
    return colours[labels.long()].numpy()


def to_bytes(video: Tensor) -> Bytes:
    """float32 [T, 3, H, W] in [0, 1] -> uint8 [T, H, W, 3]."""
    return (video.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()


def png(picture: Bytes) -> bytes:
    """A PNG file of an RGB picture, uint8 [H, W, 3]."""
    done, data = cv2.imencode(".png", cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2BGR))
    assert done, "PNG takes any picture"
    return data.tobytes()
