"""The metrics server as a probe and a scraper meet it, over real HTTP on loopback."""

import builtins
import contextlib
import http.client
import json
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest

from gcd_node.errors import ConfigError, EndpointError
from gcd_node.health.metrics_server import MetricsServer, loopback_address
from gcd_node.health.monitor import Health
from gcd_node.health.report import Level

prometheus = pytest.importorskip("prometheus_client", reason="needs the extra `metrics`")
from prometheus_client.openmetrics.parser import (  # noqa: E402
    text_string_to_metric_families as open_metrics_families,
)
from prometheus_client.parser import text_string_to_metric_families  # noqa: E402

pytestmark = pytest.mark.timeout(60)
S = 1_000_000_000


@pytest.fixture
def health() -> Health:
    return Health()


@pytest.fixture
def server(health: Health) -> Iterator[MetricsServer]:
    with MetricsServer("127.0.0.1:0", health) as opened:
        yield opened


def get(server: MetricsServer, path: str, accept: str = "*/*", method: str = "GET") -> tuple[int, str, bytes]:
    """Status, content type and body; of an error too."""
    request = urllib.request.Request(server.url + path, headers={"Accept": accept}, method=method)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.headers["Content-Type"], answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.headers["Content-Type"], error.read()


def samples(server: MetricsServer) -> dict[tuple[str, ...], float]:
    """Every sample by its name and its labels' values."""
    body = get(server, "/metrics")[2].decode()
    families = text_string_to_metric_families(body)
    found = [each for family in families for each in family.samples]
    return {(each.name, *(value for _, value in sorted(each.labels.items())[::-1])): each.value for each in found}


def make_ready(health: Health) -> None:
    now_ns = time.monotonic_ns()
    health.state("active")
    health.source("streaming")
    health.model("busy")
    health.expect(("topdown",), window_s=3600.0)
    for i in range(11):
        health.frame(now_ns + i * S // 10, now_ns)
    health.published("topdown", 0.25)


def test_a_node_that_serves_is_alive_whatever_its_state(server: MetricsServer, health: Health) -> None:
    health.model("failed")
    status, content_type, body = get(server, "/healthz")
    assert (status, content_type, json.loads(body)) == (200, "application/json", {"live": True})


def test_a_node_is_ready_only_once_views_come(server: MetricsServer, health: Health) -> None:
    status, _, body = get(server, "/readyz")
    assert status == 503
    assert json.loads(body) == {
        "ready": False,
        "not_ready": ["NOT_ACTIVE", "SRC_NOT_STREAMING", "MODEL_NOT_READY", "VIEWS_NOT_FRESH"],
        "level": 0,
        "reasons": [],
    }
    make_ready(health)
    status, _, body = get(server, "/readyz")
    assert (status, json.loads(body)["ready"]) == (200, True)
    health.source("lost")
    status, _, body = get(server, "/readyz")
    told = json.loads(body)
    assert (status, told["not_ready"], told["level"], told["reasons"]) == (503, ["SRC_NOT_STREAMING"], 2, ["SRC_LOST"])


def test_metrics_hold_what_the_health_was_told(server: MetricsServer, health: Health) -> None:
    make_ready(health)
    for seconds in (0.1, 0.2, 0.3):
        health.stage("render", seconds)
    health.windows(4, {"WIN_GAP": 2})
    health.drop("slot", 5)
    health.corrupt(1)
    health.model_load(gpu_mem_mb=812.5)
    health.sent(31, 2, 4130)
    health.raise_reason("fps", Level.WARN)
    found = samples(server)
    expected = {
        ("gcd_level",): 1,
        ("gcd_ready",): 1,
        ("gcd_reason_level", "fps"): 1,
        ("gcd_node_state", "active"): 1,
        ("gcd_node_state", "inactive"): 0,
        ("gcd_source_state", "streaming"): 1,
        ("gcd_model_state", "busy"): 1,
        ("gcd_model_state", "failed"): 0,
        ("gcd_source_frames_total",): 11,
        ("gcd_source_corrupt_frames_total",): 1,
        ("gcd_source_fps",): 10,
        ("gcd_windows_built_total",): 4,
        ("gcd_window_faults_total", "WIN_GAP"): 2,
        ("gcd_dropped_total", "slot"): 5,
        ("gcd_dropped_total", "window"): 2,
        ("gcd_dropped_total", "queue"): 0,
        ("gcd_model_gpu_memory_bytes",): 812.5e6,
        ("gcd_messages_sent_total",): 31,
        ("gcd_bytes_sent_total",): 4130,
        ("gcd_subscriptions",): 2,
        ("gcd_stage_seconds", "render", "0.5"): 0.2,
        ("gcd_stage_seconds", "render", "0.99"): 0.3,
        ("gcd_stage_seconds_count", "render"): 3,
        ("gcd_stage_seconds", "age", "0.5"): 0.25,
    }
    assert {key: found.get(key) for key in expected} == pytest.approx(expected)
    assert found["gcd_stage_seconds_sum", "render"] == pytest.approx(0.6)
    assert 0 <= found["gcd_view_last_published_seconds", "topdown"] < 60
    assert found["process_resident_memory_bytes",] > 1e6


def test_metrics_of_a_node_that_knows_nothing_yet_leave_out_what_is_unknown(server: MetricsServer) -> None:
    found = samples(server)
    assert found["gcd_node_state", "unconfigured"] == 1
    assert ("gcd_source_fps",) not in found
    assert not [key for key in found if key[0].startswith(("gcd_stage", "gcd_model_gpu", "gcd_view"))]


@pytest.mark.parametrize(
    ("accept", "kind"),
    [
        ("*/*", "text/plain"),
        ("application/openmetrics-text; version=1.0.0; charset=utf-8,text/plain;q=0.5", "application/openmetrics-text"),
        ("application/openmetrics-text; version=\u00e9;escaping==", "application/openmetrics-text"),
        ("text/plain; version=abc", "text/plain"),
    ],
)
def test_a_scraper_gets_the_format_it_asks_for(server: MetricsServer, health: Health, accept: str, kind: str) -> None:
    make_ready(health)
    status, content_type, body = get(server, "/metrics", accept)
    parse = open_metrics_families if kind.startswith("application") else text_string_to_metric_families
    names = {family.name for family in parse(body.decode())}
    assert (status, content_type.partition(";")[0]) == (200, kind)
    assert {"gcd_level", "gcd_stage_seconds", "gcd_dropped"} <= names | {name.removesuffix("_total") for name in names}


def test_every_metric_is_explained_in_the_docs(
    server: MetricsServer, health: Health, request: pytest.FixtureRequest
) -> None:
    make_ready(health)
    health.model_load(gpu_mem_mb=1.0)
    body = get(server, "/metrics")[2].decode()
    ours = {family.name for family in text_string_to_metric_families(body) if family.name.startswith("gcd_")}
    text = (request.config.rootpath / "docs" / "reliability.md").read_text()
    assert len(ours) > 20
    assert [name for name in sorted(ours) if f"`{name}" not in text] == []


def test_head_and_unknown_paths_and_methods(server: MetricsServer) -> None:
    assert get(server, "/healthz?probe=1", method="HEAD") == (200, "application/json", b"")
    status, _, body = get(server, "/etc/passwd")
    assert (status, body) == (404, b"there are /healthz, /readyz, /metrics\n")
    assert get(server, "/metrics", method="POST")[0] == 501


def test_the_server_does_not_say_what_it_runs_on(server: MetricsServer) -> None:
    with urllib.request.urlopen(server.url + "/healthz", timeout=20) as answer:
        assert answer.headers["Server"].strip() == "gcd-node"


def test_callers_that_say_nothing_neither_grow_the_node_nor_lock_probes_out_for_good(
    server: MetricsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gcd_node.health.metrics_server._Handler.timeout", 0.5)
    host, port = loopback_address(server.url.removeprefix("http://"))
    before = threading.active_count()
    silent = [socket.create_connection((host, port), timeout=20) for _ in range(30)]
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


@pytest.mark.parametrize("sent", [b"\x00\xff" * 40, b"GET " + b"/" * 70_000, b"GET /metrics HTTP/9.9\r\n\r\n", b"\r\n"])
def test_junk_is_refused_and_the_next_caller_served(server: MetricsServer, sent: bytes) -> None:
    host, port = loopback_address(server.url.removeprefix("http://"))
    with socket.create_connection((host, port), timeout=20) as caller:
        caller.sendall(sent)
        caller.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionResetError):
            assert b" 200 " not in caller.recv(100)
    assert get(server, "/healthz")[0] == 200


def test_close_frees_the_port_and_may_be_called_twice(health: Health) -> None:
    server = MetricsServer("127.0.0.1:0", health)
    address = server.url.removeprefix("http://")
    held = http.client.HTTPConnection(address, timeout=20)
    held.connect()
    server.close()
    server.close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(loopback_address(address), timeout=20)
    with MetricsServer(address, health) as again:
        assert get(again, "/healthz")[0] == 200
    held.close()


def test_a_port_in_use_is_named(server: MetricsServer, health: Health) -> None:
    address = server.url.removeprefix("http://")
    with pytest.raises(EndpointError, match=f"{address}.*in use.*another port"):
        MetricsServer(address, health)


@pytest.mark.parametrize("address", ["0.0.0.0:9100", "192.168.1.4:9100", "[::]:9100", "robot.local:9100", "*:9100"])
def test_other_machines_are_refused(address: str, health: Health) -> None:
    with pytest.raises(ConfigError, match=r"other machines.*127\.0\.0\.1"):
        MetricsServer(address, health)


@pytest.mark.parametrize("address", ["", "9100", "127.0.0.1", ":9100", "127.0.0.1:", "127.0.0.1:x", "127.0.0.1:65536"])
def test_what_is_no_address_is_refused(address: str, health: Health) -> None:
    with pytest.raises(ConfigError, match=r"127\.0\.0\.1:PORT"):
        MetricsServer(address, health)


@pytest.mark.parametrize(
    ("address", "expected"),
    [("127.0.0.1:9100", ("127.0.0.1", 9100)), ("[::1]:0", ("::1", 0)), ("localhost:1", ("localhost", 1))],
)
def test_loopback_has_three_spellings(address: str, expected: tuple[str, int]) -> None:
    assert loopback_address(address) == expected


def test_without_the_extra_the_error_names_it(health: Health, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def blocked(name: str, *args: Any, **kwargs: Any) -> object:
        if name.startswith("prometheus_client"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return real(name, *args, **kwargs)

    monkeypatch.delitem(sys.modules, "gcd_node.health.metrics", raising=False)
    monkeypatch.setattr(builtins, "__import__", blocked)
    with pytest.raises(ConfigError, match=r"prometheus_client.*gcd-node\[metrics\]"):
        MetricsServer("127.0.0.1:0", health)


def test_the_core_imports_without_the_extra() -> None:
    code = (
        "import sys; sys.modules['prometheus_client'] = None\n"
        "import gcd_node.health.monitor, gcd_node.health.metrics_server, gcd_node.health.logs\n"
        "import gcd_node.health.systemd, gcd_node.cli.status\n"
        "print('imported')"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50, check=False)
    assert (ended.returncode, ended.stdout) == (0, "imported\n"), ended.stderr
