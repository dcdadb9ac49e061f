"""Recordings: video files, folders of pictures, and a moving pattern in place of one; single still pictures."""

import contextlib
import io
import logging
import math
import re
import struct
import threading
import time
from collections.abc import Generator, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, Literal, TypeAlias

import cv2
import imagesize
import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import SourceError
from gcd_node.frame import MAX_FPS, MAX_PIXELS, Frame, Image, SourceInfo
from gcd_node.sources.opencv import codec_name, silence_opencv, to_rgb

_LOG = logging.getLogger(__name__)

Pace: TypeAlias = Literal["realtime", "lockstep"]
"""realtime: every frame at its time. lockstep: every frame as soon as it is wanted."""

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")
"""File names that count as pictures; case does not matter."""

_LOWEST_FPS = 0.1
_LONGEST_STEP_NS = 10_000_000_000
_SEAM_NS, _SEAM_PERIODS = 60_000_000_000, 30  # more than a window and any hole: a looped recording's next pass is new
_COMPLETE = 0.9  # of the frames that a container promises
_NO_VIDEO = ("ansi", None)  # FFmpeg plays a text as pictures of its letters
_MAX_BYTES = 2**29  # of a picture's file
_COLOURS = ((200, 60, 40), (60, 160, 60), (40, 80, 200), (220, 220, 210))

_LAYOUTS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "nv12": (1, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (1, cv2.COLOR_YUV2RGB_NV21),
}
"""Bytes a pixel, and OpenCV's way from there to RGB; None: it is RGB."""


class Recording:
    """What recordings have in common as FrameSources: their pace, their end, and that they may begin again.

    A subclass sets `info` and gives the frames of one pass; when it is looped, stamps and numbers keep rising. Where it
    begins again the stamps leap by a minute or more, so that the next pass is another epoch: the camera has jumped.
    """

    info: SourceInfo
    corrupt = 0

    def __init__(self, name: str, *, pace: Pace, loop: bool) -> None:
        """name: for messages."""
        self._name, self._realtime, self._loop = name, pace == "realtime", loop
        self._stopped = threading.Event()

    def frames(self) -> Iterator[Frame]:
        """Every frame, from the first; late ones at once, without its holes of more than 10 s. See FrameSource.frames.

        Raises:
            SourceError: the recording is damaged or gone.
        """
        period_ns = round(1e9 / self.info.fps_nominal)
        seam_ns, longest_ns = max(_SEAM_NS, _SEAM_PERIODS * period_ns), max(_LONGEST_STEP_NS, 2 * period_ns)
        due_ns, newest = time.monotonic_ns(), None
        while not self._stopped.is_set():
            begin_ns = begin_seq = None  # of this pass
            for frame in self._one_pass():
                if begin_ns is None or begin_seq is None:
                    begin_ns = 0 if newest is None else newest.stamp_ns + seam_ns - frame.stamp_ns
                    begin_seq = 0 if newest is None else newest.seq + 1 - frame.seq
                frame = replace(frame, stamp_ns=frame.stamp_ns + begin_ns, seq=frame.seq + begin_seq)
                step_ns = 0 if newest is None else frame.stamp_ns - newest.stamp_ns
                due_ns += step_ns if 0 <= step_ns <= longest_ns else period_ns
                newest = frame
                if self._realtime and (left_ns := due_ns - time.monotonic_ns()) > 0:
                    self._stopped.wait(left_ns / 1e9)
                if self._stopped.is_set():
                    return
                yield frame
            if begin_ns is None and not self._stopped.is_set():
                raise SourceError(f"{self._name} gives no pictures any more; was it replaced while it was playing?")
            if not self._loop:
                return

    def close(self) -> None:
        """End `frames` soon, from any thread."""
        self._stopped.set()

    def _one_pass(self) -> Iterator[Frame]:
        raise NotImplementedError


class VideoFile(Recording):
    """A video file as a FrameSource. Stamps are the container's, else counted at the frame rate."""

    def __init__(self, path: Path, *, pace: Pace = "lockstep", loop: bool = False, fps: float | None = None) -> None:
        """Open a video and decode its first frame.

        Args:
            path: mp4, mkv, avi, webm, mov, raw streams; any size, any rate.
            fps: count stamps at this rate, and ignore the container's.
        Raises:
            SourceError: missing, empty, a folder, no video, truncated, or no frame of it can be decoded.
        """
        super().__init__(str(path), pace=pace, loop=loop)
        self._path, self._stated_fps = path.absolute(), fps
        with open_video(self._path) as capture:
            first, codec = capture.read()[1], codec_name(capture.get(cv2.CAP_PROP_FOURCC))
            stated = capture.get(cv2.CAP_PROP_FPS)
        if first is None:  # pyright: ignore[reportUnnecessaryComparison] - the stub hides it
            raise SourceError(
                f"{path} opens, but no frame of it can be decoded: codec {codec} is damaged or unknown to this "
                "OpenCV; convert it: ffmpeg -i INPUT -c:v libx264 OUTPUT.mp4"
            )
        if fps is None and not _LOWEST_FPS <= stated <= MAX_FPS:
            raise SourceError(f"{path} states no frame rate; give fps in [source]")
        self.info = SourceInfo(
            kind="file",
            id=self._path.name,
            width=first.shape[1],
            height=first.shape[0],
            fps_nominal=fps or stated,
            clock="replay",
            codec=codec,
        )

    def _one_pass(self) -> Iterator[Frame]:
        stamp_ns, seq, fps = None, -1, self.info.fps_nominal
        with open_video(self._path) as capture:
            while not self._stopped.is_set() and (read := capture.read())[0]:
                seq += 1
                if self._stated_fps is None:
                    stamp_ns = rising_stamp_ns(capture.get(cv2.CAP_PROP_POS_MSEC), stamp_ns, round(1e9 / fps))
                else:
                    stamp_ns = round(seq * 1e9 / fps)
                yield Frame(image=to_rgb(read[1]), stamp_ns=stamp_ns, seq=seq)
            promised = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        if not self._stopped.is_set() and seq + 1 < _COMPLETE * promised < 1e8:  # more is nonsense
            _LOG.warning("%s ended after %d of %d frames: it may be truncated", self._path, seq + 1, promised)


def rising_stamp_ns(position_ms: float, newest_ns: int | None, period_ns: int) -> int:
    """The container's stamp of a frame where it can be, else counted at the frame rate.

    A raw stream states 0 for every frame; a broken file may step back, or leap.
    """
    stated_ns = round(position_ms * 1e6) if math.isfinite(position_ms) else -1
    longest_ns = max(_LONGEST_STEP_NS, 2 * period_ns)
    if newest_ns is None:
        return stated_ns if 0 <= stated_ns <= longest_ns else 0
    return stated_ns if 0 < stated_ns - newest_ns <= longest_ns else newest_ns + period_ns


@contextlib.contextmanager
def open_video(path: Path) -> Generator[cv2.VideoCapture]:
    """FFmpeg on one file, quiet on stderr. Raises SourceError."""
    silence_opencv()
    is_video = path.is_file() and path.suffix.lower() not in PICTURES
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG) if is_video else cv2.VideoCapture()
    try:
        if not capture.isOpened() or codec_name(capture.get(cv2.CAP_PROP_FOURCC)) in _NO_VIDEO:
            found = "there is none" if not path.exists() else "it is a folder" if path.is_dir() else "no codec knows it"
            raise SourceError(
                f"cannot open the video {path}: {found}; give one that is whole (a folder of pictures, and a log, are "
                "sources of another kind)"
            )
        width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if width * height > MAX_PIXELS:
            raise SourceError(f"{path} states {width:g} x {height:g} pixels, over {MAX_PIXELS}; make it smaller first")
        yield capture
    finally:
        capture.release()


class ImageFolder(Recording):
    """A folder of pictures as a FrameSource, in natural order of their names: 2.png before 10.png."""

    def __init__(self, path: Path, *, fps: float, pace: Pace = "lockstep", loop: bool = False) -> None:
        """List the pictures and decode the first.

        Args:
            path: the folder. Other files in it, and hidden ones, are passed over.
            fps: the rate the pictures were taken at.
        Raises:
            SourceError: no folder, no pictures in it, or the first is damaged or too large.
        """
        super().__init__(str(path), pace=pace, loop=loop)
        self._pictures = list_pictures(path)
        height, width = read_picture(self._pictures[0]).shape[:2]
        self.info = SourceInfo(
            kind="folder",
            id=path.resolve().name,
            width=width,
            height=height,
            fps_nominal=fps,
            clock="replay",
            codec=self._pictures[0].suffix[1:].lower(),
        )

    def _one_pass(self) -> Iterator[Frame]:
        size = self.info.width, self.info.height
        for seq, path in enumerate(self._pictures):
            frame = Frame(image=read_picture(path), stamp_ns=round(seq * 1e9 / self.info.fps_nominal), seq=seq)
            if frame.size != size:
                raise SourceError(
                    f"{path} is {frame.size[0]} x {frame.size[1]}, the pictures before it are {size[0]} x {size[1]}; "
                    "a folder must hold pictures of one size"
                )
            yield frame


def list_pictures(folder: Path) -> list[Path]:
    """The pictures of a folder in natural order of their names.

    Raises:
        SourceError: no such folder, or no picture in it.
    """
    try:
        found = [path for path in folder.iterdir() if path.suffix.lower() in PICTURES and path.name[0] != "."]
    except OSError as error:
        raise SourceError(f"cannot list {folder}: {error.strerror}; give a folder of pictures") from error
    if not found:
        raise SourceError(f"{folder} holds no pictures; wanted are {', '.join(PICTURES)}")
    return sorted(found, key=_natural)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key: runs of digits count as numbers."""
    return [(int(run), "") if run.isdigit() else (-1, run) for run in re.findall(r"[0-9]+|[^0-9]+", path.name.lower())]


def read_picture(path: Path) -> Image:
    """One still picture, u8 [H, W, 3] RGB; turned as its metadata says, transparency dropped.

    Raises:
        SourceError: missing, damaged, of no known kind, or more than MAX_PIXELS.
    """
    return to_rgb(_read(path, cv2.IMREAD_COLOR))


def read_depth(path: Path) -> NDArray[np.uint16]:
    """One depth picture, u16 [H, W] millimetres. Raises SourceError as read_picture(), and for another type."""
    picture = _read(path, cv2.IMREAD_UNCHANGED)
    if picture.dtype != np.uint16 or picture.ndim != 2:
        found = f"{picture.dtype} {list(picture.shape)}"
        raise SourceError(f"{path} must hold millimetres in one channel of 16 bits, got {found}; write uint16 PNG")
    return np.asarray(picture, np.uint16)


def _read(path: Path, flags: int) -> NDArray[Any]:
    """A picture as OpenCV decodes it."""
    try:
        if not path.is_file():
            raise SourceError("is missing, or no regular file")
        if path.stat().st_size > _MAX_BYTES:
            raise SourceError(f"has more than {_MAX_BYTES} bytes")
        return decode_picture(path.read_bytes(), flags)
    except (OSError, SourceError) as error:
        raise SourceError(f"{path} {error}; remove or replace it") from error


def decode_picture(coded: bytes, flags: int) -> NDArray[Any]:
    """A picture as OpenCV decodes it. Its header is looked at before: a few bytes may state a huge picture.

    Raises:
        SourceError: damaged, of no known kind, or more than MAX_PIXELS; to be read after its name.
    """
    picture = None
    with contextlib.suppress(cv2.error, ValueError, struct.error, SyntaxError):
        width, height = imagesize.get(io.BytesIO(coded), exif_rotation=False)
        if width * height > MAX_PIXELS:
            raise SourceError(f"states {width} x {height} pixels, more than {MAX_PIXELS}")
        picture = cv2.imdecode(np.frombuffer(coded, np.uint8), flags) if min(width, height) > 0 else None
    if picture is None:
        raise SourceError(f"cannot be decoded: damaged, or no {', '.join(PICTURES)}")
    return picture


def raw_picture(fields: Any) -> Image:
    """A picture without a coder, as messages of ROS and Foxglove hold it. Raises SourceError."""
    if fields.encoding not in _LAYOUTS:
        known = ", ".join(_LAYOUTS)
        raise SourceError(f"pictures in {str(fields.encoding)[:40]!r} are not read; known are {known}")
    width, (channels, code) = fields.width, _LAYOUTS[fields.encoding]
    rows = fields.height * 3 // 2 if fields.encoding in ("nv12", "nv21") else fields.height  # then half as much colour
    pixels = np.ascontiguousarray(raw_rows(fields, channels, rows).reshape(rows, width, channels))
    return np.asarray(pixels if code is None else cv2.cvtColor(pixels, code), np.uint8)


def raw_rows(fields: Any, pixel_bytes: int, rows: int) -> NDArray[np.uint8]:
    """[rows, bytes], without the padding of each row."""
    used, step = fields.width * pixel_bytes, fields.step
    fits = fields.width > 0 and fields.height > 0 and fields.width * fields.height <= MAX_PIXELS
    if not fits or not used <= step or step * rows > len(fields.data):
        raise SourceError(
            f"a {fields.width} x {fields.height} picture in {fields.encoding} has rows of {step} bytes and "
            f"{len(fields.data)} in all, wanted are {used} and {used * rows} or more: it is damaged"
        )
    return np.frombuffer(fields.data, np.uint8, count=step * rows).reshape(rows, step)[:, :used]


class MovingPattern(Recording):
    """Eight coloured stripes that move to the left, brighter below; endless unless `frames` is given. For trying the
    plumbing without a camera or a file."""

    def __init__(
        self,
        *,
        fps: float = 10.0,
        frames: int | None = None,
        pace: Pace = "lockstep",
        loop: bool = False,
        size: tuple[int, int] = (640, 480),
    ) -> None:
        """size: width and height. Raises SourceError for an impossible rate."""
        super().__init__("a moving pattern", pace=pace, loop=loop)
        self._frames, (width, height) = frames, size
        self.info = SourceInfo(
            kind="synthetic", id="pattern", width=width, height=height, fps_nominal=fps, clock="replay", hfov_deg=85.0
        )
        stripes = np.array(_COLOURS)[np.arange(width) * 8 // width % len(_COLOURS)]
        self._pattern = (stripes * np.linspace(0.4, 1.0, height)[:, None, None]).astype(np.uint8)

    def _one_pass(self) -> Iterator[Frame]:
        for seq in count() if self._frames is None else range(self._frames):
            image = np.roll(self._pattern, -(seq * self.info.width // 128), axis=1)
            yield Frame(image=image, stamp_ns=round(seq * 1e9 / self.info.fps_nominal), seq=seq)
