"""Robot logs for tests, written by the reference libraries: pictures, stamps and calibrations in MCAP."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as RosWriter

from gcd_node.frame import Image

START_NS = 1_750_000_000_123_456_789
PERIOD_NS = 100_000_000
TOPIC = "/front/image_raw/compressed"

HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
DEFINITIONS = {
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data" + HEADER,
    "sensor_msgs/msg/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
    "uint8 is_bigendian\nuint32 step\nuint8[] data" + HEADER,
    "sensor_msgs/msg/CameraInfo": "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
    "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
    "sensor_msgs/RegionOfInterest roi"
    + HEADER
    + "================================================================================\n"
    "MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
    "bool do_rectify\n",
    "std_msgs/msg/String": "string data",
}


def coded(image: Image, suffix: str = ".jpg") -> bytes:
    good, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 98])
    assert good
    return data.tobytes()


def stamp_of(stamp_ns: int) -> dict[str, int]:
    return {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}


def header(stamp_ns: int, frame_id: str = "front_optical") -> dict[str, object]:
    return {"stamp": stamp_of(stamp_ns), "frame_id": frame_id}


def compressed(image: Image, stamp_ns: int, format_: str = "bgr8; jpeg compressed bgr8") -> dict[str, object]:
    suffix = ".png" if "png" in format_ else ".jpg"
    return {"header": header(stamp_ns), "format": format_, "data": coded(image, suffix)}


def raw(data: bytes, width: int, height: int, encoding: str, step: int, stamp_ns: int = START_NS) -> dict[str, object]:
    return {
        "header": header(stamp_ns),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": step,
        "data": data,
    }


def camera_info(
    width: int,
    height: int,
    *,
    focal: float = 60.0,
    d: Sequence[float] = (-0.1, 0.01, 0.001, 0.002, 0.0),
    model: str = "plumb_bob",
    frame_id: str = "front_optical",
    binning: int = 0,
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
) -> dict[str, object]:
    cx, cy = width / 2, height / 2
    return {
        "header": header(START_NS, frame_id),
        "height": height,
        "width": width,
        "distortion_model": model,
        "d": list(d),
        "k": [focal, 0.0, cx, 0.0, focal + 1, cy, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [focal - 5, 0.0, cx, 0.0, 0.0, focal - 4, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": binning,
        "binning_y": binning,
        "roi": {"x_offset": roi[0], "y_offset": roi[1], "width": roi[2], "height": roi[3], "do_rectify": False},
    }


@dataclass
class RosLog:
    """An open log. `say` adds a message; log times rise by PERIOD_NS unless given."""

    writer: RosWriter
    count: int = 0

    def say(self, topic: str, kind: str, message: object, *, log_ns: int | None = None, sequence: int = 0) -> None:
        schema = self.writer.register_msgdef(kind, DEFINITIONS[kind])
        log_ns = START_NS + 5_000_000 + self.count * PERIOD_NS if log_ns is None else log_ns
        self.writer.write_message(topic, schema, message, log_time=log_ns, publish_time=log_ns, sequence=sequence)
        self.count += 1


@contextmanager
def ros_log(
    path: Path,
    *,
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 1 << 16,
    finish: bool = True,
    checked: bool = True,
) -> Generator[RosLog]:
    """checked: with checksums of the chunks."""
    with path.open("wb") as file:
        writer = RosWriter(file, chunk_size=chunk_size, compression=compression, enable_crcs=checked)
        yield RosLog(writer)
        if finish:
            writer.finish()


def write_log(
    path: Path,
    images: Sequence[Image],
    *,
    topic: str = TOPIC,
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 1 << 16,
    checked: bool = True,
) -> Path:
    """One topic of JPEG pictures at 10 a second."""
    with ros_log(path, compression=compression, chunk_size=chunk_size, checked=checked) as log:
        for i, image in enumerate(images):
            message = compressed(image, START_NS + i * PERIOD_NS)
            log.say(topic, "sensor_msgs/msg/CompressedImage", message, sequence=i)
    return path


def write_raw(path: Path, messages: Sequence[dict[str, object]]) -> Path:
    """One topic of raw pictures, 10 a second by their log times; header stamps are as given."""
    with ros_log(path) as log:
        for message in messages:
            log.say("/front/image_raw", "sensor_msgs/msg/Image", message)
    return path


def write_foxglove(
    path: Path,
    messages: Sequence[CompressedImage | RawImage | CameraCalibration],
    *,
    compression: CompressionType = CompressionType.ZSTD,
    checked: bool = True,
) -> Path:
    """Pictures on /camera/image, calibrations on /camera/calibration."""
    with path.open("wb") as file:
        writer = ProtobufWriter(file, compression=compression, enable_crcs=checked)
        for i, message in enumerate(messages):
            topic = "/camera/calibration" if isinstance(message, CameraCalibration) else "/camera/image"
            log_ns = START_NS + i * PERIOD_NS
            writer.write_message(topic, message, log_time=log_ns, publish_time=log_ns, sequence=i)
        writer.finish()
    return path


def stamped(message: CompressedImage | RawImage | CameraCalibration, stamp_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = stamp_ns // 10**9, stamp_ns % 10**9
