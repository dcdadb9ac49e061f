"""How the node does: threads report what they see, anybody may ask for a snapshot at any moment.

It only reports: no part of the node decides by what it says.
"""

import enum
import math
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, TypeAlias, get_args

SourceState: TypeAlias = Literal["closed", "connecting", "streaming", "stalled", "lost", "ended"]
ModelState: TypeAlias = Literal["absent", "loading", "warming", "ready", "busy", "degraded", "failed"]
Stage: TypeAlias = Literal["capture_gap", "window", "encode", "render", "publish", "age"]
"""What takes time, in order; docs/deploy.md says from where to where."""

Hop: TypeAlias = Literal["source", "window", "slot", "model", "queue"]
"""Where frames, windows and messages are given up, in order; docs/deploy.md says why."""

Count: TypeAlias = Hop | Literal["oom_count", "nan_windows", "bad_depths", "sent", "subs", "bytes"]
"""A hop, a fault of the model, or what the publisher has sent and to how many subscribers."""

THREAD_DIED = "THREAD_DIED"
"""Reason to raise once a thread that the node needs has ended: it is not ready then, whatever else it does."""

IDLE = "IDLE"
"""Reason to raise, with Level.OK, while nothing is rendered because nobody subscribes."""

_WORKING = ("ready", "busy", "degraded")
_CORRUPT_LIMIT = 0.2  # more damaged frames than this, over 5 s, is a warning
_LEAST_PATIENCE_S = 1.0
_RATE_FRAMES = 31
_LONGEST_GAP_NS = 30_000_000_000  # between two stamps; beyond, the clock stepped or a looped recording began again
_LONGEST_STEP_BACK_NS = 1_000_000_000
_RECENT_NS = 5_000_000_000
_LEAST_DURATIONS = 16  # a slow model gives few values a minute
_LEAST_ARRIVALS = 5  # one damaged picture among the first few says nothing


class Level(enum.IntEnum):
    """How bad it is, with the numbers of a ROS 2 DiagnosticStatus. STALE is for readers: who hears nothing says it."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordHealth:
    """The recording under way, or the last one.

    state: "failed" is one that ended by itself. file: the one written to now or last, below the folder of recordings.
    bytes: on the disk, all files together. written: messages. dropped: what found no room in the queue, by topic.
    """

    state: Literal["off", "recording", "stopping", "failed"] = "off"
    file: str | None = None
    bytes: int = 0
    written: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict[str, int])


class Health:
    """Collects what the node's threads report: each attribute may be set, and each method called, from any thread.

    state: the lifecycle's, lower case (lifecycle.State.label). model: the model's. recording: how it does.
    counts: by the names of Count, and "frames" that arrived whole, "corrupt" ones, "reconnects" and windows "built".
    faults: what spoilt how many windows. gpu_mem_mb: the device's memory in use. ood_score: how unlike the training the
    last window looked to the model. camera: how far it stands from where canonical views take it to stand. None:
    unknown.
    """

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """clock: monotonic nanoseconds, the clock that arrivals are stamped with."""
        self.state = "unconfigured"
        self.model: ModelState = "absent"
        self.recording = RecordHealth()
        self.counts: defaultdict[str, int] = defaultdict(int)
        self.faults: Mapping[str, int] = {}
        self.gpu_mem_mb: float | None = None
        self.ood_score: float | None = None
        self.camera: Mapping[str, float] | None = None
        self._clock, self._lock = clock, threading.Lock()
        self._source: SourceState = "closed"
        self._lost = False
        self._stages: dict[Stage, StageTimes] = {name: StageTimes() for name in get_args(Stage)}
        self._stamps: deque[int] = deque(maxlen=_RATE_FRAMES)
        self._arrivals: deque[tuple[int, bool]] = deque(maxlen=1024)  # when, and whether whole
        self._arrival_ns: int | None = None
        self._raised: dict[str, Level] = {}
        self._views: dict[str, int | None] = {}  # when each was published last
        self._window_s: float | None = None
        self._due_from_ns = self._heartbeat = 0
        self._reported: object = None

    def source(self, state: SourceState) -> None:
        """The source's state. "lost" is remembered until it streams again; streaming after that is a reconnect."""
        with self._lock:
            if state != self._source and state != "stalled":
                self._stamps.clear()  # no rate across a break
            if state == "streaming":
                self.counts["reconnects"] += self._lost
            self._lost = state == "lost" or (self._lost and state not in ("streaming", "closed", "ended"))
            self._source = state

    def frame(self, stamp_ns: int, arrival_ns: int) -> None:
        """A frame arrived whole. stamp_ns: on the source's clock; arrival_ns: on this object's clock."""
        with self._lock:
            self.counts["frames"] += 1
            self._arrival_ns = arrival_ns
            self._arrivals.append((arrival_ns, True))
            gap_ns = stamp_ns - self._stamps[-1] if self._stamps else 0
            if not -_LONGEST_STEP_BACK_NS <= gap_ns <= _LONGEST_GAP_NS:
                self._stamps.clear()  # its clock stepped: no rate and no gap across that
                gap_ns = 0
            if not self._stamps or gap_ns > 0:
                self._stamps.append(stamp_ns)
            if gap_ns > 0:
                self._stages["capture_gap"].add(arrival_ns, gap_ns / 1e9)

    def corrupt(self, total: int) -> None:
        """So many frames have arrived damaged since the source was opened first."""
        with self._lock:
            new, self.counts["corrupt"] = total - self.counts["corrupt"], total
            self._arrivals.extend(min(new, 1024) * [(self._clock(), False)])

    def stage(self, name: Stage, seconds: float) -> None:
        """How long a stage took once."""
        with self._lock:
            self._stages[name].add(self._clock(), seconds)

    def count(self, name: Count) -> None:
        """One more."""
        with self._lock:
            self.counts[name] += 1

    def expect(self, views: Iterable[str], window_s: float | None) -> None:
        """Which views are rendered, and how often a window begins, seconds; None if nobody waits for the clock
        (lockstep), so that no view is ever overdue. When each view was published last is kept."""
        with self._lock:
            self._views = {view_id: self._views.get(view_id) for view_id in views}
            self._window_s, self._due_from_ns = window_s, self._clock()

    def published(self, view_id: str, age_s: float) -> None:
        """A window of this view was published now; age_s: of its newest input frame, the stage "age"."""
        with self._lock:
            now_ns = self._clock()
            self._stages["age"].add(now_ns, age_s)
            if view_id in self._views:
                self._views[view_id] = now_ns

    def raise_reason(self, code: str, level: Level) -> bool:
        """Something lasting that the rules do not know, such as "fps" out of the trained set or MODEL_HUNG; whether
        that is new."""
        with self._lock:
            is_new = code not in self._raised
            self._raised[code] = level
            return is_new

    def clear_reason(self, code: str) -> bool:
        """It is over; whether it was raised."""
        with self._lock:
            return self._raised.pop(code, None) is not None

    def forget_reasons(self) -> None:
        """Clear what the last activation raised: all but a dead thread."""
        with self._lock:
            self._raised = {code: level for code, level in self._raised.items() if code == THREAD_DIED}

    def findings(self) -> dict[str, Level]:
        """Every reason there is now with its level, the worst first (docs/deploy.md explains each)."""
        with self._lock:
            return self._judged(self._clock())[0]

    def stages_s(self) -> dict[str, float]:
        """How long each stage has taken since the start, in all."""
        with self._lock:
            return {str(name): times.total_s for name, times in self._stages.items()}

    def changed(self) -> bool:
        """Whether level, reasons, readiness or a state differ from the last `report`; ready and busy are the same."""
        with self._lock:
            return self._essence(self._clock()) != self._reported

    def report(self) -> dict[str, object]:
        """status() for who publishes it: `heartbeat_seq` rises with each call."""
        with self._lock:
            self._heartbeat += 1
            self._reported = self._essence(self._clock())
        return {**self.status(), "heartbeat_seq": self._heartbeat}

    def status(self) -> dict[str, Any]:
        """The fields of a status message (wire protocol, section 4); what is unknown is left out."""
        with self._lock:
            now_ns = self._clock()
            findings, missing = self._judged(now_ns)
            counts = self.counts | {"window": sum(self.faults.values())}
            stages = {str(name): times.summary(now_ns) for name, times in self._stages.items() if times.count}
            render, memory_mb, ood, rec = stages.get("render", {}), self.gpu_mem_mb, self.ood_score, self.recording
            age_ns = None if self._arrival_ns is None else max(0, now_ns - self._arrival_ns)
            return {
                "state": self.state,
                "level": int(max(findings.values(), default=Level.OK)),
                "reasons": list(findings),
                "ready": not missing,
                "not_ready": missing,
                "source": _known(
                    state=self._source,
                    fps=self._fps(),
                    last_frame_age_ms=None if age_ns is None else round(age_ns / 1e6, 1),
                    dropped=counts["source"],
                    reconnects=counts["reconnects"],
                    corrupt=counts["corrupt"],
                ),
                "window": {
                    "built": counts["built"],
                    "rejected": counts["window"],
                    "reason_counts": dict(self.faults),
                    "skipped": counts["slot"],
                },
                "model": _known(
                    state=self.model,
                    ms_p50=render.get("p50_ms"),
                    ms_p99=render.get("p99_ms"),
                    gpu_mem_mb=None if memory_mb is None else round(memory_mb, 1),
                    oom_count=counts["oom_count"],
                    backoff_s=0.0,  # of protocol 1.0: no model is tried again later
                    nan_windows=counts["nan_windows"],
                    bad_depths=counts["bad_depths"] or None,
                    ood_score=None if ood is None else round(ood, 3),
                ),
                "publish": {"dropped": counts["queue"], **{name: counts[name] for name in ("sent", "subs", "bytes")}},
                "drops": {hop: counts[hop] for hop in get_args(Hop)},
                "stages": stages,
                "views": {
                    view_id: {} if at is None else {"last_ms": round((now_ns - at) / 1e6)}
                    for view_id, at in self._views.items()
                },
                "rec": {"state": rec.state} if rec.file is None else asdict(rec),
                **({} if self.camera is None else {"camera": dict(self.camera)}),
            }

    # What follows is called with the lock held.

    def _essence(self, now_ns: int) -> object:
        """What is worth a status message at once."""
        model = "ready" if self.model == "busy" else self.model
        return self.state, self._source, model, self.recording.state, self._judged(now_ns)

    def _fps(self) -> float | None:
        """By the latest stamps; None if there are too few."""
        if self._source in ("stalled", "lost"):
            return 0.0
        if len(self._stamps) < 2:
            return None
        return round((len(self._stamps) - 1) * 1e9 / (self._stamps[-1] - self._stamps[0]), 2)

    def _judged(self, now_ns: int) -> tuple[dict[str, Level], list[str]]:
        """Every reason with its level, the worst first; and what the node lacks to be ready."""
        is_active, is_streaming, works = self.state == "active", self._source == "streaming", self.model in _WORKING
        is_idle, window_s, render = IDLE in self._raised, self._window_s or 0.0, self._stages["render"]
        slowest_s = render.summary(now_ns)["p99_ms"] / 1000 if render.count else 0.0
        patience_ns = 1e9 * max(_LEAST_PATIENCE_S, 2 * slowest_s, 2 * window_s)
        if not (is_active and is_streaming and works) or is_idle:
            self._due_from_ns = now_ns  # no view can come
        waited_ns = max((now_ns - max(at or 0, self._due_from_ns) for at in self._views.values()), default=0)
        oldest_ns = -math.inf if self._window_s is None else now_ns - patience_ns
        is_fresh = bool(self._views) and all(at is not None and at >= oldest_ns for at in self._views.values())
        recent = [whole for at_ns, whole in self._arrivals if now_ns - at_ns <= _RECENT_NS]
        is_corrupt = len(recent) >= _LEAST_ARRIVALS and recent.count(False) > _CORRUPT_LIMIT * len(recent)
        is_overdue = self._window_s is not None and waited_ns > patience_ns + 1e9 * window_s
        rules = (
            (self.state == "errorprocessing", "NODE_ERROR", Level.ERROR),
            (self._lost, "SRC_LOST", Level.ERROR),
            (self._source == "stalled" and not self._lost, "SRC_STALLED", Level.WARN),
            (is_corrupt, "SRC_CORRUPT", Level.WARN),
            (self.model == "failed", "MODEL_FAILED", Level.ERROR),
            (self.model == "degraded", "MODEL_DEGRADED", Level.WARN),
            (is_overdue, "VIEWS_OVERDUE", Level.WARN),
            (self.recording.state == "failed", "REC_FAILED", Level.WARN),
        )
        needs = (
            (is_active, "NOT_ACTIVE"),
            (is_streaming, "SRC_NOT_STREAMING"),
            (works, "MODEL_NOT_READY"),
            (is_fresh or is_idle, "VIEWS_NOT_FRESH"),
            (THREAD_DIED not in self._raised, THREAD_DIED),
        )
        found = self._raised | {code: level for holds, code, level in rules if holds}
        worst_first = sorted(found.items(), key=lambda each: (-each[1], each[0]))
        return dict(worst_first), [code for holds, code in needs if not holds]


class StageTimes:
    """Durations of one stage. Times are monotonic nanoseconds, given by the caller. Not thread-safe."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float]] = deque(maxlen=512)
        self.count, self.total_s = 0, 0.0

    def add(self, now_ns: int, seconds: float) -> None:
        """Take note of one duration; a negative one counts as 0 (two clocks disagree), one that is no number not."""
        if math.isfinite(seconds):
            self._recent.append((now_ns, max(0.0, seconds)))
            self.count += 1
            self.total_s += max(0.0, seconds)

    def summary(self, now_ns: int) -> dict[str, float]:
        """For a status message, once there is a value: quantiles by nearest rank over the last minute (at most 512
        values, at least the last 16 there are), ms, and the count since the start."""
        recent = [seconds for at_ns, seconds in self._recent if now_ns - at_ns <= 60_000_000_000]
        if len(recent) < _LEAST_DURATIONS:
            recent = [seconds for _, seconds in list(self._recent)[-_LEAST_DURATIONS:]]
        recent.sort()
        p50_s, p99_s = (recent[math.ceil(part * len(recent)) - 1] for part in (0.5, 0.99))
        return {"p50_ms": round(1000 * p50_s, 2), "p99_ms": round(1000 * p99_s, 2), "count": self.count}


def _known(**fields: object) -> dict[str, object]:
    """Without those that are None."""
    return {name: value for name, value in fields.items() if value is not None}
