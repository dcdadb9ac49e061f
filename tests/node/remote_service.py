"""A service in this process, in place of one on a cluster: a replica behind a plain HTTP server, faults to order."""

import asyncio
import ssl
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import torch
from fakes import FakeSynthesizer

from gcd_model import RenderOptions, SourceFeatures, Trajectory, View, ViewSynthesizer
from gcd_node.fleet import RefusedError, Replica


class WholeLevels(FakeSynthesizer):
    """Gives pictures as a service asks for them."""

    def render(
        self, features: SourceFeatures, trajectories: list[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        views = super().render(features, trajectories, options)
        for view in views:
            object.__setattr__(view, "samples", (view.samples * 255).round().to(torch.uint8))
        return views


Act = Callable[[BaseHTTPRequestHandler, Callable[[], bytes]], None]


class ServiceStandIn:
    """Use it as a context manager. act: answers a window in the replica's place: with the open request, and what gives
    the replica's own reply; None lets the replica answer. asked: windows that came."""

    def __init__(self, model: ViewSynthesizer, *, token: str | None = None, tls: ssl.SSLContext | None = None) -> None:
        config = {"model": {"weights": "fake"}, "serve": {"token": token}}
        self.replica = Replica(config, lambda _: model)
        self.act: Act | None = None
        self.asked = 0
        self._loop = asyncio.new_event_loop()
        stand_in = self

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *_: object) -> None: ...

            def do_GET(self) -> None:
                stand_in._reply(self, None)

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                stand_in.asked += 1
                act = stand_in.act
                if act is None:
                    stand_in._reply(self, body)
                else:
                    act(self, lambda: stand_in._answer(self, body))

        class Server(ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, *_: object) -> None:
                """Nodes hang up as they please."""

        self._server = Server(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}"
        if tls is not None:
            self._server.socket = tls.wrap_socket(self._server.socket, server_side=True)
            self.address = f"https://localhost:{self._server.server_port}"

    def __enter__(self) -> "ServiceStandIn":
        for target in (self._loop.run_forever, lambda: self._server.serve_forever(0.02)):
            threading.Thread(target=target, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._loop.call_soon_threadsafe(self._loop.stop)

    def _answer(self, request: BaseHTTPRequestHandler, body: bytes | None) -> bytes:
        self.replica.admit(request.headers.get("authorization", ""))
        answer: Any = self.replica.answer(body)
        return asyncio.run_coroutine_threadsafe(answer, self._loop).result(10)

    def _reply(self, request: BaseHTTPRequestHandler, body: bytes | None) -> None:
        try:
            respond(request, self._answer(request, body))
        except RefusedError as error:
            respond(request, str(error).encode(), error.status)


def respond(request: BaseHTTPRequestHandler, content: bytes, status: int = 200) -> None:
    request.send_response(status)
    request.send_header("content-length", str(len(content)))
    request.end_headers()
    request.wfile.write(content)
