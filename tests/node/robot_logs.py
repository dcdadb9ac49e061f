"""Robot logs for tests, written by the reference libraries: pictures, depth, calibrations, poses in MCAP and bags."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from google.protobuf.message import Message
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2._dynamic import serialize_dynamic
from mcap_ros2.writer import Writer as RosWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

from gcd_node.frame import Frame, Image
from gcd_node.sources.log_reader import ros1_types
from gcd_node.sources.logs import LogSource

START_NS = 1_750_000_000_123_456_789
PERIOD_NS = 100_000_000
TOPIC = "/front/image_raw/compressed"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"
STRING = "std_msgs/msg/String"
Fields = dict[str, Any]


@cache
def definition(kind: str) -> str:
    return get_typestore(Stores.ROS2_HUMBLE).generate_msgdef(kind, ros_version=2)[0]


def coded(image: np.ndarray, suffix: str = ".jpg") -> bytes:
    picture = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    good, data = cv2.imencode(suffix, picture, [cv2.IMWRITE_JPEG_QUALITY, 98])
    assert good
    return data.tobytes()


def header(stamp_ns: int, frame_id: str = "front_optical") -> Fields:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame_id}


def compressed(image: Image, stamp_ns: int, format_: str = "bgr8; jpeg compressed bgr8") -> Fields:
    suffix = ".png" if "png" in format_ else ".jpg"
    return {"header": header(stamp_ns), "format": format_, "data": coded(image, suffix)}


def raw(data: bytes, width: int, height: int, encoding: str, step: int, stamp_ns: int = START_NS) -> Fields:
    sizes = {"height": height, "width": width, "step": step}
    return {"header": header(stamp_ns), "encoding": encoding, "is_bigendian": 0, "data": data, **sizes}


def depth(metres: np.ndarray, stamp_ns: int) -> Fields:
    """Of float32 [H, W] as 32FC1, of uint16 as 16UC1."""
    encoding = "16UC1" if metres.dtype == np.uint16 else "32FC1"
    return raw(metres.tobytes(), metres.shape[1], metres.shape[0], encoding, metres.strides[0], stamp_ns)


def pose(x: float, yaw_deg: float = 0.0) -> Fields:
    half = np.radians(yaw_deg) / 2
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(half)), "w": float(np.cos(half))}
    return {"position": {"x": x, "y": 0.0, "z": 0.0}, "orientation": turn}


def odometry(x: float, stamp_ns: int, yaw_deg: float = 0.0) -> Fields:
    still = {"twist": {axis: dict.fromkeys("xyz", 0.0) for axis in ("linear", "angular")}, "covariance": [0.0] * 36}
    place = {"pose": pose(x, yaw_deg), "covariance": [0.0] * 36}
    return {"header": header(stamp_ns, "odom"), "child_frame_id": "base_link", "pose": place, "twist": still}


def transform(parent: str, child: str, x: float, turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Fields:
    rotation = dict(zip("xyzw", turn, strict=True))
    moved = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": rotation}
    return {"header": header(START_NS, parent), "child_frame_id": child, "transform": moved}


def camera_info(
    width: int,
    height: int,
    *,
    focal: float = 60.0,
    d: Sequence[float] = (-0.1, 0.01, 0.001, 0.002, 0.0),
    model: str = "plumb_bob",
    frame_id: str = "front_optical",
) -> Fields:
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
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "width": 0, "height": 0, "do_rectify": False},
    }


@dataclass
class RosLog:
    """An open log. `say` adds a message; log times rise by PERIOD_NS unless given."""

    writer: RosWriter
    count: int = 0

    def say(self, topic: str, kind: str, message: Fields, *, log_ns: int | None = None, sequence: int = 0) -> None:
        schema = self.writer.register_msgdef(kind, definition(kind))
        log_ns = START_NS + 5_000_000 + self.count * PERIOD_NS if log_ns is None else log_ns
        self.writer.write_message(topic, schema, message, log_time=log_ns, publish_time=log_ns, sequence=sequence)
        self.count += 1


@contextmanager
def ros_log(
    path: Path, *, compression: CompressionType = CompressionType.ZSTD, chunk_size: int = 1 << 16, checked: bool = True
) -> Generator[RosLog]:
    """checked: with checksums of the chunks."""
    with path.open("wb") as file:
        writer = RosWriter(file, chunk_size=chunk_size, compression=compression, enable_crcs=checked)
        yield RosLog(writer)
        writer.finish()


def write_log(path: Path, images: Sequence[Image], *, topic: str = TOPIC, **options: Any) -> Path:
    """One topic of JPEG pictures at 10 a second. options: of ros_log()."""
    with ros_log(path, **options) as log:
        for i, image in enumerate(images):
            log.say(topic, COMPRESSED, compressed(image, START_NS + i * PERIOD_NS), sequence=i)
    return path


Sent = tuple[str, str, Fields]
"""Topic, type and fields."""


def write_bag(
    path: Path,
    messages: Sequence[Sent],
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A ROS 1 bag if `path` ends in .bag, packed by bz2, else a folder of ROS 2; a message every PERIOD_NS."""
    is_ros1 = path.suffix == ".bag"
    store, ros2 = ros1_types() if is_ros1 else get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS2_HUMBLE)
    writer = Bag1Writer(path) if is_ros1 else Bag2Writer(path, version=9, storage_plugin=storage)
    if isinstance(writer, Bag2Writer):
        writer.set_compression(compression, CompressionFormat.ZSTD)
    else:
        writer.set_compression(Bag1Writer.CompressionFormat.BZ2)
    with writer:
        connections: dict[str, Any] = {}
        for i, (topic, kind, fields) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            data = serialize_dynamic(kind, definition(kind))[kind](fields)
            written = bytes(ros2.cdr_to_ros1(data, kind)) if is_ros1 else data
            writer.write(connections[topic], START_NS + i * PERIOD_NS, written)
    return path


def write_foxglove(
    path: Path,
    messages: Sequence[Message],
    *,
    compression: CompressionType = CompressionType.ZSTD,
    checked: bool = True,
) -> Path:
    """Pictures on /camera/image, calibrations on /camera/calibration."""
    with path.open("wb") as file:
        writer = ProtobufWriter(file, compression=compression, enable_crcs=checked)
        for i, message in enumerate(messages):
            topic = "/camera/calibration" if type(message).__name__ == "CameraCalibration" else "/camera/image"
            log_ns = START_NS + i * PERIOD_NS
            writer.write_message(topic, message, log_time=log_ns, publish_time=log_ns, sequence=i)
        writer.finish()
    return path


def stamped(message: Any, stamp_ns: int) -> Any:
    message.timestamp.seconds, message.timestamp.nanos = stamp_ns // 10**9, stamp_ns % 10**9
    return message


def at(i: float) -> int:
    """When the i-th message of a log is."""
    return START_NS + round(i * PERIOD_NS)


def stamps(frames: Sequence[Frame]) -> list[int]:
    return [frame.stamp_ns for frame in frames]


def of_pictures(path: Path, pictures: Sequence[Fields], kind: str = COMPRESSED) -> LogSource:
    """A log of these on /front/image, open."""
    with ros_log(path) as log:
        for fields in pictures:
            log.say("/front/image", kind, fields)
    return LogSource(path)
