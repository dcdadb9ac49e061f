"""A small HTTP server for this machine alone: /healthz, /readyz and /metrics.

Made for liveness and readiness probes and for Prometheus. It answers GET and HEAD, reads no body, and serves at most
eight callers at a time; who comes then is turned away, so that nothing a caller does can grow the node.
"""

import json
import logging
import sys
import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import AF_INET, AF_INET6, socket
from socketserver import TCPServer
from types import TracebackType
from typing import Any, ClassVar, TypeAlias

from gcd_node.errors import ConfigError, EndpointError
from gcd_node.health.monitor import Health
from gcd_node.wire.endpoints import is_loopback

_LOG = logging.getLogger(__name__)
_CALLERS = 8
_CALLER_TIMEOUT_S = 5.0
_JSON = "application/json"

Answer: TypeAlias = tuple[int, str, bytes]
"""HTTP status, content type, body."""

Page: TypeAlias = Callable[[str], Answer]
"""Makes an answer; takes the caller's Accept header."""


class MetricsServer:
    """Serves a node's health until it is closed. Use it as a context manager.

    address: "127.0.0.1:PORT", "[::1]:PORT" or "localhost:PORT"; port 0 takes a free one.

    Raises:
        ConfigError: no such address, one that other machines could reach, or the extra `metrics` is missing.
        EndpointError: the port is in use or cannot be bound.
    """

    def __init__(self, address: str, health: Health) -> None:
        host, port = loopback_address(address)
        pages = _pages(health)
        try:
            self._server = _Server(host, port, pages)
        except OSError as error:
            raise EndpointError(
                f"cannot bind http://{address}: {error.strerror}; stop who uses it or choose another port in [health]"
            ) from error
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._server.server_address[1]}"
        self._closing = threading.Lock()
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="metrics server", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop answering; a second call does nothing."""
        with self._closing:
            if self._thread.is_alive():
                self._server.shutdown()
                self._thread.join()
            self._server.server_close()

    def __enter__(self) -> "MetricsServer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()


def loopback_address(address: str) -> tuple[str, int]:
    """Host, without brackets, and port of an address on this machine.

    Raises:
        ConfigError: it has no port, or is not loopback.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f'[health] http must be "127.0.0.1:PORT", got {address!r}')
    if not is_loopback(f"tcp://{address}"):
        raise ConfigError(
            f'[health] http = "{address}" can be reached from other machines, and nothing there asks who calls: '
            "use 127.0.0.1, and a scraper or a proxy on this machine"
        )
    return host.strip("[]"), int(port)


def _pages(health: Health) -> dict[str, Page]:
    try:
        from gcd_node.health.metrics import NodeMetrics
    except ImportError as error:
        raise ConfigError(
            f"[health] http needs the package {error.name}: pip install 'gcd-node[metrics]', or leave http out"
        ) from error
    metrics = NodeMetrics(health)

    def live(_: str) -> Answer:
        return _json(200, {"live": True})

    def ready(_: str) -> Answer:
        report = health.snapshot()
        told: dict[str, object] = {"ready": report.ready, "not_ready": report.missing, "level": report.level}
        return _json(200 if report.ready else 503, told | {"reasons": list(report.findings)})

    def scrape(accept: str) -> Answer:
        body, content_type = metrics.exposition(accept)
        return 200, content_type, body

    return {"/healthz": live, "/readyz": ready, "/metrics": scrape}


def _json(status: int, told: dict[str, object]) -> Answer:
    return status, _JSON, json.dumps(told).encode() + b"\n"


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False  # a caller that never finishes must not hold up the end
    request_queue_size = 16

    def __init__(self, host: str, port: int, pages: dict[str, Page]) -> None:
        self.address_family = AF_INET6 if ":" in host else AF_INET
        self._room = threading.BoundedSemaphore(_CALLERS)
        super().__init__((host, port), type("_PagesHandler", (_Handler,), {"pages": pages}))

    def server_bind(self) -> None:
        """Without the look-up of the host's name that the standard library makes here."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

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


class _Handler(BaseHTTPRequestHandler):
    server_version = "gcd-node"
    sys_version = ""
    timeout = _CALLER_TIMEOUT_S
    pages: ClassVar[Mapping[str, Page]] = {}

    def do_GET(self) -> None:
        """Answer with a page."""
        path = self.path.partition("?")[0]
        page = self.pages.get(path)
        if page is None:
            known = ", ".join(self.pages)
            self._answer((404, "text/plain; charset=utf-8", f"there are {known}\n".encode()))
            return
        self._answer(page(self.headers.get("Accept", "")))

    do_HEAD = do_GET  # noqa: N815  http.server's name

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  http.server's name
        """To the log, not to stderr."""
        _LOG.debug(format, *args)

    def _answer(self, answer: Answer) -> None:
        status, content_type, body = answer
        self.send_response(status)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)
