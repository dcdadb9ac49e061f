"""Keeps frames coming: notices silence, lets a lost camera go and opens it again (wire protocol, section 7, F1 to F4).

A `SourceWatch` is itself a source. Around a recording it changes nothing. Around a live source it reads and opens in
threads of their own, so that a call that never returns is left behind with its thread instead of holding up the node.
"""

import logging
import random
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import wait
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

from gcd_node.errors import SourceError, SourceLostError
from gcd_node.frame import Frame, FrameSource, SourceInfo
from gcd_node.health import SourceState
from gcd_node.life.camera_threads import Reading, close_in_time, leave, open_aside
from gcd_node.source_config import SourceKind
from gcd_node.window import Reason

_LOG = logging.getLogger(__name__)
_STALL_PERIODS = 3
_LEAST_STALL_S = 0.2
_LOST_S = 1.8
_LOOK_S = 0.02

Opener: TypeAlias = Callable[[SourceInfo], FrameSource]
"""Opens again what was open before; raises SourceError if it cannot be, within its own time-out."""


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


def backoff_of(kind: SourceKind) -> Backoff:
    """A source that only listens knocks nowhere: it is hardly ever away."""
    return Backoff(limit_s=0.5) if kind == "push" else Backoff()


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

    def source_opened(self, info: SourceInfo) -> bool:
        """What comes next is of this source: the first, one opened again, or one that changed its format. Whether its
        frames are wanted: else they are told of, and not yielded, until the format changes again. Whatever this raises
        ends `frames`."""
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
            reopen: opens it again; called in threads of their own, one at a time.
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
        self._wanted = True
        self.skipped = 0
        """Live frames replaced by newer ones before they were taken, and frames of a format nobody wanted."""

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
        self._wanted = self._listener.source_opened(self._info)
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
            close_in_time(self._current)

    def _recorded(self) -> Iterator[Frame]:
        for frame in self._current.frames():
            if self._arrived(frame):
                yield frame
        if not self._closing.is_set():
            self._turn("ended")

    def _live(self) -> Generator[Frame, None, str]:
        """Frames of one opening, until it is silent for too long, ends or fails; gives the reason."""
        opening = Reading(source=self._current, since_s=self._clock())
        opening.start()
        stall_s = self._patience.stalled_after_s(self._info.fps_nominal)
        lost_s = self._patience.lost_after_s(self._info.fps_nominal)
        last_s, allowed_s = opening.since_s, max(stall_s, self._patience.open_s)
        try:
            while not self._closing.is_set():
                frame = opening.take(_LOOK_S)
                now_s = self._clock()
                if frame is not None:
                    last_s, allowed_s = now_s, stall_s
                    if self._arrived(frame):
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

    def _arrived(self, frame: Frame) -> bool:
        """Tell of a frame; whether it is wanted."""
        if self._state != "streaming":
            self._failed_in_a_row = 0
            self._backoff.reset()
            self._turn("streaming")
        if frame.size != (self._info.width, self._info.height):  # another camera, as far as windows go
            self._info = replace(self._info, width=frame.size[0], height=frame.size[1])
            self._listener.source_broken("SRC_FORMAT")
            self._wanted = self._listener.source_opened(self._info)
        self._listener.source_frame(frame)
        self.skipped += not self._wanted
        return self._wanted

    def _let_go(self, reason: str) -> None:
        self._failed_in_a_row += self._state not in ("streaming", "stalled")  # opened, and never gave a frame
        self._turn("lost", reason)
        self._listener.source_broken("SRC_LOST")
        close_in_time(self._current)

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
                source = self._attempt()
            except SourceError as error:
                self._failed_in_a_row += 1
                reason = str(error)
                _LOG.info("not back yet: %s", error)
                continue
            if source is not None:
                self._take_over(source)
            return

    def _attempt(self) -> FrameSource | None:
        """The source, open again; None if the watch was closed meanwhile. Raises SourceError."""
        before = self._info
        opening = open_aside(lambda: self._reopen(before))
        while not opening.done():
            if self._closing.is_set():
                leave(opening)
                return None
            wait({opening}, timeout=_LOOK_S)
        return opening.result()

    def _take_over(self, source: FrameSource) -> None:
        self._corrupt_before += self._current.corrupt
        self._current, self._info = source, source.info
        if self._closing.is_set():
            close_in_time(source)  # closed while it was being opened
            return
        self._wanted = self._listener.source_opened(self._info)

    def _turn(self, state: SourceState, detail: str = "") -> None:
        self._state = state
        self._listener.source_state(state, detail)
