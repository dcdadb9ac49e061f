"""Clips as pictures and videos: frames that a run keeps, contact sheets, galleries."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Literal, TypeAlias

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.clip import palette
from gcd_model.config import SemanticClass
from gcd_train.errors import DataError, RunError
from gcd_train.evaluation.clips import HeldOutClip
from gcd_train.evaluation.predictors import Prediction, to_labels
from gcd_train.evaluation.runs import EvaluatedSet, MethodRecords
from gcd_train.evaluation.store import RunKeeper
from gcd_train.files import write_whole
from gcd_train.pictures import png, write_mp4

Pictures = NDArray[np.uint8]

KeptViews: TypeAlias = Literal["none", "few", "last", "all"]
"""Which frames are kept: none, all of the first clips, the last of each clip, or all."""
FEW_CLIPS = 4
"""Clips that "few" are."""

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
    shutil.rmtree(folder / "target", ignore_errors=True)  # until all is whole again
    for stale in [place for place in folder.glob("*/") if place.name not in strips]:
        shutil.rmtree(stale)  # of more draws, or of a run that was killed
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
    return {"none": range(0), "last": range(frames - 1, frames)}.get(which, range(frames))


def painted(labels: Tensor, classes: Sequence[SemanticClass]) -> Pictures:
    """Class ids uint8 [T, H, W] in colours, uint8 [T, H, W, 3]; what is of no class is black."""
    colours = torch.zeros(256, 3, dtype=torch.uint8)
    known = palette(tuple(classes))
    colours[: len(known)] = known
    return colours[labels.long()].numpy()


def to_bytes(video: Tensor) -> Pictures:
    """float32 [T, 3, H, W] in [0, 1] -> uint8 [T, H, W, 3]."""
    return (video.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()


_GAP, _MARGIN, _INK = 4, 140, (40, 40, 40)
_LINE, _LETTERS, _FONT = 14, 20, cv2.FONT_HERSHEY_SIMPLEX
_SCALE, _LETTER = 0.38, 8  # of captions, and pixels that a letter of theirs takes at most
HOLD_S = 0.7
"""How long a video shows its last frame."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Strip:
    """One row of a gallery. frames: uint8 [H, W, 3] RGB by number, counted from 0."""

    name: str
    frames: dict[int, Pictures]

    @classmethod
    def of(cls, name: str, frames: Pictures) -> "Strip":
        """All of [T, H, W, 3]."""
        return cls(name=name, frames=dict(enumerate(frames)))


def shown_clips(of: EvaluatedSet, methods: Sequence[MethodRecords], count: int) -> tuple[str, ...]:
    """So many clips whose frames were kept, evenly among them; one of a scene before a second of another."""
    kept = [key for key in of.clips if any(_folder(method, key).is_dir() for method in methods)]
    scenes = {record.key: record.scene for method in methods for record in method.records}
    first = list({scenes.get(key, key): key for key in reversed(kept)}.values())[::-1]
    chosen = first if len(first) >= count else kept
    places = np.linspace(0, len(chosen) - 1, min(count, len(chosen))).round().astype(int)
    return tuple(chosen[place] for place in places)


def strips(methods: Sequence[MethodRecords], key: str) -> tuple[Strip, ...]:
    """Source, each method that kept frames of this clip, target; class maps beside the pictures they belong to.

    Raises DataError for a damaged picture.
    """
    folders = [_folder(method, key) for method in methods]
    rows = [("source", "source", folders)]
    for method, at in zip(methods, folders, strict=True):
        rows += [(method.name, "sample_0", [at]), (f"{method.name}: classes", "classes_0", [at])]
    rows += [("true classes", "target_classes", folders), ("target", "target", folders)]
    every = [(name, next(filter(None, (_read(at / kind) for at in places)), {})) for name, kind, places in rows]
    sizes = [frame.shape[:2] for _, frames in every for frame in frames.values()]
    height, width = np.max(sizes, axis=0) if sizes else (0, 0)
    return tuple(
        Strip(name=name, frames={number: _centred(frame, height, width) for number, frame in frames.items()})
        for name, frames in every
        if frames
    )


def write_sheet(clips: Sequence[tuple[str, Sequence[Strip]]], out: Path) -> None:
    """PNG of clips, one below the other, each with its name; rows strips, columns frames. Raises RunError."""
    blocks = [_row(label, strip) for label, rows in clips for strip in rows]
    if not blocks:
        raise RunError(f"there is nothing to show in {out}; evaluate with --views all")
    write_whole(out, png(stacked_sheet(blocks)))


def stacked_sheet(rows: Sequence[Pictures]) -> Pictures:
    """Rows of pictures one below the other, white where one is shorter."""
    width = max(row.shape[1] for row in rows)
    return np.concatenate([_padded(row, len(row), width) for row in rows])


def write_video(rows: Sequence[Strip], fps: float, out: Path) -> bool:
    """MP4 of a clip, all rows side by side, the last frame held; False where only single frames were kept.

    Raises RunError if it cannot be written.
    """
    moments = sorted(set.intersection(*(set(row.frames) for row in rows))) if rows else []
    if len(moments) < 2:
        return False
    frames = [beside(rows, moment) for moment in moments]
    write_mp4([*frames, *frames[-1:] * round(HOLD_S * fps)], max(fps, 1.0), out)
    return True


def _folder(method: MethodRecords, key: str) -> Path:
    return RunKeeper(method.folder).views(method.name, key)


def _read(folder: Path) -> dict[int, Pictures]:
    """Frames by number; none where there is no such folder."""
    found: dict[int, Pictures] = {}
    for path in sorted(folder.glob("*.png")):
        picture = cv2.imread(str(path))
        if picture is None or not path.stem.isdigit():
            raise DataError(f"{path} is no frame of a clip; delete it, and evaluate with --views again")
        found[int(path.stem)] = np.ascontiguousarray(picture[..., ::-1]).astype(np.uint8)
    return found


def _row(label: str, strip: Strip) -> Pictures:
    numbers = sorted(strip.frames)
    places = np.linspace(0, len(numbers) - 1, min(SHOWN_FRAMES, len(numbers))).round().astype(int)  # evenly
    pictures = [strip.frames[numbers[place]] for place in places]
    lines = [*wrap(strip.name, _LETTERS), *wrap(label, _LETTERS)]
    height = max(pictures[0].shape[0], max(3, len(lines)) * _LINE) + _GAP
    margin = _words(lines, height, _MARGIN, (4, _LINE))
    return np.concatenate([margin, *(_padded(each, height, each.shape[1] + _GAP) for each in pictures)], axis=1)


def _words(lines: Sequence[str], height: int, width: int, at: tuple[int, int]) -> Pictures:
    """Lines of text on white; at: left end and foot of the first, pixels."""
    page = np.full((height, width, 3), 255, np.uint8)
    for number, text in enumerate(lines):
        cv2.putText(page, text, (at[0], at[1] + _LINE * number), _FONT, _SCALE, _INK, 1, cv2.LINE_AA)
    return page


def _padded(picture: Pictures, height: int, width: int) -> Pictures:
    """With white below and to the right."""
    rows, columns = picture.shape[:2]
    return np.pad(picture, ((0, height - rows), (0, width - columns), (0, 0)), constant_values=255)


def _centred(picture: Pictures, height: int, width: int) -> Pictures:
    """With white all round, where a method shows the middle of a frame alone."""
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    return _padded(np.pad(picture, ((top, 0), (left, 0), (0, 0)), constant_values=255), height, width)


def beside(rows: Sequence[Strip], moment: int) -> Pictures:
    """All rows' pictures of one moment with their names above, of even size as codecs want it."""
    pictures = [row.frames[moment] for row in rows]
    captions = [wrap(row.name, max(each.shape[1] // _LETTER, 1)) for row, each in zip(rows, pictures, strict=True)]
    most = max(map(len, captions))
    named = [
        np.concatenate(
            [_words(lines, _LINE * most + _GAP, each.shape[1], (2, _LINE * (1 + most - len(lines)) - 1)), each]
        )
        for lines, each in zip(captions, pictures, strict=True)
    ]
    height = max(each.shape[0] for each in named)
    whole = np.concatenate([_padded(each, height, each.shape[1] + _GAP) for each in named], axis=1)
    return _padded(whole, height + height % 2, whole.shape[1] + whole.shape[1] % 2)
