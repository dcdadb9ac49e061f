"""The source and the model as the node's threads tell of them, between two health reports. Not thread-safe."""

from collections import deque

from gcd_node.health.report import CORRUPT_SPAN_S, ModelHealth, ModelState, SourceHealth, SourceState
from gcd_node.health.stage_times import RecentShare

_RATE_FRAMES = 31
_STEP_BACK_NS = -1_000_000_000
_STEP_AHEAD_NS = 60_000_000_000


class SourceTrack:
    """The source: its state, its rate by the latest stamps, how much arrives damaged."""

    def __init__(self) -> None:
        self.state: SourceState = "closed"
        self._lost = False
        self._stamps: deque[int] = deque(maxlen=_RATE_FRAMES)
        self._arrival_ns: int | None = None
        self._frames = self._corrupt = self._reconnects = 0
        self._share = RecentShare(CORRUPT_SPAN_S)

    def turn(self, state: SourceState) -> None:
        """It is in this state now."""
        if state != self.state and state != "stalled":
            self._stamps.clear()  # no rate across a break
        if state == "lost":
            self._lost = True
        elif state in ("streaming", "closed", "ended"):
            self._reconnects += self._lost and state == "streaming"
            self._lost = False
        self.state = state

    def arrive(self, stamp_ns: int, arrival_ns: int) -> float | None:
        """Seconds since the stamp before; None if there is none or it does not rise."""
        self._frames += 1
        self._arrival_ns = arrival_ns
        self._share.add(arrival_ns, good=1)
        gap_ns = stamp_ns - self._stamps[-1] if self._stamps else 0
        if not _STEP_BACK_NS <= gap_ns <= _STEP_AHEAD_NS:
            self._stamps.clear()  # its clock stepped: no rate and no gap across that
            gap_ns = 0
        if not self._stamps or gap_ns > 0:
            self._stamps.append(stamp_ns)
        return gap_ns / 1e9 if gap_ns > 0 else None

    def spoil(self, now_ns: int, count: int) -> None:
        """So many frames arrived damaged."""
        self._corrupt += count
        self._share.add(now_ns, bad=count)

    def health(self, now_ns: int, dropped: int) -> SourceHealth:
        """What is known now; `dropped` is counted elsewhere."""
        arrival_ns = self._arrival_ns
        return SourceHealth(
            state=self.state,
            lost=self._lost,
            fps=self._fps(),
            last_frame_age_ms=None if arrival_ns is None else max(0, now_ns - arrival_ns) / 1e6,
            frames=self._frames,
            reconnects=self._reconnects,
            corrupt=self._corrupt,
            corrupt_share=self._share.share(now_ns),
            dropped=dropped,
        )

    def _fps(self) -> float | None:
        if self.state in ("stalled", "lost"):
            return 0.0
        if len(self._stamps) < 2:
            return None
        return (len(self._stamps) - 1) * 1e9 / (self._stamps[-1] - self._stamps[0])


class ModelTrack:
    """The model: its state and what went wrong with it."""

    def __init__(self) -> None:
        self.state: ModelState = "absent"
        self.gpu_mem_mb: float | None = None
        self.ooms = self.nan_windows = self.bad_depths = 0
        self.backoff_s = 0.0
        self.ood_score: float | None = None

    def health(self) -> ModelHealth:
        """What is known now."""
        return ModelHealth(
            state=self.state,
            gpu_mem_mb=self.gpu_mem_mb,
            ooms=self.ooms,
            nan_windows=self.nan_windows,
            bad_depths=self.bad_depths,
            backoff_s=self.backoff_s,
            ood_score=self.ood_score,
        )
