"""The header of a message, field by field (wire protocol, section 4).

Standard library only, Python 3.10 syntax: planners import this.
"""

import math
import re
import types
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from gcd_node.errors import MessageError
from gcd_node.wire.record_json import StampNs, short, wire

PROTO = "gcd/1.0"
"""The lowest minor that describes a message is what it states: readers take any minor of the same major."""

MAPS_PROTO = "gcd/1.1"
"""Of messages of the kinds `vis` and `depth`, which came with it."""

Clock: TypeAlias = Literal["realtime", "ptp", "replay"]
FrameRole: TypeAlias = Literal["in_transit", "at_goal"]
Encoding: TypeAlias = Literal["rgb8", "jpeg", "class8", "mono8", "invdepth16"]

CHANNELS: Mapping[str, int] = types.MappingProxyType({"rgb8": 3, "jpeg": 3, "class8": 1, "mono8": 1, "invdepth16": 1})
"""Last entry of `shape` for each encoding."""

_HALVES = "invdepth16"  # the one encoding whose values are no bytes

_HEX = re.compile(r"[0-9a-f]+")
_VERSION = re.compile(r"gcd/(\d{1,4})\.(\d{1,4})")


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceRecord:
    """Wire name `src`: where the input frames come from.

    seq: the source's own frame numbers, gaps included, one for each entry of t_capture. dropped: frames lost so far.
    fps_in, fps_cond: frames per second of the source, and as told to the model. resize: how frames were resized.
    epoch: rises when the source was lost and came back, or its clock or format jumped.
    """

    kind: str
    id: str
    seq: tuple[int, ...]
    dropped: int
    fps_in: float
    fps_cond: float
    resize: str
    epoch: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseDelta:
    """Destination minus source on the sphere; degrees, and r in `pose_units`."""

    az_deg: float
    el_deg: float
    r: float


@dataclass(frozen=True, kw_only=True, slots=True)
class SourcePoseRecord:
    """Where the source camera stands; assumed: nobody measured it. Differences alone fix no rigid transform."""

    el_deg: float
    r: float
    assumed: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class QualityRecord:
    """nan_frames: frames with non-finite values (always 0 when published); ood: what lies outside the trained domain,
    of "fps", "hfov", "view", "exposure", "static", "world"; steps and seed of the sampler (seed at most 2^53 - 1);
    ood_score: how unlike the training the source looks to the model, 0 to 1, None for one that cannot tell."""

    nan_frames: int
    ood: tuple[str, ...]
    steps: int
    seed: int
    ood_score: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelRecord:
    """What drew the pixels. sha256_12: first 12 hex digits of the weights' SHA-256."""

    name: str
    family: str
    sha256_12: str
    precision: str
    device: str


@dataclass(frozen=True, kw_only=True, slots=True)
class ClassRecord:
    """One class of a class map: the number a pixel holds, a name, and the colour to show it in, RGB 0 to 255.

    Raises:
        MessageError: a number or a colour that fits no byte.
    """

    id: int
    name: str
    colour: tuple[int, ...]

    def __post_init__(self) -> None:
        if len(self.colour) != 3 or not all(0 <= value <= 255 for value in (self.id, *self.colour)):
            raise MessageError(
                f"a class has an id and three colour levels of 0 to 255, got {self.id}, {short(self.colour)}"
            )


PAINTED, SEEN_BEFORE, SEEN_NOW = 0, 1, 2
"""What a pixel of a `vis` message says of the view's pixel."""

VISIBILITY = (
    ClassRecord(id=PAINTED, name="painted", colour=(245, 158, 11)),
    ClassRecord(id=SEEN_BEFORE, name="seen_before", colour=(147, 197, 253)),
    ClassRecord(id=SEEN_NOW, name="seen_now", colour=(29, 78, 216)),
)
"""The classes of every `vis` message."""


@dataclass(frozen=True, kw_only=True, slots=True)
class OriginHeader:
    """Who speaks, and when; the head of every message.

    boot_id: 32 hex digits, new with every start of the node. t_publish_ns: UTC realtime.
    """

    node_id: str
    boot_id: str
    t_publish_ns: StampNs = field(metadata=wire("t_publish"))
    proto: str = PROTO

    def __post_init__(self) -> None:
        if len(self.boot_id) != 32 or not _HEX.fullmatch(self.boot_id):
            raise MessageError(f"boot_id must be 32 lower-case hex digits, got {self.boot_id!r}")
        check_version(self.proto)


@dataclass(frozen=True, kw_only=True, slots=True)
class EndHeader(OriginHeader):
    """Header of an end-of-stream message. window_id: the last window published on the topic, -1 if none was."""

    view_id: str
    view_rev: int
    window_id: int
    clock: Clock


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewHeader(OriginHeader):
    """Everything a reader must know of a view's pixels. T frames = shape[0].

    t_capture_ns: T mid-exposure stamps (or 1) in the domain `clock`, with uncertainty t_capture_unc_us.
    age_ms: age of the newest input frame at publish, by the node's monotonic clock.
    valid_for_ms: ignore the message this long after t_publish_ns.
    pose: T differences; source_from_view (wire name T_src_dst): T row-major 4x4 matrices; both in pose_units, None if
        the model cannot say. intrinsics (wire name K): 9 numbers, pixels of the generated image; None if unknown.
    shape: [T, H, W, C] with C by `encoding`; offsets: T+1 byte positions in a JPEG payload; scale: of `std`,
        value = u8 * scale. range: lowest and highest level, of a class map the lowest and highest class number.
    dtype: "f16" (IEEE 754, little-endian) with encoding "invdepth16" and there alone.
    classes: of a class map or a visibility (class8) and there alone: what the numbers mean. None elsewhere.
    synthetic: the pixels are generated; never evidence of free space.
    cfg_digest: 12 hex digits naming the node's configuration.

    Raises:
        MessageError: counts that do not fit together, an id that is none.
    """

    view_id: str
    view_rev: int
    window_id: int
    t_capture_ns: tuple[StampNs, ...] = field(metadata=wire("t_capture"))
    t_capture_unc_us: int
    clock: Clock
    t_infer_start_ns: StampNs = field(metadata=wire("t_infer_start"))
    t_infer_end_ns: StampNs = field(metadata=wire("t_infer_end"))
    age_ms: float
    valid_for_ms: int
    src: SourceRecord
    frame_id: str
    src_frame_id: str
    frame_role: tuple[FrameRole, ...]
    shape: tuple[int, ...]
    encoding: Encoding
    quality: QualityRecord
    model: ModelRecord
    cfg_digest: str
    pose: tuple[PoseDelta, ...] | None = None
    source_from_view: tuple[tuple[float, ...], ...] | None = field(default=None, metadata=wire("T_src_dst"))
    pose_units: Literal["m", "scene"] = "scene"
    src_pose: SourcePoseRecord | None = None
    intrinsics: tuple[float, ...] | None = field(default=None, metadata=wire("K"))
    distortion: Literal["none"] = "none"
    layout: Literal["THWC"] = "THWC"
    dtype: Literal["u8", "f16"] = "u8"
    range: tuple[int, ...] = (0, 255)
    offsets: tuple[int, ...] | None = None
    scale: float | None = None
    classes: tuple[ClassRecord, ...] | None = None
    synthetic: bool = True

    def __post_init__(self) -> None:
        OriginHeader.__post_init__(self)
        self._check_shape()
        frames = self.shape[0]
        _check_count("t_capture", len(self.t_capture_ns), {1, frames})
        _check_count("src.seq", len(self.src.seq), {len(self.t_capture_ns)})
        _check_count("frame_role", len(self.frame_role), {frames})
        _check_count("range", len(self.range), {2})
        _check_count("pose", len(self.pose or ()), {frames if self.pose is not None else 0})
        _check_count("K", len(self.intrinsics or ()), {9 if self.intrinsics is not None else 0})
        if self.source_from_view is not None:
            _check_count("T_src_dst", len(self.source_from_view), {frames})
            for row in self.source_from_view:
                _check_count("T_src_dst[i]", len(row), {16})

    def _check_shape(self) -> None:
        channels = CHANNELS[self.encoding]
        if len(self.shape) != 4 or self.shape[3] != channels or not all(0 < size <= 65535 for size in self.shape):
            raise MessageError(f"shape of {self.encoding} must be [T, H, W, {channels}], got {list(self.shape)}")
        if (self.offsets is not None) != (self.encoding == "jpeg"):
            raise MessageError(f"offsets belong to jpeg and to jpeg alone, got encoding {self.encoding}")
        if (self.dtype == "f16") != (self.encoding == _HALVES):
            raise MessageError(f"dtype f16 belongs to {_HALVES} and to it alone, got {self.dtype} of {self.encoding}")
        if self.classes is not None:
            self._check_classes(self.classes)

    def _check_classes(self, classes: tuple[ClassRecord, ...]) -> None:
        if self.encoding != "class8":
            raise MessageError(f"classes belong to class8 alone, got encoding {self.encoding}")
        numbers = [each.id for each in classes]
        if not numbers or len(set(numbers)) < len(numbers):
            raise MessageError(f"classes must name each number once, got {short(numbers)}")

    @property
    def payload_bytes(self) -> int:
        """Bytes of the payload, by shape and dtype, or by the offsets of a JPEG."""
        if self.offsets is not None:
            return self.offsets[-1]
        return math.prod(self.shape) * (2 if self.encoding == _HALVES else 1)


def check_version(proto: object) -> None:
    """Raises MessageError unless `proto` is this protocol with our major number."""
    match = _VERSION.fullmatch(proto) if isinstance(proto, str) else None
    if match is None or match.group(1) != "1":
        raise MessageError(f"this reader speaks gcd/1.x, the message {short(proto)}; update the older of the two")


def _check_count(name: str, count: int, wanted: set[int]) -> None:
    if count not in wanted:
        raise MessageError(f"{name} must have {' or '.join(map(str, sorted(wanted)))} entries, got {count}")
