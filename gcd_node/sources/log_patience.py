"""How far a log is gone through in search of something. A few kB can unfold to billions of records."""

import time
from collections.abc import Callable

from gcd_node.errors import SourceError


class TiredError(SourceError):
    """What was looked for did not come in time, or nobody looks for it any more."""


class LogPatience:
    """Spent record by record, so that it ends whatever a log is made of; `renew` when something was found."""

    def __init__(
        self,
        *,
        records: int,
        seconds: float,
        stopped: Callable[[], bool] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """records, seconds: at most, from one find to the next. stopped: whether to give up at once. clock: seconds."""
        self._records, self._seconds, self._stopped, self._clock = records, seconds, stopped, clock
        self.renew()

    def renew(self) -> None:
        """Begin to count again, now."""
        self._left, self._since_s = self._records, self._clock()

    def spend(self) -> None:
        """Go on to the next record. Raises TiredError, with what was spent."""
        self._left -= 1
        spent_s = self._clock() - self._since_s
        if self._left < 0 or spent_s > self._seconds or (self._stopped is not None and self._stopped()):
            raise TiredError(f"{self._records - self._left - 1} records in {spent_s:.0f} s")
