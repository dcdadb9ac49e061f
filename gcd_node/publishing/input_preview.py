"""Shows what the camera sees to whoever subscribes, a few times a second, in a thread of its own."""

import logging
import threading
import time
from collections.abc import Callable

from gcd_node.capture import Newest
from gcd_node.errors import NodeError
from gcd_node.publishing.outbox import Outbox
from gcd_node.wire.input_preview import PREVIEW_PERIOD_S, Shot, preview_end, preview_message
from gcd_node.wire.view_message import Run

_LOG = logging.getLogger(__name__)
_LEAST = 0.9  # of a period between two previews, so that a camera's jitter does not make it miss every second one


class InputPreview:
    """Takes frames from the reader thread and lets most of them go; encodes and sends in its own thread.

    With no subscriber of the preview a frame costs a look at a counter. The thread begins with the first one.
    """

    def __init__(self, outbox: Outbox, run: Callable[[], Run], clock: Callable[[], float] = time.monotonic) -> None:
        """run: what is known of the source now. clock: monotonic seconds."""
        self._outbox, self._run, self._clock = outbox, run, clock
        self._newest = Newest[Shot]()
        self._next_s = clock()
        self._thread: threading.Thread | None = None

    def offer(self, shot: Shot) -> None:
        """A frame arrived. Reader thread; does not wait."""
        now_s = self._clock()
        if now_s < self._next_s or self._outbox.stats.readers.previews == 0:
            return
        self._next_s = max(self._next_s + PREVIEW_PERIOD_S, now_s + _LEAST * PREVIEW_PERIOD_S)
        self._newest.put(shot)
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="input preview", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """No more frames come; from any thread, does not wait."""
        self._newest.close()

    def join(self, timeout_s: float) -> None:
        """Wait for the thread, after `close`."""
        if self._thread is not None:
            self._thread.join(timeout_s)

    def announce_end(self, *, delay_ms: int | None) -> None:
        """End the topic, if anybody got something on it. After `join`. delay_ms: see Outbox."""
        if self._thread is not None:
            self._outbox.end(preview_end(self._run()), delay_ms=delay_ms)

    def _serve(self) -> None:
        try:
            while (shot := self._newest.take()) is not None:
                self._outbox.send(preview_message(self._run(), shot))
        except NodeError as error:  # the end of a thread: views must not suffer from it
            _LOG.warning("the preview of the input ends: %s", error)
