"""Clips as pictures and videos: what came in, what each method made of it, what was there."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model.config import SemanticClass
from gcd_train.errors import DataError, RunError
from gcd_train.evaluation.clips import HeldOutClip
from gcd_train.evaluation.kept_frames import painted, png, read_row, shown_frames
from gcd_train.evaluation.predictors import to_labels
from gcd_train.evaluation.runs import EvaluatedSet, Method
from gcd_train.evaluation.store import RunKeeper, write_whole

Pictures = NDArray[np.uint8]

_GAP, _MARGIN, _INK = 4, 140, (40, 40, 40)
_LINE, _LETTERS, _FONT = 14, 20, cv2.FONT_HERSHEY_SIMPLEX
_SCALE, _SMALL = 0.38, 0.3  # of captions; the small one where the other would be broken
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


def shown_clips(of: EvaluatedSet, methods: Sequence[Method], count: int) -> tuple[str, ...]:
    """So many clips whose frames were kept, evenly among them; one of a scene before a second of another."""
    kept = [key for key in of.keys if any(_folder(method, key).is_dir() for method in methods)]
    scenes = {record.key: record.scene for method in methods for record in method.records}
    first = list({scenes.get(key, key): key for key in reversed(kept)}.values())[::-1]
    chosen = first if len(first) >= count else kept
    places = np.linspace(0, len(chosen) - 1, min(count, len(chosen))).round().astype(int)
    return tuple(chosen[place] for place in places)


def strips(methods: Sequence[Method], key: str) -> tuple[Strip, ...]:
    """Source, each method that kept frames of this clip, target. Raises DataError for a damaged picture."""
    made = [Strip(name=method.name, frames=_read(_folder(method, key) / "sample_0")) for method in methods]
    seen = {side: _side(methods, key, side) for side in ("source", "target")}
    every = [Strip(name="source", frames=seen["source"]), *made, Strip(name="target", frames=seen["target"])]
    return tuple(strip for strip in every if strip.frames)


def contact_rows(
    clip: HeldOutClip, methods: Sequence[tuple[str, Path]], classes: Sequence[SemanticClass]
) -> tuple[Strip, ...]:
    """A clip's rows of the contact sheet: source, each method's picture and class map, the true ones.

    Args:
        methods: by name, each with the place of its rows, see `write_rows`. classes: the ontology, empty for none.
    Raises: RunError if a row is damaged.
    """
    shown, width = shown_frames(len(clip.target)), clip.target.shape[2]
    rows = [("source", clip.seen.source[shown])]
    for name, place in methods:
        files = {name: Path(f"{place}.png"), f"{name}: classes": Path(f"{place}.classes.png")}
        rows += [(kind, read_row(file, width)) for kind, file in files.items() if file.exists()]
    true = to_labels(clip.target_classes if classes else None)
    rows += [] if true is None else [("true classes", painted(true[shown], classes))]
    rows.append(("target", clip.target[shown]))
    return tuple(Strip.of(kind, frames) for kind, frames in rows)


def write_sheet(clips: Sequence[tuple[str, Sequence[Strip]]], out: Path) -> None:
    """PNG of clips, one below the other, each with its name; rows strips, columns frames. Raises RunError."""
    blocks = [_row(label, strip) for label, rows in clips for strip in rows]
    if not blocks:
        raise RunError(f"there is nothing to show in {out}; evaluate with --views all")
    width = max(block.shape[1] for block in blocks)
    sheet = [np.pad(block, ((0, 0), (0, width - block.shape[1]), (0, 0)), constant_values=255) for block in blocks]
    write_whole(out, png(np.concatenate(sheet)))


def write_mp4(frames: Iterable[Pictures], fps: float, out: Path) -> None:
    """Pictures of one even size, as MPEG-4 part 2. Raises RunError if it cannot be written."""
    out.parent.mkdir(parents=True, exist_ok=True)
    video: cv2.VideoWriter | None = None
    for frame in frames:
        if video is None:
            size = (frame.shape[1], frame.shape[0])
            video = cv2.VideoWriter(str(out), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
            if not video.isOpened():
                raise RunError(f"{out} cannot be written; give a folder that takes files with --out")
        video.write(frame[..., ::-1])
    if video is not None:
        video.release()


def write_video(rows: Sequence[Strip], fps: float, out: Path) -> bool:
    """MP4 of a clip, all rows side by side, the last frame held; False where only single frames were kept.

    Raises RunError if it cannot be written.
    """
    moments = sorted(set.intersection(*(set(row.frames) for row in rows))) if rows else []
    if len(moments) < 2:
        return False
    frames = [_beside(rows, moment) for moment in moments]
    write_mp4([*frames, *frames[-1:] * round(HOLD_S * fps)], max(fps, 1.0), out)
    return True


def _folder(method: Method, key: str) -> Path:
    return RunKeeper(method.folder).views(method.name, key)


def _side(methods: Sequence[Method], key: str, side: str) -> dict[int, Pictures]:
    """The source or the target, from whichever method it was kept beside."""
    return next((found for method in methods if (found := _read(_folder(method, key) / side))), {})


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
    pictures = [strip.frames[numbers[place]] for place in shown_frames(len(numbers))]
    lines = (*wrap(strip.name, _LETTERS), *wrap(label, _LETTERS))
    height = max(pictures[0].shape[0], max(3, len(lines)) * _LINE)
    margin = np.full((height + _GAP, _MARGIN, 3), 255, np.uint8)
    for line, text in enumerate(lines):
        cv2.putText(margin, text, (4, _LINE * (1 + line)), _FONT, _SCALE, _INK, 1, cv2.LINE_AA)
    framed = [
        cv2.copyMakeBorder(p, 0, height + _GAP - p.shape[0], 0, _GAP, cv2.BORDER_CONSTANT, value=(255,) * 3)
        for p in pictures
    ]
    return np.concatenate([margin, *(each.astype(np.uint8) for each in framed)], axis=1)


def _beside(rows: Sequence[Strip], moment: int) -> Pictures:
    """All rows' pictures of one moment with their names above, of even size as codecs want it."""
    pictures = [row.frames[moment] for row in rows]
    captions = [caption(row.name, each.shape[1]) for row, each in zip(rows, pictures, strict=True)]
    lines = max(len(each.lines) for each in captions)
    named = [_named(text, lines, picture) for text, picture in zip(captions, pictures, strict=True)]
    height = max(each.shape[0] for each in named)
    panels = [np.pad(each, ((0, height - each.shape[0]), (0, _GAP), (0, 0)), constant_values=255) for each in named]
    whole = np.concatenate(panels, axis=1)
    odd = whole.shape[0] % 2, whole.shape[1] % 2
    return np.pad(whole, ((0, odd[0]), (0, odd[1]), (0, 0)), constant_values=255)


@dataclass(frozen=True, kw_only=True, slots=True)
class Caption:
    """A name as it is written above a picture: lines, in letters of this scale."""

    lines: tuple[str, ...]
    scale: float

    @property
    def width(self) -> int:
        """Pixels."""
        return max(_width(line, self.scale) for line in self.lines)


def caption(name: str, width: int) -> Caption:
    """A name over a picture of so many pixels: in one line, else in smaller letters, else broken into lines."""
    for scale in (_SCALE, _SMALL):
        if _width(name, scale) <= width - 2:
            return Caption(lines=(name,), scale=scale)
    return Caption(lines=_broken(name, width), scale=_SMALL)


def _broken(name: str, width: int) -> tuple[str, ...]:
    """Lines that fit, broken behind a space, underscore or hyphen where there is one; a letter at the least."""
    lines, rest = list[str](), name
    while rest:
        fitting = max([count for count in range(1, len(rest) + 1) if _width(rest[:count], _SMALL) <= width - 2] or [1])
        ends = [count for count in range(1, fitting + 1) if count == len(rest) or rest[count - 1] in " _-"]
        taken = ends[-1] if ends else fitting
        lines.append(rest[:taken].strip())
        rest = rest[taken:].lstrip()
    return tuple(lines)


def _width(text: str, scale: float) -> int:
    return cv2.getTextSize(text, _FONT, scale, 1)[0][0] + 2  # the margin before it


def _named(text: Caption, lines: int, picture: Pictures) -> Pictures:
    """A picture under its caption, with room for so many lines."""
    strip = np.full((_LINE * lines + _GAP, picture.shape[1], 3), 255, np.uint8)
    for line, words in enumerate(text.lines, start=1 + lines - len(text.lines)):
        cv2.putText(strip, words, (2, _LINE * line - 1), _FONT, text.scale, _INK, 1, cv2.LINE_AA)
    return np.concatenate([strip, picture])
