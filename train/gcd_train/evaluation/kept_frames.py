"""Frames that a run keeps as PNG: for galleries, read back by `SavedFrames`, and for the contact sheet."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from textwrap import wrap
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

SHEET_FRAMES = (1, 4, 7, 10, 12, 14)
"""Frames a contact sheet shows, counted from 1."""

_GAP, _LABEL_WIDTH, _INK = 4, 132, (40, 40, 40)
_LINE, _LETTERS = 14, 19  # pixels a line of a label, letters that fit in one


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
    """Write a method's rows of the contact sheet: `KEY.classes.png` where it has class maps, `KEY.png` of pictures.

    place: of both, without a suffix.
    """
    if prediction.classes is not None and classes:
        write_whole(Path(f"{place}.classes.png"), png(_row(painted(prediction.classes, classes))))
    if prediction.video is not None:
        write_whole(Path(f"{place}.png"), png(_row(to_bytes(prediction.video))))


def has_rows(place: Path) -> bool:
    """Whether a method has any row at this place."""
    return any(Path(place.as_posix() + suffix).exists() for suffix in (".png", ".classes.png"))


def write_contact_sheet(
    path: Path,
    methods: Sequence[tuple[str, Sequence[Path]]],
    clips: Iterable[tuple[str, HeldOutClip]],
    *,
    classes: Sequence[SemanticClass] = (),
) -> None:
    """PNG of some clips. Rows: source, each method's picture and class map, the true ones; columns: frames.

    Args:
        methods: from top to bottom, by name, each with the places of its rows (see `write_rows`), clip by clip.
        clips: from top to bottom, each with what it is called. classes: the ontology, empty for none.
    Raises: RunError if a row cannot be read, or the file cannot be written.
    """
    blocks: list[Bytes] = []
    for number, (label, clip) in enumerate(clips):
        rows = [("source", _row(clip.seen.source))]
        for name, places in methods:
            files = {name: f"{places[number]}.png", f"{name}: classes": f"{places[number]}.classes.png"}
            rows += [(kind, _read(Path(file))) for kind, file in files.items() if Path(file).exists()]
        true = to_labels(clip.target_classes if classes else None)
        rows += [] if true is None else [("true classes", _row(painted(true, classes)))]
        rows.append(("target", _row(clip.target)))
        blocks += [np.concatenate([_label(kind, label, len(row)), row], axis=1) for kind, row in rows]
        blocks.append(np.zeros((_GAP, blocks[-1].shape[1], 3), np.uint8))
    write_whole(path, png(np.concatenate(blocks[:-1])))


def _row(frames: Bytes) -> Bytes:
    """Some frames side by side, a gap behind each."""
    shown = [frames[number - 1] for number in SHEET_FRAMES if number <= len(frames)]
    return np.concatenate([np.pad(each, ((0, 0), (0, _GAP), (0, 0)), constant_values=255) for each in shown], axis=1)


def _read(path: Path) -> Bytes:
    picture = cv2.imread(str(path))
    if picture is None:
        raise RunError(f"{path} is damaged; delete it, and run the same line again")
    return np.ascontiguousarray(picture[..., ::-1]).astype(np.uint8)


def _label(kind: str, clip: str, height: int) -> Bytes:
    margin = np.full((height, _LABEL_WIDTH, 3), 255, np.uint8)
    for line, text in enumerate((*wrap(kind, _LETTERS), *wrap(clip, _LETTERS))):
        cv2.putText(margin, text, (4, _LINE * (1 + line)), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)
    return margin


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
