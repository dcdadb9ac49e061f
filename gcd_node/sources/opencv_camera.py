"""What cameras that OpenCV reads have in common: a cv2.VideoCapture as a Driver, and OpenCV kept quiet.

OpenCV's and FFmpeg's own messages are no use to a user, and may hold an address with a password in it.
"""

import os
import threading
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from typing import Any, Protocol

import cv2
import numpy as np
from cv2.utils import logging as cv2_logging

from gcd_node.errors import SourceLostError
from gcd_node.frame import Frame, Image, SourceInfo
from gcd_node.source_config import SourceKind
from gcd_node.sources.live_camera import sane_fps

_LOCK = threading.Lock()
_LEVELS: list[int] = []  # one for every block that is being kept quiet; the first is the level to go back to


class Capture(Protocol):
    """What is used of cv2.VideoCapture, as OpenCV documents it."""

    def isOpened(self) -> bool: ...  # noqa: N802
    def get(self, prop: int, /) -> float: ...
    def set(self, prop: int, value: float, /) -> bool: ...
    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, Any]: ...
    def release(self) -> None: ...


class OpenCvDriver:
    """A cv2.VideoCapture as a Driver; each kind says how it is opened and what its stamps are.

    name, hint: of messages, see LiveCamera. Sequence numbers count what the camera gives.
    """

    kind: SourceKind
    name: str
    hint: str
    id: str

    def __init__(self, open_capture: Callable[[], Capture]) -> None:
        """Raises SourceError as `check`."""
        self.corrupt, self._seq = 0, -1
        with ExitStack() as stack:
            stack.enter_context(quiet_opencv())
            self.capture = open_capture()
            stack.callback(self.capture.release)
            self.check()
            self._open = stack.pop_all()

    def check(self) -> None:
        """Look at what was just opened, and set it up. Raises SourceError."""

    def grab(self) -> int | None:
        """Wait for the next picture. When it was taken, monotonic nanoseconds; None if the camera gives no more."""
        raise NotImplementedError

    def uncertainty_us(self, fps: float) -> int:
        """How far a stamp may be from mid-exposure."""
        raise NotImplementedError

    @property
    def fps(self) -> float | None:
        """See Driver."""
        return sane_fps(self.capture.get(cv2.CAP_PROP_FPS))

    def read(self) -> Frame | None:
        """See Driver."""
        try:
            stamp_ns = self.grab()
            if stamp_ns is None:
                raise SourceLostError(f"{self.name} gives no more pictures; {self.hint}")
            self._seq += 1
            picture = retrieve_picture(self.capture)
            self.corrupt += picture is None
            rgb = None if picture is None else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)
        except cv2.error as error:
            raise SourceLostError(f"{self.name} fails ({error.err}); {self.hint}") from error
        return None if rgb is None else Frame(image=rgb, stamp_ns=stamp_ns, seq=self._seq)

    def describe(self, first: Frame, fps: float) -> SourceInfo:
        """See Driver."""
        return SourceInfo(
            kind=self.kind,
            id=self.id,
            width=first.size[0],
            height=first.size[1],
            fps_nominal=fps,
            clock="realtime",
            codec=codec_name(self.capture.get(cv2.CAP_PROP_FOURCC)),
            stamp_uncertainty_us=self.uncertainty_us(fps),
        )

    def close(self) -> None:
        """See Driver."""
        self._open.close()


def codec_name(code: float) -> str | None:
    """The four characters of a CAP_PROP_FOURCC, None if they are none."""
    text = (int(code) & 0xFFFFFFFF).to_bytes(4, "little").rstrip(b"\0 ").decode("ascii", "replace")
    return text if text and text.isprintable() and text.isascii() else None


def retrieve_picture(capture: Capture) -> Image | None:
    """What `capture` grabbed last, u8 [H, W, 3] BGR; None if it cannot be decoded."""
    try:
        good, picture = capture.retrieve()
    except cv2.error:
        return None
    if not good or picture is None or picture.size == 0:
        return None
    if picture.ndim == 2:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    return np.asarray(picture, np.uint8) if picture.dtype == np.uint8 and picture.shape[2] == 3 else None


@contextmanager
def quiet_opencv() -> Generator[None]:
    """Silence for the length of a block; blocks of several threads may overlap."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first video is opened
    with _LOCK:
        _LEVELS.append(_LEVELS[0] if _LEVELS else cv2_logging.getLogLevel())
        cv2_logging.setLogLevel(cv2_logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        with _LOCK:
            level = _LEVELS.pop()
            if not _LEVELS:
                cv2_logging.setLogLevel(level)
