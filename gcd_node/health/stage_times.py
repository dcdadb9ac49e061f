"""Rolling figures: quantiles of how long things take, and the share of what arrives damaged. No clock of their own."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

_KEPT = 512
_SPAN_NS = 60_000_000_000
_AT_LEAST = 16  # a slow model gives few values a minute
_SLOTS = 50
_MIN_ARRIVALS = 5  # one bad picture among the first few says nothing


@dataclass(frozen=True, kw_only=True, slots=True)
class StageSummary:
    """How long a stage takes. p50_s, p99_s: over the last minute (at most 512 values, at least the last 16 there are),
    seconds. count, total_s: since the start."""

    p50_s: float
    p99_s: float
    count: int
    total_s: float


class StageTimes:
    """Durations of one stage. Times are monotonic nanoseconds, given by the caller. Not thread-safe."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float]] = deque(maxlen=_KEPT)
        self._count = 0
        self._total_s = 0.0

    def add(self, now_ns: int, seconds: float) -> None:
        """Take note of one duration; a negative one counts as 0 (two clocks disagree), one that is no number not."""
        if not math.isfinite(seconds):
            return
        seconds = max(0.0, seconds)
        self._recent.append((now_ns, seconds))
        self._count += 1
        self._total_s += seconds

    def summary(self, now_ns: int) -> StageSummary | None:
        """The figures now; None before the first value."""
        if not self._recent:
            return None
        recent = [seconds for at_ns, seconds in self._recent if now_ns - at_ns <= _SPAN_NS]
        if len(recent) < _AT_LEAST:
            recent = [seconds for _, seconds in list(self._recent)[-_AT_LEAST:]]
        return StageSummary(
            p50_s=quantile(recent, 0.5), p99_s=quantile(recent, 0.99), count=self._count, total_s=self._total_s
        )


class RecentShare:
    """The damaged share of what arrived in the last `span_s` seconds, to a fiftieth of that. Not thread-safe."""

    def __init__(self, span_s: float) -> None:
        self._span_ns = round(span_s * 1e9)
        self._slots: deque[_Slot] = deque()  # at most 51, however much arrives

    def add(self, now_ns: int, *, good: int = 0, bad: int = 0) -> None:
        """Take note of arrivals."""
        self._forget(now_ns)
        if not self._slots or now_ns - self._slots[-1].from_ns >= self._span_ns // _SLOTS:
            self._slots.append(_Slot(from_ns=now_ns))
        self._slots[-1].good += good
        self._slots[-1].bad += bad

    def share(self, now_ns: int) -> float:
        """Between 0 and 1; 0 while fewer than five arrived, as one of two says nothing."""
        self._forget(now_ns)
        bad = sum(slot.bad for slot in self._slots)
        arrived = bad + sum(slot.good for slot in self._slots)
        return bad / arrived if arrived >= _MIN_ARRIVALS else 0.0

    def _forget(self, now_ns: int) -> None:
        while self._slots and now_ns - self._slots[0].from_ns > self._span_ns:
            self._slots.popleft()


@dataclass(kw_only=True, slots=True)
class _Slot:
    """What arrived within a short while."""

    from_ns: int
    good: int = 0
    bad: int = 0


def quantile(values: Sequence[float], part: float) -> float:
    """The smallest value that at least `part` of them do not exceed (nearest rank). values: at least one."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(part * len(ordered)) - 1)]
