"""What a browser says to the viewer, and how what it is sent is put into bytes. Pure.

From the page: one JSON object in a text message, one of Hello, Watch, Ask, Got.
To the page: JSON objects with a `type` in text messages, and pictures in binary ones: the length of a JSON header as
a 32-bit little-endian number, that header, and what it describes.
"""

import asyncio
import json
import struct
import time
import zlib
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias

import msgspec
from msgspec import Meta

from gcd_client.images import colours, encode_jpegs, images
from gcd_client.protocol import PREVIEW_ID, MessageError, ViewHeader, ViewMessage, kind_of, to_json
from gcd_client.subscriber import ReceivedView

MAX_REQUEST = 4096  # bytes a message of a browser may have
MOST_UNSEEN = 3  # pictures a browser may have on the way, sent and not yet shown
MOST_WAITING = 64  # messages that wait for a browser
_QUALITY = 85
_LENGTH = struct.Struct("<I")


class Hello(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="hello"):
    """Who it is. token: makes it an operator; without one it is a viewer."""

    token: Annotated[str, Meta(max_length=128)] | None = None


class Watch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="watch"):
    """Which view it wants to see from now on."""

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
    """Read what a browser says. Raises MessageError for anything else than a request."""
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


def picture(view: ReceivedView) -> Picture:
    """What a browser is sent of a message: pictures as JPEG; class maps, visibility and deviations packed without loss,
    depth as grey levels (zlib).

    Raises:
        MessageError: pixels that do not fit the header.
    """
    header = view.header
    payload, offsets = _packed(view.message)
    since_ms = view.age_ms - header.age_ms
    return Picture(
        view=header.view_id,
        kind="src" if header.view_id == PREVIEW_ID else kind_of(view.message.topic),
        head={"offsets": offsets, **_shown(header)},
        payload=payload,
        age_ms=view.age_ms,
        left_ms=header.valid_for_ms - since_ms,
    )


def _packed(message: ViewMessage) -> tuple[bytes, tuple[int, ...] | None]:
    """Payload, and where each JPEG begins; None for pixels packed as one."""
    header = message.header
    if header.encoding == "jpeg":
        return bytes(message.payload), header.offsets
    if header.encoding == "rgb8":
        return encode_jpegs(images(message), _QUALITY)
    levels = colours(message)[..., 0].tobytes() if header.encoding == "invdepth16" else message.payload
    return zlib.compress(levels, 1), None


def _shown(header: ViewHeader) -> dict[str, Any]:
    """What the page shows of a header. Times are seconds, as doubles: for the eye."""
    return {
        "boot_id": header.boot_id,
        "rev": header.view_rev,
        "window_id": header.window_id,
        "frames": header.shape[0],
        "height": header.shape[1],
        "width": header.shape[2],
        "fps": header.src.fps_cond,
        "source": {"kind": header.src.kind, "id": header.src.id, "fps": header.src.fps_in},
        "epoch": header.src.epoch,
        "captured_s": [stamp_ns / 1e9 for stamp_ns in header.t_capture_ns],
        "clock": header.clock,
        "at_s": header.t_publish_ns / 1e9,
        "published": _publishing_times(header),
        "valid_for_ms": header.valid_for_ms,
        "roles": list(header.frame_role),
        "pose": None if header.pose is None else to_json(header.pose[-1]),
        "pose_units": header.pose_units,
        "synthetic": header.synthetic,
        "quality": to_json(header.quality),
        "model": to_json(header.model),
        "scale": header.scale,
        "classes": None if header.classes is None else [to_json(each) for each in header.classes],
    }


def _publishing_times(header: ViewHeader) -> dict[str, float]:
    """Where the age of a window at its publishing comes from, ms: it waited for the model, the model worked, and the
    rest until it left."""
    model_ms = (header.t_infer_end_ns - header.t_infer_start_ns) / 1e6
    after_ms = max(0.0, (header.t_publish_ns - header.t_infer_end_ns) / 1e6)
    times = {"age_ms": header.age_ms, "model_ms": model_ms, "after_ms": after_ms}
    times["waited_ms"] = max(0.0, header.age_ms - model_ms - after_ms)
    return {name: round(ms, 1) for name, ms in times.items()}
