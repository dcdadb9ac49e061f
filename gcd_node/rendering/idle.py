"""When nobody watches, nothing needs to be rendered (wire protocol, section 7, F10)."""

import time
from collections.abc import Callable


class IdleRule:
    """Says whether the node may rest. It has to be asked often: who came and went in between was not seen."""

    def __init__(self, idle_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin as if somebody had just left. idle_s: patience, seconds; 0 for never. clock: monotonic seconds."""
        self._idle_s, self._clock = idle_s, clock
        self._watched_s = clock()

    def rests(self, subscribers: int) -> bool:
        """Whether nobody has watched for `idle_s`. subscribers: of views, now; who
        looks at the input alone keeps nobody busy."""
        now_s = self._clock()
        if subscribers > 0:
            self._watched_s = now_s
        return 0 < self._idle_s < now_s - self._watched_s
