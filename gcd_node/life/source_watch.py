"""Keeps frames coming: notices silence, lets a lost camera go and opens it again (wire protocol, section 7, F1 to F4).

A `SourceWatch` is itself a source. Around a recording it changes nothing. Around a live source it reads in a thread of
its own, so that a `read` that never returns is left behind with its thread instead of holding up the node.
"""

import logging
import queue
import random
import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeAlias

from gcd_node.errors import SourceError, SourceLostError
from gcd_node.frame import Frame, FrameSource, SourceInfo
from gcd_node.health.report import SourceState
from gcd_node.window import Reason

_LOG = logging.getLogger(__name__)
_STALL_PERIODS = 3
_LEAST_STALL_S = 0.2
_LOST_S = 1.8
_LOOK_S = 0.02
_CLOSE_S = 1.0
_QUEUED = 4

Opener: TypeAlias = Callable[[], FrameSource]
"""Opens the source again; raises SourceError if it cannot be, within its own time-out."""


class Backoff:
    """How long to wait before the next attempt: from `first_s`, doubling up to `limit_s`, with some jitter so that
    many nodes do not knock together."""

    def __init__(
        self,
        *,
        first_s: float = 0.5,
        limit_s: float = 10.0,
        jitter: float = 0.2,
        draw: Callable[[], float] = random.random,
    ) -> None:
        self._first_s, self._limit_s, self._jitter, self._draw = first_s, limit_s, jitter, draw
        self._attempts = 0

    def next_s(self) -> float:
        """The next wait, seconds; at most `limit_s`, and `jitter` of itself away from the even series."""
        even_s = min(self._limit_s, self._first_s * 2.0 ** min(self._attempts, 30))
        self._attempts += 1
        return min(self._limit_s, even_s * (1 + self._jitter * (2 * self._draw() - 1)))

    def reset(self) -> None:
        """It worked: begin again from `first_s`."""
        self._attempts = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class Patience:
    """How long a live source may be silent.

    stall_s: until it counts as stalled; None for 3 frame periods and at least 0.2 s.
    open_s: until its first frame after it was opened.
    max_reconnects: attempts in a row that may fail before it is given up; None for ever.
    """

    stall_s: float | None = None
    open_s: float = 5.0
    max_reconnects: int | None = None

    def stalled_after_s(self, fps: float) -> float:
        """Silence that makes a source of this rate stalled."""
        return max(_LEAST_STALL_S, _STALL_PERIODS / fps) if self.stall_s is None else self.stall_s

    def lost_after_s(self, fps: float) -> float:
        """Silence that makes it lost: within 2 s, but never before it could be seen to stall."""
        return max(_LOST_S, 2 * self.stalled_after_s(fps))


class WatchListener(Protocol):
    """Who is told how the source does; called from the thread that iterates `frames`, between two frames."""

    def source_state(self, state: SourceState, detail: str) -> None:
        """The source is in another state now. detail: why, in words; may be empty."""
        ...

    def source_frame(self, frame: Frame) -> None:
        """A frame arrived, before it is yielded."""
        ...

    def source_broken(self, reason: Reason) -> None:
        """The stream was interrupted: frames of before and after do not belong together."""
        ...

    def source_opened(self, info: SourceInfo) -> None:
        """What comes next is of this source: the first, one opened again, or one that changed its format. Whatever
        this raises ends `frames`."""
        ...


class SourceWatch:
    """A source that is opened again when it is lost. Implements FrameSource; its frames have a rising epoch.

    `frames` may be iterated once. It raises SourceLostError once `max_reconnects` attempts in a row have failed.
    """

    def __init__(
        self,
        first: FrameSource,
        reopen: Opener,
        listener: WatchListener,
        patience: Patience | None = None,
        backoff: Backoff | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Watch a source that is already open.

        Args:
            reopen: opens it again; called in the thread that iterates `frames`.
            clock: monotonic seconds.
        """
        self._current: FrameSource = first
        self._info = first.info
        self._reopen, self._listener, self._clock = reopen, listener, clock
        self._patience, self._backoff = patience or Patience(), backoff or Backoff()
        self._closing = threading.Event()
        self._state: SourceState = "connecting"
        self._corrupt_before = 0
        self._failed_in_a_row = 0
        self.skipped = 0
        """Live frames replaced by newer ones before they were taken."""

    @property
    def info(self) -> SourceInfo:
        """Of what is open now, or was open last."""
        return self._info

    @property
    def corrupt(self) -> int:
        """Damaged frames so far, of all openings."""
        return self._corrupt_before + self._current.corrupt

    def frames(self) -> Iterator[Frame]:
        """Frames of the source, again and again. Ends with a recording, or with `close`.

        Raises:
            SourceLostError: given up. SourceError: of a recording. What the listener raises.
        """
        self._turn("connecting")
        self._listener.source_opened(self._info)
        while not self._closing.is_set():
            if not self._info.live:
                yield from self._recorded()
                return
            reason = yield from self._live()
            if self._closing.is_set():
                return
            self._let_go(reason)
            self._open_again(reason)

    def close(self) -> None:
        """End `frames` within a second, from any thread, for good."""
        if not self._closing.is_set():
            self._closing.set()
            _close_in_time(self._current)

    def _recorded(self) -> Iterator[Frame]:
        for frame in self._current.frames():
            self._arrived(frame)
            yield frame
        if not self._closing.is_set():
            self._turn("ended")

    def _live(self) -> Generator[Frame, None, str]:
        """Frames of one opening, until it is silent for too long, ends or fails; gives the reason."""
        opening = _Opening(source=self._current, since_s=self._clock())
        threading.Thread(target=opening.read, name="camera", daemon=True).start()
        stall_s = self._patience.stalled_after_s(self._info.fps_nominal)
        lost_s = self._patience.lost_after_s(self._info.fps_nominal)
        last_s, allowed_s = opening.since_s, max(stall_s, self._patience.open_s)
        try:
            while not self._closing.is_set():
                frame = opening.take(_LOOK_S)
                now_s = self._clock()
                if frame is not None:
                    last_s, allowed_s = now_s, stall_s
                    self._arrived(frame)
                    yield frame
                elif opening.exhausted:
                    return opening.reason()
                elif now_s - last_s > max(lost_s, allowed_s):
                    return f"no frame for {now_s - last_s:.1f} s"
                elif now_s - last_s > allowed_s and self._state == "streaming":
                    self._turn("stalled", f"no frame for {now_s - last_s:.2f} s")
        finally:
            opening.abandoned.set()
            self.skipped += opening.skipped
        return "closed"

    def _arrived(self, frame: Frame) -> None:
        if self._state != "streaming":
            self._failed_in_a_row = 0
            self._backoff.reset()
            self._turn("streaming")
        self._tell(frame)

    def _tell(self, frame: Frame) -> None:
        """Of a frame; a picture of another size is another camera, as far as windows go."""
        if frame.size != (self._info.width, self._info.height):
            self._info = replace(self._info, width=frame.size[0], height=frame.size[1])
            self._listener.source_broken("SRC_FORMAT")
            self._listener.source_opened(self._info)
        self._listener.source_frame(frame)

    def _let_go(self, reason: str) -> None:
        self._failed_in_a_row += self._state not in ("streaming", "stalled")  # opened, and never gave a frame
        self._turn("lost", reason)
        self._listener.source_broken("SRC_LOST")
        _close_in_time(self._current)

    def _open_again(self, reason: str) -> None:
        """Try until it opens or the watch is closed. Raises SourceLostError."""
        limit = self._patience.max_reconnects
        while not self._closing.is_set():
            if limit is not None and self._failed_in_a_row >= limit:
                raise SourceLostError(
                    f"{self._info.kind} {self._info.id} is gone and did not come back in {limit} attempts, at last: "
                    f"{reason}. Look at its cable and power, or leave max_reconnects out to wait for ever"
                )
            if self._closing.wait(self._backoff.next_s()):
                return
            try:
                source = self._reopen()
            except SourceError as error:
                self._failed_in_a_row += 1
                reason = str(error)
                _LOG.info("not back yet: %s", error)
                continue
            self._take_over(source)
            return

    def _take_over(self, source: FrameSource) -> None:
        self._corrupt_before += self._current.corrupt
        self._current, self._info = source, source.info
        if self._closing.is_set():
            _close_in_time(source)  # closed while it was being opened
            return
        self._listener.source_opened(self._info)

    def _turn(self, state: SourceState, detail: str = "") -> None:
        self._state = state
        self._listener.source_state(state, detail)


@dataclass(eq=False, kw_only=True, slots=True)
class _Opening:
    """One opening of a live source, read in its own thread until that ends or is left behind."""

    source: FrameSource
    since_s: float
    over: threading.Event = field(default_factory=threading.Event)
    abandoned: threading.Event = field(default_factory=threading.Event)
    skipped: int = 0
    _frames: "queue.Queue[Frame]" = field(default_factory=lambda: queue.Queue[Frame](_QUEUED))
    _error: Exception | None = None

    def read(self) -> None:
        """The camera thread."""
        try:
            for frame in self.source.frames():
                if self.abandoned.is_set():
                    return
                self._put(frame)
        except Exception as error:  # the end of a thread: the watch is told
            self._error = error
        finally:
            self.over.set()

    def take(self, timeout_s: float) -> Frame | None:
        """The next frame; None if none came in time."""
        try:
            return self._frames.get(timeout=timeout_s)
        except queue.Empty:
            return None

    @property
    def exhausted(self) -> bool:
        """Whether it is over and every frame was taken."""
        return self.over.is_set() and self._frames.empty()

    def reason(self) -> str:
        """Why it is over. Raises what is no fault of the source."""
        if self._error is None:
            return "the stream ended"
        if not isinstance(self._error, SourceError):
            raise self._error
        return str(self._error)

    def _put(self, frame: Frame) -> None:
        while True:
            try:
                return self._frames.put_nowait(frame)
            except queue.Full:
                self._make_room()

    def _make_room(self) -> None:
        try:
            self._frames.get_nowait()
        except queue.Empty:
            return
        self.skipped += 1


def _close_in_time(source: FrameSource) -> None:
    """Close; a device that does not even answer that is left to a thread of its own."""
    closer = threading.Thread(target=source.close, name="camera close", daemon=True)
    closer.start()
    closer.join(_CLOSE_S)
    if closer.is_alive():
        _LOG.warning("%s %s does not answer to being closed; it is left behind", source.info.kind, source.info.id)
