"""Notices when somebody sets this machine's clock (wire protocol, section 7, F24). Ages are not affected."""

import time
from collections.abc import Callable

_STEP_NS = 100_000_000
_SHARP_NS = 5_000_000


class WallClock:
    """Compares UTC with the monotonic clock, look by look."""

    def __init__(self, utc_ns: Callable[[], int] | None = None, monotonic_ns: Callable[[], int] | None = None) -> None:
        """Take the first look. The clocks are nanoseconds; left out, the system's."""
        self._utc_ns = (lambda: time.time_ns()) if utc_ns is None else utc_ns
        self._monotonic_ns = (lambda: time.monotonic_ns()) if monotonic_ns is None else monotonic_ns
        self._offset_ns: int | None = None
        self.step_ms()

    def step_ms(self) -> float | None:
        """How far UTC was moved since the last look, ms, forwards positive; None if by less than 100.

        A clock that is only slewed never shows here. A look that was interrupted between the two clocks is not used.
        """
        before_ns, utc_ns, after_ns = self._monotonic_ns(), self._utc_ns(), self._monotonic_ns()
        if after_ns - before_ns > _SHARP_NS:
            return None
        offset_ns, last_ns = utc_ns - before_ns, self._offset_ns
        self._offset_ns = offset_ns
        if last_ns is None or abs(offset_ns - last_ns) < _STEP_NS:
            return None
        return (offset_ns - last_ns) / 1e6
