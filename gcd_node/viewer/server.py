"""Serves the page and its feed on loopback, in threads of its own (docs/viewer.md)."""

import http
import logging
import os
import socket
import struct
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from gcd_node.errors import ConfigError, EndpointError
from gcd_node.security.gate import ServerSecurity
from gcd_node.security.keys import ClientKeys, read_key_pair
from gcd_node.viewer.access import Access, Refusal, security_headers, viewer_address
from gcd_node.viewer.browser import Browser
from gcd_node.viewer.hub import Hub, NodeEndpoints
from gcd_node.viewer.messages import MAX_REQUEST
from gcd_node.viewer.page_files import load_page

MOST_BROWSERS = 8
"""Feeds that are served at a time."""

_MOST_CONNECTIONS = 32
_FEED = "/feed"
_OPEN_S, _PING_S, _CLOSE_S, _STUCK_S = 5.0, 5.0, 1.0, 5
_TRY_LATER = 1013
_JOIN_S = 2.0
_BREATH_S = 0.1
_LOG = logging.getLogger(__name__)
_SILENT = logging.Logger("gcd_node.viewer.websockets", logging.CRITICAL + 1)  # its debug lines would hold the token
_SILENT.propagate = False


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewerOptions:
    """http: "127.0.0.1:PORT"; port 0 takes a free one."""

    http: str
    node: NodeEndpoints
    access: Access = field(default_factory=Access)


class ViewerServer:
    """Serves until it is closed. Use it as a context manager.

    Raises:
        ConfigError: no such address, or one that other machines could reach.
        EndpointError: the port is in use or cannot be bound. NodeError: the package lacks the page.
    """

    def __init__(self, options: ViewerOptions) -> None:
        self._node, self._access = options.node, options.access
        self._page = load_page()
        listening = _bound(options.http)
        host, port = listening.getsockname()[:2]
        self.url = f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"
        """Who opens this may look."""
        self._closing, self._lock = False, threading.Lock()
        self._gone = threading.Condition(self._lock)
        self._connections: set[socket.socket] = set()
        self._browsers: set[Browser] = set()
        self._hub = Hub(options.node)
        self._listening, self._library = listening, _library(listening, self)
        self._thread = threading.Thread(target=self._accept, name="viewer server", daemon=True)
        self._thread.start()

    @property
    def operator_url(self) -> str:
        """Who opens this may command. Browsers send what follows the # to nobody."""
        return f"{self.url}#token={self._access.token}"

    @property
    def browsers(self) -> int:
        """How many are served now."""
        with self._lock:
            return len(self._browsers)

    @property
    def feeds(self) -> int:
        """Topics of the node that are read now."""
        return self._hub.feeds

    def close(self) -> None:
        """End all feeds, within a few seconds whatever the browsers do; a second call does nothing."""
        with self._lock:
            if self._closing:
                return
            self._closing = True
            browsers = list(self._browsers)
        _hang_up(self._listening)
        self._listening.close()
        for browser in browsers:
            browser.close()
        if not self._wait_for_all():
            with self._lock:
                left = list(self._connections)
            for each in left:  # whoever still holds on; threads that wait for it come free
                _hang_up(each)
            self._wait_for_all()
        self._thread.join(_JOIN_S)
        self._hub.close()

    def __enter__(self) -> "ViewerServer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    # What follows is called by the server's threads.

    def _accept(self) -> None:
        """Every connection gets a thread; so they are counted before anything is read from one."""
        while True:
            try:
                connection, peer = self._listening.accept()
            except OSError:
                if self._closing:
                    return
                time.sleep(_BREATH_S)  # no file descriptors left, or a connection that was gone at once
                continue
            with self._lock:
                room = not self._closing and len(self._connections) < _MOST_CONNECTIONS
                if room:
                    self._connections.add(connection)
            if room:
                threading.Thread(
                    target=self._handle, args=(connection, peer), name="viewer browser", daemon=True
                ).start()
            else:
                connection.close()

    def _handle(self, connection: socket.socket, peer: Any) -> None:
        try:
            # Who takes nothing for so long is given up: the library's own pings wait behind what is being sent.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", _STUCK_S, 0))
            self._library.handler(connection, peer)
        finally:
            with self._lock:
                self._connections.discard(connection)
                self._gone.notify_all()

    def answer(self, _: ServerConnection, request: Request) -> Response | None:
        """A file or a refusal; None where a feed may begin."""
        path, feed = request.path.partition("?")[0], request.path == _FEED
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        refusal = self._access.refusal(hosts, origins, feed=feed)
        if refusal is None and getattr(request, "method", "GET") != "GET":  # older websockets know no other
            refusal = Refusal(status=405, reason="this server answers GET alone")
        if refusal is not None:
            return _response(refusal.status, "text/plain; charset=utf-8", refusal.reason.encode() + b"\n", {})
        headers = security_headers(hosts[0])
        if feed:
            return None
        file = self._page.get(path)
        if file is None:
            return _response(404, "text/plain; charset=utf-8", b"there is no such file\n", headers)
        return _response(200, file.content_type, file.body, headers)

    def serve_feed(self, connection: ServerConnection) -> None:
        """One browser, until it has gone."""
        browser = Browser(connection, self._hub, self._node, self._access)
        with self._lock:
            room = not self._closing and len(self._browsers) < MOST_BROWSERS
            if room:
                self._browsers.add(browser)
        if not room:
            connection.close(_TRY_LATER, f"{MOST_BROWSERS} pages are open already; close one of them")
            return
        try:
            browser.serve()
        except Exception:  # the end of a thread
            _LOG.exception("a browser's feed broke off")
        finally:
            with self._lock:
                self._browsers.discard(browser)

    def _wait_for_all(self) -> bool:
        """Whether all connections have ended, soon."""
        with self._lock:
            return self._gone.wait_for(lambda: not self._connections, _CLOSE_S + 0.5)


def own_keys(folder: str | None, security: ServerSecurity | None) -> ClientKeys | None:
    """With what the page reaches a secured node of this process: client keys from this folder. None for one without.

    Raises:
        ConfigError: the node asks for keys and none are given, or they cannot be read.
    """
    if security is None:
        return None
    if folder is None:
        raise ConfigError(
            "this node asks its clients for keys, and the page is one of them: make a pair with `gcd-node keys new`, "
            "name its folder in [viewer] keys, and put its public key on the list in [security] allow"
        )
    return ClientKeys(own=read_key_pair(Path(folder).expanduser()), server=security.keys.public)


def _bound(address: str) -> socket.socket:
    host, port = viewer_address(address)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=16)
    except OSError as error:
        raise EndpointError(
            f"cannot bind http://{address}: {_reason(error)}; stop who uses it or choose another port in [viewer]"
        ) from error


def _reason(error: OSError) -> str:
    """Without what create_server() adds to it, which is the address once more."""
    return str(error.strerror) if error.errno is None else os.strerror(error.errno)


def _library(listening: socket.socket, viewer: ViewerServer) -> Server:
    """What speaks HTTP and WebSocket on one connection; accepting them is our own work, as it sets no limit."""
    return serve(
        viewer.serve_feed,
        sock=listening,
        process_request=viewer.answer,
        compression=None,
        server_header="gcd-node",
        open_timeout=_OPEN_S,
        ping_interval=_PING_S,
        ping_timeout=_PING_S,
        close_timeout=_CLOSE_S,
        max_size=MAX_REQUEST,
        logger=_SILENT,
    )


def _hang_up(connection: socket.socket) -> None:
    try:
        connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        _LOG.debug("a connection was gone already")


def _response(status: int, content_type: str, body: bytes, headers: Mapping[str, str]) -> Response:
    told = {**headers, "Content-Type": content_type, "Content-Length": str(len(body)), "Connection": "close"}
    return Response(status, http.HTTPStatus(status).phrase, Headers(told), body)
