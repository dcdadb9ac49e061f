"""Clients of a page's server that are no browser, good ones and bad ones, and a server for them."""

import asyncio
import contextlib
import http.client
import json
import socket
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from gcd_node.viewer.feed import NodeEndpoints
from gcd_node.viewer.server import ViewerServer

TOKEN = "a-token-of-the-tests"
WAIT_S = 30.0


def endpoints_in(folder: Path, *, control: bool = True) -> NodeEndpoints:
    """Of the node of a Rig in this folder, or of none."""
    at = f"ipc://{folder}"
    return NodeEndpoints(data=f"{at}/data", status=f"{at}/status", control=f"{at}/control" if control else None)


class Served(ViewerServer):
    """In a thread; use it as a context manager."""

    def __enter__(self) -> "Served":
        started = threading.Event()

        async def main() -> None:
            self._loop, self._serving = asyncio.get_running_loop(), asyncio.create_task(self.serve())
            started.set()
            await asyncio.wait([self._serving])

        self._thread = threading.Thread(target=lambda: asyncio.run(main()), daemon=True)
        self._thread.start()
        started.wait()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._serving.cancel)
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()


def viewer_of(folder: Path, *, control: bool = True) -> Served:
    return Served("127.0.0.1:0", endpoints_in(folder, control=control), TOKEN)


def host_of(viewer: ViewerServer) -> str:
    return viewer.url.removeprefix("http://").rstrip("/")


def get(viewer: ViewerServer, path: str, *, hosts: list[str] | None = None, method: str = "GET", **more: str) -> Any:
    """Status, headers and body."""
    connection = http.client.HTTPConnection(host_of(viewer), timeout=WAIT_S)
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    for host in [host_of(viewer)] if hosts is None else hosts:
        connection.putheader("Host", host)
    for name, value in more.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, answer.headers, body


def deaf(viewer: ViewerServer) -> dict[str, Any]:
    """Of a feed that nobody reads: it takes one message off its socket, which holds little."""
    raw, (host, port) = socket.socket(), host_of(viewer).split(":")
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    raw.connect((host, int(port)))
    return {"sock": raw, "max_queue": 1, "close_timeout": 0.2}


def open_feed(url: str, origin: str | None = None, **limits: Any) -> ClientConnection:
    """url: of the page, as it is printed. origin: what the browser says the page came from."""
    page = url.partition("/#")[0].rstrip("/")
    feed = page.replace("http:", "ws:") + "/feed"
    limits = {"open_timeout": WAIT_S, "max_size": 2**26, **limits}
    return connect(feed, origin=page if origin is None else origin or None, **limits)  # type: ignore[arg-type]


def say(feed: ClientConnection, kind: str, **what: object) -> None:
    feed.send(json.dumps({"type": kind, **what}))


def hear(feed: ClientConnection, kind: str, holds: Callable[[Any], bool] = lambda _: True) -> Any:
    """The next note, or head of a picture, of a kind; pictures are acknowledged."""
    until_s = time.monotonic() + WAIT_S
    while time.monotonic() < until_s:
        told = feed.recv(WAIT_S)
        head = json.loads(told) if isinstance(told, str) else {"type": "picture", **taken_apart(told)[0]}
        if head["type"] == "picture":
            say(feed, "got")
        if head["type"] == kind and holds(head):
            return head
    raise AssertionError(f"no {kind} came")


def role(feed: ClientConnection, **token: str) -> tuple[str, bool]:
    """What the server makes of who says hello, and whether it refused a token."""
    say(feed, "hello", **token)
    told = hear(feed, "role")
    return told["role"], told["refused"]


def answer(feed: ClientConnection, verb: str, **args: object) -> Any:
    say(feed, "ask", id=5, verb=verb, args=args)
    reply = hear(feed, "reply")
    assert (reply["id"], reply["verb"]) == (5, verb)
    return reply


def farewell(feed: ClientConnection) -> int:
    """The code with which the other end closes; what comes before is thrown away."""
    with contextlib.suppress(ConnectionClosed):
        while feed.recv(WAIT_S) is not None:
            pass
    return feed.close_code or 0


def taken_apart(part: bytes) -> tuple[Any, bytes]:
    """Header, with how long it waited, and payload."""
    waited_ms, size = struct.unpack_from("<fI", part)
    return {**json.loads(part[8 : 8 + size]), "waited_ms": waited_ms}, part[8 + size :]
