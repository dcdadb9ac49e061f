"""The viewer: serves the page and its feed on loopback, one event loop for all browsers (docs/deploy.md).

Loopback alone is no protection: every page of the web that is open in a browser of this machine can send requests
there. So the Host header must name this machine (a foreign name that was made to point here does not), and a feed is
opened only for the page that was served under that very Host (Origin). Whoever commands must know the token.
"""

import asyncio
import contextlib
import http
import logging
import re
import secrets
import signal
import sys
from importlib.resources import files

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from gcd_node.service import listen
from gcd_node.viewer.feed import MAX_REQUEST, TRY_LATER, Browser, NodeEndpoints, NodeLink

MOST_BROWSERS = 8  # feeds that are served at a time
_FEED = "/feed"
_PING_S, _CLOSE_S = 5.0, 1.0
_HOST = re.compile(r"(127(\.[0-9]{1,3}){3}|localhost|\[::1\])(:[0-9]{1,5})?")
_TUNNEL = "from elsewhere use a tunnel: ssh -L 8470:127.0.0.1:8470 ROBOT, then open http://127.0.0.1:8470 there"
_TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "require-trusted-types-for 'script'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Connection": "close",
}
"""What every answer tells the browser: nothing from elsewhere, nothing inline, no frame around it."""

_LOG = logging.getLogger(__name__)
_SILENT = logging.Logger("gcd_node.viewer.websockets", logging.CRITICAL + 1)  # its debug lines would hold the token
_SILENT.propagate = False


class ViewerServer:
    """The page of a node and the feeds of those who look at it.

    http: "127.0.0.1:PORT"; port 0 takes a free one. token: what makes an operator; left out, new with every start.

    Raises:
        ConfigError: no such address, or one that other machines could reach.
        EndpointError: the port is in use or cannot be bound.
    """

    def __init__(self, http: str, node: NodeEndpoints, token: str | None = None) -> None:
        self._node, self._token = node, token or secrets.token_urlsafe(24)
        self._page, self._link = load_page(), None
        self._listening = listen(http, "[viewer] http")
        host, port = self._listening.getsockname()[:2]
        self.url = f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"
        """Who opens this may look."""
        self.operator_url = f"{self.url}#token={self._token}"
        """Who opens this may command. Browsers send what follows the # to nobody."""

    @property
    def browsers(self) -> int:
        """Feeds that are open."""
        return 0 if self._link is None else len(self._link.browsers)

    def run(self, *, ends_with_stdin: bool = False) -> None:
        """Serve until SIGINT or SIGTERM, or until stdin, a pipe, is closed. Main thread only."""

        async def serve_until_told() -> None:
            loop, serving = asyncio.get_running_loop(), asyncio.create_task(self.serve())
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.add_signal_handler(number, serving.cancel)
            if ends_with_stdin:
                loop.add_reader(sys.stdin, lambda: (loop.remove_reader(sys.stdin), serving.cancel()))  # nobody writes
            with contextlib.suppress(asyncio.CancelledError):
                await serving

        asyncio.run(serve_until_told())

    async def serve(self) -> None:
        """Until it is cancelled; then all feeds end within a few seconds, whatever the browsers do."""
        self._link = NodeLink(self._node)
        try:
            async with serve(
                self._feed,
                sock=self._listening,
                process_request=self._answer,
                compression=None,
                server_header="gcd-node",
                open_timeout=_PING_S,
                ping_interval=_PING_S,
                ping_timeout=_PING_S,
                close_timeout=_CLOSE_S,
                max_size=MAX_REQUEST,
                logger=_SILENT,
            ) as server:
                await server.serve_forever()
        finally:
            await self._link.close()

    def _answer(self, _: ServerConnection, request: Request) -> Response | None:
        """A file or a refusal; None where a feed may begin."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        feed = request.path == _FEED
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
            return _response(403, f"this page is for browsers of this machine alone; {_TUNNEL}\n".encode())
        if (origins or feed) and origins != [f"http://{hosts[0]}"]:
            return _response(403, b"only the page served here may open its feed; load it from this address\n")
        if getattr(request, "method", "GET") != "GET":  # older websockets know no other
            return _response(405, b"this server answers GET alone\n")
        if feed:
            return None
        found = self._page.get(request.path.partition("?")[0])
        return _response(404, b"there is no such file\n") if found is None else _response(200, *found)

    async def _feed(self, connection: ServerConnection) -> None:
        """One browser, until it has gone."""
        assert self._link is not None
        if self.browsers >= MOST_BROWSERS:
            return await connection.close(TRY_LATER, f"{MOST_BROWSERS} pages are open already; close one of them")
        try:
            await Browser(connection, self._link, self._token).serve()
        except Exception:  # the end of a task
            _LOG.exception("a browser's feed broke off")


def load_page() -> dict[str, tuple[bytes, str]]:
    """Every file of the page with its content type, by its path; "/" for the page itself."""
    return {
        "/" if entry.name == "index.html" else f"/{entry.name}": (entry.read_bytes(), _TYPES[kind])
        for entry in files("gcd_node").joinpath("viewer", "page").iterdir()
        if (kind := entry.name.rpartition(".")[2]) in _TYPES
    }


def _response(status: int, body: bytes, content_type: str = "text/plain") -> Response:
    told = HEADERS | {"Content-Type": f"{content_type}; charset=utf-8", "Content-Length": str(len(body))}
    return Response(status, http.HTTPStatus(status).phrase, Headers(told), body)
