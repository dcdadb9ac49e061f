"""Live cameras: read in a thread of their own, and opened again when they are lost (docs/node.md, F1 to F4).

A `LiveCamera` is one opening of a camera, a `SourceWatch` makes one source of one opening after another; what differs
from kind to kind is a driver. Any call into a driver may take for ever: it belongs to a daemon thread, which is left
behind if it does not end by itself, and lets the camera go as soon as its call returns.
"""

import logging
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from statistics import median
from typing import Protocol, TypeAlias

from gcd_node.errors import SourceAbsentError, SourceError, SourceLostError
from gcd_node.frame import Frame, FrameSource, SourceInfo
from gcd_node.health import SourceState
from gcd_node.sources import LiveSource, SourceConfig, SourceKind
from gcd_node.window import Reason

_LOG = logging.getLogger(__name__)
_LOWEST_FPS, _HIGHEST_FPS = 1.0, 500.0
_MEASURED_STEPS = 8
_WAITING = 4  # frames; with less, a reader that is late once leaves a hole in its window
_STALL_PERIODS, _LEAST_STALL_S, _LOST_S = 3, 0.2, 1.8
_LEAVE_AFTER_S, _LOOK_S = 0.5, 0.02

Opener: TypeAlias = Callable[[SourceInfo], FrameSource]
"""Begins to open again what was open before, at once; raises SourceError if it cannot be."""


class Driver(Protocol):
    """A camera while it is open; one thread alone uses it.

    kind, id: see SourceInfo. corrupt: pictures so far that arrived damaged.
    fps: the rate it states, None if it has to be measured; of interest once the first picture was read.
    """

    kind: SourceKind
    id: str

    @property
    def fps(self) -> float | None: ...
    @property
    def corrupt(self) -> int: ...

    def read(self) -> Frame | None:
        """Wait for the next picture, or a moment; None: none came, or a damaged one. Raises SourceLostError."""
        ...

    def describe(self, info: SourceInfo) -> SourceInfo:
        """With what else is known of the camera once it has given its first picture."""
        ...

    def close(self) -> None:
        """Let the camera go."""
        ...


class LiveCamera:
    """One opening of a camera, as a FrameSource. Its latest pictures wait to be taken."""

    skipped = 0
    """Pictures replaced by newer ones before they were taken, since the first one was: nobody misses those before."""

    def __init__(
        self,
        name: str,
        open_driver: Callable[[], Driver],
        *,
        open_timeout_s: float,
        hint: str,
        alone: "threading.Lock | None" = None,
    ) -> None:
        """Begin to open a camera; its rate will be as stated or, where that is nonsense, as measured.

        Args:
            name: for messages; holds no password. hint: what to do if it does not answer.
            open_driver: opens it, in the camera's own thread; raises SourceError. May take for ever.
            open_timeout_s: until the first picture.
            alone: held while it is open, for a device that two openings would fight for.
        """
        self._name, self._hint, self._open_driver, self._open_timeout_s = name, hint, open_driver, open_timeout_s
        self._alone = alone or threading.Lock()
        self._until_s = time.monotonic() + open_timeout_s
        self._driver: Driver | None = None
        self._changed = threading.Condition()
        self._waiting: deque[Frame] = deque(maxlen=_WAITING)
        self._over = self._closed = self._is_read = False
        self._error: Exception | None = None
        self._described: SourceInfo | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def info(self) -> SourceInfo:
        """What is known of the camera. Waits for its first picture; without one in time it is closed.

        Raises:
            SourceAbsentError: no such camera, or no picture in time. SourceError: it is there, but cannot be used.
        """
        with self._changed:
            while not (self._described or self._over or self._closed or time.monotonic() >= self._until_s):
                self._changed.wait(max(0.0, self._until_s - time.monotonic()))
            if self._described is not None:
                return self._described
            self._closed = True
        if self._error is not None and not isinstance(self._error, SourceLostError):
            raise self._error
        late = f"none within {self._open_timeout_s:g} s, {self.corrupt} damaged; {self._hint}"
        raise SourceAbsentError(f"{self._name} gives no picture: {self._error or late}") from self._error

    @property
    def corrupt(self) -> int:
        """Pictures so far that arrived damaged."""
        return 0 if self._driver is None else self._driver.corrupt

    def frames(self) -> Iterator[Frame]:
        """See FrameSource.frames. Raises SourceLostError if the camera is gone; else as `info`."""
        if self.info:
            while (frame := self.take()) is not None:
                yield frame

    def take(self, timeout_s: float | None = None) -> Frame | None:
        """The oldest picture that waits, once; None: none came in time, or the camera was closed here.

        Raises: SourceLostError, every time: it is gone, and the last picture was taken.
        """
        with self._changed:
            self._is_read = True
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

    # The camera's own thread.

    def _run(self) -> None:
        try:
            if not self._alone.acquire(timeout=self._open_timeout_s):
                raise SourceAbsentError(f"the attempt before is still busy with {self._name}; {self._hint}")
            self._until_s = time.monotonic() + self._open_timeout_s  # its own time, whatever the one before took
            try:
                if not self._closed:
                    with closing(self._open_driver()) as driver:
                        self._driver = driver
                        self._read(driver)
            finally:
                self._alone.release()
        except Exception as error:  # the end of a thread: whoever opens, or takes frames, gets it
            self._error = error
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _read(self, driver: Driver) -> None:
        first: list[Frame] = []  # pictures, until it is known at which rate they come
        while not self._closed:
            if (frame := driver.read()) is None:
                continue
            if self._described is None:
                first.append(frame)
                if driver.fps is None and len(first) <= _MEASURED_STEPS:
                    continue
                self._described = driver.describe(self._describe(driver, first))
                first.clear()
            with self._changed:
                self.skipped += self._is_read and len(self._waiting) == _WAITING
                self._waiting.append(frame)
                self._changed.notify_all()

    def _describe(self, driver: Driver, first: list[Frame]) -> SourceInfo:
        """By its first pictures, at the rate it states, or else they came at."""
        steps_ns = [(b.stamp_ns - a.stamp_ns) // max(b.seq - a.seq, 1) for a, b in pairwise(first)]
        fps = driver.fps or sane_fps(1e9 / max(median(steps_ns), 1))
        if fps is None:
            raise SourceError(f"{self._name} states no frame rate, and keeps to none; give fps in [source]")
        width, height = first[-1].size
        return SourceInfo(kind=driver.kind, id=driver.id, width=width, height=height, fps_nominal=fps, clock="realtime")


def sane_fps(stated: float) -> float | None:
    """A frame rate that a camera may have, else None: drivers state 0, streams 90000."""
    return stated if _LOWEST_FPS <= stated <= _HIGHEST_FPS else None


def backoff_s(kind: SourceKind, failures: int) -> float:
    """How long to wait before the next attempt, seconds, after so many that failed: doubling up to a limit, a fifth
    more or less, so that many nodes do not knock together. A source that only listens knocks nowhere."""
    limit_s = 0.5 if kind == "push" else 10.0
    return min(limit_s, 0.5 * 2.0 ** min(failures, 30) * random.uniform(0.8, 1.2))  # noqa: S311


def patience_s(config: LiveSource, fps: float) -> tuple[float, float]:
    """Silence that makes a source of this rate stalled, and lost: within 2 s, but never before it could be seen to
    stall."""
    stall_s = max(_LEAST_STALL_S, _STALL_PERIODS / fps) if config.stall_ms is None else config.stall_ms / 1000
    return stall_s, max(_LOST_S, 2 * stall_s)


class WatchListener(Protocol):
    """Who is told how the source does; called from the thread that iterates `frames`, between two frames.

    source_state: another one now; detail: why, in words. source_frame: one arrived, before it is yielded.
    source_broken: frames of before and after do not belong together.
    source_opened: what comes next is of this source: the first, one opened again, or one of another format. Whether its
        frames are wanted: else they are not yielded, until the format changes again. What this raises ends `frames`.
    """

    def source_state(self, state: SourceState, detail: str) -> None: ...
    def source_frame(self, frame: Frame) -> None: ...
    def source_broken(self, reason: Reason) -> None: ...
    def source_opened(self, info: SourceInfo) -> bool: ...


class SourceWatch:
    """A FrameSource that is opened again when it is lost, if it is a LiveCamera; a recording just passes."""

    def __init__(self, first: FrameSource, reopen: Opener, listener: WatchListener, config: SourceConfig) -> None:
        """Watch a source that is already open. config: of it; says how long a live one may be silent."""
        self._current, self.info = first, first.info  # of what is open now, or was open last
        self._reopen, self._listener, self._config = reopen, listener, config
        self._closing = threading.Event()
        self._state: SourceState = "connecting"
        self._corrupt_before = self._skipped_before = 0
        self._failed_in_a_row = 0
        self._wanted = True

    @property
    def corrupt(self) -> int:
        """Damaged frames so far, of all openings."""
        return self._corrupt_before + self._current.corrupt

    @property
    def skipped(self) -> int:
        """Live frames replaced by newer ones before they were taken, and frames of a format nobody wanted."""
        return self._skipped_before + (self._current.skipped if isinstance(self._current, LiveCamera) else 0)

    def frames(self) -> Iterator[Frame]:
        """Frames of the source, again and again; to be iterated once. Ends with a recording, or with `close`.

        Raises:
            SourceLostError: `max_reconnects` attempts in a row have failed. SourceError: of a recording. What the
                listener raises.
        """
        self._turn("connecting")
        self._wanted = self._listener.source_opened(self.info)
        while not self._closing.is_set():
            if not isinstance(self._current, LiveCamera):
                yield from filter(self._arrived, self._current.frames())
                if not self._closing.is_set():
                    self._turn("ended")
                return
            reason = yield from self._live(self._current)
            if not self._closing.is_set():
                self._failed_in_a_row += self._state not in ("streaming", "stalled")  # opened, and never gave a frame
                self._turn("lost", reason)
                self._listener.source_broken("SRC_LOST")
                self._current.close()
                self._open_again(reason)

    def close(self) -> None:
        """End `frames` within a second, from any thread, for good."""
        if not self._closing.is_set():
            self._closing.set()
            self._current.close()

    def _live(self, camera: LiveCamera) -> Generator[Frame, None, str]:
        """Frames of one opening, until it is silent for too long, ends or fails; gives the reason."""
        config = self._config
        assert isinstance(config, LiveSource), "a camera is opened by the settings of one"
        stall_s, lost_s = patience_s(config, self.info.fps_nominal)
        last_s, allowed_s = time.monotonic(), max(stall_s, config.open_timeout_s)
        while True:
            try:
                frame = camera.take(_LOOK_S)
            except SourceError as error:
                return str(error)
            silent_s = time.monotonic() - last_s
            if self._closing.is_set():
                return "closed"
            if frame is not None:
                last_s, allowed_s = time.monotonic(), stall_s
                if self._arrived(frame):
                    yield frame
            elif silent_s > max(lost_s, allowed_s):
                return f"no frame for {silent_s:.1f} s"
            elif silent_s > allowed_s and self._state == "streaming":
                self._turn("stalled", f"no frame for {silent_s:.2f} s")

    def _arrived(self, frame: Frame) -> bool:
        """Tell of a frame; whether it is wanted."""
        if self._state != "streaming":
            self._failed_in_a_row = 0
            self._turn("streaming")
        if frame.size != (self.info.width, self.info.height):  # another camera, as far as windows go
            self.info = replace(self.info, width=frame.size[0], height=frame.size[1])
            self._listener.source_broken("SRC_FORMAT")
            self._wanted = self._listener.source_opened(self.info)
        self._listener.source_frame(frame)
        self._skipped_before += not self._wanted
        return self._wanted

    def _open_again(self, reason: str) -> None:
        """Try until it opens or the watch is closed. Raises SourceLostError."""
        limit = self._config.max_reconnects if isinstance(self._config, LiveSource) else None
        while limit is None or self._failed_in_a_row < limit:
            if self._closing.wait(backoff_s(self.info.kind, self._failed_in_a_row)):
                return
            try:
                self._take_over(self._reopen(self.info))
            except SourceError as error:
                self._failed_in_a_row += 1
                reason = str(error)
                _LOG.info("not back yet: %s", error)
            else:
                self._wanted = self._listener.source_opened(self.info)
                return
        if not self._closing.is_set():
            raise SourceLostError(
                f"{self.info.kind} {self.info.id} is gone and did not come back in {limit} attempts, at last: "
                f"{reason}. Look at its cable and power, or leave max_reconnects out to wait for ever"
            )

    def _take_over(self, source: FrameSource) -> None:
        """Go on with this one once it is open. Raises SourceError."""
        before, self._current = self._current, source
        self._corrupt_before += before.corrupt
        self._skipped_before += before.skipped if isinstance(before, LiveCamera) else 0
        if self._closing.is_set():
            source.close()  # nobody else knew of it
        self.info = source.info

    def _turn(self, state: SourceState, detail: str = "") -> None:
        self._state = state
        self._listener.source_state(state, detail)
