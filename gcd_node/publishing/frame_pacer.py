"""Single frames leave at the rhythm they were taken in, not in one burst with their window."""

import heapq
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import replace

from gcd_node.envelope import ViewMessage


class FramePacer:
    """Sends messages later, from a thread of its own. With no delay they go straight through.

    send: takes each message when it is due.
    """

    def __init__(self, send: Callable[[ViewMessage], object]) -> None:
        self._send = send
        self._changed = threading.Condition()
        self._waiting: list[tuple[float, int, ViewMessage]] = []
        self._count = 0
        self._finishing = False
        self._failure: Exception | None = None
        self._thread: threading.Thread | None = None

    def send(self, message: ViewMessage, delay_s: float) -> None:
        """Send a message `delay_s` from now. Raises what an earlier send failed with."""
        if self._failure is not None:
            raise self._failure
        if delay_s <= 0:
            self._send(message)
            return
        with self._changed:
            self._count += 1  # keeps the order of messages that are due together
            heapq.heappush(self._waiting, (time.monotonic() + delay_s, self._count, _later(message, delay_s)))
            self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="frame pacer", daemon=True)
            self._thread.start()

    def forget(self, topics: Collection[str]) -> None:
        """Let go of messages of these topics that are not yet due."""
        with self._changed:
            self._waiting = [each for each in self._waiting if each[2].topic not in topics]
            heapq.heapify(self._waiting)
            self._changed.notify()

    def finish(self, *, abandon: bool = False) -> None:
        """Wait until all messages have left, or forget those that wait. Raises what a send failed with."""
        with self._changed:
            self._finishing = True
            if abandon:
                self._waiting.clear()
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()
        if self._failure is not None and not abandon:
            raise self._failure

    def _serve(self) -> None:
        try:
            while (message := self._next()) is not None:
                self._send(message)
        except Exception as error:
            self._failure = error

    def _next(self) -> ViewMessage | None:
        """The next message once it is due; None at the end."""
        with self._changed:
            while True:
                if self._waiting and self._waiting[0][0] <= time.monotonic():
                    return heapq.heappop(self._waiting)[2]
                if not self._waiting and self._finishing:
                    return None
                self._changed.wait(self._waiting[0][0] - time.monotonic() if self._waiting else None)


def _later(message: ViewMessage, delay_s: float) -> ViewMessage:
    """The message as it will be true when it leaves."""
    header = message.header
    aged = replace(
        header, t_publish_ns=header.t_publish_ns + round(delay_s * 1e9), age_ms=header.age_ms + delay_s * 1000.0
    )
    return replace(message, header=aged)
