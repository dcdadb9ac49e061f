"""Frames to files: PNG, video, strips and side-by-side pictures. Images are u8 RGB [H, W, 3]."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import OutputError
from gcd_node.frame import Image

_ANIMATION_QUALITY = 60  # WebP's scale of 100


def to_u8(video: NDArray[np.float32] | NDArray[np.uint8]) -> Image:
    """[T, 3, H, W] in [0, 1], or in levels already -> u8 [T, H, W, 3], rounded to the nearest level."""
    if video.dtype == np.uint8:
        return np.ascontiguousarray(video.transpose(0, 2, 3, 1), np.uint8)
    frames, _, height, width = video.shape
    pixels = np.empty((frames, height, width, 3), np.uint8)
    for picture, frame in zip(pixels, np.ascontiguousarray(video), strict=True):
        rows = frame.reshape(-1, width)  # of all three planes; what is out of range becomes 0 or 255
        levels = cv2.addWeighted(rows, 255.0, rows, 0.0, 0.0, dtype=cv2.CV_8U).reshape(3, height, width)
        cv2.merge(list(levels), picture)
    return pixels


def make_folder(folder: Path) -> None:
    """Create a folder and those above it. Raises OutputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot create {folder}: {error.strerror}; name another folder") from error


def write_png(path: Path, image: Image) -> None:
    """Write one picture. Raises OutputError."""
    make_folder(path.parent)
    if not cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise OutputError(f"cannot write {path}; is there space, and may this user write there?")


def video_writer(path: Path, width: int, height: int, fps: float) -> cv2.VideoWriter:
    """An open video: .mp4 is small and lossy, .mkv is lossless (FFV1). It takes BGR. Raises OutputError."""
    make_folder(path.parent)
    code = cv2.VideoWriter.fourcc(*("FFV1" if path.suffix == ".mkv" else "mp4v"))
    writer = cv2.VideoWriter(str(path), code, max(fps, 1.0), (width, height))
    if not writer.isOpened():
        raise OutputError(f"cannot write {path}; is there space, and may this user write there?")
    return writer


def write_video(path: Path, frames: Sequence[Image], fps: float) -> None:
    """Write a whole video, see video_writer(). Raises OutputError."""
    writer = video_writer(path, frames[0].shape[1], frames[0].shape[0], fps)
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()


def write_animation(path: Path, frames: Sequence[Image], fps: float) -> None:
    """Write a moving picture that plays for ever where pictures are shown (.webp), lossy. Raises OutputError."""
    make_folder(path.parent)
    animation = cv2.Animation()
    animation.frames = [cv2.cvtColor(frame, cv2.COLOR_RGB2BGR) for frame in frames]
    animation.durations = [round(1000 / max(fps, 1.0))] * len(frames)
    if not cv2.imwriteanimation(str(path), animation, [cv2.IMWRITE_WEBP_QUALITY, _ANIMATION_QUALITY]):
        raise OutputError(f"cannot write {path}; is there space, and may this user write there?")


def side_by_side(*columns: Image) -> Image:
    """Pictures of one height next to each other, a thin white line between."""
    height = columns[0].shape[0]
    parts: list[Image] = []
    for column in columns:
        parts += [np.full((height, 4, 3), 255, np.uint8), _at_height(column, height)]
    return np.concatenate(parts[1:], axis=1)


def strip(rows: Sequence[Sequence[Image]]) -> Image:
    """Rows of pictures under each other; every row has as many."""
    joined = [side_by_side(*row) for row in rows]
    width = joined[0].shape[1]
    line = np.full((4, width, 3), 255, np.uint8)
    parts: list[Image] = []
    for row in joined:
        parts += [line, row]
    return np.concatenate(parts[1:], axis=0)


def scaled(image: Image, width: int) -> Image:
    """A smaller copy, of that width and the same shape."""
    size = (width, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def spread(count: int, wanted: int) -> list[int]:
    """Up to `wanted` indices from 0 to count-1, first and last included, evenly spread."""
    wanted = min(wanted, count)
    return [math.floor(i * (count - 1) / max(wanted - 1, 1) + 0.5) for i in range(wanted)]


def heat(values: NDArray[np.float32], top: float) -> Image:
    """A map of numbers as a picture, [H, W] -> [H, W, 3]; black is 0, bright is `top`."""
    grey = np.rint(values / top * 255.0).clip(0, 255).astype(np.uint8)
    return np.asarray(cv2.cvtColor(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB), np.uint8)


def write_frames(folder: Path, frames: Iterable[Image]) -> int:
    """Write frames as 0000.png, 0001.png, ...; gives how many. Raises OutputError."""
    count = 0
    for count, frame in enumerate(frames, start=1):
        write_png(folder / f"{count - 1:04d}.png", frame)
    return count


def _at_height(image: Image, height: int) -> Image:
    if image.shape[0] == height:
        return image
    width = round(image.shape[1] * height / image.shape[0])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
