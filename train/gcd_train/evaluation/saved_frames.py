"""Frames of other methods, read from folders or videos."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import cv2
import torch
from torch import Tensor

from gcd_model.colours import nearest_classes
from gcd_model.config import SemanticClass
from gcd_train.data.files import FileFault, read_colour
from gcd_train.data.sample import Bytes
from gcd_train.errors import DataError
from gcd_train.evaluation.predictors import Prediction, SourceClip, to_pictures

_PICTURES = (".png", ".jpg", ".jpeg", ".webp")
_VIDEO = ".mp4"
_SAMPLE = re.compile(r"sample_(\d+)")
_RELEASED = re.compile(r"(.+)_pred_s(\d+)")


def read_draw(path: Path) -> list[Bytes]:
    """RGB pictures, uint8 [H, W, 3] each, of a folder of numbered pictures, or of a video.

    Raises: FileFault for a damaged file; DataError for a folder whose pictures do not count up one by one.
    """
    if not path.is_dir():
        return _video_frames(path)
    found = sorted(_pictures(path), key=lambda each: int(each.stem))
    numbers = [int(each.stem) for each in found]
    if numbers != list(range(numbers[0], numbers[0] + len(numbers))) or numbers[0] > 1:
        raise DataError(f"{path} holds frames {numbers}, one is missing or there twice; number them from 0 on")
    return [read_colour(each) for each in found]


def find_draws(folder: Path, key: str) -> list[Path]:
    """The draws of a clip, in order.

    A draw is a folder of pictures by number (`0000.png`, ...; also JPEG and WebP) or a video (`.mp4`), and stands at

        KEY, KEY/sample_0, ...                                   ours
        PREFIX_pred_s0, ... , in `extra` or in the folder itself  of the paper's test script

    where PREFIX names the scene and, from the second on, the trajectory: `..._c02_scn02900_fs...` is that of the key
    `scn02900.sample_02`. Where pictures and a video are of one name, the pictures count.

    Raises: DataError naming the clip if there is nothing, or the draws of several runs.
    """
    if not key or Path(key).name != key:
        raise DataError(f"saved frames are found by the clip's name, which must be a file name, got {key!r}")
    found = _ours(folder, key) or _released(folder / "extra", key) or _released(folder, key)
    if not found:
        raise DataError(
            f"{folder} holds no frames for clip {key}: wanted {key}/0000.png and so on, {key}/sample_0/0000.png, "
            f"{key}.mp4, or extra/..._pred_s0 of its scene"
        )
    return found


def _ours(folder: Path, key: str) -> list[Path]:
    place = folder / key
    samples: dict[int, Path] = {}
    for path in _entries(place):
        named = _SAMPLE.fullmatch(_name_of(path))
        if named and _is_draw(path):
            samples.setdefault(int(named[1]), path)
    if samples:
        return [samples[number] for number in sorted(samples)]
    return [path for path in (place, place.with_name(key + _VIDEO)) if _is_draw(path)][:1]


def _released(folder: Path, key: str) -> list[Path]:
    by_prefix: dict[str, dict[int, Path]] = {}
    for path in _entries(folder):
        named = _RELEASED.fullmatch(_name_of(path))
        if named and _is_draw(path) and _tells_of(named[1], key):
            by_prefix.setdefault(named[1], {}).setdefault(int(named[2]), path)
    if len(by_prefix) > 1:
        raise DataError(f"{folder} holds clip {key} several times: {', '.join(sorted(by_prefix))}; keep one")
    return [draws[number] for draws in by_prefix.values() for number in sorted(draws)]


def _tells_of(prefix: str, key: str) -> bool:
    """Whether the name of a released output is that of a clip; without its number it is the first trajectory's."""
    scene, _, sample = key.partition(".")
    told = re.search(rf"(?:_c(\d+))?_{re.escape(scene)}_fs", prefix)
    wanted = re.search(r"\d+$", sample)
    return told is not None and int(told[1] or 0) == (int(wanted[0]) if wanted else 0)


def _entries(folder: Path) -> list[Path]:
    """What is in a folder, folders before files; nothing where there is none."""
    return sorted(folder.iterdir(), key=lambda path: (path.is_file(), path.name)) if folder.is_dir() else []


def _name_of(path: Path) -> str:
    return path.stem if path.suffix == _VIDEO else path.name


def _is_draw(path: Path) -> bool:
    return bool(_pictures(path)) if path.is_dir() else path.suffix == _VIDEO and path.is_file()


def _pictures(folder: Path) -> Sequence[Path]:
    return [path for path in folder.iterdir() if path.suffix in _PICTURES and path.stem.isdecimal()]


def _video_frames(path: Path) -> list[Bytes]:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        frames: list[Bytes] = []
        while True:
            there, frame = capture.read()
            if not there:
                break
            frames.append(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB).astype("uint8", copy=False))
    finally:
        capture.release()
    if not frames:
        raise FileFault(path, "holds no frame that can be decoded; save the frames as PNG")
    return frames


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
        videos = [_read(draw, clip) for draw in find_draws(self.folder, clip.key)]
        first, *more = (
            Prediction(classes=nearest_classes(video, self.painted)) if self.painted else Prediction(video=video)
            for video in videos
        )
        return replace(first, more=tuple(more))


def _read(draw: Path, clip: SourceClip) -> Tensor:
    """float32 [T, 3, H, W] in [0, 1]. Raises DataError."""
    frames, lens = read_draw(draw), clip.cameras.target
    if len(frames) != len(clip.source):
        raise DataError(f"{draw} holds {len(frames)} frames, clip {clip.key} has {len(clip.source)}; save all")
    for number, frame in enumerate(frames):
        if frame.shape != (lens.height, lens.width, 3):
            raise DataError(
                f"{draw}: frame {number} is {frame.shape[1]} x {frame.shape[0]}, the target {lens.width} x "
                f"{lens.height}; save them in that size"
            )
    return torch.cat([to_pictures(frame[None]) for frame in frames])
