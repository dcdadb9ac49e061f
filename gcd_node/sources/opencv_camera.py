"""Live cameras through OpenCV: the thread that reads one, and the slot that holds its newest picture.

A decoder may never return from a read. So it belongs to a daemon thread, and closing leaves that thread behind if it
does not end by itself; it lets the camera go as soon as its read returns.
"""

import logging
import queue
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any, Protocol

import cv2
import numpy as np

from gcd_node.capture import Newest
from gcd_node.config import SourceKind
from gcd_node.errors import SourceAbsentError, SourceError, SourceLostError
from gcd_node.frame import Frame, Image, SourceInfo
from gcd_node.sources.opencv_log import quiet_opencv

_LOG = logging.getLogger(__name__)
_LOWEST_FPS, _HIGHEST_FPS = 1.0, 500.0
_MEASURED_STEPS = 8
_LEAVE_AFTER_S = 0.5


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraTraits:
    """What an open camera says of itself.

    fps: the rate it states, None if that cannot be. codec: four characters, None if unknown.
    stamp_uncertainty_us: how far a stamp may be from mid-exposure.
    """

    fps: float | None
    codec: str | None
    stamp_uncertainty_us: int


class Capture(Protocol):
    """What is used of cv2.VideoCapture, as OpenCV documents it."""

    def isOpened(self) -> bool: ...  # noqa: N802
    def get(self, prop: int, /) -> float: ...
    def set(self, prop: int, value: float, /) -> bool: ...
    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, Any]: ...
    def release(self) -> None: ...


class Connection(Protocol):
    """A camera while it is open; one thread alone uses it."""

    def grab(self) -> int | None:
        """Wait for the next picture. When it was taken, monotonic nanoseconds; None if the camera gives no more."""
        ...

    def retrieve(self) -> Image | None:
        """The picture grabbed last, u8 [H, W, 3] in OpenCV's order BGR; None if it arrived damaged."""
        ...

    def traits(self) -> CameraTraits:
        """What is known once the first picture was grabbed."""
        ...

    def release(self) -> None:
        """Let the camera go."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraPort:
    """Where a camera is, and how to reach it.

    kind: as a launch file names it. id: a short name. name: for messages; holds no password.
    connect: opens it; raises SourceError. May take for ever.
    hint: what to do if it does not answer.
    """

    kind: SourceKind
    id: str
    name: str
    hint: str
    connect: Callable[[], Connection]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Grabbed:
    """A picture in BGR, and what goes with it."""

    picture: Image
    stamp_ns: int
    seq: int


class OpenCvCamera:
    """A camera as a FrameSource. Sequence numbers count what it gives, taken by the caller or not."""

    def __init__(self, port: CameraPort, *, open_timeout_s: float = 5.0) -> None:
        """Open the camera and wait for its first picture.

        Args:
            open_timeout_s: how long that may take.
        Raises:
            SourceAbsentError: no such camera, or no picture in time.
            SourceError: it is there, but cannot be used.
        """
        self._port = port
        self._newest: Newest[_Grabbed] = Newest()
        self._answer: queue.SimpleQueue[SourceInfo | Exception] = queue.SimpleQueue()
        self._error: Exception | None = None
        self._corrupt = 0
        self._reader = threading.Thread(target=self._run, name=f"camera {port.id}", daemon=True)
        self._reader.start()
        self._info = self._await_answer(open_timeout_s)

    @property
    def corrupt(self) -> int:
        """Pictures so far that arrived damaged."""
        return self._corrupt

    @property
    def info(self) -> SourceInfo:
        """Size of the first picture, rate as stated or, where that is nonsense, as measured."""
        return self._info

    def frames(self) -> Iterator[Frame]:
        """The newest picture, again and again. See FrameSource.frames. Raises SourceLostError if the camera is gone."""
        while (grabbed := self._newest.take()) is not None:
            rgb = np.asarray(cv2.cvtColor(grabbed.picture, cv2.COLOR_BGR2RGB), np.uint8)
            yield Frame(image=rgb, stamp_ns=grabbed.stamp_ns, seq=grabbed.seq)
        if self._error is not None and not self._newest.closed:
            raise self._error

    def close(self) -> None:
        """End `frames`, from any thread. Waits shortly until the camera is free; then leaves it to its thread."""
        self._newest.close()
        self._reader.join(_LEAVE_AFTER_S)
        if self._reader.is_alive():
            _LOG.info("%s does not return from a read; its thread is left behind", self._port.name)

    def _await_answer(self, timeout_s: float) -> SourceInfo:
        try:
            answer = self._answer.get(timeout=timeout_s)
        except queue.Empty:
            self._newest.close()
            raise SourceAbsentError(
                f"{self._port.name} gave no picture within {timeout_s:g} s; {self._port.hint}"
            ) from None
        if isinstance(answer, SourceLostError):
            raise SourceAbsentError(f"{self._port.name} opens, but gives no picture; {self._port.hint}") from answer
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _run(self) -> None:
        """Reader thread."""
        try:
            with quiet_opencv():
                self._read()
        except Exception as error:  # the end of a thread: whoever opens, or takes frames, gets it
            self._error = self._lost(f"fails ({error.err})") if isinstance(error, cv2.error) else error
            self._answer.put(self._error)
        self._newest.finish()

    def _read(self) -> None:
        connection = self._port.connect()
        try:
            grabbed, fps = self._next(connection, seq=-1), connection.traits().fps
            if fps is None:
                grabbed, fps = self._measure_fps(connection, grabbed)
            self._answer.put(self._describe(grabbed, connection.traits(), fps))
            while self._newest.put(grabbed):
                grabbed = self._next(connection, grabbed.seq)
        finally:
            connection.release()

    def _next(self, connection: Connection, seq: int) -> _Grabbed:
        """The first sound picture after number `seq`."""
        while not self._newest.closed:
            seq += 1
            if (stamp_ns := connection.grab()) is None:
                break
            picture = connection.retrieve()
            if picture is not None:
                return _Grabbed(picture=picture, stamp_ns=stamp_ns, seq=seq)
            self._corrupt += 1
        raise self._lost("gives no more pictures")

    def _lost(self, what: str) -> SourceLostError:
        return SourceLostError(f"{self._port.name} {what}; {self._port.hint}")

    def _measure_fps(self, connection: Connection, newest: _Grabbed) -> tuple[_Grabbed, float]:
        """The newest picture after a few, and the rate they came at."""
        steps_ns: list[int] = []
        for _ in range(_MEASURED_STEPS):
            before, newest = newest, self._next(connection, newest.seq)
            steps_ns.append((newest.stamp_ns - before.stamp_ns) // (newest.seq - before.seq))
        fps = sane_fps(1e9 / max(median(steps_ns), 1))
        if fps is None:
            raise SourceError(
                f"{self._port.name} states no frame rate, and its pictures come at no steady one; give fps in [source]"
            )
        return newest, fps

    def _describe(self, first: _Grabbed, traits: CameraTraits, fps: float) -> SourceInfo:
        height, width = first.picture.shape[:2]
        return SourceInfo(
            kind=self._port.kind,
            id=self._port.id,
            width=width,
            height=height,
            fps_nominal=fps,
            clock="realtime",
            codec=traits.codec,
            stamp_uncertainty_us=traits.stamp_uncertainty_us,
        )


def sane_fps(stated: float) -> float | None:
    """A frame rate that a camera may have, else None: drivers state 0, streams 90000."""
    return stated if _LOWEST_FPS <= stated <= _HIGHEST_FPS else None


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
