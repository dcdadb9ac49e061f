"""What a page is sent of a node, and what it may ask: reads the node's sockets as any client, and carries commands.

From the page: a Request as JSON in a text message.
To the page: JSON objects with a `type` in text messages, and pictures in binary ones: how long it waited here in ms as
a 32-bit little-endian float, the length of a JSON header as such an integer, that header, and what it describes.
"""

import asyncio
import contextlib
import json
import logging
import secrets
import struct
import time
import zlib
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import Meta
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from gcd_client.control import Code, ControlClient, ControlError, Reply
from gcd_client.endpoints import AuthError, ClientKeys
from gcd_client.images import encode_jpegs
from gcd_client.protocol import PREVIEW_ID, ClientError, MessageError, ViewKind, kind_of, to_json
from gcd_client.subscriber import ReceivedView, StatusSubscriber, ViewSubscriber
from gcd_node.auth import Role

MAX_REQUEST = 4096  # bytes a message of a browser may have
MOST_UNSEEN = 3  # pictures a browser may have on the way, sent and not yet shown
MOST_WAITING = 64  # messages that wait for a browser
BEAT_S = 0.5  # a page that hears nothing for some of these knows that nobody lives here
NOT_OURS, TRY_LATER = 1008, 1013  # codes with which a feed is closed
_MOST_A_BEAT = 100  # messages of a browser
_CLOSE_S, _STUCK_S = 2.0, 5.0
_LOOKING, _STEERING = ("describe", "views"), ("set_view", "set_param", "get_config")  # verbs of the control socket
_KINDS = tuple(kind for kind in get_args(ViewKind) if kind != "frm")
_QUALITY = 85
_RETRY_S, _REPLY_S, _SETTLE_S = 2.0, 2.0, 0.05
_EVENTS = 50
_WAITED, _LENGTH = struct.Struct("<f"), struct.Struct("<I")
_LOG = logging.getLogger(__name__)


class Request(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a browser says.

    "hello": who it is; with the `token` it is an operator, without one a viewer. "watch": which `view` to send from now
    on. "ask": a command; its `id` comes back with the reply. "got": a picture has been shown, more may come.
    """

    type: Literal["hello", "watch", "ask", "got"]
    token: Annotated[str, Meta(max_length=128)] | None = None
    view: Annotated[str, Meta(pattern=r"^[a-z0-9_]{1,16}$(?!\n)")] | None = None
    id: Annotated[int, Meta(ge=0, le=2**31)] = 0
    verb: Annotated[str, Meta(max_length=32)] = ""
    args: dict[str, Any] = {}


_REQUESTS = msgspec.json.Decoder(Request)


def parse_request(text: str | bytes) -> Request:
    """Read what a browser sent. Raises MessageError for anything else than a request."""
    if isinstance(text, bytes) or len(text) > MAX_REQUEST:
        raise MessageError(f"a request of the page is a text of at most {MAX_REQUEST} characters")
    try:
        return _REQUESTS.decode(text)
    except (msgspec.DecodeError, RecursionError, UnicodeError) as error:
        raise MessageError(f"this is no request of the page: {str(error)[:200]}") from error


def text_message(kind: str, fields: Mapping[str, Any]) -> str:
    """A text message of a type. fields: plain JSON."""
    return json.dumps({**fields, "type": kind}, allow_nan=False, separators=(",", ":"))


def picture(view: ReceivedView) -> bytes:
    """What a browser is sent of a view, but for how long it waited: pictures as JPEG; class maps, visibility and
    deviations packed without loss, depth as grey levels (zlib).

    The header has the topic's `kind` ("src" for the input), the protocol's `header`, the `offsets` of JPEGs, `age_ms`
    of the newest frame, and `left_ms`, how long it can still be used. Raises MessageError: damaged pixels.
    """
    header, payload = view.header, view.message.payload
    offsets = header.offsets
    if header.encoding == "rgb8":
        payload, offsets = encode_jpegs(view.images, _QUALITY)
    elif header.encoding != "jpeg":
        payload = zlib.compress(view.colours[..., 0].tobytes() if header.encoding == "invdepth16" else payload, 1)
    kind = "src" if header.view_id == PREVIEW_ID else kind_of(view.message.topic)
    ages = {"age_ms": view.age_ms, "left_ms": header.valid_for_ms - (view.age_ms - header.age_ms)}
    head = json.dumps({"kind": kind, "header": to_json(header), "offsets": offsets, **ages}, allow_nan=False).encode()
    return b"".join((_LENGTH.pack(len(head)), head, payload))


@dataclass(frozen=True, kw_only=True, slots=True)
class NodeEndpoints:
    """Where a node is reached. control: None if it takes no commands. keys: for tcp endpoints, if they ask for any."""

    data: str = "ipc"
    status: str = "ipc"
    control: str | None = "ipc"
    keys: ClientKeys | None = field(default=None, repr=False)

    def keys_for(self, endpoint: str) -> ClientKeys | None:
        """What this endpoint asks for: ipc endpoints of a secured node ask for nothing."""
        return self.keys if endpoint.startswith("tcp://") else None


class NodeLink:
    """What is known of the node, and which browsers get it. Everything runs in one event loop.

    Views are read only while a browser wants them; the status always, so that a browser that comes later knows the last
    minutes.
    """

    def __init__(self, node: NodeEndpoints) -> None:
        """Begin to read the node's status."""
        self._node = node
        self.browsers: set[Browser] = set()
        self._readers: dict[tuple[str, ViewKind], asyncio.Task[None]] = {}
        self._status_s: float | None = None
        self._last: dict[str, str] = {}
        self._events: deque[tuple[str, str]] = deque(maxlen=_EVENTS)
        self._count = 0
        self._notes = asyncio.create_task(_kept_up("status", self._read_notes))

    @property
    def silent_ms(self) -> int | None:
        """Since the node's last status; None before the first."""
        return None if self._status_s is None else round(1000 * (time.monotonic() - self._status_s))

    def join(self, browser: "Browser") -> None:
        """A browser is there: from now on it gets what the node says, and the input."""
        browser.put("welcome", text_message("welcome", {"commands": self._node.control is not None}))
        self.browsers.add(browser)
        for slot, text in [*self._events, *self._last.items()]:
            browser.put(slot, text)
        self.read_what_is_watched()

    def leave(self, browser: "Browser") -> None:
        """A browser has gone."""
        self.browsers.discard(browser)
        self.read_what_is_watched()

    def read_what_is_watched(self) -> None:
        """The input and the views on the browsers' screens, and no others; each topic the newest message alone."""
        views = {browser.view for browser in self.browsers if browser.view is not None}
        topics: set[tuple[str, ViewKind]] = {(view, kind) for view in views for kind in _KINDS}
        topics |= {(PREVIEW_ID, "frm")} if self.browsers else set()
        for topic in self._readers.keys() - topics:
            self._readers.pop(topic).cancel()
        for topic in topics - self._readers.keys():
            self._readers[topic] = asyncio.create_task(_kept_up("/".join(topic), self._read_view, *topic))

    async def ask(self, asked: Request, role: Role) -> str:
        """Carry a command to the node; the reply, a refusal too."""
        try:
            reply = await self._reply(asked, role)
            fields = {"ok": reply.ok, "code": reply.code, "message": reply.message, "result": reply.result}
        except (ControlError, AuthError) as error:
            code = Code.FORBIDDEN if isinstance(error, AuthError) else error.code or "NO_ANSWER"
            fields = {"ok": False, "code": code, "message": str(error), "result": None}
        return text_message("reply", {"id": asked.id, "verb": asked.verb, **fields})

    async def close(self) -> None:
        """Stop reading."""
        readers = [self._notes, *self._readers.values()]
        for reader in readers:
            reader.cancel()
        await asyncio.wait(readers)

    async def _reply(self, asked: Request, role: Role) -> Reply:
        if asked.verb not in _LOOKING and (role != "operator" or asked.verb not in _STEERING):
            known = f"a page asks for {', '.join(_LOOKING)}; opened with its token also for {', '.join(_STEERING)}"
            raise ControlError(f"{known}; not for {asked.verb!r}", Code.FORBIDDEN)
        endpoint = self._node.control
        if endpoint is None:
            raise ControlError("this node takes no commands: it has no [control] endpoint", Code.FORBIDDEN)
        keys = self._node.keys_for(endpoint)
        with ControlClient(endpoint, keys=keys, timeout_s=_REPLY_S, attempts=1) as client:
            return await client.request_async(asked.verb, asked.args)

    async def _read_view(self, view: str, kind: ViewKind) -> None:
        await asyncio.sleep(_SETTLE_S)  # a reader that was just cancelled still lets go of a file that this one may get
        endpoint = self._node.data
        with ViewSubscriber(endpoint, view, kind, keys=self._node.keys_for(endpoint)) as views:
            while True:
                if (received := await views.receive_async()) is None:  # the stream's end; another may begin
                    continue
                part = await asyncio.to_thread(picture, received)
                for browser in self.browsers:
                    if view in (browser.view, PREVIEW_ID):
                        browser.put(f"picture/{view}/{kind}", part)

    async def _read_notes(self) -> None:
        endpoint = self._node.status
        with StatusSubscriber(endpoint, keys=self._node.keys_for(endpoint)) as notes:
            async for note in notes:
                self._count += 1
                header, slot = note.header, note.topic
                told = {"node_id": header.node_id, "boot_id": header.boot_id, "at_s": header.t_publish_ns / 1e9}
                text = text_message(slot, {**told, "number": self._count, "fields": dict(note.fields)})
                if slot == "event":
                    slot = f"event/{self._count}"
                    self._events.append((slot, text))
                else:
                    self._last[slot] = text
                if slot == "status":
                    self._status_s = time.monotonic()
                for browser in self.browsers:
                    browser.put(slot, text)


async def _kept_up(name: str, read: Callable[..., Awaitable[None]], *arguments: str) -> None:
    """Read until this is cancelled, whatever happens."""
    while True:
        try:
            await read(*arguments)
        except ClientError as error:
            _LOG.warning("the page gets nothing of %s: %s", name, error)
        except Exception:  # the end of a task
            _LOG.exception("reading %s broke", name)
        await asyncio.sleep(_RETRY_S)


class Browser:
    """One browser: what it says is read here, and of all there is for it the newest is sent.

    A newer message replaces an unsent one of its slot and keeps its place in the row. Pictures wait until the browser
    has shown earlier ones, so that what it is too slow for is left out here and never piles up on the way.
    """

    def __init__(self, connection: ServerConnection, link: NodeLink, token: str) -> None:
        self.view: str | None = None
        self._connection, self._link, self._token = connection, link, token
        self._role: Role = "viewer"
        self._waiting: dict[str, tuple[float, str | bytes]] = {}  # since when (monotonic), and what
        self._changed = asyncio.Event()
        self._unseen = 0

    async def serve(self) -> None:
        """Returns when the browser has gone or was sent away."""
        sender = asyncio.create_task(self._send())
        try:
            self._link.join(self)
            beat_s, heard = time.monotonic(), 0
            async for text in self._connection:
                if time.monotonic() >= beat_s + BEAT_S:
                    beat_s, heard = time.monotonic(), 0
                heard += 1
                if heard > _MOST_A_BEAT:
                    return await self.close(NOT_OURS, "too many messages")
                await self._take(parse_request(text))
        except MessageError as error:
            _LOG.debug("a page is sent away: %s", error)
            await self.close(NOT_OURS, "this is no request of the page")
        except ConnectionClosed:
            pass
        finally:
            self._link.leave(self)
            sender.cancel()

    async def close(self, code: int, reason: str) -> None:
        """Say good-bye; who takes nothing any more is cut off."""
        try:
            await asyncio.wait_for(self._connection.close(code, reason), _CLOSE_S)
        except TimeoutError:
            self._connection.transport.abort()

    def put(self, slot: str, what: str | bytes) -> None:
        """Leave a text or a picture; when it gets too much, the oldest is given up."""
        self._waiting[slot] = time.monotonic(), what
        if len(self._waiting) > MOST_WAITING:
            del self._waiting[next(iter(self._waiting))]
        self._changed.set()

    def shown(self) -> None:
        """The browser has shown a picture."""
        self._unseen = max(0, self._unseen - 1)
        self._changed.set()

    def next_message(self) -> str | bytes | None:
        """What to send now; None while nothing waits, or only pictures and the browser is behind."""
        room = self._unseen < MOST_UNSEEN
        slot = next((slot for slot, (_, what) in self._waiting.items() if room or isinstance(what, str)), None)
        if slot is None:
            return None
        since_s, what = self._waiting.pop(slot)
        if isinstance(what, str):
            return what
        self._unseen += 1
        return _WAITED.pack(1000 * (time.monotonic() - since_s)) + what

    async def _take(self, said: Request) -> None:
        if said.type == "hello":
            right = secrets.compare_digest((said.token or "").encode(errors="replace"), self._token.encode())
            self._role = "operator" if right else "viewer"
            refused = said.token is not None and not right
            self.put("role", text_message("role", {"role": self._role, "refused": refused}))
        elif said.type == "watch":
            self.view = said.view
            self._link.read_what_is_watched()
        elif said.type == "ask":
            self.put(f"reply/{said.id}", await self._link.ask(said, self._role))
        else:
            self.shown()

    async def _send(self) -> None:
        """Send what waits, and a beat twice a second; who takes nothing for 5 s is cut off."""
        beat_s = 0.0
        try:
            while True:
                self._changed.clear()
                if time.monotonic() >= beat_s:
                    beat_s = time.monotonic() + BEAT_S
                    message = text_message("beat", {"silent_ms": self._link.silent_ms})
                else:
                    message = self.next_message()
                if message is not None:
                    await asyncio.wait_for(self._connection.send(message), _STUCK_S)
                    continue
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._changed.wait(), max(0.0, beat_s - time.monotonic()))
        except ConnectionClosed:
            pass
        except TimeoutError:
            self._connection.transport.abort()
