"""What a browser says to the node, and how what it hears is put into bytes. Pure.

From the page: one JSON object in a text message, one of Hello, Watch, Ask, Got.
To the page: JSON objects with a `type` in text messages, and pictures in binary ones: the length of a JSON header as
a 32-bit little-endian number, that header, and what it describes.
"""

import json
import struct
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias

import msgspec
from msgspec import Meta

from gcd_node.envelope import ViewMessage, colours, images, kind_of
from gcd_node.errors import MessageError
from gcd_node.subscriber import ReceivedView
from gcd_node.wire.header import ViewHeader
from gcd_node.wire.jpeg import encode_frames
from gcd_node.wire.record_json import to_json

MAX_REQUEST = 4096
"""Bytes a message of a browser may have."""

_QUALITY = 85
_LENGTH = struct.Struct("<I")
_SECOND_NS = 1e9


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


@dataclass(frozen=True, kw_only=True, slots=True)
class Note:
    """A text message, ready to be sent."""

    text: str


def note(kind: str, fields: Mapping[str, Any]) -> Note:
    """A note of a kind. fields: plain JSON."""
    return Note(text=json.dumps({**fields, "type": kind}, allow_nan=False, separators=(",", ":")))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Picture:
    """A picture message for browsers, the same for all of them but for its number and its age.

    age_ms, left_ms: how old its newest frame was, and how long it could still be used, at `born_s` (monotonic).
    """

    head: Mapping[str, Any]
    payload: bytes
    age_ms: float
    left_ms: float
    born_s: float = field(default_factory=time.monotonic)

    def part(self, number: int, now_s: float) -> bytes:
        """The binary message, as old as it is now."""
        since_ms = max(0.0, 1000 * (now_s - self.born_s))
        told = {
            **self.head,
            "number": number,
            "age_ms": round(self.age_ms + since_ms, 1),
            "left_ms": round(self.left_ms - since_ms, 1),
        }
        head = json.dumps(told, allow_nan=False, separators=(",", ":")).encode()
        return b"".join((_LENGTH.pack(len(head)), head, self.payload))


def picture(view: ReceivedView) -> Picture:
    """What a browser is sent of a message: pictures as JPEG; class maps, visibility and deviations packed without loss,
    depth as grey levels (zlib).

    Raises:
        MessageError: pixels that do not fit the header.
    """
    message, header = view.message, view.header
    kind = "src" if header.view_id == "src" else kind_of(message.topic)
    payload, offsets = _packed(message)
    since_ms = view.age_ms - header.age_ms
    head = {
        "type": "picture",
        "kind": kind,
        "view": header.view_id,
        "offsets": offsets,
        "skipped": view.skipped,
        **_told(header),
    }
    return Picture(head=head, payload=payload, age_ms=view.age_ms, left_ms=header.valid_for_ms - since_ms)


def _packed(message: ViewMessage) -> tuple[bytes, tuple[int, ...] | None]:
    """Payload, and where each JPEG begins; None for pixels packed as one."""
    header = message.header
    if header.encoding == "jpeg":
        return bytes(message.payload), header.offsets
    if header.encoding == "rgb8":
        return encode_frames(images(message), _QUALITY)
    levels = colours(message)[..., 0].tobytes() if header.encoding == "invdepth16" else message.payload
    return zlib.compress(levels, 1), None


def _told(header: ViewHeader) -> dict[str, Any]:
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
        "captured_s": [stamp_ns / _SECOND_NS for stamp_ns in header.t_capture_ns],
        "clock": header.clock,
        "at_s": header.t_publish_ns / _SECOND_NS,
        "published": publishing_times(header),
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


def publishing_times(header: ViewHeader) -> dict[str, float]:
    """Where the age of a window at its publishing comes from, ms: it waited for the model, the model worked, and the
    rest until it left."""
    model_ms = (header.t_infer_end_ns - header.t_infer_start_ns) / 1e6
    after_ms = max(0.0, (header.t_publish_ns - header.t_infer_end_ns) / 1e6)
    waited_ms = max(0.0, header.age_ms - model_ms - after_ms)
    return {
        "age_ms": round(header.age_ms, 1),
        "waited_ms": round(waited_ms, 1),
        "model_ms": round(model_ms, 1),
        "after_ms": round(after_ms, 1),
    }
