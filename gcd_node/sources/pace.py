"""At which speed a recording plays."""

import threading
import time
from typing import Literal, TypeAlias

Pace: TypeAlias = Literal["realtime", "lockstep"]
"""realtime: every frame at its time. lockstep: every frame as soon as it is wanted."""


class Pacer:
    """Holds a recording's frames back until their time. Late frames pass at once; none is skipped."""

    def __init__(self, pace: Pace) -> None:
        self._realtime = pace == "realtime"
        self._stopped = threading.Event()

    @property
    def stopped(self) -> bool:
        """True once `stop` was called."""
        return self._stopped.is_set()

    def stop(self) -> None:
        """Let every waiting thread go, from any thread."""
        self._stopped.set()

    def start(self, stamp_ns: int) -> int:
        """The offset that makes a frame of `stamp_ns` due now; pass it to `wait`."""
        return time.monotonic_ns() - stamp_ns

    def wait(self, stamp_ns: int, offset_ns: int) -> bool:
        """Wait until a frame is due. False if the source was stopped meanwhile."""
        if self._realtime and (left_ns := stamp_ns + offset_ns - time.monotonic_ns()) > 0:
            self._stopped.wait(left_ns / 1e9)
        return not self.stopped
