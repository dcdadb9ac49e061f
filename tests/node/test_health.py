"""Health: quantiles and rates by hand-made clocks, the rules of the levels, readiness, and the status note."""

import contextlib
import json
import socket
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest
from fakes import Box
from wire_messages import origin

from gcd_client.protocol import StatusMessage, decode, encode
from gcd_node.errors import ConfigError
from gcd_node.health import IDLE, THREAD_DIED, Health, Level, SourceState, StageTimes
from gcd_node.session import metrics_server
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
    health.state, health.model = "active", "ready"
    health.source("streaming")
    health.expect(("topdown",), window_s)
    stream(health, clock, frames=14)
    health.published("topdown", 0.25)


def stream(health: Health, clock: Clock, *, frames: int, fps: float = 10.0) -> None:
    for _ in range(frames):
        clock.sleep(1 / fps)
        health.frame(clock.now_ns, clock.now_ns)


def told(health: Health) -> tuple[int, list[str], list[str]]:
    """Level, reasons, and what is missing to be ready."""
    status = health.status()
    assert status["ready"] == (not status["not_ready"])
    return status["level"], status["reasons"], status["not_ready"]


def test_a_stage_counts_everything_and_ranks_the_last_minute(clock: Clock) -> None:
    times = StageTimes()
    for milliseconds in (*[9000] * 30, None, *range(1, 101)):
        if milliseconds is None:
            clock.sleep(61)
        else:
            times.add(clock.now_ns, milliseconds / 1000)
    assert times.summary(clock.now_ns) == {"p50_ms": 50.0, "p99_ms": 99.0, "count": 130}
    assert times.total_s == pytest.approx(30 * 9 + 5.05)


def test_the_rate_is_that_of_stamps_not_of_arrivals(clock: Clock) -> None:
    for seam_s, gaps in ((0, 19), (60, 18)):  # even, and looped
        health = Health(clock)
        for i in range(20):
            clock.sleep(0.02 if i % 2 else 0.18)
            health.frame(i * 100 * MS + (seam_s * S if i > 16 else 0), clock.now_ns)
        assert health.status()["source"]["fps"] == pytest.approx(10.0)
        gap = health.status()["stages"]["capture_gap"]
        assert (gap["p99_ms"], gap["count"]) == (pytest.approx(100.0), gaps)


def test_a_stalled_source_warns_and_a_lost_one_is_an_error_until_it_streams(health: Health, clock: Clock) -> None:
    work(health, clock)
    clock.sleep(0.4)
    health.source("stalled")
    source = health.status()["source"]
    assert (source["fps"], source["last_frame_age_ms"]) == (0.0, 400.0)
    seen = []
    states: tuple[SourceState, ...] = ("stalled", "lost", "connecting", "lost", "connecting", "streaming")
    for state in states:
        health.source(state)
        seen.append(told(health)[:2])
    lost = (Level.ERROR, ["SRC_LOST"])
    assert seen == [(Level.WARN, ["SRC_STALLED"]), lost, lost, lost, lost, (Level.OK, [])]
    assert health.status()["source"]["reconnects"] == 1


def test_a_fifth_of_damaged_frames_warns_and_passes(clock: Clock) -> None:
    for corrupt, expected in ((2, []), (3, ["SRC_CORRUPT"])):
        health = Health(clock)
        work(health, clock, window_s=None)
        clock.sleep(6)
        stream(health, clock, frames=8)
        for total in (corrupt - 1, corrupt, corrupt):
            health.corrupt(total)
        assert told(health)[:2] == (len(expected), expected)
        clock.sleep(6)
        assert told(health)[0] == Level.OK
        assert health.status()["source"]["corrupt"] == corrupt


def test_reasons_are_listed_worst_first_and_the_worst_is_the_level(health: Health, clock: Clock) -> None:
    work(health, clock)
    assert told(health) == (Level.OK, [], [])
    assert health.raise_reason("fps", Level.WARN)
    health.raise_reason(IDLE, Level.OK)
    health.source("stalled")
    assert [health.raise_reason("MODEL_HUNG", Level.ERROR) for _ in range(2)] == [True, False]
    assert told(health)[:2] == (Level.ERROR, ["MODEL_HUNG", "SRC_STALLED", "fps", "IDLE"])
    for code in ("MODEL_HUNG", "MODEL_HUNG", "never raised"):
        health.clear_reason(code)
    assert told(health)[0] == Level.WARN
    health.raise_reason(THREAD_DIED, Level.ERROR)
    health.forget_reasons()
    assert told(health)[1] == [THREAD_DIED, "SRC_STALLED"]


def test_views_that_do_not_come_warn_and_what_is_missing_is_named(health: Health, clock: Clock) -> None:
    work(health, clock, window_s=1.0)
    stream(health, clock, frames=30)
    assert told(health) == (Level.OK, [], ["VIEWS_NOT_FRESH"])
    stream(health, clock, frames=1)
    assert told(health) == (Level.WARN, ["VIEWS_OVERDUE"], ["VIEWS_NOT_FRESH"])
    health.raise_reason(IDLE, Level.OK)
    assert told(health) == (Level.OK, [IDLE], [])
    health.clear_reason(IDLE)
    assert told(health) == (Level.OK, [], ["VIEWS_NOT_FRESH"])  # from now on they are due again
    health.published("topdown", 0.3)
    assert told(health) == (Level.OK, [], [])
    health.source("stalled")
    assert told(health)[2] == ["SRC_NOT_STREAMING"]
    health.model, health.state = "failed", "inactive"
    health.raise_reason(THREAD_DIED, Level.ERROR)
    assert told(health)[2] == ["NOT_ACTIVE", "SRC_NOT_STREAMING", "MODEL_NOT_READY", "THREAD_DIED"]


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
    status = health.status()
    stages = status.pop("stages")
    message = StatusMessage(topic="status", header=origin(), fields=status)
    assert decode(encode(message)).fields == status
    timed = {"ms_p50": 250.0, "ms_p99": 250.0, "gpu_mem_mb": 812.2, "backoff_s": 0.0}
    feed = {"state": "streaming", "fps": 10.0, "last_frame_age_ms": 50.0, "reconnects": 0, "corrupt": 1, "dropped": 7}
    assert status == {"state": "active", "level": 1, "reasons": ["fps"], "ready": True, "not_ready": []} | {
        "source": feed,
        "window": {"built": 5, "rejected": 3, "reason_counts": {"WIN_GAP": 2, "CLOCK_STEP": 1}, "skipped": 4},
        "model": {"state": "ready", "oom_count": 1, "nan_windows": 1, **timed},
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
    assert not health.changed()
    health.source("stalled")
    assert health.changed()


def test_a_code_that_comes_all_the_time_is_logged_now_and_then(caplog: pytest.LogCaptureFixture) -> None:
    outbox, now_s = Box(), 100.0
    announcer = Announcer("gcd", "0" * 32, outbox, Health(), lambda: now_s)
    for count in range(25):
        announcer.event("WIN_GAP", Level.WARN, {"count": count})
        announcer.event("MODEL_NAN", Level.ERROR, {"window_id": count})
        now_s += 1.0
    assert sum("WIN_GAP" in record.message for record in caplog.records) == 3
    assert len(outbox.notes) == 50


# The metrics server as a probe and a scraper meet it, over real HTTP on loopback.


prometheus = pytest.importorskip("prometheus_client", reason="needs the extra `metrics`")
from prometheus_client.parser import text_string_to_metric_families  # noqa: E402

from gcd_node.metrics import MetricsServer  # noqa: E402


@pytest.fixture
def server(health: Health) -> Iterator[MetricsServer]:
    with MetricsServer("127.0.0.1:0", health) as opened:
        yield opened


def get(server: MetricsServer, path: str) -> tuple[int, Any]:
    """Status and body, of an error too; a body of JSON read."""
    try:
        with urllib.request.urlopen(server.url + path, timeout=20) as answer:
            code, body = answer.status, answer.read()
    except urllib.error.HTTPError as error:
        code, body = error.code, error.read()
    return code, body.decode() if path == "/metrics" else json.loads(body)


def connected(server: MetricsServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.server_port), timeout=20)


def families(server: MetricsServer) -> list[Any]:
    return list(text_string_to_metric_families(get(server, "/metrics")[1]))


def test_a_node_is_ready_only_once_views_come(server: MetricsServer, health: Health, clock: Clock) -> None:
    code, told = get(server, "/readyz")
    assert (code, told["not_ready"]) == (503, ["NOT_ACTIVE", "SRC_NOT_STREAMING", "MODEL_NOT_READY", "VIEWS_NOT_FRESH"])
    work(health, clock, window_s=3600.0)
    assert get(server, "/readyz") == (200, {"ready": True, "not_ready": [], "level": 0, "reasons": []})
    health.source("lost")
    assert get(server, "/readyz")[0] == 503
    assert get(server, "/healthz") == (200, {"live": True})
    assert get(server, "/")[0] == 404


def test_metrics_hold_what_the_health_was_told_and_are_explained_in_the_docs(
    server: MetricsServer, health: Health, clock: Clock, request: pytest.FixtureRequest
) -> None:
    work(health, clock, window_s=3600.0)
    for seconds in (0.1, 0.2, 0.3):
        health.stage("render", seconds)
    health.counts["built"], health.faults = 4, {"WIN_GAP": 2}
    health.counts.update(slot=5, sent=31, subs=2, bytes=4130)
    health.corrupt(1)
    health.gpu_mem_mb = 812.5
    health.raise_reason("fps", Level.WARN)
    samples = [each for family in families(server) for each in family.samples]
    found = {
        " ".join((each.name, *(value for _, value in sorted(each.labels.items())[::-1]))): each.value
        for each in samples
    }
    expected = {
        "gcd_level": 1, "gcd_ready": 1, "gcd_reason_level fps": 1, "gcd_node_state active": 1,
        "gcd_node_state inactive": 0, "gcd_source_state streaming": 1, "gcd_model_state ready": 1,
        "gcd_source_frames_total": 14, "gcd_source_corrupt_frames_total": 1, "gcd_source_fps": 10,
        "gcd_windows_built_total": 4, "gcd_window_faults_total WIN_GAP": 2, "gcd_dropped_total slot": 5,
        "gcd_dropped_total window": 2, "gcd_dropped_total queue": 0, "gcd_model_gpu_memory_bytes": 812.5e6,
        "gcd_messages_sent_total": 31, "gcd_bytes_sent_total": 4130, "gcd_subscriptions": 2,
        "gcd_stage_seconds render 0.5": 0.2, "gcd_stage_seconds render 0.99": 0.3, "gcd_stage_seconds_sum render": 0.6,
        "gcd_stage_seconds_count render": 3, "gcd_stage_seconds age 0.5": 0.25,
    }  # fmt: skip
    assert {key: found.get(key) for key in expected} == pytest.approx(expected)
    assert 0 <= found["gcd_view_last_published_seconds topdown"] < 60
    assert found["process_resident_memory_bytes"] > 1e6
    ours = {family.name for family in families(server) if family.name.startswith("gcd_")}
    text = (request.config.rootpath / "docs" / "deploy.md").read_text()
    assert len(ours) > 20
    assert [name for name in sorted(ours) if f"`{name}" not in text] == []


def test_silent_callers_lock_nobody_out_for_good(server: MetricsServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gcd_node.metrics._Handler.timeout", 0.5)
    before = threading.active_count()
    silent = [connected(server) for _ in range(30)]
    try:
        for caller in silent[8:]:
            assert caller.recv(1) == b""  # turned away
        assert threading.active_count() - before <= 8
        for caller in silent[:8]:
            assert caller.recv(1) == b""  # timed out
        assert get(server, "/healthz")[0] == 200
    finally:
        for caller in silent:
            caller.close()


def test_junk_is_refused_and_the_next_one_served(
    server: MetricsServer, health: Health, monkeypatch: pytest.MonkeyPatch
) -> None:
    for sent in (b"\x00\xff" * 40, b"GET " + b"/" * 70_000, b"GET /metrics HTTP/9.9\r\n\r\n", b"\r\n"):
        with connected(server) as caller:
            caller.sendall(sent)
            caller.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                assert b" 200 " not in caller.recv(100)
        assert get(server, "/healthz")[0] == 200
    monkeypatch.setitem(sys.modules, "prometheus_client", None)  # without the extra
    monkeypatch.delitem(sys.modules, "gcd_node.metrics")
    with pytest.raises(ConfigError):
        metrics_server("127.0.0.1:0", health)
