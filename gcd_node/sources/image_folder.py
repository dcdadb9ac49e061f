"""A folder of pictures as a recording, and single still pictures."""

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import imagesize
import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import SourceError
from gcd_node.frame import MAX_FPS, MAX_PIXELS, Frame, Image, SourceInfo
from gcd_node.sources.pace import Pace, Pacer

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")
"""File names that count as pictures; case does not matter."""

_MAX_BYTES = 2**29


class ImageFolder:
    """A folder of pictures as a FrameSource, in natural order of their names: 2.png before 10.png."""

    def __init__(self, path: Path, *, fps: float, pace: Pace = "lockstep", loop: bool = False) -> None:
        """Look at every picture's header and decode the first.

        Args:
            path: the folder. Other files in it, and hidden ones, are passed over.
            fps: the rate the pictures were taken at.
            pace: "realtime" yields every frame at its time, "lockstep" as soon as it is asked for.
            loop: begin again at the end; stamps and sequence numbers keep rising.
        Raises:
            SourceError: no folder, no pictures in it, one is damaged, too large or of another size than the first.
        """
        if not 0 < fps <= MAX_FPS:
            raise SourceError(f"fps of an image folder must lie between 0 and {MAX_FPS:g}, got {fps:g}")
        self._path = path
        self._fps = fps
        self._pacer = Pacer(pace)
        self._loop = loop
        self._pictures = list_pictures(path)
        _check_alike(self._pictures)
        height, width = read_picture(self._pictures[0]).shape[:2]
        self._info = SourceInfo(
            kind="folder",
            id=path.resolve().name,
            width=width,
            height=height,
            fps_nominal=fps,
            clock="replay",
            codec=self._pictures[0].suffix[1:].lower(),
        )

    @property
    def corrupt(self) -> int:
        """Always 0: a damaged picture ends the recording with an error."""
        return 0

    @property
    def info(self) -> SourceInfo:
        """Size of the first picture as shown, the given rate."""
        return self._info

    def frames(self) -> Iterator[Frame]:
        """Every picture, from the first. See FrameSource.frames. Raises SourceError for a damaged one."""
        offset_ns = self._pacer.start(0)
        for seq, path in enumerate(self._paths()):
            stamp_ns = round(seq * 1e9 / self._fps)
            image = read_picture(path)
            if not self._pacer.wait(stamp_ns, offset_ns):
                return
            frame = Frame(image=image, stamp_ns=stamp_ns, seq=seq)
            if frame.size != (self._info.width, self._info.height):
                raise _unlike(path, frame.size, (self._info.width, self._info.height))
            yield frame

    def close(self) -> None:
        """End `frames` soon, from any thread."""
        self._pacer.stop()

    def _paths(self) -> Iterator[Path]:
        while not self._pacer.stopped:
            yield from self._pictures
            if not self._loop:
                return


def list_pictures(folder: Path) -> list[Path]:
    """The pictures of a folder in natural order of their names.

    Raises:
        SourceError: no such folder, or no picture in it.
    """
    if not folder.is_dir():
        raise SourceError(f"{folder} is {'not a folder' if folder.exists() else 'missing'}; give a folder of pictures")
    try:
        names = [path for path in folder.iterdir() if path.suffix.lower() in PICTURES and path.name[0] != "."]
    except OSError as error:
        raise SourceError(f"cannot list {folder}: {error.strerror}; check its permissions") from error
    if not names:
        raise SourceError(f"{folder} holds no pictures; wanted are {', '.join(PICTURES)}")
    return sorted(names, key=_natural)


def read_picture(path: Path) -> Image:
    """One still picture, u8 [H, W, 3] RGB; turned as its metadata says, transparency dropped.

    Raises:
        SourceError: missing, damaged, of no known kind, or more than MAX_PIXELS.
    """
    _checked_size(path)
    try:
        picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    except (cv2.error, OSError) as error:
        raise _damaged(path) from error
    if picture is None:
        raise _damaged(path)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)


def read_depth(path: Path) -> NDArray[np.uint16]:
    """One depth picture, u16 [H, W] millimetres. Raises SourceError as read_picture(), and for another type."""
    _checked_size(path)
    try:
        picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, OSError) as error:
        raise _damaged(path) from error
    if picture is None:
        raise _damaged(path)
    if picture.dtype != np.uint16 or picture.ndim != 2:
        found = f"{picture.dtype} {list(picture.shape)}"
        raise SourceError(f"{path} must hold millimetres in one channel of 16 bits, got {found}; write uint16 PNG")
    return np.asarray(picture, np.uint16)


def _checked_size(path: Path) -> tuple[int, int]:
    """Width and height as stored, before the picture is decoded: a small file may state a huge one."""
    if path.exists() and not path.is_file():
        raise SourceError(f"{path} is not a regular file; give a picture")
    try:
        with path.open("rb") as file:
            width, height = imagesize.get(file, exif_rotation=False)
    except OSError as error:
        raise SourceError(f"cannot read the picture {path}: {error.strerror}; check the path") from error
    if width < 1 or height < 1:
        raise _damaged(path)
    if width * height > MAX_PIXELS or path.stat().st_size > _MAX_BYTES:
        raise SourceError(
            f"{path} states {width} x {height} pixels; make it smaller first: at most {MAX_PIXELS} of them in "
            f"{_MAX_BYTES} bytes"
        )
    return width, height


def _check_alike(pictures: list[Path]) -> None:
    """Sides are compared in any order: metadata may turn a picture."""
    first = _checked_size(pictures[0])
    for path in pictures[1:]:
        if set(size := _checked_size(path)) != set(first):
            raise _unlike(path, size, first)


def _unlike(path: Path, size: tuple[int, int], wanted: tuple[int, int]) -> SourceError:
    return SourceError(
        f"{path} is {size[0]} x {size[1]}, the pictures before it are {wanted[0]} x {wanted[1]}; "
        "a folder must hold pictures of one size"
    )


def _damaged(path: Path) -> SourceError:
    return SourceError(f"{path} cannot be decoded: damaged, or no {', '.join(PICTURES)}; remove or replace it")


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key: runs of digits count as numbers."""
    return [(int(run), "") if run.isdigit() else (-1, run) for run in re.findall(r"[0-9]+|[^0-9]+", path.name.lower())]
