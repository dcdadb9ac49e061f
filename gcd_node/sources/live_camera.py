"""Live cameras: the thread that reads one, and its latest pictures. What differs from kind to kind is a driver.

A driver may never return from a call. So it belongs to a daemon thread, and closing leaves that thread behind if it
does not end by itself; it lets the camera go as soon as its call returns.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from statistics import median
from typing import Protocol

from gcd_node.errors import SourceAbsentError, SourceError, SourceLostError
from gcd_node.frame import Frame, SourceInfo

_LOG = logging.getLogger(__name__)
_LOWEST_FPS, _HIGHEST_FPS = 1.0, 500.0
_MEASURED_STEPS = 8
_WAITING = 4  # frames; with less, a reader that is late once leaves a hole in its window
_LEAVE_AFTER_S = 0.5


class Driver(Protocol):
    """A camera while it is open; one thread alone uses it."""

    @property
    def fps(self) -> float | None:
        """The rate it states, None if it has to be measured. Of interest once the first picture was read."""
        ...

    @property
    def corrupt(self) -> int:
        """Pictures so far that arrived damaged."""
        ...

    def read(self) -> Frame | None:
        """Wait for the next picture, or a moment; None: none came, or a damaged one. Raises SourceLostError."""
        ...

    def describe(self, first: Frame, fps: float) -> SourceInfo:
        """What is known of the camera once it has given its first picture."""
        ...

    def close(self) -> None:
        """Let the camera go."""
        ...


class LiveCamera:
    """One opening of a camera, as a FrameSource. Its latest pictures wait to be taken."""

    info: SourceInfo
    """Size of the first picture, rate as stated or, where that is nonsense, as measured."""
    skipped = 0
    """Pictures replaced by newer ones before they were taken."""

    def __init__(
        self,
        name: str,
        open_driver: Callable[[], Driver],
        *,
        open_timeout_s: float,
        hint: str,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        """Open a camera and wait for its first picture.

        Args:
            name: for messages; holds no password. hint: what to do if it does not answer.
            open_driver: opens it; raises SourceError. May take for ever.
            open_timeout_s: until the first picture.
            on_end: called in the camera's own thread once the driver has let go, or could not be opened.
        Raises:
            SourceAbsentError: no such camera, or no picture in time. SourceError: it is there, but cannot be used.
        """
        self._name, self._hint, self._open_driver, self._on_end = name, hint, open_driver, on_end
        self._driver: Driver | None = None
        self._changed = threading.Condition()
        self._waiting: deque[Frame] = deque(maxlen=_WAITING)
        self._over = self._closed = False
        self._error: Exception | None = None
        self._described: SourceInfo | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()
        self.info = self._await_first(open_timeout_s)

    @property
    def corrupt(self) -> int:
        """Pictures so far that arrived damaged."""
        return 0 if self._driver is None else self._driver.corrupt

    def frames(self) -> Iterator[Frame]:
        """See FrameSource.frames. Raises SourceLostError if the camera is gone."""
        while (frame := self.take()) is not None:
            yield frame

    def take(self, timeout_s: float | None = None) -> Frame | None:
        """The oldest picture that waits, once; None: none came in time, or the camera was closed here.

        Raises: SourceLostError, every time: it is gone, and the last picture was taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._over or self._closed, timeout_s)
            if self._closed or not (self._waiting or self._over):
                return None
            if self._waiting:
                return self._waiting.popleft()
        raise self._error or SourceLostError(f"{self._name} has ended")

    def close(self) -> None:
        """End `frames`, from any thread. Waits shortly until the camera is free; then leaves it to its thread."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_LEAVE_AFTER_S)
        if self._thread.is_alive():
            _LOG.warning("%s does not let go; its thread is left behind", self._name)

    def _await_first(self, timeout_s: float) -> SourceInfo:
        with self._changed:
            self._changed.wait_for(lambda: self._described is not None or self._over, timeout_s)
            if self._described is not None:
                return self._described
            self._closed = True
        if not self._over:
            damaged = f" ({self.corrupt} damaged ones)" if self.corrupt else ""
            raise SourceAbsentError(f"{self._name} gave no picture within {timeout_s:g} s{damaged}; {self._hint}")
        if isinstance(self._error, SourceLostError):
            raise SourceAbsentError(f"{self._name} opens, but gives no picture: {self._error}") from self._error
        raise self._error or SourceAbsentError(f"{self._name} gave no picture; {self._hint}")

    # The camera's own thread.

    def _run(self) -> None:
        try:
            driver = self._driver = self._open_driver()
            try:
                self._read(driver)
            finally:
                driver.close()
        except Exception as error:  # the end of a thread: whoever opens, or takes frames, gets it
            self._error = error
        finally:
            self._on_end()
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _read(self, driver: Driver) -> None:
        frame = self._next(driver)
        if frame is None:
            return
        fps = driver.fps
        if fps is None:
            frame, fps = self._measured(driver, frame)
        self._described = driver.describe(frame, fps)
        while frame is not None:
            with self._changed:
                self.skipped += len(self._waiting) == _WAITING
                self._waiting.append(frame)
                self._changed.notify_all()
            frame = self._next(driver)

    def _next(self, driver: Driver) -> Frame | None:
        """The next sound picture; None once the camera was closed here."""
        while not self._closed:
            frame = driver.read()
            if frame is not None:
                return frame
        return None

    def _measured(self, driver: Driver, newest: Frame) -> tuple[Frame, float]:
        """The newest picture after a few, and the rate they came at."""
        steps_ns: list[int] = []
        while len(steps_ns) < _MEASURED_STEPS and (frame := self._next(driver)) is not None:
            steps_ns.append((frame.stamp_ns - newest.stamp_ns) // max(frame.seq - newest.seq, 1))
            newest = frame
        fps = sane_fps(1e9 / max(median(steps_ns or [0]), 1))
        if fps is None:
            raise SourceError(
                f"{self._name} states no frame rate, and its pictures come at no steady one; give fps in [source]"
            )
        return newest, fps


def sane_fps(stated: float) -> float | None:
    """A frame rate that a camera may have, else None: drivers state 0, streams 90000."""
    return stated if _LOWEST_FPS <= stated <= _HIGHEST_FPS else None
