"""Clients of a page's server that are no browser, good ones and bad ones, and servers for them."""

import base64
import contextlib
import http.client
import json
import os
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rig import Rig
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from gcd_client.protocol import ViewMessage
from gcd_client.subscriber import ReceivedView
from gcd_node.viewer.feed import NodeEndpoints
from gcd_node.viewer.server import ViewerServer

TOKEN = "a-token-of-the-tests"
WAIT_S = 30.0


def nobody(folder: Path, *, control: bool = True) -> NodeEndpoints:
    """Endpoints at which no node answers."""
    at = f"ipc://{folder}"
    return NodeEndpoints(data=f"{at}/data", status=f"{at}/status", control=f"{at}/control" if control else None)


@contextlib.contextmanager
def lonely_viewer(folder: Path) -> Iterator[ViewerServer]:
    """A page's server at whose endpoints no node answers."""
    with ViewerServer("127.0.0.1:0", nobody(folder), TOKEN) as opened:
        yield opened


@contextlib.contextmanager
def viewer_of(rig: Rig) -> Iterator[ViewerServer]:
    with ViewerServer("127.0.0.1:0", nobody(rig.folder), TOKEN) as opened:
        yield opened


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


def open_feed(viewer: ViewerServer, origin: str | None = None) -> ClientConnection:
    wanted = viewer.url.rstrip("/") if origin is None else origin
    return connect(f"ws://{host_of(viewer)}/feed", origin=wanted or None, open_timeout=WAIT_S, max_size=2**26)  # type: ignore[arg-type]


def say(feed: ClientConnection, **what: object) -> None:
    feed.send(json.dumps(what))


def hear(feed: ClientConnection, kind: str, holds: Callable[[Any], bool] = lambda _: True) -> Any:
    """The next note, or head of a picture, of a kind; pictures are acknowledged."""
    until_s = time.monotonic() + WAIT_S
    while time.monotonic() < until_s:
        told = feed.recv(WAIT_S)
        head = json.loads(told) if isinstance(told, str) else taken_apart(told)[0]
        if head["type"] == "picture":
            say(feed, type="got", number=head["number"])
        if head["type"] == kind and holds(head):
            return head
    raise AssertionError(f"no {kind} came")


def farewell(feed: ClientConnection) -> tuple[int, str]:
    """Code and reason with which the other end closes; what comes before is thrown away."""
    with contextlib.suppress(ConnectionClosed):
        while feed.recv(WAIT_S) is not None:
            pass
    return feed.close_code or 0, feed.close_reason or ""


def taken_apart(part: bytes) -> tuple[Any, bytes]:
    (size,) = struct.unpack_from("<I", part)
    return json.loads(part[4 : 4 + size]), part[4 + size :]


def raw_feed(viewer: ViewerServer) -> socket.socket:
    """A feed that was asked for by somebody who then does nothing."""
    host, port = host_of(viewer).split(":")
    raw = socket.socket()
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    raw.settimeout(WAIT_S)
    raw.connect((host, int(port)))
    key = base64.b64encode(os.urandom(16)).decode()
    lines = ["GET /feed HTTP/1.1", f"Host: {host}:{port}", f"Origin: http://{host}:{port}", "Upgrade: websocket"]
    lines += ["Connection: Upgrade", f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", "", ""]
    raw.sendall("\r\n".join(lines).encode())
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        answer += raw.recv(1)
    assert b" 101 " in answer
    return raw


def received(message: ViewMessage, age_ms: float = 50.0) -> ReceivedView:
    return ReceivedView(message=message, age_ms=age_ms, expired=False, skipped=0, restarted=False)


def send_raw(raw: socket.socket, what: dict[str, object]) -> None:
    """A masked text frame."""
    text = json.dumps(what).encode()
    assert len(text) < 126
    raw.sendall(bytes((0x81, 0x80 | len(text), 0, 0, 0, 0)) + text)
