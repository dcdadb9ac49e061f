"""The reader thread, and the slot through which the model thread gets its windows."""

import threading
import time
from collections.abc import Callable

from gcd_node.errors import NodeError, ReaderError, TooShortError
from gcd_node.frame import FrameSource
from gcd_node.window import FrameWindow, PartialWindow, WindowBuilder


class WindowSlot:
    """A slot for one window between two threads. A newer window replaces an unread one, which counts as dropped. It
    also shows what the next window holds so far.

    With `lossless` a full slot makes `put` wait instead, and nothing is dropped.
    The giver ends with `finish`, the taker with `close`.
    """

    def __init__(self, *, lossless: bool = False) -> None:
        self._lossless = lossless
        self._changed = threading.Condition()
        self._slot: FrameWindow | None = None
        self._notices = 0
        self._finished = False
        self._error: Exception | None = None
        self.dropped = 0
        """Windows that were replaced before anybody took them."""
        self.closed = False
        """True once the taker wants no more."""
        self.filling: PartialWindow | None = None
        """What the next window holds so far; None where nobody knows."""

    def put(self, window: FrameWindow) -> bool:
        """Leave a window; waits for room if lossless. False, and it is not left, once the slot is closed."""
        with self._changed:
            self.filling = None  # it is this window's
            if self._lossless:
                self._changed.wait_for(lambda: self.closed or self._slot is None)
            if self.closed:
                return False
            self.dropped += self._slot is not None
            self._slot = window
            self._changed.notify_all()
            return True

    def show(self, filling: PartialWindow) -> None:
        """Giver: this is what the next window holds so far. Never waits."""
        with self._changed:
            self.filling = filling
            self._notices += 1
            self._changed.notify_all()

    def take(self, idle_work: Callable[[], bool] | None = None) -> FrameWindow | None:
        """Wait for a window. None after `close`, or after `finish` once the last window was taken.

        Args:
            idle_work: what to do while there is nothing to take: called until it returns False, and anew after every
                `show`. A window that comes is taken as soon as the call under way returns.
        Raises:
            the error given to `finish`, once, after the last window was taken; what `idle_work` raises.
        """
        asleep, notices = idle_work is None, 0
        while not self._await(asleep, notices):
            notices = self._notices
            asleep = idle_work is None or not idle_work()
        with self._changed:
            if not self.closed and self._slot is not None:
                window, self._slot = self._slot, None
                self._changed.notify_all()
                return window
            error, self._error = self._error, None
        if error is not None and not self.closed:
            raise error
        return None

    def _await(self, asleep: bool, notices: int) -> bool:
        """Whether `take` need not wait any longer. asleep: return only then, or after another `show` than these."""

        def due() -> bool:
            return self.closed or self._finished or self._slot is not None

        with self._changed:
            if asleep:
                self._changed.wait_for(lambda: due() or self._notices != notices)
            return due()

    def finish(self, error: Exception | None = None) -> None:
        """Giver: nothing more comes. What was left can still be taken; then `take` raises `error`, if there is one."""
        with self._changed:
            self._finished, self._error = True, error
            self._changed.notify_all()

    def close(self) -> None:
        """Taker: stop at once. Everybody who waits is let go; a window that was left is forgotten."""
        with self._changed:
            self.closed, self._slot = True, None
            self._changed.notify_all()


def read(source: FrameSource, windows: WindowBuilder, newest: WindowSlot) -> None:
    """Reader thread: every frame is used; of complete windows the newest wins.

    Of the window that fills, the slot shows every frame as it arrives.

    Returns when the source has ended or `newest` was closed; an error of the source goes to whoever takes from
    `newest`. To stop early, close `newest` first, then the source.
    """
    try:
        for frame in source.frames():
            for window in windows.push(frame, time.monotonic_ns()):
                newest.put(window)
            newest.show(windows.filling)
            if newest.closed:
                break
        else:
            for window in windows.flush():
                newest.put(window)
            if windows.built == 0 and not newest.closed:
                raise _too_short(source.info.id, windows)
    except NodeError as error:
        newest.finish(error)
    except Exception as error:  # the end of a thread: whoever takes gets it
        broken = ReaderError(f"reading frames broke: {type(error).__name__}: {error}")
        broken.__cause__ = error
        newest.finish(broken)
    else:
        newest.finish()


def _too_short(name: str, windows: WindowBuilder) -> TooShortError:
    spoilt = "".join(f", {count} x {reason}" for reason, count in sorted(windows.reasons.items()))
    return TooShortError(
        f"TOO_SHORT n={windows.pushed}: {name} has {windows.pushed} frames, {windows.placed} of them usable{spoilt}; "
        f"a window takes {windows.frames} in a row at {windows.fps:g} FPS: give a longer recording, or another fps "
        "in [window]"
    )
