"""The reader thread, and the slot through which the model thread gets its windows."""

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from gcd_node.errors import NodeError, ReaderError, TooShortError
from gcd_node.frame import FrameSource
from gcd_node.window import FrameWindow, PartialWindow, WindowBuilder

T = TypeVar("T")


class LatestSlot(Generic[T]):
    """A slot for one item between two threads. A newer item replaces an unread one, which counts as dropped.

    With `lossless` a full slot makes `put` wait instead, and nothing is dropped.
    The giver ends with `finish`, the taker with `close`.
    """

    def __init__(self, *, lossless: bool = False) -> None:
        self._lossless = lossless
        self._changed = threading.Condition()
        self._slot: list[T] = []
        self._dropped = 0
        self._notices = 0
        self._finished = False
        self._closed = False
        self._error: Exception | None = None

    @property
    def dropped(self) -> int:
        """Items that were replaced before anybody took them."""
        with self._changed:
            return self._dropped

    @property
    def closed(self) -> bool:
        """True once the taker wants no more."""
        with self._changed:
            return self._closed

    def put(self, item: T) -> bool:
        """Leave an item; waits for room if lossless. False, and the item is not left, once the slot is closed."""
        with self._changed:
            if self._lossless:
                self._changed.wait_for(lambda: self._closed or not self._slot)
            if self._closed:
                return False
            self._dropped += len(self._slot)
            self._slot = [item]
            self._changed.notify_all()
            return True

    def take(self, idle_work: Callable[[], bool] | None = None) -> T | None:
        """Wait for an item. None after `close`, or after `finish` once the last item was taken.

        Args:
            idle_work: what to do while there is nothing to take: called until it returns False, and anew after every
                `notify`. An item that comes is taken as soon as the call under way returns.
        Raises:
            the error given to `finish`, once, after the last item was taken; what `idle_work` raises.
        """
        asleep, notices = idle_work is None, 0
        while not self._await(asleep, notices):
            notices = self._notices
            asleep = idle_work is None or not idle_work()
        with self._changed:
            if self._closed:
                return None
            if self._slot:
                self._changed.notify_all()
                return self._slot.pop()
            error, self._error = self._error, None
        if error is not None:
            raise error
        return None

    def notify(self) -> None:
        """Giver: there may be something to do for a taker who waits."""
        with self._changed:
            self._notices += 1
            self._changed.notify_all()

    def _await(self, asleep: bool, notices: int) -> bool:
        """Whether `take` need not wait any longer. asleep: return only then, or after another notify than these."""
        with self._changed:
            if asleep:
                self._changed.wait_for(lambda: self._due or self._notices != notices)
            return self._due

    @property
    def _due(self) -> bool:
        return self._closed or self._finished or bool(self._slot)

    def finish(self, error: Exception | None = None) -> None:
        """Giver: nothing more comes. What was left can still be taken; then `take` raises `error`, if there is one."""
        with self._changed:
            self._finished = True
            self._error = error
            self._changed.notify_all()

    def close(self) -> None:
        """Taker: stop at once. Everybody who waits is let go; an item that was left is forgotten."""
        with self._changed:
            self._closed = True
            self._slot = []
            self._changed.notify_all()


class WindowSlot(LatestSlot[FrameWindow]):
    """The slot for windows; it also shows what the next window holds so far."""

    def __init__(self, *, lossless: bool = False) -> None:
        super().__init__(lossless=lossless)
        self._filling: PartialWindow | None = None

    @property
    def filling(self) -> PartialWindow | None:
        """What the next window holds so far; None where nobody knows."""
        return self._filling

    def show(self, filling: PartialWindow) -> None:
        """Reader: this is what the next window holds so far. Never waits."""
        self._filling = filling
        self.notify()

    def put(self, item: FrameWindow) -> bool:
        """See LatestSlot."""
        self._filling = None  # it is this window's
        return super().put(item)


def read(
    source: FrameSource,
    windows: WindowBuilder,
    newest: WindowSlot,
    clock_ns: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Reader thread: every frame is used; of complete windows the newest wins.

    Of the window that fills, the slot shows every frame as it arrives.

    Returns when the source has ended or `newest` was closed; an error of the source goes to whoever takes from
    `newest`. To stop early, close `newest` first, then the source.

    Args:
        clock_ns: the monotonic clock that arrivals are stamped with.
    """
    try:
        _read_all(source, windows, newest, clock_ns)
    except NodeError as error:
        newest.finish(error)
    except Exception as error:  # the end of a thread: whoever takes gets it
        broken = ReaderError(f"reading frames broke: {type(error).__name__}: {error}")
        broken.__cause__ = error
        newest.finish(broken)
    else:
        newest.finish()


def _read_all(source: FrameSource, windows: WindowBuilder, newest: WindowSlot, clock_ns: Callable[[], int]) -> None:
    for frame in source.frames():
        for window in windows.push(frame, clock_ns()):
            newest.put(window)
        newest.show(windows.filling)
        if newest.closed:
            return
    for window in windows.flush():
        newest.put(window)
    if windows.counts.built == 0 and not newest.closed:
        raise _too_short(source.info.id, windows)


def _too_short(name: str, windows: WindowBuilder) -> TooShortError:
    counts = windows.counts
    spoilt = "".join(f", {count} x {reason}" for reason, count in sorted(counts.reasons.items()))
    return TooShortError(
        f"TOO_SHORT n={counts.frames}: {name} has {counts.frames} frames, {counts.placed} of them usable{spoilt}; "
        f"a window takes {windows.frames} in a row at {windows.fps:g} FPS: give a longer recording, or another fps "
        "in [window]"
    )
