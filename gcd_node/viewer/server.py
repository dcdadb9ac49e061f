"""The viewer: serves the page and its feed on loopback, one event loop for all browsers (docs/deploy.md).

Loopback alone is no protection: every page of the web that is open in a browser of this machine can send requests
there. So the Host header must name this machine (a foreign name that was made to point here does not), and a feed is
opened only for the page that was served under that very Host (Origin). Whoever commands must know the token.
"""

import asyncio
import http
import logging
import re
import secrets
import threading
import time
from collections.abc import Mapping
from importlib.resources import files

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from gcd_client.protocol import MessageError
from gcd_node.auth import Role
from gcd_node.service import listen
from gcd_node.viewer.feed import (
    MAX_REQUEST,
    Ask,
    Got,
    Hello,
    Mailbox,
    NodeEndpoints,
    NodeLink,
    Watch,
    parse_request,
    text_message,
)

MOST_BROWSERS = 8  # feeds that are served at a time
BEAT_S = 0.5  # a page that hears nothing for some of these knows that nobody lives here
_FEED = "/feed"
_OPEN_S, _PING_S, _CLOSE_S, _STUCK_S = 5.0, 5.0, 1.0, 5.0
_JOIN_S = 5.0
_BURST, _PER_S = 100, 50.0  # messages of a browser
_GOING_AWAY, _NOT_OURS, _TRY_LATER = 1001, 1008, 1013
_HOST = re.compile(r"(127(\.[0-9]{1,3}){3}|localhost|\[::1\])(:[0-9]{1,5})?")
_TUNNEL = "from elsewhere use a tunnel: ssh -L 8470:127.0.0.1:8470 ROBOT, then open http://127.0.0.1:8470 there"
_TEXT = "text/plain; charset=utf-8"
_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
_POLICY = (  # nothing from elsewhere, nothing inline, no frame around it
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self' ws://{host}; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'"
)
_LOG = logging.getLogger(__name__)
_SILENT = logging.Logger("gcd_node.viewer.websockets", logging.CRITICAL + 1)  # its debug lines would hold the token
_SILENT.propagate = False


class ViewerServer:
    """Serves in a thread of its own until it is closed. Use it as a context manager.

    http: "127.0.0.1:PORT"; port 0 takes a free one. token: what makes an operator; left out, new with every start.

    Raises:
        ConfigError: no such address, or one that other machines could reach.
        EndpointError: the port is in use or cannot be bound.
    """

    def __init__(self, http: str, node: NodeEndpoints, token: str | None = None) -> None:
        self._node, self._token = node, token or secrets.token_urlsafe(24)
        self._page = load_page()
        self._listening = listen(http, "[viewer] http")
        host, port = self._listening.getsockname()[:2]
        self.url = f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"
        """Who opens this may look."""
        self.browsers: set[Browser] = set()
        self._started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="viewer server", daemon=True)
        self._thread.start()
        self._started.wait()

    @property
    def operator_url(self) -> str:
        """Who opens this may command. Browsers send what follows the # to nobody."""
        return f"{self.url}#token={self._token}"

    def close(self) -> None:
        """End all feeds, within a few seconds whatever the browsers do; a second call does nothing."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join(_JOIN_S)

    def __enter__(self) -> "ViewerServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # What follows runs in the event loop.

    async def _serve(self) -> None:
        self._loop, self._closing = asyncio.get_running_loop(), asyncio.Event()
        self._link = NodeLink(self._node)
        try:
            async with serve(
                self._feed,
                sock=self._listening,
                process_request=self._answer,
                compression=None,
                server_header="gcd-node",
                open_timeout=_OPEN_S,
                ping_interval=_PING_S,
                ping_timeout=_PING_S,
                close_timeout=_CLOSE_S,
                max_size=MAX_REQUEST,
                logger=_SILENT,
            ):
                self._started.set()
                await self._closing.wait()
                await asyncio.gather(*(each.close(_GOING_AWAY, "the viewer has ended") for each in self.browsers))
        finally:
            self._started.set()
            await self._link.close()

    def _answer(self, _: ServerConnection, request: Request) -> Response | None:
        """A file or a refusal; None where a feed may begin."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        feed = request.path == _FEED
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
            return _response(403, _TEXT, f"this page is for browsers of this machine alone; {_TUNNEL}\n".encode())
        if (origins or feed) and origins != [f"http://{hosts[0]}"]:
            return _response(403, _TEXT, b"only the page served here may open its feed; load it from this address\n")
        if getattr(request, "method", "GET") != "GET":  # older websockets know no other
            return _response(405, _TEXT, b"this server answers GET alone\n")
        if feed:
            return None
        body, content_type = self._page.get(request.path.partition("?")[0], (b"there is no such file\n", ""))
        return _response(200 if content_type else 404, content_type or _TEXT, body, security_headers(hosts[0]))

    async def _feed(self, connection: ServerConnection) -> None:
        """One browser, until it has gone."""
        if len(self.browsers) >= MOST_BROWSERS:
            await connection.close(_TRY_LATER, f"{MOST_BROWSERS} pages are open already; close one of them")
            return
        browser = Browser(connection, self._link, self._token)
        self.browsers.add(browser)
        try:
            await browser.serve()
        except Exception:  # the end of a task
            _LOG.exception("a browser's feed broke off")
        finally:
            self.browsers.discard(browser)


class Browser:
    """One browser: what it says is read here, what waits in its mailbox is sent."""

    def __init__(self, connection: ServerConnection, link: NodeLink, token: str) -> None:
        self._connection, self._link, self._token = connection, link, token
        self._role: Role = "viewer"
        self._mailbox = Mailbox()
        self._allowed, self._allowed_s = float(_BURST), time.monotonic()

    async def serve(self) -> None:
        """Returns when the browser has gone or was sent away."""
        sender = asyncio.create_task(self._send())
        try:
            self._link.join(self._mailbox)
            async for text in self._connection:
                if not self._may_speak():
                    return await self.close(_NOT_OURS, "too many messages")
                await self._take(text)
        except MessageError as error:
            _LOG.debug("a page is sent away: %s", error)
            await self.close(_NOT_OURS, "this is no request of the page")
        except ConnectionClosed:
            pass
        finally:
            self._link.leave(self._mailbox)
            sender.cancel()

    async def close(self, code: int, reason: str) -> None:
        """Say good-bye; who takes nothing any more is cut off."""
        try:
            await asyncio.wait_for(self._connection.close(code, reason), 2 * _CLOSE_S)
        except TimeoutError:
            self._connection.transport.abort()

    def _may_speak(self) -> bool:
        now_s = time.monotonic()
        self._allowed = min(_BURST, self._allowed + _PER_S * (now_s - self._allowed_s)) - 1
        self._allowed_s = now_s
        return self._allowed >= 0

    async def _take(self, text: str | bytes) -> None:
        """Raises MessageError."""
        match parse_request(text):
            case Hello(token=token):
                right = secrets.compare_digest((token or "").encode(errors="replace"), self._token.encode())
                self._role = "operator" if right else "viewer"
                refused = token is not None and not right
                self._mailbox.put("role", text_message("role", {"role": self._role, "refused": refused}))
            case Watch(view=view):
                self._link.watch(self._mailbox, view)
            case Ask() as ask:
                self._mailbox.put(f"reply/{ask.id}", await self._link.ask(ask, self._role))
            case Got(number=number):
                self._mailbox.shown(number)

    async def _send(self) -> None:
        """Send what waits, and a beat twice a second; who takes nothing for 5 s is cut off."""
        beat_s = 0.0
        try:
            while True:
                self._mailbox.changed.clear()
                if time.monotonic() >= beat_s:
                    beat_s = time.monotonic() + BEAT_S
                    beat = text_message("beat", {"silent_ms": self._link.silent_ms})
                    await asyncio.wait_for(self._connection.send(beat), _STUCK_S)
                if (message := self._mailbox.take(time.monotonic())) is not None:
                    await asyncio.wait_for(self._connection.send(message), _STUCK_S)
                    continue
                try:
                    await asyncio.wait_for(self._mailbox.changed.wait(), max(0.0, beat_s - time.monotonic()))
                except TimeoutError:
                    continue
        except ConnectionClosed:
            pass
        except TimeoutError:
            self._connection.transport.abort()


def load_page() -> dict[str, tuple[bytes, str]]:
    """Every file of the page with its content type, by its path; "/" for the page itself."""
    return {
        "/" if entry.name == "index.html" else f"/{entry.name}": (entry.read_bytes(), f"{_TYPES[kind]}; charset=utf-8")
        for entry in files("gcd_node").joinpath("viewer", "page").iterdir()
        if (kind := entry.name.rpartition(".")[2]) in _TYPES
    }


def security_headers(host: str) -> dict[str, str]:
    """What every answer tells the browser. host: the Host header, already checked."""
    return {
        "Content-Security-Policy": _POLICY.format(host=host),
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
    }


def _response(status: int, content_type: str, body: bytes, headers: Mapping[str, str] | None = None) -> Response:
    told = {**(headers or {}), "Content-Type": content_type, "Content-Length": str(len(body)), "Connection": "close"}
    return Response(status, http.HTTPStatus(status).phrase, Headers(told), body)
