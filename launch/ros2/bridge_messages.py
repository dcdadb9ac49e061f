"""What the bridge publishes: ROS 2 messages as plain records, and how the wire's headers become these. No ROS in here.

Standard library, numpy and gcd_client, Python 3.10 syntax. cv2 only where pictures do not come as JPEG.
"""

import math
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_client import ReceivedView, StatusMessage, ViewHeader
from gcd_client.images import depth_m, encode_jpegs
from gcd_client.protocol import ViewKind

STALE_AFTER_S = 3.0
"""A node speaks once a second; silent for so long, it counts as stale."""

OK, WARN, STALE = 0, 1, 3
"""Levels of a DiagnosticStatus that the bridge itself uses; the node's own pass through."""

_SECOND_NS = 1_000_000_000


# Names of types and fields are ROS's, so that each record can fill the message of its name.


@dataclass(frozen=True, kw_only=True, slots=True)
class Time:
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Header:
    """std_msgs/Header."""

    stamp: Time
    frame_id: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class CompressedImage:
    """sensor_msgs/CompressedImage. data: an array of bytes, which rclpy takes without looking at each."""

    header: Header
    data: "array[int]"
    format: str = "jpeg"


@dataclass(frozen=True, kw_only=True, slots=True)
class Image:
    """sensor_msgs/Image. data: an array of bytes, as above. step: bytes of a row."""

    header: Header
    height: int
    width: int
    encoding: str
    step: int
    data: "array[int]"
    is_bigendian: int = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraInfo:
    """sensor_msgs/CameraInfo of a picture without distortion; `k` all zero where the camera is not known."""

    header: Header
    height: int
    width: int
    k: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]
    d: tuple[float, ...] = (0.0,) * 5
    distortion_model: str = "plumb_bob"


@dataclass(frozen=True, kw_only=True, slots=True)
class Vector3:
    """geometry_msgs/Vector3, metres."""

    x: float
    y: float
    z: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Quaternion:
    """geometry_msgs/Quaternion, of length 1."""

    x: float
    y: float
    z: float
    w: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Transform:
    """geometry_msgs/Transform."""

    translation: Vector3
    rotation: Quaternion


@dataclass(frozen=True, kw_only=True, slots=True)
class TransformStamped:
    """geometry_msgs/TransformStamped: where `child_frame_id` is, in `header.frame_id`."""

    header: Header
    child_frame_id: str
    transform: Transform


@dataclass(frozen=True, kw_only=True, slots=True)
class TFMessage:
    """tf2_msgs/TFMessage."""

    transforms: tuple[TransformStamped, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class KeyValue:
    """diagnostic_msgs/KeyValue."""

    key: str
    value: str


@dataclass(frozen=True, kw_only=True, slots=True)
class DiagnosticStatus:
    """diagnostic_msgs/DiagnosticStatus. level: one byte, as rclpy has it."""

    level: bytes
    name: str
    message: str
    hardware_id: str
    values: tuple[KeyValue, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class DiagnosticArray:
    """diagnostic_msgs/DiagnosticArray."""

    header: Header
    status: tuple[DiagnosticStatus, ...]


PACKAGES: Mapping[str, str] = {
    "Time": "builtin_interfaces.msg",
    "Header": "std_msgs.msg",
    "CompressedImage": "sensor_msgs.msg",
    "Image": "sensor_msgs.msg",
    "CameraInfo": "sensor_msgs.msg",
    "Vector3": "geometry_msgs.msg",
    "Quaternion": "geometry_msgs.msg",
    "Transform": "geometry_msgs.msg",
    "TransformStamped": "geometry_msgs.msg",
    "TFMessage": "tf2_msgs.msg",
    "KeyValue": "diagnostic_msgs.msg",
    "DiagnosticStatus": "diagnostic_msgs.msg",
    "DiagnosticArray": "diagnostic_msgs.msg",
}
"""Where ROS 2 has each of these messages."""


# From the wire to these records.


@dataclass(frozen=True, kw_only=True, slots=True)
class Settings:
    """The bridge's ROS parameters.

    data, status: the node's endpoints; "ipc" finds those of a node of the same user.
    views: ids. prefix: before the names of their topics.
    max_age_ms: older pictures are not published; 0 for no limit but the node's own `valid_for_ms`.
    source_frame: TF frame the source camera has on this robot (x right, y down, z ahead); "": as the node names it.
    metres_per_unit: of the scene units of kubric checkpoints; 0: their virtual cameras get no TF.
    maps: which kinds to publish beside the pictures, of "vis" and "depth".
    """

    data: str = "ipc"
    status: str = "ipc"
    views: tuple[str, ...] = ("topdown",)
    prefix: str = "gcd"
    max_age_ms: float = 0.0
    source_frame: str = ""
    metres_per_unit: float = 0.0
    maps: tuple[ViewKind, ...] = ()


def to_time(stamp_ns: int) -> Time:
    """Nanoseconds since the epoch as ROS has them."""
    seconds, nanoseconds = divmod(stamp_ns, _SECOND_NS)
    return Time(sec=seconds, nanosec=nanoseconds)


def newest_at_goal(header: ViewHeader) -> int | None:
    """Number of the newest frame whose camera has arrived at its goal; None if none has."""
    return max((i for i, role in enumerate(header.frame_role) if role == "at_goal"), default=None)


def to_header(header: ViewHeader, index: int) -> Header:
    """The stamp of a frame is when its input was captured, never when anything was published."""
    stamps_ns = header.t_capture_ns
    return Header(stamp=to_time(stamps_ns[min(index, len(stamps_ns) - 1)]), frame_id=header.frame_id)


def to_compressed_image(view: ReceivedView, index: int) -> CompressedImage:
    """One frame as JPEG: the node's own bytes, or coded here.

    Raises:
        SetupError: the view is not JPEG, and cv2 is not installed to make one of it.
    """
    header = view.header
    if header.offsets is not None:
        coded = bytes(view.message.payload[header.offsets[index] : header.offsets[index + 1]])
    else:
        coded, _ = encode_jpegs(view.images[index : index + 1])
    return CompressedImage(header=to_header(header, index), data=array("B", coded))


def to_image(view: ReceivedView, index: int) -> Image:
    """One frame of a map: depth in metres as 32FC1 with NaN where there is none (REP 118), visibility as mono8."""
    is_depth = view.header.encoding == "invdepth16"
    pixels = depth_m(view.message)[index] if is_depth else view.images[index, ..., 0]
    return Image(
        header=to_header(view.header, index),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding="32FC1" if is_depth else "mono8",
        step=pixels.strides[0],
        data=array("B", pixels.tobytes()),
    )


def to_camera_info(header: ViewHeader, index: int) -> CameraInfo:
    """The pinhole camera of a view."""
    k = header.intrinsics or (0.0,) * 9
    unknown = header.intrinsics is None  # ROS then wants every matrix zero
    return CameraInfo(
        header=to_header(header, index),
        height=header.shape[1],
        width=header.shape[2],
        k=k,
        r=(0.0,) * 9 if unknown else (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        p=(*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0),
    )


def to_transform(header: ViewHeader, index: int, settings: Settings) -> TransformStamped | None:
    """Where the virtual camera stands in the frame of the source camera; None if that is not known in metres."""
    metres = 1.0 if header.pose_units == "m" else settings.metres_per_unit
    if header.source_from_view is None or metres <= 0:
        return None
    source_from_view = np.array(header.source_from_view[index]).reshape(4, 4)
    x, y, z = (float(each) for each in metres * source_from_view[:3, 3])
    stamp = to_header(header, index).stamp
    return TransformStamped(
        header=Header(stamp=stamp, frame_id=settings.source_frame or header.src_frame_id),
        child_frame_id=header.frame_id,
        transform=Transform(translation=Vector3(x=x, y=y, z=z), rotation=to_quaternion(source_from_view[:3, :3])),
    )


def to_quaternion(rotation: NDArray[np.float64]) -> Quaternion:
    """A rotation matrix [3, 3] as a quaternion with w >= 0: the eigenvector of Bar-Itzhack 2000, for any angle."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    symmetric = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = (float(each) for each in np.linalg.eigh(symmetric)[1][:, -1])
    sign = math.copysign(1.0, w)
    return Quaternion(x=sign * x, y=sign * y, z=sign * z, w=sign * w)


def flat(told: Mapping[str, Any], before: str = "") -> Iterator[KeyValue]:
    """The fields of a status note as texts, `source.fps` for what lies within another."""
    for key, value in told.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{key}.")
        else:
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            yield KeyValue(key=f"{before}{key}", value=text)


def to_diagnostic(note: StatusMessage | None, *, silent: bool) -> DiagnosticStatus:
    """What the node says of itself; STALE if it has been silent for too long, or has not spoken yet."""
    told: Mapping[str, Any] = {} if note is None else note.fields
    name = "" if note is None else note.header.node_id
    level, reasons = told.get("level"), told.get("reasons")
    known = level if isinstance(level, int) and 0 <= level <= STALE else WARN
    said = ", ".join(map(str, reasons)) if isinstance(reasons, list) and reasons else str(told.get("state", "unknown"))
    return DiagnosticStatus(
        level=bytes([STALE if silent else known]),
        name=f"gcd: node {name}".rstrip(),
        message="silent" if silent else said,
        hardware_id=name,
        values=tuple(flat(told)),
    )
