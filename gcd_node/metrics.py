"""/healthz, /readyz and /metrics over HTTP, for probes and Prometheus on this machine. Needs the extra `metrics`."""

import json
import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from http import HTTPStatus
from socket import socket
from socketserver import ThreadingMixIn
from typing import Any, TypeAlias, get_args
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric, SummaryMetricFamily
from prometheus_client.registry import Collector

from gcd_node.health import Health, ModelState, SourceState
from gcd_node.lifecycle import State
from gcd_node.service import listen

_LOG = logging.getLogger(__name__)
_CALLERS = 8
_CALLER_TIMEOUT_S = 5.0

Respond: TypeAlias = Callable[[str, list[tuple[str, str]]], object]
App: TypeAlias = Callable[[dict[str, Any], Respond], Iterable[bytes]]
Row: TypeAlias = tuple[type[GaugeMetricFamily | CounterMetricFamily], str, str, str, Mapping[str, float | None]]
"""Kind, name, text, label and the value for each of its values; without a label, that of ""."""


class _Handler(WSGIRequestHandler):
    timeout = _CALLER_TIMEOUT_S

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  http.server's name
        """To the log, not to stderr."""
        _LOG.debug(format, *args)


class MetricsServer(ThreadingMixIn, WSGIServer):
    """Serves a node's health until it is closed; a context manager. At most eight callers are served at a time, others
    are turned away, so that nothing a caller does can grow the node.

    address: "127.0.0.1:PORT", "[::1]:PORT" or "localhost:PORT"; port 0 takes a free one.

    Raises:
        ConfigError: no address, or one that other machines could reach. EndpointError: the port cannot be bound.
    """

    daemon_threads = True
    block_on_close = False  # a caller that never finishes must not hold up the end

    def __init__(self, address: str, health: Health) -> None:
        listening = listen(address, "[health] http")
        super().__init__(listening.getsockname()[:2], _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening
        self.server_name, self.server_port = listening.getsockname()[:2]
        self.setup_environ()
        self.set_app(make_app(health))
        self.url = f"http://{address.rpartition(':')[0]}:{self.server_port}"
        self._room = threading.BoundedSemaphore(_CALLERS)
        self._thread = threading.Thread(target=self.serve_forever, args=(0.1,), name="metrics server", daemon=True)
        self._thread.start()

    def server_close(self) -> None:
        """Stop answering; a second call does nothing."""
        self.shutdown()
        self._thread.join()
        super().server_close()

    def process_request(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        """Give the caller a thread, or turn it away."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        """The caller's thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        """Such as a caller that hangs up in the middle."""
        _LOG.debug("a call to the metrics server failed", exc_info=True)


def make_app(health: Health) -> App:
    """The three pages as a WSGI application."""
    registry = CollectorRegistry()
    registry.register(_HealthCollector(health))
    ProcessCollector(registry=registry)
    metrics = make_wsgi_app(registry)

    def app(environ: dict[str, Any], respond: Respond) -> Iterable[bytes]:
        match environ["PATH_INFO"]:
            case "/metrics":
                return metrics(environ, respond)
            case "/healthz":
                code, fields = HTTPStatus.OK, {"live": True}
            case "/readyz":
                status = health.status()
                code = HTTPStatus.OK if status["ready"] else HTTPStatus.SERVICE_UNAVAILABLE
                fields = {key: status[key] for key in ("ready", "not_ready", "level", "reasons")}
            case _:
                code, fields = HTTPStatus.NOT_FOUND, {"pages": ["/healthz", "/readyz", "/metrics"]}
        respond(f"{code.value} {code.phrase}", [("Content-Type", "application/json"), ("Cache-Control", "no-store")])
        return [json.dumps(fields).encode() + b"\n"]

    return app


class _HealthCollector(Collector):
    """Asks how the node does whenever somebody scrapes."""

    def __init__(self, health: Health) -> None:
        self._health = health

    def collect(self) -> Iterator[Metric]:
        status = self._health.status()
        for kind, name, text, label, values in _rows(self._health, status):
            family = kind(f"gcd_{name}", text, labels=[label] if label else ())
            for each, number in values.items():
                if number is not None:  # unknown
                    family.add_metric([each] if label else [], number)
            yield family
        stages = SummaryMetricFamily("gcd_stage_seconds", "How long each stage takes.", labels=["stage"])
        sums_s = self._health.stages_s()
        for name, stage in status["stages"].items():  # quantiles of the last minute, count and sum of all
            for part, ms in (("0.5", stage["p50_ms"]), ("0.99", stage["p99_ms"])):
                stages.add_sample("gcd_stage_seconds", {"stage": name, "quantile": part}, ms / 1000)
            stages.add_metric([name], stage["count"], sums_s[name])
        yield stages


def _rows(health: Health, status: dict[str, Any]) -> Iterable[Row]:
    gauge, counter = GaugeMetricFamily, CounterMetricFamily
    source, window, model, publish = (status[name] for name in ("source", "window", "model", "publish"))
    age_ms, memory_mb = source.get("last_frame_age_ms"), model.get("gpu_mem_mb")
    ages_s = {view_id: view["last_ms"] / 1000 for view_id, view in status["views"].items() if view}
    states = (
        ("node", [state.label for state in State], status["state"]),
        ("source", get_args(SourceState), source["state"]),
        ("model", get_args(ModelState), model["state"]),
    )
    for name, known, now in states:
        text = f"1 for the state of the {name}, 0 for others."
        yield gauge, f"{name}_state", text, "state", {each: int(each == now) for each in known}
    yield gauge, "level", "0 OK, 1 WARN, 2 ERROR; the worst of gcd_reason_level.", "", {"": status["level"]}
    yield gauge, "reason_level", "Level of each reason there is now.", "code", health.findings()
    yield gauge, "ready", "1 if views come, or would if somebody subscribed.", "", {"": int(status["ready"])}
    yield gauge, "source_fps", "Frames a second by the latest stamps.", "", {"": source.get("fps")}
    yield gauge, "source_last_frame_age_seconds", "Since a frame arrived.", "", {"": age_ms and age_ms / 1000}
    yield counter, "source_frames", "Frames that arrived whole.", "", {"": health.counts["frames"]}
    yield counter, "source_corrupt_frames", "Frames that arrived damaged.", "", {"": source["corrupt"]}
    yield counter, "source_reconnects", "Times the source came back.", "", {"": source["reconnects"]}
    yield counter, "windows_built", "Windows of frames.", "", {"": window["built"]}
    yield counter, "window_faults", "What spoilt windows.", "reason", window["reason_counts"]
    yield counter, "dropped", "Frames, windows or messages given up.", "hop", status["drops"]
    yield gauge, "model_gpu_memory_bytes", "Device memory in use.", "", {"": memory_mb and memory_mb * 1e6}
    yield counter, "model_out_of_memory", "Windows the model found no memory for.", "", {"": model["oom_count"]}
    yield counter, "model_nan_windows", "Windows that came out with NaN.", "", {"": model["nan_windows"]}
    yield gauge, "view_last_published_seconds", "Since a view was published.", "view", ages_s
    moved, text = status.get("camera", {}), "How far the camera stands from where canonical views take it to stand."
    yield gauge, "camera_moved", text, "of", moved
    yield gauge, "subscriptions", "Subscriptions on the data socket.", "", {"": publish["subs"]}
    yield counter, "messages_sent", "Messages that left on the data socket.", "", {"": publish["sent"]}
    yield counter, "bytes_sent", "Bytes that left on the data socket.", "", {"": publish["bytes"]}
