"""What is known of a node's health at one moment, what it amounts to, and how the status note says it."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from gcd_node.health.stage_times import StageSummary

SourceState: TypeAlias = Literal["closed", "connecting", "streaming", "stalled", "lost", "ended"]
ModelState: TypeAlias = Literal["absent", "loading", "warming", "ready", "busy", "degraded", "failed"]
RecordState: TypeAlias = Literal["off", "recording", "stopping", "failed"]

Stage: TypeAlias = Literal["capture_gap", "window", "encode", "render", "publish", "age"]
"""capture_gap: between the stamps of two frames. window: from the arrival of a window's newest frame until the model
takes it. encode, render: of the model, a window each. publish: from the last pixel until the publisher has it.
age: of the newest input frame when its view is published."""

Hop: TypeAlias = Literal["source", "window", "slot", "model", "queue"]
"""Where something was given up. source: frames (skipped by a slow reader, stamps that did not rise). window: windows
rejected, see their reasons. slot: windows replaced by newer ones before the model was free. model: windows that were
rendered and could not be used (NaN, no memory). queue: messages the publisher had no room for."""

STAGES: tuple[Stage, ...] = ("capture_gap", "window", "encode", "render", "publish", "age")
HOPS: tuple[Hop, ...] = ("source", "window", "slot", "model", "queue")

CORRUPT_LIMIT = 0.2
"""More damaged frames than this, over CORRUPT_SPAN_S, is a warning."""

CORRUPT_SPAN_S = 5.0


class Level(enum.IntEnum):
    """How bad it is, with the numbers of a ROS 2 DiagnosticStatus. STALE is for readers: who hears nothing says it."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceHealth:
    """The camera or recording.

    lost: it was lost and has not streamed since, whatever `state` says now.
    fps: by the stamps of the latest frames, 0 while it is silent or lost; last_frame_age_ms: since a frame arrived.
        None before there are any.
    frames: arrived whole since the start.
    reconnects: times it came back. corrupt: frames that arrived damaged; corrupt_share: of the last 5 s.
    dropped: frames given up before a window.
    """

    state: SourceState = "closed"
    lost: bool = False
    fps: float | None = None
    last_frame_age_ms: float | None = None
    frames: int = 0
    reconnects: int = 0
    corrupt: int = 0
    corrupt_share: float = 0.0
    dropped: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelHealth:
    """The model. ooms, nan_windows, bad_depths: since the start; bad_depths are frames whose depth could not be used.
    gpu_mem_mb: None on a CPU. backoff_s: until it is tried again. ood_score: of the last window, None for a model that
    cannot tell.
    """

    state: ModelState = "absent"
    gpu_mem_mb: float | None = None
    ooms: int = 0
    nan_windows: int = 0
    bad_depths: int = 0
    backoff_s: float = 0.0
    ood_score: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class PublishHealth:
    """What left on the data socket since the start, and the subscriptions there now."""

    sent: int = 0
    subscribers: int = 0
    bytes: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordHealth:
    """The recording under way, or the last one.

    state: "failed" is one that ended by itself. file: the one written to now or last, below the folder of recordings.
    bytes: on the disk, all files together. written: messages. dropped: frames, windows and notes that found no room in
        the queue, by topic.
    """

    state: RecordState = "off"
    file: str | None = None
    bytes: int = 0
    written: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict[str, int])

    def to_status(self) -> dict[str, object]:
        """The field `rec` of a status note."""
        status: dict[str, object] = {"state": self.state}
        if self.file is not None:
            status |= {"file": self.file, "bytes": self.bytes, "written": self.written, "dropped": dict(self.dropped)}
        return status


@dataclass(frozen=True, kw_only=True, slots=True)
class HealthReport:
    """A node's health at one moment.

    state: of the lifecycle, lower case. built: windows. reason_counts: what spoilt windows, and how often.
    drops: by hop. stages: those measured so far. views: how long ago each was published, ms; None if never.
    overdue: views are due and do not come. idle: nobody subscribes, so nothing is rendered.
    raised: further reasons and their levels, as the node raised them.
    missing: what keeps the node from being ready; empty if it is.
    """

    state: str
    source: SourceHealth
    model: ModelHealth
    publish: PublishHealth
    built: int
    reason_counts: Mapping[str, int]
    drops: Mapping[Hop, int]
    stages: Mapping[Stage, StageSummary]
    views: Mapping[str, float | None]
    overdue: bool
    raised: Mapping[str, Level]
    missing: tuple[str, ...]
    rec: RecordHealth = field(default_factory=RecordHealth)

    @property
    def findings(self) -> dict[str, Level]:
        """Every reason with its level, the worst first.

            NODE_ERROR      ERROR   the lifecycle is in errorprocessing
            SRC_LOST        ERROR   the source was lost and has not streamed since
            SRC_STALLED     WARN    the source is silent
            SRC_CORRUPT     WARN    over 20 % of the frames of 5 s arrived damaged
            MODEL_FAILED    ERROR   the model was given up
            MODEL_DEGRADED  WARN    it runs with less than was asked for
            VIEWS_OVERDUE   WARN    frames come, nobody is idle, and still no view was published for too long
            REC_FAILED      WARN    a recording has ended by itself

        and whatever the node raised itself.
        """
        found = dict(self.raised)
        rules = (
            (self.state == "errorprocessing", "NODE_ERROR", Level.ERROR),
            (self.source.lost, "SRC_LOST", Level.ERROR),
            (self.source.state == "stalled" and not self.source.lost, "SRC_STALLED", Level.WARN),
            (self.source.corrupt_share > CORRUPT_LIMIT, "SRC_CORRUPT", Level.WARN),
            (self.model.state == "failed", "MODEL_FAILED", Level.ERROR),
            (self.model.state == "degraded", "MODEL_DEGRADED", Level.WARN),
            (self.overdue, "VIEWS_OVERDUE", Level.WARN),
            (self.rec.state == "failed", "REC_FAILED", Level.WARN),
        )
        found |= {code: level for holds, code, level in rules if holds}
        return dict(sorted(found.items(), key=lambda each: (-each[1], each[0])))

    @property
    def level(self) -> Level:
        """The worst of all findings."""
        return max(self.findings.values(), default=Level.OK)

    @property
    def ready(self) -> bool:
        """Whether views come, or would if somebody subscribed."""
        return not self.missing

    def to_status(self, heartbeat: int) -> dict[str, object]:
        """The fields of a status note (wire protocol, section 4); what is not known is left out."""
        return {
            "state": self.state,
            "level": int(self.level),
            "reasons": list(self.findings),
            "ready": self.ready,
            "not_ready": list(self.missing),
            "source": self._source_status(),
            "window": {
                "built": self.built,
                "rejected": self.drops["window"],
                "reason_counts": dict(self.reason_counts),
                "skipped": self.drops["slot"],
            },
            "model": self._model_status(),
            "publish": {
                "sent": self.publish.sent,
                "subs": self.publish.subscribers,
                "bytes": self.publish.bytes,
                "dropped": self.drops["queue"],
            },
            "drops": dict(self.drops),
            "stages": {
                name: {"p50_ms": _ms(stage.p50_s), "p99_ms": _ms(stage.p99_s), "count": stage.count}
                for name, stage in self.stages.items()
            },
            "views": {view_id: {} if ago is None else {"last_ms": round(ago)} for view_id, ago in self.views.items()},
            "rec": self.rec.to_status(),
            "heartbeat_seq": heartbeat,
        }

    def _source_status(self) -> dict[str, object]:
        source = self.source
        status: dict[str, object] = {
            "state": source.state,
            "reconnects": source.reconnects,
            "corrupt": source.corrupt,
            "dropped": source.dropped,
        }
        if source.fps is not None:
            status["fps"] = round(source.fps, 2)
        if source.last_frame_age_ms is not None:
            status["last_frame_age_ms"] = round(source.last_frame_age_ms, 1)
        return status

    def _model_status(self) -> dict[str, object]:
        model, render = self.model, self.stages.get("render")
        status: dict[str, object] = {
            "state": model.state,
            "oom_count": model.ooms,
            "nan_windows": model.nan_windows,
            "backoff_s": model.backoff_s,
        }
        if render is not None:
            status |= {"ms_p50": _ms(render.p50_s), "ms_p99": _ms(render.p99_s)}
        if model.gpu_mem_mb is not None:
            status["gpu_mem_mb"] = round(model.gpu_mem_mb, 1)
        if model.bad_depths:
            status["bad_depths"] = model.bad_depths
        if model.ood_score is not None:
            status["ood_score"] = round(model.ood_score, 3)
        return status


def _ms(seconds: float) -> float:
    return round(1000 * seconds, 2)
