"""Health: quantiles and rates by hand-made clocks, the rules of the levels, readiness, and the status note."""

from typing import Any

import pytest
from fakes import Box

from gcd_client.protocol import OriginHeader, StatusMessage, decode, encode
from gcd_node.health import IDLE, THREAD_DIED, Health, Level, SourceState, StageTimes
from gcd_node.status import Announcer

MS = 1_000_000
S = 1_000_000_000


class Clock:
    """Monotonic nanoseconds that stand still until a test moves them; starts far from 0."""

    def __init__(self) -> None:
        self.now_ns = 5000 * S

    def __call__(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * S)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def health(clock: Clock) -> Health:
    return Health(clock)


def work(health: Health, clock: Clock, *, window_s: float | None = 1.4) -> None:
    """A node that has just published its first view."""
    health.state = "active"
    health.source("streaming")
    health.model = "ready"
    health.expect(("topdown",), window_s)
    stream(health, clock, frames=14)
    health.published("topdown", 0.25)


def stream(health: Health, clock: Clock, *, frames: int, fps: float = 10.0) -> None:
    for _ in range(frames):
        clock.sleep(1 / fps)
        health.frame(clock.now_ns, clock.now_ns)


def status(health: Health) -> dict[str, Any]:
    return health.status()


def level(health: Health) -> Level:
    return Level(status(health)["level"])


def missing(health: Health) -> list[str]:
    return status(health)["not_ready"]


def reasons(health: Health) -> list[str]:
    return status(health)["reasons"]


def test_a_stage_counts_everything_and_ranks_the_last_minute(clock: Clock) -> None:
    times = StageTimes()
    for _ in range(30):
        times.add(clock.now_ns, 9.0)
    clock.sleep(61)
    for milliseconds in range(1, 101):
        times.add(clock.now_ns, milliseconds / 1000)
    assert times.summary(clock.now_ns) == {"p50_ms": 50.0, "p99_ms": 99.0, "count": 130}
    assert times.total_s == pytest.approx(30 * 9 + 5.05)


@pytest.mark.parametrize(("seam_s", "gaps"), [(0, 19), (60, 18)], ids=["even", "looped"])
def test_the_rate_is_measured_by_stamps_and_not_by_arrivals(
    health: Health, clock: Clock, seam_s: int, gaps: int
) -> None:
    for i in range(20):
        clock.sleep(0.02 if i % 2 else 0.18)
        health.frame(i * 100 * MS + (seam_s * S if i > 16 else 0), clock.now_ns)
    assert status(health)["source"]["fps"] == pytest.approx(10.0)
    gap = status(health)["stages"]["capture_gap"]
    assert (gap["p99_ms"], gap["count"]) == (pytest.approx(100.0), gaps)


def test_a_stalled_source_warns_and_a_lost_one_is_an_error_until_it_streams(health: Health, clock: Clock) -> None:
    work(health, clock)
    clock.sleep(0.4)
    health.source("stalled")
    assert (status(health)["source"]["fps"], status(health)["source"]["last_frame_age_ms"]) == (0.0, 400.0)
    seen = []
    states: tuple[SourceState, ...] = ("stalled", "lost", "connecting", "lost", "connecting", "streaming")
    for state in states:
        health.source(state)
        seen.append((level(health), reasons(health)))
    lost = (Level.ERROR, ["SRC_LOST"])
    assert seen == [(Level.WARN, ["SRC_STALLED"]), lost, lost, lost, lost, (Level.OK, [])]
    assert status(health)["source"]["reconnects"] == 1


@pytest.mark.parametrize(("corrupt", "expected"), [(2, Level.OK), (3, Level.WARN)])
def test_over_a_fifth_of_damaged_frames_warns_and_passes(
    health: Health, clock: Clock, corrupt: int, expected: Level
) -> None:
    work(health, clock, window_s=None)
    clock.sleep(6)
    stream(health, clock, frames=8)
    health.corrupt(corrupt)
    assert level(health) is expected
    assert ("SRC_CORRUPT" in reasons(health)) == (expected is Level.WARN)
    clock.sleep(6)
    assert level(health) is Level.OK
    assert status(health)["source"]["corrupt"] == corrupt


def test_reasons_are_listed_worst_first_and_the_worst_is_the_level(health: Health, clock: Clock) -> None:
    work(health, clock)
    assert (level(health), missing(health), reasons(health)) == (Level.OK, [], [])
    health.raise_reason("fps", Level.WARN)
    health.raise_reason(IDLE, Level.OK)
    health.source("stalled")
    health.raise_reason("MODEL_HUNG", Level.ERROR)
    assert reasons(health) == ["MODEL_HUNG", "SRC_STALLED", "fps", "IDLE"]
    assert level(health) is Level.ERROR
    for code in ("MODEL_HUNG", "MODEL_HUNG", "never raised"):
        health.clear_reason(code)
    assert level(health) is Level.WARN


def test_views_that_do_not_come_warn_once_they_are_overdue(health: Health, clock: Clock) -> None:
    work(health, clock, window_s=1.0)
    stream(health, clock, frames=30)
    assert (level(health), missing(health)) == (Level.OK, ["VIEWS_NOT_FRESH"])
    stream(health, clock, frames=1)
    assert reasons(health) == ["VIEWS_OVERDUE"]
    assert missing(health) == ["VIEWS_NOT_FRESH"]
    health.published("topdown", 0.3)
    assert (level(health), missing(health)) == (Level.OK, [])


def test_what_is_missing_is_named(health: Health, clock: Clock) -> None:
    assert missing(health) == ["NOT_ACTIVE", "SRC_NOT_STREAMING", "MODEL_NOT_READY", "VIEWS_NOT_FRESH"]
    work(health, clock)
    health.source("stalled")
    assert missing(health) == ["SRC_NOT_STREAMING"]
    health.model = "failed"
    health.state = "inactive"
    assert missing(health) == ["NOT_ACTIVE", "SRC_NOT_STREAMING", "MODEL_NOT_READY"]
    health.raise_reason(THREAD_DIED, Level.ERROR)
    assert missing(health)[-1] == "THREAD_DIED"


def test_a_status_holds_every_key_of_the_protocol_that_is_known(health: Health, clock: Clock) -> None:
    work(health, clock)
    health.counts["built"], health.faults = 5, {"WIN_GAP": 2, "CLOCK_STEP": 1}
    health.counts.update(source=7, slot=4, model=2, queue=9, sent=31, subs=2, bytes=4_130_000)
    health.corrupt(1)
    for name in ("model", "oom_count", "nan_windows"):
        health.count(name)
    health.gpu_mem_mb = 812.25
    health.stage("render", 0.25)
    health.raise_reason("fps", Level.WARN)
    clock.sleep(0.05)
    told = status(health)
    stages = told.pop("stages")
    header = OriginHeader(node_id="gcd", boot_id="0" * 32, t_publish_ns=1)
    received = decode(encode(StatusMessage(topic="status", header=header, fields=told)))
    assert isinstance(received, StatusMessage)
    assert {key: received.fields[key] for key in told} == told
    source = {"state": "streaming", "fps": 10.0, "last_frame_age_ms": 50.0, "reconnects": 0, "corrupt": 1, "dropped": 7}
    model = {"state": "ready", "ms_p50": 250.0, "ms_p99": 250.0, "gpu_mem_mb": 812.2}
    faults = {"WIN_GAP": 2, "CLOCK_STEP": 1}
    overall = {"state": "active", "level": 1, "reasons": ["fps"], "ready": True, "not_ready": []}
    assert told == overall | {
        "source": source,
        "window": {"built": 5, "rejected": 3, "reason_counts": faults, "skipped": 4},
        "model": {**model, "oom_count": 1, "nan_windows": 1, "backoff_s": 0.0},
        "publish": {"sent": 31, "subs": 2, "bytes": 4_130_000, "dropped": 9},
        "drops": {"source": 7, "window": 3, "slot": 4, "model": 3, "queue": 9},
        "views": {"topdown": {"last_ms": 50}},
        "rec": {"state": "off"},
    }
    assert list(stages) == ["capture_gap", "render", "age"]
    assert stages["render"] == {"p50_ms": 250.0, "p99_ms": 250.0, "count": 1}


def test_a_change_is_noticed_once_and_rendering_is_none(health: Health, clock: Clock) -> None:
    work(health, clock)
    assert health.changed()
    assert health.report()["heartbeat_seq"] == 1
    health.model = "busy"
    health.stage("render", 0.1)
    stream(health, clock, frames=1)
    assert not health.changed()
    health.source("stalled")
    assert health.changed()
    assert health.report()["heartbeat_seq"] == 2
    assert not health.changed()


def test_a_code_that_comes_all_the_time_is_published_each_time_and_logged_now_and_then(
    caplog: pytest.LogCaptureFixture,
) -> None:
    outbox, now_s = Box(), 100.0
    announcer = Announcer("gcd", "0" * 32, outbox, Health(), lambda: now_s)
    for count in range(25):
        announcer.event("WIN_GAP", Level.WARN, {"count": count})
        announcer.event("MODEL_NAN", Level.ERROR, {"window_id": count})
        now_s += 1.0
    assert [record.getMessage() for record in caplog.records if "WIN_GAP" in record.message] == [
        f"WIN_GAP (count: {count})" for count in (0, 10, 20)
    ]
    assert len(outbox.notes) == 50
