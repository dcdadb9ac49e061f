"""The metrics server as a probe and a scraper meet it, over real HTTP on loopback."""

import contextlib
import json
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest

from gcd_node.errors import ConfigError
from gcd_node.health import Health, Level
from gcd_node.session import metrics_server

prometheus = pytest.importorskip("prometheus_client", reason="needs the extra `metrics`")
from prometheus_client.parser import text_string_to_metric_families  # noqa: E402

from gcd_node.metrics import MetricsServer  # noqa: E402

pytestmark = pytest.mark.timeout(60)
S = 1_000_000_000


@pytest.fixture
def health() -> Health:
    return Health()


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


def samples(server: MetricsServer) -> dict[str, float]:
    """Every sample by its name and its labels' values."""
    families = text_string_to_metric_families(get(server, "/metrics")[1])
    found = [each for family in families for each in family.samples]
    return {
        " ".join((each.name, *(value for _, value in sorted(each.labels.items())[::-1]))): each.value for each in found
    }


def make_ready(health: Health) -> None:
    now_ns = time.monotonic_ns()
    health.state = "active"
    health.source("streaming")
    health.model = "busy"
    health.expect(("topdown",), window_s=3600.0)
    for i in range(11):
        health.frame(now_ns + i * S // 10, now_ns)
    health.published("topdown", 0.25)


def test_a_node_is_ready_only_once_views_come(server: MetricsServer, health: Health) -> None:
    def ready(*missing: str, level: int = 0, reasons: tuple[str, ...] = ()) -> tuple[int, Any]:
        fields = {"ready": not missing, "not_ready": list(missing), "level": level, "reasons": list(reasons)}
        return (503 if missing else 200), fields

    everything = ("NOT_ACTIVE", "SRC_NOT_STREAMING", "MODEL_NOT_READY", "VIEWS_NOT_FRESH")
    assert get(server, "/readyz") == ready(*everything)
    make_ready(health)
    assert get(server, "/readyz") == ready()
    health.source("lost")
    assert get(server, "/readyz") == ready("SRC_NOT_STREAMING", level=2, reasons=("SRC_LOST",))
    assert get(server, "/healthz") == (200, {"live": True})
    assert get(server, "/")[0] == 404


def test_metrics_hold_what_the_health_was_told_and_are_explained_in_the_docs(
    server: MetricsServer, health: Health, request: pytest.FixtureRequest
) -> None:
    make_ready(health)
    for seconds in (0.1, 0.2, 0.3):
        health.stage("render", seconds)
    health.counts["built"], health.faults = 4, {"WIN_GAP": 2}
    health.counts.update(slot=5, sent=31, subs=2, bytes=4130)
    health.corrupt(1)
    health.gpu_mem_mb = 812.5
    health.raise_reason("fps", Level.WARN)
    found = samples(server)
    expected = {
        "gcd_level": 1, "gcd_ready": 1, "gcd_reason_level fps": 1, "gcd_node_state active": 1,
        "gcd_node_state inactive": 0, "gcd_source_state streaming": 1, "gcd_model_state busy": 1,
        "gcd_source_frames_total": 11, "gcd_source_corrupt_frames_total": 1, "gcd_source_fps": 10,
        "gcd_windows_built_total": 4, "gcd_window_faults_total WIN_GAP": 2, "gcd_dropped_total slot": 5,
        "gcd_dropped_total window": 2, "gcd_dropped_total queue": 0, "gcd_model_gpu_memory_bytes": 812.5e6,
        "gcd_messages_sent_total": 31, "gcd_bytes_sent_total": 4130, "gcd_subscriptions": 2,
        "gcd_stage_seconds render 0.5": 0.2, "gcd_stage_seconds render 0.99": 0.3, "gcd_stage_seconds_sum render": 0.6,
        "gcd_stage_seconds_count render": 3, "gcd_stage_seconds age 0.5": 0.25,
    }  # fmt: skip
    assert {key: found.get(key) for key in expected} == pytest.approx(expected)
    assert 0 <= found["gcd_view_last_published_seconds topdown"] < 60
    assert found["process_resident_memory_bytes"] > 1e6
    families = text_string_to_metric_families(get(server, "/metrics")[1])
    ours = {family.name for family in families if family.name.startswith("gcd_")}
    text = (request.config.rootpath / "docs" / "deploy.md").read_text()
    assert len(ours) == 22
    assert [name for name in sorted(ours) if f"`{name}" not in text] == []


def test_callers_that_say_nothing_neither_grow_the_node_nor_lock_probes_out_for_good(
    server: MetricsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_without_the_extra_a_launch_file_that_asks_for_it_is_refused(
    health: Health, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    monkeypatch.delitem(sys.modules, "gcd_node.metrics")
    with pytest.raises(ConfigError):
        metrics_server("127.0.0.1:0", health)


@pytest.mark.parametrize("sent", [b"\x00\xff" * 40, b"GET " + b"/" * 70_000, b"GET /metrics HTTP/9.9\r\n\r\n", b"\r\n"])
def test_junk_is_refused_and_the_next_caller_served(server: MetricsServer, sent: bytes) -> None:
    with connected(server) as caller:
        caller.sendall(sent)
        caller.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionResetError):
            assert b" 200 " not in caller.recv(100)
    assert get(server, "/healthz")[0] == 200
