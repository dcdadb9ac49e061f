"""The node's health: every thread tells what it sees, a report can be had at any moment.

    health = Health()
    health.state("active"); health.source("streaming"); health.model("ready")
    health.expect(("topdown",), window_s=1.4)
    health.frame(frame.stamp_ns, arrival_ns)
    health.stage("render", seconds)
    health.published("topdown", age_s)
    publisher.note("status", origin, health.report())

No thread, no socket and no clock of its own. What the reasons mean is said at HealthReport.findings.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping

from gcd_node.health.report import (
    HOPS,
    STAGES,
    HealthReport,
    Hop,
    Level,
    ModelState,
    PublishHealth,
    RecordHealth,
    SourceState,
    Stage,
)
from gcd_node.health.stage_times import StageSummary, StageTimes
from gcd_node.health.tracks import ModelTrack, SourceTrack

IDLE = "IDLE"
"""Reason to raise, with Level.OK, while nothing is rendered because nobody subscribes."""

_LEAST_PATIENCE_S = 1.0
_WORKING: frozenset[ModelState] = frozenset({"ready", "busy", "degraded"})


class Health:
    """Collects what the node's threads tell; every method may be called from any thread and returns at once.

    clock: monotonic nanoseconds, the clock that arrivals are stamped with.
    """

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._state = "unconfigured"
        self._model = ModelTrack()
        self._source = SourceTrack()
        self._stages = {name: StageTimes() for name in STAGES}
        self._drops: Counter[Hop] = Counter()
        self._built = 0
        self._reason_counts: dict[str, int] = {}
        self._publish = PublishHealth()
        self._rec = RecordHealth()
        self._raised: dict[str, Level] = {}
        self._views: dict[str, int | None] = {}
        self._window_s: float | None = None
        self._due_from_ns = 0
        self._beats = 0
        self._told: tuple[object, ...] | None = None

    # What the node tells.

    def state(self, name: str) -> None:
        """The lifecycle's state, lower case (lifecycle.State.label)."""
        with self._lock:
            if name != self._state:
                self._due_from_ns = self._clock()
            self._state = name

    def source(self, state: SourceState) -> None:
        """The source's state. "lost" is remembered until it streams again; streaming after that is a reconnect."""
        with self._lock:
            if state == "streaming" and self._source.state != "streaming":
                self._due_from_ns = self._clock()
            self._source.turn(state)

    def model(self, state: ModelState) -> None:
        """The model's state."""
        with self._lock:
            if state in _WORKING and self._model.state not in _WORKING:
                self._due_from_ns = self._clock()
            self._model.state = state

    def frame(self, stamp_ns: int, arrival_ns: int) -> None:
        """A frame arrived whole. stamp_ns: on the source's clock; arrival_ns: on this object's clock."""
        with self._lock:
            gap_s = self._source.arrive(stamp_ns, arrival_ns)
            if gap_s is not None:
                self._stages["capture_gap"].add(arrival_ns, gap_s)

    def corrupt(self, count: int = 1) -> None:
        """So many more frames arrived damaged."""
        with self._lock:
            self._source.spoil(self._clock(), count)

    def stage(self, name: Stage, seconds: float) -> None:
        """How long a stage took once."""
        with self._lock:
            self._stages[name].add(self._clock(), seconds)

    def drop(self, hop: Hop, count: int = 1) -> None:
        """So many more were given up at this hop. Of hops that count for themselves use `dropped` instead."""
        with self._lock:
            self._drops[hop] += count

    def dropped(self, hop: Hop, total: int) -> None:
        """So many were given up at this hop in total, by the hop's own counter."""
        with self._lock:
            self._drops[hop] = total

    def windows(self, built: int, reasons: Mapping[str, int]) -> None:
        """What the window builder counts: windows built, and what spoilt how many; sets the hop "window"."""
        with self._lock:
            self._built, self._reason_counts = built, dict(reasons)
            self._drops["window"] = sum(reasons.values())

    def expect(self, views: Iterable[str], window_s: float | None) -> None:
        """Which views are rendered, and how often a window begins, seconds; None if nobody waits for the clock
        (lockstep), so that no view is ever overdue. When each view was published last is kept."""
        with self._lock:
            self._views = {view_id: self._views.get(view_id) for view_id in views}
            self._window_s = window_s
            self._due_from_ns = self._clock()

    def published(self, view_id: str, age_s: float) -> None:
        """A window of this view was published now; age_s: of its newest input frame, the stage "age"."""
        with self._lock:
            now_ns = self._clock()
            self._stages["age"].add(now_ns, age_s)
            if view_id in self._views:
                self._views[view_id] = now_ns

    def sent(self, count: int, subscribers: int, size_bytes: int) -> None:
        """What the publisher counts, in total."""
        with self._lock:
            self._publish = PublishHealth(sent=count, subscribers=subscribers, bytes=size_bytes)

    def recording(self, now: RecordHealth) -> None:
        """How the recording does."""
        with self._lock:
            self._rec = now

    def out_of_memory(self) -> None:
        """The model found no memory for a window."""
        with self._lock:
            self._model.ooms += 1

    def nan_window(self) -> None:
        """A window came out with values that are no numbers."""
        with self._lock:
            self._model.nan_windows += 1

    def bad_depth(self) -> None:
        """The depth of a frame could not be used."""
        with self._lock:
            self._model.bad_depths += 1

    def ood_score(self, score: float | None) -> None:
        """How unlike the training the last window looked to the model; None if it cannot tell."""
        with self._lock:
            self._model.ood_score = score

    def model_load(self, *, gpu_mem_mb: float | None = None, backoff_s: float = 0.0) -> None:
        """The device's memory in use, None on a CPU, and how long until the model is tried again, 0 if it works."""
        with self._lock:
            self._model.gpu_mem_mb, self._model.backoff_s = gpu_mem_mb, backoff_s

    def raise_reason(self, code: str, level: Level) -> None:
        """Something lasting that the rules do not know, such as "fps" out of the trained set or MODEL_HUNG."""
        with self._lock:
            self._raised[code] = level

    def clear_reason(self, code: str) -> None:
        """It is over; nothing happens if it never was."""
        with self._lock:
            if self._raised.pop(code, None) is not None and code == IDLE:
                self._due_from_ns = self._clock()

    # What others ask.

    def snapshot(self) -> HealthReport:
        """Everything as it stands now."""
        with self._lock:
            return self._snapshot(self._clock())

    def report(self) -> dict[str, object]:
        """The fields of a status note; `heartbeat_seq` rises with each call, so only whoever publishes it calls it."""
        with self._lock:
            report = self._snapshot(self._clock())
            self._beats += 1
            self._told = _essence(report)
        return report.to_status(self._beats)

    def changed(self) -> bool:
        """Whether level, reasons, readiness or a state differ from the last `report`; ready and busy are the same."""
        report = self.snapshot()
        with self._lock:
            return _essence(report) != self._told

    def level(self) -> Level:
        """How bad it is now."""
        return self.snapshot().level

    def missing(self) -> tuple[str, ...]:
        """What keeps the node from being ready: NOT_ACTIVE, SRC_NOT_STREAMING, MODEL_NOT_READY, VIEWS_NOT_FRESH; empty
        if it is ready."""
        return self.snapshot().missing

    # What follows is called with the lock held.

    def _snapshot(self, now_ns: int) -> HealthReport:
        summaries: dict[Stage, StageSummary | None] = {name: self._stages[name].summary(now_ns) for name in STAGES}
        return HealthReport(
            state=self._state,
            source=self._source.health(now_ns, self._drops["source"]),
            model=self._model.health(),
            publish=self._publish,
            built=self._built,
            reason_counts=dict(self._reason_counts),
            drops={hop: self._drops[hop] for hop in HOPS},
            stages={name: summary for name, summary in summaries.items() if summary is not None},
            views={view_id: None if at is None else (now_ns - at) / 1e6 for view_id, at in self._views.items()},
            overdue=self._overdue(now_ns),
            raised=dict(self._raised),
            missing=self._missing(now_ns),
            rec=self._rec,
        )

    def _missing(self, now_ns: int) -> tuple[str, ...]:
        fresh = bool(self._views) and all(self._is_fresh(at, now_ns) for at in self._views.values())
        rules = (
            (self._state == "active", "NOT_ACTIVE"),
            (self._source.state == "streaming", "SRC_NOT_STREAMING"),
            (self._model.state in _WORKING, "MODEL_NOT_READY"),
            (fresh or IDLE in self._raised, "VIEWS_NOT_FRESH"),
        )
        return tuple(code for holds, code in rules if not holds)

    def _is_fresh(self, published_ns: int | None, now_ns: int) -> bool:
        if published_ns is None:
            return False
        return self._window_s is None or now_ns - published_ns <= self._patience_ns(now_ns)

    def _overdue(self, now_ns: int) -> bool:
        """Whether views should have come by now: frames do, the model works, and one window more than patience passed
        since the last view, or since whatever had to happen first."""
        works = self._state == "active" and self._source.state == "streaming" and self._model.state in _WORKING
        if self._window_s is None or not works or not self._views or IDLE in self._raised:
            return False
        allowed_ns = self._patience_ns(now_ns) + self._window_s * 1e9
        return any(now_ns - max(at or 0, self._due_from_ns) > allowed_ns for at in self._views.values())

    def _patience_ns(self, now_ns: int) -> float:
        """How old the last view may be: two windows, or two renderings if those take longer, and at least a second."""
        render = self._stages["render"].summary(now_ns)
        slowest_s = max(self._window_s or 0.0, 0.0 if render is None else render.p99_s)
        return 1e9 * max(_LEAST_PATIENCE_S, 2 * slowest_s)


def _essence(report: HealthReport) -> tuple[object, ...]:
    """What of a report is worth a note at once."""
    model = "ready" if report.model.state == "busy" else report.model.state
    return report.state, tuple(report.findings.items()), report.source.state, model, report.missing, report.rec.state
