"""Windows of frames out of any video: at a trained rate, cut and resized to the network's size."""

import math
import os
import re
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import Traits
from gcd_model.errors import ShapeError
from gcd_model.geometry import center_crop_box
from gcd_train.data.encodings import decoded
from gcd_train.data.files import read
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.store import folder_name

Bytes = NDArray[np.uint8]

VIDEO_SUFFIXES = (".mp4", ".mkv", ".webm", ".avi", ".mov", ".m4v")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
_MIN_RATE, _MAX_RATE = 0.1, 1000.0
_QUIET = ("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first video is opened; the decoder prints its own lines else
_RATE_TOLERANCE = 1.01  # 23.976 is 24


@dataclass(frozen=True, kw_only=True, slots=True)
class WindowChoice:
    """Which windows of a video.

    count: at most so many, evenly over the video. start_s: where the first begins, seconds. rate: frames per second of
    a folder of pictures, or of a video whose file does not tell. hfov_deg: horizontal field of view of the pictures;
    what is wider than the network was trained with is cut off. None where nobody knows.
    """

    count: int = 2
    start_s: float = 0.0
    rate: float | None = None
    hfov_deg: float | None = None

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.start_s, self.rate or 0.0, self.hfov_deg or 0.0))):
            raise RecipeError(f"a window wants a start, a rate and a field of view that are numbers, got {self}")


@dataclass(frozen=True, kw_only=True, slots=True)
class RealVideo:
    """A video file, or the pictures of a folder in the order of their names.

    name: for the files that are made of it, unlike that of any other video it was found with.
    """

    path: Path
    name: str
    pictures: tuple[Path, ...] = ()

    def frames(self) -> Iterator[Bytes]:
        """Every frame as RGB u8 [H, W, 3]. Raises DataError for what is no video or picture."""
        if self.pictures:
            for path in self.pictures:
                picture = decoded(path, read(path), cv2.IMREAD_COLOR)
                yield np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)
            return
        with _opened(self.path) as capture:
            while (found := capture.read())[0]:
                yield np.asarray(cv2.cvtColor(found[1], cv2.COLOR_BGR2RGB), np.uint8)

    def measured(self) -> tuple[int, float | None]:
        """Frames, counted one by one as containers lie, and frames per second; None where the file does not tell."""
        if self.pictures:
            return len(self.pictures), None
        with _opened(self.path) as capture:
            stated = float(capture.get(cv2.CAP_PROP_FPS))
            count = 0
            while capture.grab():
                count += 1
        return count, stated if _MIN_RATE <= stated <= _MAX_RATE else None


@dataclass(frozen=True, kw_only=True, slots=True)
class Windowed:
    """T frames of a video as a network takes them.

    video: name of its file. name: for the files that are made of it. number: of the window. start_s: when it begins.
    pictures: u8 [T, H, W, 3]. fps: of these frames.
    trained_rate: whether the network was trained with that rate. size: width and height of the frames in the file.
    hfov_deg: field of view of `pictures`, None where nobody knows.
    """

    video: str
    name: str
    number: int
    start_s: float
    pictures: Bytes
    fps: float
    trained_rate: bool
    size: tuple[int, int]
    hfov_deg: float | None = None


def find_videos(paths: Sequence[Path]) -> tuple[RealVideo, ...]:
    """Videos among files and folders, in order.

    A folder gives its video files; without any, its pictures are one video. Files are not opened yet.

    Raises: DataError for a path that is not there, or a folder with neither.
    """
    times = Counter[str]()
    found: list[RealVideo] = []
    for path, pictures in (place for given in paths for place in _videos_at(given)):
        stem = folder_name(path.stem)
        times[stem] += 1
        name = stem if times[stem] == 1 else f"{stem}.{times[stem]}"
        found.append(RealVideo(path=path, name=name, pictures=pictures))
    return tuple(found)


def read_windows(video: RealVideo, traits: Traits, choice: WindowChoice) -> tuple[Windowed, ...]:
    """Windows of a video, in time.

    Raises: DataError if it cannot be decoded, is too short for one window, or its frame rate is not known.
    """
    count, stated = video.measured()
    if not count:
        raise DataError(f"{video.path} has no frame that can be decoded; copy or record it again")
    own = choice.rate or stated
    if own is None:
        raise DataError(f"{video.path} does not tell its frame rate; give it with --rate")
    reachable = [rate for rate in traits.rates if rate <= own * _RATE_TOLERANCE]
    fps = max(reachable, default=own)
    starts = _starts(video.path, count, own, fps, traits.config.frames, choice)
    wanted = [[start + math.floor(i * own / fps + 0.5) for i in range(traits.config.frames)] for start in starts]
    chosen, size = _chosen(video, {number for each in wanted for number in each}, traits, choice.hfov_deg)
    return tuple(
        Windowed(
            video=video.path.name,
            name=f"{video.name}-{number}",
            number=number,
            start_s=start / own,
            pictures=np.stack([chosen[frame] for frame in frames]),
            fps=fps,
            trained_rate=bool(reachable) or not traits.rates,
            size=size,
            hfov_deg=_kept(size, traits, choice.hfov_deg)[1],
        )
        for number, (start, frames) in enumerate(zip(starts, wanted, strict=True))
    )


def _kept(size: tuple[int, int], traits: Traits, hfov_deg: float | None) -> tuple[list[int], float | None]:
    """What of a picture this wide and high the network takes: left, top, width and height, and its field of view.

    As much of the middle as has the network's shape and shows no more than it was trained with.
    """
    config, trained_deg = traits.config, None if traits.family is None else traits.family.hfov_deg
    half = None if hfov_deg is None else math.tan(math.radians(hfov_deg / 2))
    share = 1.0 if half is None or trained_deg is None else min(1.0, math.tan(math.radians(trained_deg / 2)) / half)
    beside = round(size[0] * (1 - share) / 2)
    left, top, wide, high = center_crop_box(max(1, size[0] - 2 * beside), size[1], config.width / config.height)
    angle = None if half is None else math.degrees(2 * math.atan(half * wide / size[0]))
    return [left + beside, top, wide, high], angle


def _videos_at(path: Path) -> list[tuple[Path, tuple[Path, ...]]]:
    """Each video's place, and its pictures if it is a folder of these."""
    if path.is_file():
        return [(path, ())]
    if not path.is_dir():
        raise DataError(f"{path} does not exist; give videos, or folders of videos or pictures")
    inside = sorted(path.iterdir(), key=_by_number)
    videos = [each for each in inside if each.suffix.lower() in VIDEO_SUFFIXES]
    pictures = tuple(each for each in inside if each.suffix.lower() in PICTURE_SUFFIXES)
    if not videos and not pictures:
        raise DataError(f"{path} holds neither videos nor pictures ({', '.join(VIDEO_SUFFIXES + PICTURE_SUFFIXES)})")
    return [(each, ()) for each in videos] or [(path, pictures)]


def _by_number(path: Path) -> list[tuple[str, int]]:
    """The order people mean: im_2 before im_10."""
    return [(name, int(part or -1)) for name, part in re.findall(r"(\D*)(\d*)", path.name)]


@contextmanager
def _opened(path: Path) -> Generator[cv2.VideoCapture]:
    if not _is_container(path):
        raise DataError(f"{path} is no whole video file; wanted is one of {', '.join(VIDEO_SUFFIXES)}")
    os.environ.setdefault(*_QUIET)
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    try:
        if not capture.isOpened():
            raise DataError(f"{path} cannot be decoded: truncated or damaged; copy or record it again")
        yield capture
    finally:
        capture.release()


def _is_container(path: Path) -> bool:
    """By its first bytes: the decoder would also play a text, or follow a play list to other files."""
    try:
        if not path.is_file():
            raise DataError(f"{path} is no regular file; give a video")
        with path.open("rb") as file:
            head = file.read(12)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}; check the path and its rights") from error
    return head[4:8] in _BOXES or head[:4] == b"\x1a\x45\xdf\xa3" or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")


def _starts(path: Path, count: int, own: float, fps: float, frames: int, choice: WindowChoice) -> list[int]:
    """First frame of each window, evenly from `start_s` to the last that fits; windows do not overlap."""
    span = math.floor((frames - 1) * own / fps + 0.5) + 1
    first, last = round(choice.start_s * own), count - span
    if last < first:
        raise DataError(
            f"{path} has {count} frames at {own:g} a second; {frames} at {fps:g} a second from {choice.start_s:g} s on "
            f"want {first + span}; give a longer video, or start earlier"
        )
    windows = max(1, min(choice.count, (last - first) // span + 1))
    return [first + (last - first) * number // max(windows - 1, 1) for number in range(windows)]


def _chosen(
    video: RealVideo, wanted: set[int], traits: Traits, hfov_deg: float | None
) -> tuple[Mapping[int, Bytes], tuple[int, int]]:
    """Frames by number in the network's size, and the size they had."""
    wanted_size = (traits.config.width, traits.config.height)
    chosen: dict[int, Bytes] = {}
    size, number = (0, 0), -1
    for number, picture in enumerate(video.frames()):
        if number in wanted:
            size = (picture.shape[1], picture.shape[0])
            try:
                (left, top, wide, high), _ = _kept(size, traits, hfov_deg)
            except ShapeError as error:
                raise DataError(f"{video.path}: {error}") from error
            part = picture[top : top + high, left : left + wide]
            how = cv2.INTER_AREA if wide > wanted_size[0] else cv2.INTER_LINEAR
            chosen[number] = cv2.resize(part, wanted_size, interpolation=how).astype(np.uint8, copy=False)
        if len(chosen) == len(wanted):
            return chosen, size
    raise DataError(f"{video.path} ended after {number + 1} frames while it was read; is it still being written?")
