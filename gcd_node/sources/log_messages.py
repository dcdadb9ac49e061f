"""Pictures and calibrations in the messages of robot logs: ROS 2 (CDR) and Foxglove (protobuf).

Only the few fields needed are read, at the places their definitions fix. So no definition out of a log is ever
followed (mcap_container.py says why that matters), and neither ROS nor protobuf is needed.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

from gcd_node.errors import SourceError
from gcd_node.optics.calibration import CameraInfo
from gcd_node.sources.byte_cursor import ByteCursor

_MOST_FIELDS = 1000
_MOST_COEFFICIENTS = 64


@dataclass(frozen=True, kw_only=True, slots=True)
class CodedPicture:
    """A compressed picture. stamp_ns: of its header, 0 if nobody filled it in. format: as the sender named it."""

    stamp_ns: int
    frame_id: str
    format: str
    data: memoryview


@dataclass(frozen=True, kw_only=True, slots=True)
class RawPicture:
    """A picture as it is. step: bytes from one row to the next. encoding: as ROS names it."""

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    encoding: str
    step: int
    data: memoryview


@dataclass(frozen=True, kw_only=True, slots=True)
class StatedCamera:
    """A calibration, and which camera it is of."""

    frame_id: str
    info: CameraInfo


Picture: TypeAlias = CodedPicture | RawPicture


def read_picture_message(encoding: str, schema: str, data: memoryview) -> Picture:
    """The picture in a message of a type listed in PICTURES. Raises SourceError: it is damaged."""
    return PICTURES[encoding, schema](data)


def read_camera_message(encoding: str, schema: str, data: memoryview) -> StatedCamera:
    """The calibration in a message of a type listed in CAMERAS. Raises SourceError: it is damaged."""
    return CAMERAS[encoding, schema](data)


# --- ROS 2 -------------------------------------------------------------------------------------------------------


def _cdr(data: memoryview) -> ByteCursor:
    """Behind the four bytes that say how the message is written."""
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        raise SourceError(f"a ROS 2 message begins with {bytes(data[:4])!r}, which is no plain CDR: it is damaged")
    return ByteCursor(data[4:], aligned=True, big_endian=data[1] == 0)


def _ros_header(cursor: ByteCursor) -> tuple[int, str]:
    """Stamp and frame_id."""
    seconds, nanoseconds = cursor.integer("i"), cursor.integer("I")
    return max(0, seconds * 1_000_000_000 + nanoseconds), cursor.text()


def _ros_coded(data: memoryview) -> CodedPicture:
    cursor = _cdr(data)
    stamp_ns, frame_id = _ros_header(cursor)
    format_ = cursor.text()
    return CodedPicture(stamp_ns=stamp_ns, frame_id=frame_id, format=format_, data=cursor.blob(cursor.integer("I")))


def _ros_raw(data: memoryview) -> RawPicture:
    cursor = _cdr(data)
    stamp_ns, frame_id = _ros_header(cursor)
    height, width, encoding = cursor.integer("I"), cursor.integer("I"), cursor.text()
    cursor.blob(1)  # byte order, of no meaning for bytes
    step = cursor.integer("I")
    return RawPicture(
        stamp_ns=stamp_ns,
        frame_id=frame_id,
        width=width,
        height=height,
        encoding=encoding,
        step=step,
        data=cursor.blob(cursor.integer("I")),
    )


def _ros_camera(data: memoryview) -> StatedCamera:
    cursor = _cdr(data)
    _, frame_id = _ros_header(cursor)
    height, width, model = cursor.integer("I"), cursor.integer("I"), cursor.text()
    count = cursor.integer("I")
    if count > _MOST_COEFFICIENTS:
        raise SourceError(f"a CameraInfo states {count} coefficients: it is damaged")
    d, k, _, p = cursor.floats(count), cursor.floats(9), cursor.floats(9), cursor.floats(12)
    binning = cursor.integer("I"), cursor.integer("I")
    left, top, high, wide = (cursor.integer("I") for _ in range(4))
    info = CameraInfo(
        width=width,
        height=height,
        distortion_model=model,
        d=d,
        k=k,
        p=p,
        binning=binning,
        roi=(left, top, wide, high),
    )
    return StatedCamera(frame_id=frame_id, info=info)


# --- Foxglove ----------------------------------------------------------------------------------------------------

_Fields: TypeAlias = dict[int, list[int | memoryview]]


def _protobuf(data: memoryview) -> _Fields:
    """Field number to values: integers of varints, bytes of everything else."""
    cursor = ByteCursor(data)
    fields: _Fields = {}
    for _ in range(_MOST_FIELDS):
        if not cursor.left:
            return fields
        number, wire = divmod(_varint(cursor), 8)
        if wire == 0:
            value = _varint(cursor)
        elif wire in (1, 2, 5):
            value = cursor.blob(_varint(cursor) if wire == 2 else (8 if wire == 1 else 4))
        else:
            raise SourceError(f"a protobuf message has a field of unknown kind {wire}: it is damaged")
        fields.setdefault(number, []).append(value)
    raise SourceError(f"a protobuf message has more than {_MOST_FIELDS} fields: it is damaged")


def _varint(cursor: ByteCursor) -> int:
    value = 0
    for shift in range(0, 70, 7):
        byte = cursor.integer("B")
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value
    raise SourceError("a protobuf message has a number without end: it is damaged")


def _bytes_of(fields: _Fields, number: int) -> memoryview:
    values = fields.get(number, [b""])
    return memoryview(b"") if isinstance(values[-1], int) else memoryview(values[-1])


def _text_of(fields: _Fields, number: int) -> str:
    return bytes(_bytes_of(fields, number)).decode("utf-8", "replace")


def _integer_of(fields: _Fields, number: int) -> int:
    """A varint or fixed32; 0 if left out."""
    value = fields.get(number, [0])[-1]
    return value if isinstance(value, int) else int.from_bytes(value, "little")


def _doubles_of(fields: _Fields, number: int) -> tuple[float, ...]:
    """A repeated double, packed or not."""
    raw = b"".join(value for value in fields.get(number, []) if not isinstance(value, int))
    if len(raw) % 8 or len(raw) > 8 * _MOST_COEFFICIENTS:
        raise SourceError(f"a protobuf message has {len(raw)} bytes where float64 belong: it is damaged")
    return struct.unpack(f"<{len(raw) // 8}d", raw)


def _stamp_of(fields: _Fields) -> int:
    stamp = _protobuf(_bytes_of(fields, 1))
    return _integer_of(stamp, 1) * 1_000_000_000 + _integer_of(stamp, 2)


def _foxglove_coded(data: memoryview) -> CodedPicture:
    fields = _protobuf(data)
    return CodedPicture(
        stamp_ns=_stamp_of(fields),
        frame_id=_text_of(fields, 4),
        format=_text_of(fields, 3),
        data=_bytes_of(fields, 2),
    )


def _foxglove_raw(data: memoryview) -> RawPicture:
    fields = _protobuf(data)
    return RawPicture(
        stamp_ns=_stamp_of(fields),
        frame_id=_text_of(fields, 7),
        width=_integer_of(fields, 2),
        height=_integer_of(fields, 3),
        encoding=_text_of(fields, 4),
        step=_integer_of(fields, 5),
        data=_bytes_of(fields, 6),
    )


def _foxglove_camera(data: memoryview) -> StatedCamera:
    fields = _protobuf(data)
    info = CameraInfo(
        width=_integer_of(fields, 2),
        height=_integer_of(fields, 3),
        distortion_model=_text_of(fields, 4),
        d=_doubles_of(fields, 5),
        k=_doubles_of(fields, 6),
        p=_doubles_of(fields, 8),
    )
    return StatedCamera(frame_id=_text_of(fields, 9), info=info)


PICTURES: Mapping[tuple[str, str], Callable[[memoryview], Picture]] = MappingProxyType(
    {
        ("cdr", "sensor_msgs/msg/CompressedImage"): _ros_coded,
        ("cdr", "sensor_msgs/msg/Image"): _ros_raw,
        ("protobuf", "foxglove.CompressedImage"): _foxglove_coded,
        ("protobuf", "foxglove.RawImage"): _foxglove_raw,
    }
)
"""Message encoding and type of what holds a picture."""

CAMERAS: Mapping[tuple[str, str], Callable[[memoryview], StatedCamera]] = MappingProxyType(
    {
        ("cdr", "sensor_msgs/msg/CameraInfo"): _ros_camera,
        ("protobuf", "foxglove.CameraCalibration"): _foxglove_camera,
    }
)
"""Message encoding and type of what holds a calibration."""
