"""Keeps frames coming: notices silence, lets a lost camera go, opens it again (wire protocol, section 7, F1 to F4)."""

import logging
import random
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, wait
from dataclasses import replace
from typing import Protocol, TypeAlias

from gcd_node.errors import SourceError, SourceLostError
from gcd_node.frame import Frame, FrameSource, SourceInfo
from gcd_node.health import SourceState
from gcd_node.source_config import LiveSource, SourceConfig, SourceKind
from gcd_node.sources.live_camera import LiveCamera
from gcd_node.window import Reason

_LOG = logging.getLogger(__name__)
_STALL_PERIODS = 3
_LEAST_STALL_S = 0.2
_LOST_S = 1.8
_LOOK_S = 0.02

Opener: TypeAlias = Callable[[SourceInfo], FrameSource]
"""Opens again what was open before; raises SourceError if it cannot be, within its own time-out."""


class Backoff:
    """How long to wait before the next attempt: doubling up to a limit, a fifth more or less, so that many nodes do not
    knock together."""

    def __init__(self, *, first_s: float = 0.5, limit_s: float = 10.0) -> None:
        self._first_s, self._limit_s, self._attempts = first_s, limit_s, 0

    def next_s(self) -> float:
        """The next wait, seconds."""
        even_s = min(self._limit_s, self._first_s * 2.0 ** min(self._attempts, 30))
        self._attempts += 1
        return min(self._limit_s, even_s * random.uniform(0.8, 1.2))  # noqa: S311

    def reset(self) -> None:
        """It worked: begin again from the first wait."""
        self._attempts = 0


def backoff_of(kind: SourceKind) -> Backoff:
    """A source that only listens knocks nowhere: it is hardly ever away."""
    return Backoff(limit_s=0.5) if kind == "push" else Backoff()


def patience_s(config: LiveSource, fps: float) -> tuple[float, float]:
    """Silence that makes a source of this rate stalled, and lost: within 2 s, but never before it could be seen to
    stall."""
    stall_s = max(_LEAST_STALL_S, _STALL_PERIODS / fps) if config.stall_ms is None else config.stall_ms / 1000
    return stall_s, max(_LOST_S, 2 * stall_s)


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
    """A source that is opened again when it is lost, if it is a LiveCamera; a recording just passes. Implements
    FrameSource; `frames` may be iterated once."""

    def __init__(
        self,
        first: FrameSource,
        reopen: Opener,
        listener: WatchListener,
        config: SourceConfig,
        backoff: Backoff | None = None,
    ) -> None:
        """Watch a source that is already open.

        Args:
            reopen: opens it again; called in threads of their own, one at a time.
            config: of the source; says how long a live one may be silent.
        """
        self._current, self._info = first, first.info
        self._reopen, self._listener, self._config = reopen, listener, config
        self._backoff = backoff or backoff_of(first.info.kind)
        self._closing = threading.Event()
        self._state: SourceState = "connecting"
        self._corrupt_before = self._skipped_before = 0
        self._failed_in_a_row = 0
        self._wanted = True

    @property
    def info(self) -> SourceInfo:
        """Of what is open now, or was open last."""
        return self._info

    @property
    def corrupt(self) -> int:
        """Damaged frames so far, of all openings."""
        return self._corrupt_before + self._current.corrupt

    @property
    def skipped(self) -> int:
        """Live frames replaced by newer ones before they were taken, and frames of a format nobody wanted."""
        return self._skipped_before + (self._current.skipped if isinstance(self._current, LiveCamera) else 0)

    def frames(self) -> Iterator[Frame]:
        """Frames of the source, again and again. Ends with a recording, or with `close`.

        Raises:
            SourceLostError: `max_reconnects` attempts in a row have failed. SourceError: of a recording. What the
                listener raises.
        """
        self._turn("connecting")
        self._wanted = self._listener.source_opened(self._info)
        while not self._closing.is_set():
            if not isinstance(self._current, LiveCamera):
                yield from filter(self._arrived, self._current.frames())
                if not self._closing.is_set():
                    self._turn("ended")
                return
            reason = yield from self._live(self._current)
            if not self._closing.is_set():
                self._let_go(reason)
                self._open_again(reason)

    def close(self) -> None:
        """End `frames` within a second, from any thread, for good."""
        if not self._closing.is_set():
            self._closing.set()
            self._current.close()

    def _live(self, camera: LiveCamera) -> Generator[Frame, None, str]:
        """Frames of one opening, until it is silent for too long, ends or fails; gives the reason."""
        config, fps = self._config, self._info.fps_nominal
        assert isinstance(config, LiveSource), "a camera is opened by the settings of one"
        stall_s, lost_s = patience_s(config, fps)
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
            self._backoff.reset()
            self._turn("streaming")
        if frame.size != (self._info.width, self._info.height):  # another camera, as far as windows go
            self._info = replace(self._info, width=frame.size[0], height=frame.size[1])
            self._listener.source_broken("SRC_FORMAT")
            self._wanted = self._listener.source_opened(self._info)
        self._listener.source_frame(frame)
        self._skipped_before += not self._wanted
        return self._wanted

    def _let_go(self, reason: str) -> None:
        self._failed_in_a_row += self._state not in ("streaming", "stalled")  # opened, and never gave a frame
        self._turn("lost", reason)
        self._listener.source_broken("SRC_LOST")
        self._current.close()

    def _open_again(self, reason: str) -> None:
        """Try until it opens or the watch is closed. Raises SourceLostError."""
        assert isinstance(self._config, LiveSource)
        limit = self._config.max_reconnects
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
        opening = _open_aside(lambda: self._reopen(before))
        while not opening.done():
            if self._closing.is_set() and opening.cancel():
                return None
            wait({opening}, timeout=_LOOK_S)
        return opening.result()

    def _take_over(self, source: FrameSource) -> None:
        before, self._current, self._info = self._current, source, source.info
        self._corrupt_before += before.corrupt
        self._skipped_before += before.skipped if isinstance(before, LiveCamera) else 0
        if self._closing.is_set():
            source.close()  # closed while it was being opened
            return
        self._wanted = self._listener.source_opened(self._info)

    def _turn(self, state: SourceState, detail: str = "") -> None:
        self._state = state
        self._listener.source_state(state, detail)


def _open_aside(open_source: Callable[[], FrameSource]) -> "Future[FrameSource]":
    """Open a source in a thread of its own. If the future is cancelled, the source is closed as soon as it is open."""
    opening: Future[FrameSource] = Future()

    def run() -> None:
        try:
            source = open_source()
        except Exception as error:  # the end of a thread: whoever waits gets it
            if opening.set_running_or_notify_cancel():
                opening.set_exception(error)
            return
        if opening.set_running_or_notify_cancel():
            opening.set_result(source)
        else:
            source.close()

    threading.Thread(target=run, name="camera open", daemon=True).start()
    return opening
