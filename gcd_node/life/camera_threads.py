"""The threads that call a live camera. Any call into a driver may take for ever, so each of them can be left behind."""

import logging
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

from gcd_node.errors import SourceError
from gcd_node.frame import Frame, FrameSource

_LOG = logging.getLogger(__name__)
_CLOSE_S = 1.0
_QUEUED = 4


@dataclass(eq=False, kw_only=True, slots=True)
class Reading:
    """One opening of a live source, read in its own thread until that ends or is left behind.

    since_s: when it was opened. over: nothing more comes. abandoned: set it to leave the thread behind.
    skipped: frames replaced by newer ones before they were taken.
    """

    source: FrameSource
    since_s: float
    over: threading.Event = field(default_factory=threading.Event)
    abandoned: threading.Event = field(default_factory=threading.Event)
    skipped: int = 0
    _frames: "queue.Queue[Frame]" = field(default_factory=lambda: queue.Queue[Frame](_QUEUED))
    _error: Exception | None = None

    def start(self) -> None:
        """Begin to read."""
        threading.Thread(target=self._read, name="camera", daemon=True).start()

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

    def _read(self) -> None:
        try:
            for frame in self.source.frames():
                if self.abandoned.is_set():
                    return
                self._put(frame)
        except Exception as error:  # the end of a thread: the watch is told
            self._error = error
        finally:
            self.over.set()

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


def open_aside(open_source: Callable[[], FrameSource]) -> "Future[FrameSource]":
    """Open a source in a thread of its own. The future holds the source, or what opening raised; see `leave`."""
    opening: Future[FrameSource] = Future()
    threading.Thread(target=_open, args=(open_source, opening), name="camera open", daemon=True).start()
    return opening


def leave(opening: "Future[FrameSource]") -> None:
    """Want the source no more: it is closed at once, or as soon as it is open."""
    if not opening.cancel() and opening.exception() is None:
        close_in_time(opening.result())


def close_in_time(source: FrameSource) -> None:
    """Close; a device that does not even answer that is left to a thread of its own."""
    closer = threading.Thread(target=source.close, name="camera close", daemon=True)
    closer.start()
    closer.join(_CLOSE_S)
    if closer.is_alive():
        _LOG.warning("%s %s does not answer to being closed; it is left behind", source.info.kind, source.info.id)


def _open(open_source: Callable[[], FrameSource], opening: "Future[FrameSource]") -> None:
    try:
        source = open_source()
    except Exception as error:  # the end of a thread: whoever waits gets it
        if opening.set_running_or_notify_cancel():
            opening.set_exception(error)
        return
    if opening.set_running_or_notify_cancel():
        opening.set_result(source)
    else:
        close_in_time(source)
