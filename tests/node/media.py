"""Small recordings for tests, written with OpenCV; pictures are RGB. And what processes of tests need."""

import os
import sys
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from gcd_node.frame import Frame, Image

WIDTH, HEIGHT = 64, 48
CODECS = {"mp4": "mp4v", "avi": "MJPG", "mkv": "FFV1", "webm": "VP80"}


def environment() -> dict[str, str]:
    """Of a process that finds what this one finds."""
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}


def flat(red: int, green: int, blue: int, width: int = WIDTH, height: int = HEIGHT) -> Image:
    return np.full((height, width, 3), (red, green, blue), np.uint8)


def ramp(count: int, width: int = WIDTH, height: int = HEIGHT) -> list[Image]:
    """Pictures that get brighter, each with the same coarse pattern."""
    pattern = (np.indices((height, width)).sum(axis=0) // 8 % 2 * 40).astype(np.uint8)
    return [np.repeat((pattern + 5 * i)[:, :, None], 3, axis=2) for i in range(count)]


def write_video(path: Path, images: Iterable[Image], fps: float = 10.0, codec: str | None = None) -> Path:
    images = list(images)
    height, width = images[0].shape[:2]
    code = cv2.VideoWriter.fourcc(*(codec or CODECS[path.suffix[1:]]))
    writer = cv2.VideoWriter(str(path), code, fps, (width, height))
    assert writer.isOpened(), f"OpenCV cannot write {path.name}"
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def write_pictures(folder: Path, images: dict[str, Image]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, image in images.items():
        assert cv2.imwrite(str(folder / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return folder


def noise(folder: Path, height: int, width: int) -> Path:
    """Fourteen pictures, enough for a clip."""
    drawn = np.random.default_rng(0).integers(0, 256, (14, height, width, 3), np.uint8)
    return write_pictures(folder, {f"{i:02d}.png": image for i, image in enumerate(drawn)})


def frames_at(stamps_ms: Iterable[float], width: int = 4, height: int = 2) -> list[Frame]:
    """Tiny frames whose pixels hold their sequence number."""
    return [
        Frame(image=np.full((height, width, 3), seq % 256, np.uint8), stamp_ns=round(ms * 1e6), seq=seq)
        for seq, ms in enumerate(stamps_ms)
    ]
