"""What a page is sent of a node, and what it may ask: reads the node's sockets as any client, and carries commands.

From the page: one JSON object in a text message, one of Hello, Watch, Ask, Got.
To the page: JSON objects with a `type` in text messages, and pictures in binary ones: the length of a JSON header as
a 32-bit little-endian number, that header, and what it describes.
"""

import asyncio
import contextlib
import json
import logging
import struct
import time
import zlib
from collections import OrderedDict, deque
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, TypeAlias, get_args

import msgspec
from msgspec import Meta

from gcd_client.control import Code, ControlClient, ControlError, Reply
from gcd_client.endpoints import AuthError, ClientKeys
from gcd_client.images import encode_jpegs
from gcd_client.protocol import PREVIEW_ID, ClientError, MessageError, StatusMessage, ViewKind, kind_of, to_json
from gcd_client.subscriber import ReceivedView, StatusSubscriber, ViewSubscriber
from gcd_node.auth import Role

MAX_REQUEST = 4096  # bytes a message of a browser may have
MOST_UNSEEN = 3  # pictures a browser may have on the way, sent and not yet shown
MOST_WAITING = 64  # messages that wait for a browser
_LOOKING: Final = frozenset({"describe", "views"})
_STEERING: Final = frozenset({"set_view", "set_param", "get_config"})
_KINDS: tuple[ViewKind, ...] = tuple(kind for kind in get_args(ViewKind) if kind != "frm")
_QUALITY = 85
_RETRY_S, _REPLY_S = 2.0, 2.0
_MOST_AT_ONCE, _SETTLE_S = 64, 0.05
_EVENTS = 50
_LENGTH = struct.Struct("<I")
_LOG = logging.getLogger(__name__)


class Hello(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="hello"):
    """Who it is. token: makes it an operator; without one it is a viewer."""

    token: Annotated[str, Meta(max_length=128)] | None = None


class Watch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="watch"):
    """Which view to send from now on."""

    view: Annotated[str, Meta(pattern=r"^[a-z0-9_]{1,16}$(?!\n)")]


class Ask(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="ask"):
    """A command. id: comes back with its reply."""

    id: Annotated[int, Meta(ge=0, le=2**31)]
    verb: Annotated[str, Meta(max_length=32)]
    args: dict[str, Any] = {}


class Got(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="got"):
    """The picture of this number is on the screen; more may come."""

    number: Annotated[int, Meta(ge=0, le=2**53)]


Request: TypeAlias = Hello | Watch | Ask | Got

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


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Picture:
    """A picture message for browsers, the same for all of them but for its number and its age.

    kind: of the topic, "src" for the input. age_ms, left_ms: how old its newest frame was, and how long it could still
    be used, at `born_s` (monotonic).
    """

    view: str
    kind: str
    head: Mapping[str, Any]
    payload: bytes
    age_ms: float
    left_ms: float
    born_s: float = field(default_factory=time.monotonic)

    def part(self, number: int, now_s: float) -> bytes:
        """The binary message, as old as it is now."""
        since_ms = max(0.0, 1000 * (now_s - self.born_s))
        ages = {"age_ms": round(self.age_ms + since_ms, 1), "left_ms": round(self.left_ms - since_ms, 1)}
        fields = {**self.head, "view": self.view, "kind": self.kind, "number": number, **ages}
        head = text_message("picture", fields).encode()
        return b"".join((_LENGTH.pack(len(head)), head, self.payload))


def picture(view: ReceivedView) -> Picture:
    """What a browser is sent of a view: pictures as JPEG; class maps, visibility and deviations packed without loss,
    depth as grey levels (zlib). Raises MessageError: pixels that do not fit the header."""
    header = view.header
    payload, offsets = _packed(view)
    return Picture(
        view=header.view_id,
        kind="src" if header.view_id == PREVIEW_ID else kind_of(view.message.topic),
        head={"offsets": offsets, **_head(view)},
        payload=payload,
        age_ms=view.age_ms,
        left_ms=header.valid_for_ms - (view.age_ms - header.age_ms),
    )


def _packed(view: ReceivedView) -> tuple[bytes, tuple[int, ...] | None]:
    """Payload, and where each JPEG begins; None for pixels packed as one."""
    encoding, payload = view.header.encoding, view.message.payload
    if encoding == "jpeg":
        return bytes(payload), view.header.offsets
    if encoding == "rgb8":
        return encode_jpegs(view.images, _QUALITY)
    return zlib.compress(view.colours[..., 0].tobytes() if encoding == "invdepth16" else payload, 1), None


def _head(view: ReceivedView) -> dict[str, Any]:
    """What the page shows of a header. Times are seconds, as doubles: for the eye."""
    header = view.header
    frames, height, width, _ = header.shape
    return {
        "boot_id": header.boot_id,
        "rev": header.view_rev,
        "window_id": header.window_id,
        "frames": frames,
        "height": height,
        "width": width,
        "fps": header.src.fps_cond,
        "source": {"kind": header.src.kind, "id": header.src.id, "fps": header.src.fps_in},
        "epoch": header.src.epoch,
        "captured_s": [stamp_ns / 1e9 for stamp_ns in header.t_capture_ns],
        "clock": header.clock,
        "at_s": header.t_publish_ns / 1e9,
        "valid_for_ms": header.valid_for_ms,
        "pose": None if header.pose is None else to_json(header.pose[-1]),
        "synthetic": header.synthetic,
        "quality": to_json(header.quality),
        "model": to_json(header.model),
        "scale": header.scale,
        "classes": None if header.classes is None else [to_json(each) for each in header.classes],
    }


class Mailbox:
    """What waits to be sent to one browser: of everything the newest.

    A newer message replaces an unread one of its slot and keeps its place in the row. Pictures wait until the browser
    has shown earlier ones, so that what it is too slow for is left out here and never piles up on the way.
    """

    def __init__(self) -> None:
        self.changed = asyncio.Event()
        self._waiting: OrderedDict[str, str | Picture] = OrderedDict()
        self._sent = self._shown = 0

    def put(self, slot: str, what: str | Picture) -> None:
        """Leave a message; when it gets too much, the oldest is given up."""
        self._waiting[slot] = what
        if len(self._waiting) > MOST_WAITING:
            self._waiting.popitem(last=False)
        self.changed.set()

    def put_picture(self, shown: Picture) -> None:
        """Leave a picture."""
        self.put(f"picture/{shown.view}/{shown.kind}", shown)

    def drop_views(self) -> None:
        """Forget the pictures that still wait, but for those of the input."""
        for slot, what in list(self._waiting.items()):
            if isinstance(what, Picture) and what.view != PREVIEW_ID:
                del self._waiting[slot]

    def shown(self, number: int) -> None:
        """The browser has shown the picture of this number, and so all before it."""
        self._shown = max(self._shown, min(number, self._sent))
        self.changed.set()

    def take(self, now_s: float) -> str | bytes | None:
        """The message to send now; None while nothing waits, or only pictures and the browser is behind."""
        room = self._sent - self._shown < MOST_UNSEEN
        slot = next((slot for slot, each in self._waiting.items() if room or isinstance(each, str)), None)
        what = None if slot is None else self._waiting.pop(slot)
        if not isinstance(what, Picture):
            return what
        self._sent += 1
        return what.part(self._sent, now_s)


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
        self._watched: dict[Mailbox, str | None] = {}
        self._readers: dict[str, asyncio.Task[None]] = {}
        self._newest: dict[tuple[str, str], Picture] = {}
        self._status_s: float | None = None
        self._last: dict[str, str] = {}
        self._events: deque[tuple[str, str]] = deque(maxlen=_EVENTS)
        self._count = 0
        self._notes = asyncio.create_task(self._read_notes())

    @property
    def silent_ms(self) -> int | None:
        """Since the node's last status; None before the first."""
        return None if self._status_s is None else round(1000 * max(0.0, time.monotonic() - self._status_s))

    def join(self, browser: Mailbox) -> None:
        """A browser is there: from now on it gets what the node says, and the input."""
        browser.put("welcome", text_message("welcome", {"commands": self._node.control is not None}))
        self.watch(browser, None)
        for slot, text in [*self._events, *self._last.items()]:
            browser.put(slot, text)

    def watch(self, browser: Mailbox, view: str | None) -> None:
        """A browser wants to see this view instead of the one before; None for the input alone."""
        browser.drop_views()
        self._watched[browser] = view
        self._read_what_is_watched()
        for newest in self._newest.values():
            if newest.view in (view, PREVIEW_ID):
                browser.put_picture(newest)

    def leave(self, browser: Mailbox) -> None:
        """A browser has gone."""
        self._watched.pop(browser, None)
        self._read_what_is_watched()

    async def ask(self, ask: Ask, role: Role) -> str:
        """Carry a command to the node; the reply, a refusal too."""
        try:
            reply = await self._request(ask, role)
            fields = {"ok": reply.ok, "code": reply.code, "message": reply.message, "result": reply.result}
        except (ControlError, AuthError) as error:
            code = Code.FORBIDDEN if isinstance(error, AuthError) else error.code or "NO_ANSWER"
            fields = {"ok": False, "code": code, "message": str(error), "result": None}
        return text_message("reply", {"id": ask.id, "verb": ask.verb, **fields})

    async def close(self) -> None:
        """Stop reading."""
        readers = [self._notes, *self._readers.values()]
        for reader in readers:
            reader.cancel()
        await asyncio.wait(readers)

    async def _request(self, ask: Ask, role: Role) -> Reply:
        endpoint = self._node.control
        if ask.verb not in _LOOKING | _STEERING:
            known = ", ".join(sorted(_LOOKING | _STEERING))
            raise ControlError(f"a page asks for {known}, not for {ask.verb!r}; use `gcd-node ctl`", Code.FORBIDDEN)
        if ask.verb in _STEERING and role != "operator":
            raise ControlError(
                "you are looking, not steering: open the address that was printed, with its #token=...", Code.FORBIDDEN
            )
        if endpoint is None:
            raise ControlError("this node takes no commands: it has no [control] endpoint", Code.FORBIDDEN)
        keys = self._node.keys_for(endpoint)
        with ControlClient(endpoint, keys=keys, timeout_s=_REPLY_S, attempts=1) as client:
            return await client.request_async(ask.verb, ask.args)

    def _read_what_is_watched(self) -> None:
        views = {view for view in self._watched.values() if view is not None}
        views |= {PREVIEW_ID} if self._watched else set()
        for view in self._readers.keys() - views:
            self._readers.pop(view).cancel()
            self._newest = {key: newest for key, newest in self._newest.items() if key[0] != view}
        for view in views - self._readers.keys():
            self._readers[view] = asyncio.create_task(self._read_view(view))

    async def _read_view(self, view: str) -> None:
        """Until it is cancelled. Of the views that have come, the newest of each topic: nobody must see old ones."""
        endpoint, keys = self._node.data, self._node.keys_for(self._node.data)
        kinds = ("frm",) if view == PREVIEW_ID else _KINDS
        await asyncio.sleep(_SETTLE_S)  # a reader that was just cancelled still lets go of a file that this one may get
        while True:
            with _logged_errors(view), ViewSubscriber(endpoint, view, kinds, conflate=False, keys=keys) as views:
                while True:
                    newest: dict[str, ReceivedView] = {}
                    received, count = await views.receive_async(), 0
                    while received is not None:
                        newest[received.message.topic] = received
                        count += 1  # a node that is faster than this must not keep everybody waiting
                        received = await views.receive_async(0) if count < _MOST_AT_ONCE else None
                    for each in newest.values():
                        with contextlib.suppress(MessageError):  # its pixels: the page leaves it out
                            self._take_picture(await asyncio.to_thread(picture, each))
            await asyncio.sleep(_RETRY_S)

    async def _read_notes(self) -> None:
        """Until it is cancelled."""
        while True:
            keys = self._node.keys_for(self._node.status)
            with _logged_errors("status"), StatusSubscriber(self._node.status, keys=keys) as notes:
                async for note in notes:
                    self._take_note(note)
            await asyncio.sleep(_RETRY_S)

    def _take_picture(self, shown: Picture) -> None:
        self._newest[shown.view, shown.kind] = shown
        for browser, watched in self._watched.items():
            if shown.view in (watched, PREVIEW_ID):
                browser.put_picture(shown)

    def _take_note(self, note: StatusMessage) -> None:
        self._count += 1
        header, slot = note.header, note.topic
        origin = {"node_id": header.node_id, "boot_id": header.boot_id, "at_s": header.t_publish_ns / 1e9}
        text = text_message(note.topic, {**origin, "number": self._count, "fields": dict(note.fields)})
        if note.topic == "event":
            slot = f"event/{self._count}"
            self._events.append((slot, text))
        else:
            self._last[note.topic] = text
        if note.topic == "status":
            # The first may be one that was kept for late readers, and is as old as its stamp says.
            kept_s = 0.0 if self._status_s is not None else max(0.0, (time.time_ns() - header.t_publish_ns) / 1e9)
            self._status_s = time.monotonic() - kept_s
        for browser in self._watched:
            browser.put(slot, text)


@contextlib.contextmanager
def _logged_errors(name: str) -> Generator[None]:
    try:
        yield
    except ClientError as error:
        _LOG.warning("the page gets nothing of %s: %s", name, error)
    except Exception:  # the end of a task
        _LOG.exception("reading %s broke", name)
