"""A message as bytes: 64-byte prefix, JSON header, payload, all in one part (wire protocol, section 2).

Pure functions, no socket. Standard library and numpy only, Python 3.10 syntax: planners import this.
"""

import enum
import itertools
import re
import struct
import types
import uuid
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import ConfigError, MessageError
from gcd_node.wire.class_colours import paint
from gcd_node.wire.header import Encoding, EndHeader, OriginHeader, ViewHeader, check_version
from gcd_node.wire.record_json import dump, from_json, parse, to_json

PREFIX = struct.Struct("<32s4sHHQQII")
"""topic, magic, header length / 16, flags, payload length, sequence, CRC32, reserved."""

MAGIC = b"GCD1"
TOPIC_BYTES = 32
MAX_HEADER = 64 * 1024
MAX_PAYLOAD = 64 * 1024 * 1024
WELCOME = bytes(PREFIX.size)
"""What a publisher sends to each new subscriber; not a message."""

PREVIEW_ID = "src"
"""What stands for the input where a view's id is asked for; no view has this id."""

PREVIEW_TOPIC = f"{PREVIEW_ID}/frm"
"""The preview of the input."""

ViewKind: TypeAlias = Literal["win", "frm", "std", "cls", "vis", "depth"]
NoteTopic: TypeAlias = Literal["status", "event", "meta"]
Buffer: TypeAlias = bytes | memoryview

_VIEW_ID = re.compile(r"[a-z0-9_]{1,16}")
_KINDS = "|".join(get_args(ViewKind))
_VIEW_TOPIC = re.compile(rf"view/([a-z0-9_]{{1,16}})/(?:{_KINDS})|(src)/frm")
_NOTES = ("status", "event", "meta")
_ENCODINGS: Mapping[str, Encoding] = types.MappingProxyType({"cls": "class8", "vis": "class8", "depth": "invdepth16"})
_MIDDLE_GREY = 0.1  # 1/m: what is 10 m away is shown at half brightness


class Flags(enum.IntFlag):
    """Bits of the prefix; readers ignore bits they do not know."""

    PAYLOAD = 1
    END_OF_STREAM = 2
    REPLAY_CLOCK = 4


_KNOWN_FLAGS = 7


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewMessage:
    """Pixels of one view: a window of frames, single frames, their standard deviation, or the window's class map,
    visibility or inverse depth.

    topic: `view/<id>/` and a ViewKind, or `src/frm`. payload: the bytes `header` describes.
    sequence: number on this topic, counted by the publisher.

    Raises:
        MessageError: topic, header and payload contradict each other.
    """

    topic: str
    header: ViewHeader
    payload: Buffer
    sequence: int = 0

    def __post_init__(self) -> None:
        _check_view_topic(self.topic, self.header.view_id)
        if self.topic.endswith("/std") and self.header.scale is None:
            raise MessageError("a std message needs `scale` in its header")
        encoding, expected = self.header.encoding, _ENCODINGS.get(kind_of(self.topic))
        if expected != (encoding if encoding in _ENCODINGS.values() else None):
            raise MessageError(f"{self.topic} is of encoding {expected or 'rgb8, jpeg or mono8'}, got {encoding}")
        if encoding == "class8" and self.header.classes is None:
            raise MessageError("a message of encoding class8 needs `classes` in its header")
        if self.header.offsets is not None:
            _check_offsets(self.header.offsets, self.header.shape[0])
        wanted, got = self.header.payload_bytes, len(self.payload)
        if wanted != got:
            shape = list(self.header.shape)
            raise MessageError(f"{self.header.encoding} of shape {shape} needs {wanted} payload bytes, got {got}")

    @property
    def flags(self) -> Flags:
        """The prefix bits that follow from the content."""
        return Flags.PAYLOAD | _clock_flag(self.header.clock)


@dataclass(frozen=True, kw_only=True, slots=True)
class EndMessage:
    """Nothing more will come on this topic until the node starts a stream again. Raises MessageError as ViewMessage."""

    topic: str
    header: EndHeader
    sequence: int = 0

    def __post_init__(self) -> None:
        _check_view_topic(self.topic, self.header.view_id)

    @property
    def flags(self) -> Flags:
        """The prefix bits that follow from the content."""
        return Flags.END_OF_STREAM | _clock_flag(self.header.clock)

    @property
    def payload(self) -> Buffer:
        """Always empty."""
        return b""


@dataclass(frozen=True, kw_only=True, slots=True)
class NoteMessage:
    """A message of the status socket: header only. fields: what stands in the header besides its origin."""

    topic: NoteTopic
    header: OriginHeader
    fields: Mapping[str, Any]
    sequence: int = 0

    def __post_init__(self) -> None:
        if self.topic not in _NOTES:
            raise MessageError(f"a note's topic is one of {', '.join(_NOTES)}, got {self.topic!r}")

    @property
    def flags(self) -> Flags:
        """No bit applies to a note."""
        return Flags(0)

    @property
    def payload(self) -> Buffer:
        """Always empty."""
        return b""


Message: TypeAlias = ViewMessage | EndMessage | NoteMessage


def encode(message: Message, *, checksum: bool = True) -> bytes:
    """One ZeroMQ part. The join is the only copy of the payload. See decode().

    checksum: False leaves it out, for bytes that go through this machine's memory alone; it takes longer than the way.
    Raises:
        MessageError: the header is not plain JSON, or longer than 64 KiB.
    """
    header = _header_bytes(message)
    crc = zlib.crc32(message.payload, zlib.crc32(header)) if checksum else 0
    size = len(message.payload)
    key = topic_key(message.topic)
    prefix = PREFIX.pack(key, MAGIC, len(header) // 16, message.flags, size, message.sequence, crc, 0)
    return b"".join((prefix, header, message.payload))


def decode(part: Buffer, max_payload: int = MAX_PAYLOAD) -> Message:
    """Inverse of encode(). The payload is a read-only view into `part`, not a copy.

    Raises:
        MessageError: not this protocol, another major version, a length, checksum, header or shape that does not fit.
    """
    data = memoryview(part).toreadonly().cast("B")
    if len(data) < PREFIX.size:
        raise MessageError(f"a message has at least {PREFIX.size} bytes, got {len(data)}")
    key, magic, header_16, flags, size, sequence, crc, _ = PREFIX.unpack_from(data)
    if magic != MAGIC:
        raise MessageError(f"magic must be {MAGIC!r}, got {magic!r}; is this a gcd data or status socket?")
    start = PREFIX.size + 16 * header_16
    _check_sizes(len(data), start, size, max_payload)
    if crc and crc != zlib.crc32(data[PREFIX.size :]):
        raise MessageError(f"checksum must be {crc:08x}, got {zlib.crc32(data[PREFIX.size :]):08x}: damaged on the way")
    header = parse(bytes(data[PREFIX.size : start]))
    check_version(header.get("proto"))
    message = _message(_topic_of(key), header, data[start:], sequence, Flags(flags & _KNOWN_FLAGS))
    if message.flags != flags & _KNOWN_FLAGS:
        raise MessageError(f"flags must be {message.flags:#x} for this content, got {flags:#x}")
    return message


def images(message: ViewMessage) -> NDArray[np.uint8]:
    """The pixels, u8 [T, H, W, C], read-only; RGB for rgb8 and jpeg, class numbers for class8. Raw encodings are not
    copied.

    Raises:
        MessageError: a JPEG frame is damaged or has another size, or the message is of kind depth: see inverse_depth().
        ConfigError: the view is JPEG and cv2 is not installed here.
    """
    header = message.header
    if header.encoding == "invdepth16":
        raise MessageError(f"{message.topic} holds no levels; read its inverse_depth")
    if header.offsets is None:
        return np.frombuffer(message.payload, np.uint8).reshape(header.shape)
    try:
        from gcd_node.wire.jpeg import decode_frames  # needs cv2, which readers of rgb8 can do without
    except ImportError as error:
        remedy = 'install opencv-python-headless here, or let the node publish encoding = "rgb8"'
        raise ConfigError(f"this view is JPEG and cv2 cannot be imported ({error}); {remedy}") from error
    return decode_frames(message.payload, header.offsets, header.shape)


def inverse_depth(message: ViewMessage) -> NDArray[np.float32]:
    """Of a message of kind depth: inverse depth along the view's axis in 1/m, float32 [T, H, W]; 0: none, or infinitely
    far. Under painted pixels it is a guess.

    Raises:
        MessageError: a message of another kind, or a value that is negative or not finite.
    """
    if message.header.encoding != "invdepth16":
        raise MessageError(f"{message.topic} holds no depth; subscribe to kind depth")
    found = np.frombuffer(message.payload, "<f2").reshape(message.header.shape[:3]).astype(np.float32)
    if not (np.isfinite(found) & (found >= 0)).all():
        raise MessageError("inverse depth must be finite and not negative")
    return found


def depth_m(message: ViewMessage) -> NDArray[np.float32]:
    """The same as depth in metres, NaN where there is none. Raises MessageError as inverse_depth()."""
    inverse = inverse_depth(message)
    return np.divide(1, inverse, out=np.full_like(inverse, np.nan), where=inverse > 0)


def colours(message: ViewMessage) -> NDArray[np.uint8]:
    """The pixels to look at, u8 RGB [T, H, W, 3], read-only: a class map in its colours, grey levels as grey, depth as
    grey that is brighter the nearer it is.

    Raises:
        MessageError: a pixel holds a number that the header's `classes` do not name. Else as images(), inverse_depth().
    """
    if message.header.encoding == "invdepth16":
        inverse = inverse_depth(message)[..., None]
        grey = np.rint(255 * inverse / (inverse + _MIDDLE_GREY)).astype(np.uint8)
        return np.broadcast_to(grey, (*grey.shape[:3], 3))
    pixels = images(message)
    if message.header.classes is not None:
        return paint(pixels[..., 0], message.header.classes)
    return np.broadcast_to(pixels, (*pixels.shape[:3], 3))


def payload_of(pixels: NDArray[np.uint8]) -> memoryview:
    """An image array as a raw payload: read-only bytes, copied only if `pixels` is not contiguous."""
    return np.ascontiguousarray(pixels).data.toreadonly().cast("B")


def view_topic(view_id: str, kind: ViewKind) -> str:
    """The topic of a view, or of the preview of the input ("src", "frm").

    Raises:
        MessageError: an id that is not [a-z0-9_]{1,16}, or another kind of the input.
    """
    if not _VIEW_ID.fullmatch(view_id):
        raise MessageError(f"a view id is 1 to 16 of a-z, 0-9 and _, got {view_id!r}")
    if view_id == PREVIEW_ID:
        if kind != "frm":
            raise MessageError(f"of the input there is {PREVIEW_TOPIC} alone, got {view_id}/{kind}; ask for kind frm")
        return PREVIEW_TOPIC
    return f"view/{view_id}/{kind}"


def kind_of(topic: str) -> str:
    """The last part of a view's topic: its ViewKind."""
    return topic.rpartition("/")[2]


def topic_key(topic: str) -> bytes:
    """What to subscribe to for this topic alone: 32 bytes, NUL-padded, so no topic is a prefix of another."""
    if _VIEW_TOPIC.fullmatch(topic) is None and topic not in _NOTES:
        raise MessageError(f"a topic is view/<id>/{_KINDS}, src/frm or {', '.join(_NOTES)}, got {topic[:40]!r}")
    return topic.encode("ascii").ljust(TOPIC_BYTES, b"\0")


def new_boot_id() -> str:
    """128 random bits as 32 hex digits; make one each time the node starts."""
    return uuid.uuid4().hex


def _header_bytes(message: Message) -> bytes:
    content = to_json(message.header)
    if isinstance(message, NoteMessage):
        content = {**message.fields, **content}
    text = dump(content)
    padded = text.ljust(-(-len(text) // 16) * 16)
    if len(padded) > MAX_HEADER:
        raise MessageError(f"a header has at most {MAX_HEADER} bytes, got {len(padded)}")
    return padded


def _check_sizes(total: int, start: int, payload: int, max_payload: int) -> None:
    if start - PREFIX.size > MAX_HEADER:
        raise MessageError(f"a header has at most {MAX_HEADER} bytes, got {start - PREFIX.size}")
    if payload > max_payload:
        raise MessageError(f"a payload has at most {max_payload} bytes here, got {payload}; raise max_payload")
    if total != start + payload:
        raise MessageError(f"the prefix promises {start + payload} bytes, got {total}")


def _topic_of(key: bytes) -> str:
    topic = key.rstrip(b"\0").decode("ascii", "backslashreplace")
    if topic_key(topic) != key:
        raise MessageError(f"a topic is padded with NUL, got {key!r}")
    return topic


def _message(topic: str, header: dict[str, Any], payload: memoryview, sequence: int, flags: Flags) -> Message:
    if topic not in _NOTES and Flags.END_OF_STREAM not in flags:
        parsed = from_json(ViewHeader, header)
        return ViewMessage(topic=topic, header=parsed, payload=payload, sequence=sequence)
    if len(payload) > 0:
        raise MessageError(f"{topic} with flags {flags:#x} carries no payload, got {len(payload)} bytes")
    if topic not in _NOTES:
        return EndMessage(topic=topic, header=from_json(EndHeader, header), sequence=sequence)
    fields = types.MappingProxyType({key: header[key] for key in header if key not in _ORIGIN_KEYS})
    origin = from_json(OriginHeader, header)
    return NoteMessage(topic=topic, header=origin, fields=fields, sequence=sequence)


_ORIGIN_KEYS = frozenset({"proto", "node_id", "boot_id", "t_publish"})


def _check_view_topic(topic: str, view_id: str) -> None:
    match = _VIEW_TOPIC.fullmatch(topic)
    if match is None:
        raise MessageError(f"a view's topic is view/<id>/{_KINDS} or src/frm, got {topic[:40]!r}")
    if view_id not in match.groups():
        raise MessageError(f"topic {topic} must carry view_id {match.group(1) or 'src'}, got {view_id[:40]!r}")


def _check_offsets(offsets: tuple[int, ...], frames: int) -> None:
    rising = all(a < b for a, b in itertools.pairwise(offsets))
    if len(offsets) != frames + 1 or offsets[0] != 0 or not rising:
        raise MessageError(f"offsets must be {frames + 1} rising positions from 0, got {str(offsets)[:60]}")


def _clock_flag(clock: str) -> Flags:
    return Flags.REPLAY_CLOCK if clock == "replay" else Flags(0)
