"""The messages of a gcd node as bytes, and back: prefix, JSON header and payload in one ZeroMQ part (docs/protocol.md).
Records and pure functions, no socket. Received bytes become a message or a MessageError, never another exception."""

import json
import math
import re
import struct
import zlib
from collections.abc import Mapping
from functools import reduce
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_args

import msgspec
from msgspec import Meta, field

from gcd_client.records import LARGEST_INTEGER as LARGEST_INTEGER
from gcd_client.records import (
    ClassRecord,
    MessageError,
    ModelRecord,
    Nanosec,
    Number,
    PoseDelta,
    QualityRecord,
    Record,
    SourcePoseRecord,
    SourceRecord,
    Whole,
)
from gcd_client.records import ClientError as ClientError

PROTO, MAPS_PROTO, PUSH_PROTO, GRID_PROTO = (f"gcd/1.{minor}" for minor in range(4))  # the first minor that has a kind
PREFIX = struct.Struct("<32s4sHHQQII")  # topic, magic, header length / 16, flags, payload length, sequence, CRC32, 0
MAGIC, TOPIC_BYTES, MAX_HEADER, MAX_PAYLOAD = b"GCD1", 32, 64 * 1024, 64 * 1024 * 1024
HAS_PAYLOAD, END_OF_STREAM, REPLAY_CLOCK = 1, 2, 4  # flags; readers ignore others
WELCOME = bytes(PREFIX.size)  # sent to each new subscriber; not a message
PREVIEW_ID, PREVIEW_TOPIC = "src", "src/frm"  # the input, in place of a view
CELL_BYTES = 7  # of a grid, all layers together

Part: TypeAlias = bytes | memoryview
ViewKind: TypeAlias = Literal["win", "frm", "std", "cls", "vis", "depth"]
StatusTopic: TypeAlias = Literal["status", "event", "meta"]
FrameRole: TypeAlias = Literal["in_transit", "at_goal"]
_Side: TypeAlias = Annotated[int, Meta(ge=1, le=65535)]
Shape: TypeAlias = Annotated[tuple[_Side, ...], Meta(min_length=4, max_length=4)]
Matrix3: TypeAlias = Annotated[tuple[Number, ...], Meta(min_length=9, max_length=9)]
Matrix4: TypeAlias = Annotated[tuple[Number, ...], Meta(min_length=16, max_length=16)]

_SECOND_NS = 1_000_000_000
_TIMES = ("t_publish", "t_infer_start", "t_infer_end")  # [sec, nanosec] in JSON, nanoseconds here
_CHANNELS = {"rgb8": 3, "jpeg": 3, "class8": 1, "mono8": 1, "invdepth16": 1}
_OF_KIND = {"cls": "class8", "vis": "class8", "depth": "invdepth16"}
_KINDS = "|".join(get_args(ViewKind))
_ID = rf"((?!{PREVIEW_ID}(?:/|$))[a-z0-9_]{{1,16}})"
_DATA_TOPIC = re.compile(rf"view/{_ID}/(?:{_KINDS})|({PREVIEW_ID})/frm|grid/{_ID}")
_VERSION = re.compile(r"gcd/1\.[0-9]{1,4}")


class OriginHeader(Record, frozen=True, kw_only=True):
    """The head of every message. boot_id: new with every start of the node. t_publish_ns: UTC."""

    node_id: str
    boot_id: Annotated[str, Meta(pattern=r"^[0-9a-f]{32}\Z")]
    t_publish_ns: int = field(name="t_publish")
    proto: str = PROTO


class EndHeader(OriginHeader, frozen=True, kw_only=True):
    """Of an end-of-stream message. window_id: the last window published on the topic, -1: none."""

    view_id: str
    view_rev: Whole
    window_id: Whole
    clock: Literal["realtime", "ptp", "replay"]


class CapturedHeader(OriginHeader, frozen=True, kw_only=True):
    """Of a message that was made of input frames.

    t_capture_ns: mid-exposure stamps in the domain `clock`, with uncertainty t_capture_unc_us.
    age_ms: of the newest input frame at publish. valid_for_ms: ignore the message this long after t_publish_ns.
    cfg_digest: names the node's configuration.
    """

    view_id: str
    view_rev: Whole
    window_id: Whole
    t_capture_ns: tuple[int, ...] = field(name="t_capture")
    t_capture_unc_us: Whole
    clock: Literal["realtime", "ptp", "replay"]
    t_infer_start_ns: int = field(name="t_infer_start")
    t_infer_end_ns: int = field(name="t_infer_end")
    age_ms: Number
    valid_for_ms: Whole
    src: SourceRecord
    frame_id: str
    src_frame_id: str
    quality: QualityRecord
    model: ModelRecord
    cfg_digest: str


class ViewHeader(CapturedHeader, frozen=True, kw_only=True):
    """What a reader must know of a view's pixels, T frames of shape [T, H, W, C], with T stamps or 1.

    pose: T differences. source_from_view (T_src_dst): T row-major 4x4 matrices. Both in pose_units; None: unknown.
    intrinsics (K): row-major 3x3, pixels of the generated image; None: unknown.
    offsets: T+1 byte positions in a JPEG payload. scale: of kind `std`, value = u8 * scale. range: lowest and highest
        level or class number. dtype: "f16" (little-endian) with encoding "invdepth16", else "u8". classes: of "class8".
    synthetic: the pixels are generated, never evidence of free space.

    Raises MessageError where counts, encoding and shape do not fit together.
    """

    frame_role: tuple[FrameRole, ...]
    shape: Shape
    encoding: Literal["rgb8", "jpeg", "class8", "mono8", "invdepth16"]
    pose: tuple[PoseDelta, ...] | None = None
    source_from_view: tuple[Matrix4, ...] | None = field(default=None, name="T_src_dst")
    pose_units: Literal["m", "scene"] = "scene"
    src_pose: SourcePoseRecord | None = None
    intrinsics: Matrix3 | None = field(default=None, name="K")
    distortion: Literal["none"] = "none"
    layout: Literal["THWC"] = "THWC"
    dtype: Literal["u8", "f16"] = "u8"
    range: tuple[Whole, Whole] = (0, 255)
    offsets: tuple[Annotated[int, Meta(ge=0, le=LARGEST_INTEGER)], ...] | None = None
    scale: Number | None = None
    classes: tuple[ClassRecord, ...] | None = None
    synthetic: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        frames, stamps, offsets, classes = self.shape[0], len(self.t_capture_ns), self.offsets, self.classes
        for fits, rule in (
            (self.shape[3] == _CHANNELS[self.encoding], f"shape[3] must be {_CHANNELS[self.encoding]}"),
            (stamps in (1, frames), "t_capture must have 1 or T entries"),
            (len(self.src.seq) == stamps, "src.seq must have an entry for each of t_capture"),
            (len(self.frame_role) == frames, "frame_role must have T entries"),
            (self.pose is None or len(self.pose) == frames, "pose must have T entries"),
            (self.source_from_view is None or len(self.source_from_view) == frames, "T_src_dst must have T entries"),
            ((offsets is not None) == (self.encoding == "jpeg"), "offsets belong to jpeg, to it alone"),
            (offsets is None or [*offsets] == sorted({0, *offsets}), "offsets must rise from 0"),
            (offsets is None or len(offsets) == frames + 1, "offsets must have T+1 entries"),
            ((self.dtype == "f16") == (self.encoding == "invdepth16"), "f16 belongs to invdepth16, to it alone"),
            ((classes is not None) == (self.encoding == "class8"), "classes belong to class8, to it alone"),
            (classes is None or 0 < len(classes) == len({each.id for each in classes}), "classes must be distinct"),
        ):
            if not fits:
                raise MessageError(f"{rule}; the shape is {list(self.shape)}, the encoding {self.encoding}")

    @property
    def payload_bytes(self) -> int:
        """Size of the payload, by shape and dtype, or by the offsets of a JPEG."""
        values = math.prod(self.shape) * (2 if self.dtype == "f16" else 1)
        return values if self.offsets is None else self.offsets[-1]


class GridHeader(CapturedHeader, frozen=True, kw_only=True):
    """What a reader must know of a grid: [H, W] cells about the vehicle, rows along y, columns along x.

    view_id: the grid's. frame_id: x ahead, y left, z up, origin on the ground. origin_m: x and y of the outer corner of
    the first cell. classes: what the numbers of the class layer mean. synthetic: nothing in it is painted.
    """

    shape: Annotated[tuple[_Side, ...], Meta(min_length=2, max_length=2)]
    cell_m: Annotated[float, Meta(gt=0, le=LARGEST_INTEGER)]
    origin_m: tuple[Number, Number]
    classes: tuple[ClassRecord, ...]
    synthetic: bool = False
    proto: str = GRID_PROTO

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.t_capture_ns) == len(self.src.seq) == 1:
            raise MessageError("a grid has one entry in t_capture and in src.seq")
        if not 0 < len(self.classes) == len({each.id for each in self.classes}):
            raise MessageError("the classes of a grid must be distinct")


class ViewMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Pixels of a view. topic: `view/<id>/<kind>` or `src/frm`. sequence: counted on this topic by the publisher.

    Raises MessageError where topic, header and payload contradict each other.
    """

    topic: str
    header: ViewHeader
    payload: bytes | memoryview
    sequence: int = 0

    def __post_init__(self) -> None:
        _check_view_id(self.topic, self.header.view_id)
        encoding, kind = self.header.encoding, kind_of(self.topic)
        if (encoding if encoding in _OF_KIND.values() else None) != _OF_KIND.get(kind):
            raise MessageError(f"{self.topic} cannot have the encoding {encoding}")
        if kind == "std" and self.header.scale is None:
            raise MessageError("a message of kind std needs `scale` in its header")
        if len(self.payload) != self.header.payload_bytes:
            raise MessageError(f"payload must have {self.header.payload_bytes} bytes, got {len(self.payload)}")


class GridMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Cells of the topic `grid/<id>`; `gcd_client.images.layers` reads them. Raises MessageError as ViewMessage."""

    topic: str
    header: GridHeader
    payload: bytes | memoryview
    sequence: int = 0

    def __post_init__(self) -> None:
        _check_view_id(self.topic, self.header.view_id)
        size = CELL_BYTES * math.prod(self.header.shape)
        if not is_grid(self.topic) or len(self.payload) != size:
            raise MessageError(f"{self.topic} of {list(self.header.shape)} has {size} bytes, got {len(self.payload)}")


class EndMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Nothing more comes on this topic until the node starts a stream again. Raises MessageError as ViewMessage."""

    topic: str
    header: EndHeader
    sequence: int = 0

    def __post_init__(self) -> None:
        _check_view_id(self.topic, self.header.view_id)


class StatusMessage(msgspec.Struct, frozen=True, kw_only=True):
    """A message of the status socket. fields: its header without the origin."""

    topic: StatusTopic
    header: OriginHeader
    fields: Mapping[str, Any]
    sequence: int = 0


Header = TypeVar("Header", bound=OriginHeader)
DataMessage: TypeAlias = ViewMessage | GridMessage
Message: TypeAlias = DataMessage | EndMessage | StatusMessage


def encode(message: Message, *, checksum: bool = True) -> bytes:
    """One ZeroMQ part. checksum: False for bytes that stay in this machine's memory: computing it takes longer than
    sending them. Raises MessageError: the header is not plain JSON with finite numbers, or longer than 64 KiB."""
    text = to_text(message.header, message.fields if isinstance(message, StatusMessage) else {})
    payload = (message.payload,) if isinstance(message, DataMessage) else ()
    return pack(topic_key(message.topic), flags_of(message), message.sequence, text, *payload, checksum=checksum)


def pack(key: bytes, flags: int, sequence: int, text: bytes, *payload: Part, checksum: bool = True) -> bytes:
    """Prefix, header and payload; the only copy of the payload is made here. Raises MessageError: a longer header."""
    header = text.ljust(-(-len(text) // 16) * 16)
    if len(header) > MAX_HEADER:
        raise MessageError(f"a header has at most {MAX_HEADER} bytes, got {len(header)}")
    crc = reduce(lambda crc, each: zlib.crc32(each, crc), (header, *payload), 0) if checksum else 0
    prefix = PREFIX.pack(key, MAGIC, len(header) // 16, flags, sum(map(len, payload)), sequence, crc, 0)
    return b"".join((prefix, header, *payload))


def decode(part: Part, max_payload: int = MAX_PAYLOAD) -> Message:
    """Inverse of encode(). The payload is a read-only view into `part`, not a copy. Raises MessageError: another
    protocol or major version, a length, checksum, header or shape that does not fit."""
    key, flags, sequence, header, payload = unpack(part, max_payload)
    topic = key.rstrip(b"\0").decode("ascii", "backslashreplace")
    if topic_key(topic) != key:
        raise MessageError(f"a topic is padded with NUL, got {key!r}")
    try:
        content = msgspec.json.decode(header, type=dict[str, Any])
        check_version(content.get("proto"))
        message = _message(topic, content, payload, sequence, bool(flags & END_OF_STREAM))
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"header of {topic}: {str(error)!a:.200}") from error
    if flags & 0b111 != flags_of(message) or len(payload) != len(getattr(message, "payload", b"")):
        raise MessageError(f"flags {flags:#x} and {len(payload)} payload bytes contradict the content of {topic}")
    return message


def unpack(part: Part, max_payload: int) -> tuple[bytes, int, int, memoryview, memoryview]:
    """Inverse of pack(): topic key, flags, sequence, header and payload. Raises MessageError as decode()."""
    data = memoryview(part).toreadonly().cast("B")
    if len(data) < PREFIX.size:
        raise MessageError(f"a message has at least {PREFIX.size} bytes, got {len(data)}")
    key, magic, header_16, flags, size, sequence, crc, _ = PREFIX.unpack_from(data)
    start = PREFIX.size + 16 * header_16
    if magic != MAGIC:
        raise MessageError(f"magic must be {MAGIC!r}, got {magic!r}; is this a socket of a gcd node?")
    if start > PREFIX.size + MAX_HEADER or size > max_payload:
        raise MessageError(f"at most {MAX_HEADER} + {max_payload} bytes here, got {start} + {size}; raise max_payload")
    if len(data) != start + size:
        raise MessageError(f"the prefix promises {start + size} bytes, got {len(data)}")
    if crc and crc != zlib.crc32(data[PREFIX.size :]):
        raise MessageError(f"checksum must be {crc:08x}, got {zlib.crc32(data[PREFIX.size :]):08x}: damaged on the way")
    return key, flags, sequence, data[PREFIX.size : start], data[start:]


def to_json(record: Record) -> dict[str, Any]:
    """A record as plain JSON, by wire names; None is left out. Raises TypeError for values of other types."""
    content = msgspec.to_builtins(record)
    content |= {name: divmod(content[name], _SECOND_NS) for name in _TIMES if name in content}
    if "t_capture" in content:
        content["t_capture"] = [divmod(stamp_ns, _SECOND_NS) for stamp_ns in content["t_capture"]]
    return {name: value for name, value in content.items() if value is not None}


def to_text(header: OriginHeader, fields: Mapping[str, Any]) -> bytes:
    """Header and further fields as compact JSON. Raises MessageError for what it cannot hold: NaN, other types."""
    try:
        content = {**fields, **to_json(header)}
        return json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False).encode()
    except (ValueError, TypeError, RecursionError) as error:
        raise MessageError(f"a header must be plain JSON with finite numbers: {error}") from error


def flags_of(message: Message) -> int:
    """The prefix bits that follow from the content."""
    ended, note = isinstance(message, EndMessage), isinstance(message, StatusMessage)
    content = END_OF_STREAM if ended else 0 if note else HAS_PAYLOAD
    return content | (REPLAY_CLOCK if getattr(message.header, "clock", "") == "replay" else 0)


def view_topic(view_id: str, kind: ViewKind) -> str:
    """The topic of a view, or of the preview of the input ("src", "frm"). Raises MessageError for others."""
    topic = PREVIEW_TOPIC if (view_id, kind) == (PREVIEW_ID, "frm") else f"view/{view_id}/{kind}"
    if _DATA_TOPIC.fullmatch(topic) is None:
        raise MessageError(f"a view id is 1 to 16 of a-z, 0-9 and _, or src of kind frm; got {view_id!a:.60}, {kind}")
    return topic


def grid_topic(grid_id: str) -> str:
    """The topic of a grid. Raises MessageError for others."""
    topic_key(topic := f"grid/{grid_id}")
    return topic


def is_grid(topic: str) -> bool:
    """Whether it is the topic of a grid, if it is one at all."""
    return topic.startswith("grid/")


def kind_of(topic: str) -> str:
    """The last part of a view's topic: its ViewKind; of a grid's its first, "grid"."""
    return "grid" if is_grid(topic) else topic.rpartition("/")[2]


def topic_key(topic: str) -> bytes:
    """What to subscribe to for this topic alone: 32 bytes, NUL-padded, so no topic is a prefix of another."""
    if _DATA_TOPIC.fullmatch(topic) is None and topic not in get_args(StatusTopic):
        known = f"view/<id>/{_KINDS}, grid/<id>, {PREVIEW_TOPIC}, status, event, meta"
        raise MessageError(f"a topic is {known}; got {topic!a:.60}")
    return topic.encode("ascii").ljust(TOPIC_BYTES, b"\0")


def check_version(proto: object) -> None:
    """Raises MessageError unless `proto` is this protocol with our major number."""
    if not isinstance(proto, str) or not _VERSION.fullmatch(proto):
        raise MessageError(f"this reader speaks gcd/1.x, the message {proto!a:.60}; update the older of the two")


def _message(topic: str, content: dict[str, Any], payload: memoryview, sequence: int, ends: bool) -> Message:
    if topic in ("status", "event", "meta"):
        fields = {name: content[name] for name in content if name not in OriginHeader.__struct_encode_fields__}
        return StatusMessage(topic=topic, header=_header(OriginHeader, content), fields=fields, sequence=sequence)
    if ends:
        return EndMessage(topic=topic, header=_header(EndHeader, content), sequence=sequence)
    if is_grid(topic):
        return GridMessage(topic=topic, header=_header(GridHeader, content), payload=payload, sequence=sequence)
    return ViewMessage(topic=topic, header=_header(ViewHeader, content), payload=payload, sequence=sequence)


def _header(kind: type[Header], content: dict[str, Any]) -> Header:
    """Raises msgspec.ValidationError, MessageError."""
    known = {name: content[name] for name in kind.__struct_encode_fields__ if name in content}
    known |= {name: _nanoseconds(known[name]) for name in _TIMES if name in known}
    if isinstance(known.get("t_capture"), list):
        known["t_capture"] = [_nanoseconds(each) for each in known["t_capture"]]
    return msgspec.convert(known, kind)


def _nanoseconds(pair: Any) -> int:
    seconds, nanoseconds = msgspec.convert(pair, tuple[Whole, Nanosec])
    return seconds * _SECOND_NS + nanoseconds


def _check_view_id(topic: str, view_id: str) -> None:
    match = _DATA_TOPIC.fullmatch(topic)
    if match is None or view_id not in match.groups():
        raise MessageError(f"topic {topic!a:.60} does not belong to view_id {view_id!a:.60}")
