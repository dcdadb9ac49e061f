"""/healthz, /readyz and /metrics over HTTP, for probes and for Prometheus on this machine. Needs the extra `metrics`.

At most eight callers are served at a time; who comes then is turned away, so that nothing a caller does can grow the
node.
"""

import json
import logging
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from socket import AF_INET, AF_INET6, socket
from socketserver import TCPServer, ThreadingMixIn
from types import TracebackType
from typing import Any, TypeAlias, get_args
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric, SummaryMetricFamily
from prometheus_client.registry import Collector

from gcd_node.errors import EndpointError
from gcd_node.health import Health, ModelState, Snapshot, SourceState
from gcd_node.lifecycle import State
from gcd_node.service import loopback_address

_LOG = logging.getLogger(__name__)
_CALLERS = 8
_CALLER_TIMEOUT_S = 5.0

Respond: TypeAlias = Callable[[str, list[tuple[str, str]]], object]
App: TypeAlias = Callable[[dict[str, Any], Respond], Iterable[bytes]]


class MetricsServer:
    """Serves a node's health until it is closed. Use it as a context manager.

    address: "127.0.0.1:PORT", "[::1]:PORT" or "localhost:PORT"; port 0 takes a free one.

    Raises:
        ConfigError: no address, or one that other machines could reach. EndpointError: the port cannot be bound.
    """

    def __init__(self, address: str, health: Health) -> None:
        host, port = loopback_address(address, "[health] http")
        try:
            self._server = _Server(host, port)
        except OSError as error:
            raise EndpointError(
                f"cannot bind http://{address}: {error.strerror}; stop who uses it or choose another port in [health]"
            ) from error
        self._server.set_app(make_app(health))
        self.url = f"http://{address.rpartition(':')[0]}:{self._server.server_port}"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="metrics server", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop answering; a second call does nothing."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def __enter__(self) -> "MetricsServer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()


def make_app(health: Health) -> App:
    """The three pages as a WSGI application."""
    registry = CollectorRegistry()
    registry.register(_HealthCollector(health))
    ProcessCollector(registry=registry)
    metrics: App = make_wsgi_app(registry)

    def live(_: dict[str, Any], respond: Respond) -> Iterable[bytes]:
        return _json(respond, "200 OK", {"live": True})

    def ready(_: dict[str, Any], respond: Respond) -> Iterable[bytes]:
        snapshot = health.snapshot()
        told = {key: snapshot.status[key] for key in ("ready", "not_ready", "level", "reasons")}
        return _json(respond, "200 OK" if snapshot.ready else "503 Service Unavailable", told)

    pages: dict[str, App] = {"/healthz": live, "/readyz": ready, "/metrics": metrics}

    def app(environ: dict[str, Any], respond: Respond) -> Iterable[bytes]:
        page, head = pages.get(environ["PATH_INFO"]), environ["REQUEST_METHOD"] == "HEAD"
        if page is None:
            respond("404 Not Found", [("Content-Type", "text/plain; charset=utf-8")])
            return [f"there are {', '.join(pages)}\n".encode()]
        if head:
            environ["REQUEST_METHOD"] = "GET"

        def uncached(status: str, headers: list[tuple[str, str]]) -> object:
            return respond(status, [*headers, ("Cache-Control", "no-store"), ("Server", "gcd-node")])

        body = page(environ, uncached)
        return [] if head else body

    return app


def _json(respond: Respond, status: str, fields: Mapping[str, object]) -> Iterable[bytes]:
    respond(status, [("Content-Type", "application/json")])
    return [json.dumps(fields).encode() + b"\n"]


class _HealthCollector(Collector):
    """Asks for a snapshot whenever somebody scrapes."""

    def __init__(self, health: Health) -> None:
        self._health = health

    def collect(self) -> Iterator[Metric]:
        snapshot = self._health.snapshot()
        yield from _states(snapshot)
        yield from _source_and_model(snapshot)
        yield from _windows_and_messages(snapshot.status)
        yield _stages(snapshot)


def _states(snapshot: Snapshot) -> Iterator[Metric]:
    yield GaugeMetricFamily("gcd_level", "0 OK, 1 WARN, 2 ERROR; the worst of gcd_reason_level.", int(snapshot.level))
    yield GaugeMetricFamily("gcd_ready", "1 if views come, or would if somebody subscribed.", int(snapshot.ready))
    reasons = {code: int(level) for code, level in snapshot.findings.items()}
    yield _by_label(GaugeMetricFamily, "gcd_reason_level", "Level of each reason there is now.", "code", reasons)
    status = snapshot.status
    for name, known, now in (
        ("node", tuple(state.label for state in State), status["state"]),
        ("source", get_args(SourceState), status["source"]["state"]),
        ("model", get_args(ModelState), status["model"]["state"]),
    ):
        values = {state: int(state == now) for state in known}
        text = f"1 for the state of the {name}, 0 for the others."
        yield _by_label(GaugeMetricFamily, f"gcd_{name}_state", text, "state", values)


def _source_and_model(snapshot: Snapshot) -> Iterator[Metric]:
    source, model = snapshot.status["source"], snapshot.status["model"]
    yield from _known("gcd_source_fps", "Frames a second by the latest stamps.", source.get("fps"))
    age_ms = source.get("last_frame_age_ms")
    yield from _known("gcd_source_last_frame_age_seconds", "Since a frame arrived.", age_ms and age_ms / 1000)
    yield CounterMetricFamily("gcd_source_frames", "Frames that arrived whole.", snapshot.frames)
    yield CounterMetricFamily("gcd_source_corrupt_frames", "Frames that arrived damaged.", source["corrupt"])
    yield CounterMetricFamily("gcd_source_reconnects", "Times the source came back.", source["reconnects"])
    yield CounterMetricFamily("gcd_model_out_of_memory", "Windows the model found no memory for.", model["oom_count"])
    yield CounterMetricFamily("gcd_model_nan_windows", "Windows that came out with NaN.", model["nan_windows"])
    memory_mb = model.get("gpu_mem_mb")
    yield from _known("gcd_model_gpu_memory_bytes", "Device memory in use.", memory_mb and memory_mb * 1e6)


def _windows_and_messages(status: Mapping[str, Any]) -> Iterator[Metric]:
    window, publish, drops = status["window"], status["publish"], status["drops"]
    yield CounterMetricFamily("gcd_windows_built", "Windows of frames.", window["built"])
    faults = window["reason_counts"]
    yield _by_label(CounterMetricFamily, "gcd_window_faults", "What spoilt windows.", "reason", faults)
    yield _by_label(CounterMetricFamily, "gcd_dropped", "Frames, windows or messages given up.", "hop", drops)
    ages = {view_id: view["last_ms"] / 1000 for view_id, view in status["views"].items() if view}
    text = "Since a window of the view was published."
    yield _by_label(GaugeMetricFamily, "gcd_view_last_published_seconds", text, "view", ages)
    yield CounterMetricFamily("gcd_messages_sent", "Messages that left on the data socket.", publish["sent"])
    yield CounterMetricFamily("gcd_bytes_sent", "Bytes that left on the data socket.", publish["bytes"])
    yield GaugeMetricFamily("gcd_subscriptions", "Subscriptions on the data socket.", publish["subs"])


def _stages(snapshot: Snapshot) -> Metric:
    """A summary: quantiles of the last minute, count and sum since the start."""
    family = SummaryMetricFamily("gcd_stage_seconds", "How long each stage takes.", labels=["stage"])
    for name, stage in snapshot.stages.items():
        for part, seconds in (("0.5", stage.p50_s), ("0.99", stage.p99_s)):
            family.add_sample("gcd_stage_seconds", {"stage": name, "quantile": part}, seconds)
        family.add_metric([name], stage.count, stage.total_s)
    return family


def _by_label(
    kind: type[GaugeMetricFamily | CounterMetricFamily], name: str, text: str, label: str, values: Mapping[str, float]
) -> Metric:
    family = kind(name, text, labels=[label])
    for value, number in values.items():
        family.add_metric([value], number)
    return family


def _known(name: str, text: str, value: float | None) -> Iterator[Metric]:
    """A gauge, left out while nothing is known."""
    if value is not None:
        yield GaugeMetricFamily(name, text, value)


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True
    block_on_close = False  # a caller that never finishes must not hold up the end
    request_queue_size = 16

    def __init__(self, host: str, port: int) -> None:
        self.address_family = AF_INET6 if ":" in host else AF_INET
        self._room = threading.BoundedSemaphore(_CALLERS)
        super().__init__((host, port), _Handler)

    def server_bind(self) -> None:
        """Without the look-up of the host's name that the standard library makes here."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])
        self.setup_environ()

    def process_request(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        """Give the caller a thread, or turn it away."""
        if not self._room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        """The caller's thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        """A caller that hangs up in the middle is no news; anything else is a mistake of ours."""
        gone = isinstance(sys.exception(), OSError)
        _LOG.log(logging.DEBUG if gone else logging.ERROR, "a call to the metrics server failed", exc_info=True)


class _Handler(WSGIRequestHandler):
    timeout = _CALLER_TIMEOUT_S

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  http.server's name
        """To the log, not to stderr."""
        _LOG.debug(format, *args)
