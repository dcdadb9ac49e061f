"""Recorded video: any container, size and rate that OpenCV decodes."""

import logging
import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np

from gcd_node.errors import SourceError
from gcd_node.frame import MAX_FPS, MAX_PIXELS, Frame, Image, SourceInfo
from gcd_node.sources.image_folder import PICTURES
from gcd_node.sources.opencv_camera import codec_name, quiet_opencv
from gcd_node.sources.pace import Pace, Pacer

_LOG = logging.getLogger(__name__)
_LOWEST_FPS = 0.1
_LONGEST_STEP_S = 10.0
_COMPLETE = 0.9
_LOGS = (".mcap", ".db3", ".bag")
_NO_VIDEO = ("ansi", "unknown")  # FFmpeg plays a text as pictures of its letters


class VideoFile:
    """A video file as a FrameSource. Stamps are the container's, else counted at the frame rate."""

    def __init__(self, path: Path, *, pace: Pace = "lockstep", loop: bool = False, fps: float | None = None) -> None:
        """Open a video and decode its first frame.

        Args:
            path: mp4, mkv, avi, webm, mov, raw streams; any size, any rate.
            pace: "realtime" yields every frame at its time, "lockstep" as soon as it is asked for.
            loop: begin again at the end; stamps and sequence numbers keep rising.
            fps: count stamps at this rate, and ignore the container's.
        Raises:
            SourceError: missing, empty, a folder, no video, truncated, or no frame of it can be decoded.
        """
        _check_file(path)
        self._path = path.resolve()
        self._pacer = Pacer(pace)
        self._loop = loop
        self._stated_fps = fps
        if fps is not None and not 0 < fps <= MAX_FPS:
            raise SourceError(f"fps of a video must lie between 0 and {MAX_FPS:g}, got {fps:g}")
        with closing(_Decoder(self._path)) as decoder:
            self._info = _describe(self._path, decoder, fps)

    @property
    def corrupt(self) -> int:
        """Always 0: the decoder passes over what is damaged and tells nobody."""
        return 0

    @property
    def info(self) -> SourceInfo:
        """Size of the first frame as shown (rotated if the file says so), rate, codec."""
        return self._info

    def frames(self) -> Iterator[Frame]:
        """Every frame, from the beginning. See FrameSource.frames. Raises SourceError if the file is gone."""
        offset_ns: int | None = None
        for seq, (image, stamp_ns) in enumerate(self._decoded()):
            offset_ns = self._pacer.start(stamp_ns) if offset_ns is None else offset_ns
            if not self._pacer.wait(stamp_ns, offset_ns):
                return
            yield Frame(image=image, stamp_ns=stamp_ns, seq=seq)

    def close(self) -> None:
        """End `frames` soon, from any thread."""
        self._pacer.stop()

    def _decoded(self) -> Iterator[tuple[Image, int]]:
        begin_ns = 0
        while not self._pacer.stopped:
            stamps = StampTrack(fps=self._info.fps_nominal, counted=self._stated_fps is not None)
            newest_ns: int | None = None
            for image, position_ms in self._one_pass():
                newest_ns = begin_ns + stamps.next(position_ms)
                yield image, newest_ns
            if newest_ns is None:
                raise SourceError(f"{self._path} gives no frames any more; was it replaced while it was playing?")
            if not self._loop:
                return
            begin_ns = newest_ns + stamps.period_ns

    def _one_pass(self) -> Iterator[tuple[Image, float]]:
        count = 0
        with closing(_Decoder(self._path)) as decoder:
            while not self._pacer.stopped and (decoded := decoder.read()) is not None:
                count += 1
                yield decoded
            if not self._pacer.stopped and count < _COMPLETE * decoder.promised_frames:
                _LOG.warning(
                    "%s ended after %d of %d frames: it may be truncated", self._path, count, decoder.promised_frames
                )


class StampTrack:
    """Capture stamps of one pass through a file: the container's where they can be, else counted at the frame rate.

    A raw stream states 0 for every frame; a broken file may step back, or leap. Stamps always rise.
    """

    def __init__(self, *, fps: float, counted: bool = False) -> None:
        self.period_ns = round(1e9 / fps)
        self._counted = counted
        self._fps = fps
        self._index = -1
        self._newest_ns: int | None = None

    def next(self, position_ms: float) -> int:
        """Stamp of the next frame, nanoseconds; position_ms is what the container says."""
        self._index += 1
        if self._counted:
            return round(self._index * 1e9 / self._fps)
        stated_ns = round(position_ms * 1e6) if math.isfinite(position_ms) and position_ms >= 0 else None
        self._newest_ns = self._plausible(stated_ns)
        return self._newest_ns

    def _plausible(self, stated_ns: int | None) -> int:
        if self._newest_ns is None:
            return stated_ns if stated_ns is not None and stated_ns <= _LONGEST_STEP_S * 1e9 else 0
        expected_ns = self._newest_ns + self.period_ns
        if stated_ns is None or not 0 < stated_ns - self._newest_ns <= max(_LONGEST_STEP_S * 1e9, 2 * self.period_ns):
            return expected_ns
        return stated_ns


class _Decoder:
    """OpenCV's FFmpeg reader on one file, quiet on stderr."""

    def __init__(self, path: Path) -> None:
        with quiet_opencv():
            self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened() or self.codec in _NO_VIDEO:
            raise SourceError(f"cannot open {path} as a video: none, truncated or damaged; give a video file")
        self._check_size(path)

    def _check_size(self, path: Path) -> None:
        width, height = self._number(cv2.CAP_PROP_FRAME_WIDTH), self._number(cv2.CAP_PROP_FRAME_HEIGHT)
        if width * height > MAX_PIXELS:
            self.close()
            raise SourceError(
                f"{path} states {width:.0f} x {height:.0f} pixels, more than {MAX_PIXELS}; make it smaller first"
            )

    @property
    def codec(self) -> str:
        """Four characters, as the container names it."""
        return codec_name(self._number(cv2.CAP_PROP_FOURCC)) or "unknown"

    @property
    def fps(self) -> float | None:
        """The stated rate, None if it cannot be."""
        stated = self._number(cv2.CAP_PROP_FPS)
        return stated if _LOWEST_FPS <= stated <= MAX_FPS else None

    @property
    def promised_frames(self) -> int:
        """What the container says it holds, 0 if that is nonsense. Good for a hint, nothing else."""
        count = self._number(cv2.CAP_PROP_FRAME_COUNT)
        return int(count) if 0 < count < 1e8 else 0

    def read(self) -> tuple[Image, float] | None:
        """The next picture, RGB, and the container's position in ms; None at the end."""
        good, picture = self._capture.read()
        if not good:
            return None
        rgb = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)
        return rgb, self._capture.get(cv2.CAP_PROP_POS_MSEC)

    def close(self) -> None:
        """Let the file go."""
        self._capture.release()

    def _number(self, prop: int) -> float:
        value = self._capture.get(prop)
        return value if math.isfinite(value) else 0.0


def _check_file(path: Path) -> None:
    """Raise SourceError for what a decoder cannot be asked to open, or what belongs to another kind of source."""
    if not path.exists():
        raise SourceError(f"no such video: {path}; check the path")
    if path.suffix.lower() in _LOGS or (path / "metadata.yaml").is_file():
        raise SourceError(f'{path} is a log, not a video; say kind = "mcap"')
    if path.is_dir():
        raise SourceError(f'{path} is a folder, not a video; for a folder of pictures say kind = "folder"')
    if not path.is_file():
        raise SourceError(f"{path} is not a regular file; give a video file")
    if path.suffix.lower() in PICTURES:
        raise SourceError(f'{path} is a still picture, not a video; put pictures in a folder and say kind = "folder"')
    if path.stat().st_size == 0:
        raise SourceError(f"{path} is empty (0 bytes); copy or record it again")


def _describe(path: Path, decoder: _Decoder, stated_fps: float | None) -> SourceInfo:
    first = decoder.read()
    if first is None:
        raise SourceError(
            f"{path} opens, but no frame of it can be decoded: codec {decoder.codec} is damaged or unknown to this "
            "OpenCV; convert it: ffmpeg -i INPUT -c:v libx264 OUTPUT.mp4"
        )
    fps = stated_fps or decoder.fps
    if fps is None:
        raise SourceError(f"{path} states no frame rate; give fps in [source]")
    height, width = first[0].shape[:2]
    return SourceInfo(
        kind="file", id=path.name, width=width, height=height, fps_nominal=fps, clock="replay", codec=decoder.codec
    )
