"""Robot logs for tests, written by the reference libraries: pictures, depth, calibrations, poses in MCAP and bags.

Fields that are left out of a ROS message are zeros.
"""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from itertools import count
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

START_NS, PERIOD_NS = 1_750_000_000_123_456_789, 100_000_000
TOPIC = "/front/image_raw/compressed"
WORDS = ("std_msgs/msg/String", {"data": "hello"})
TYPES = get_typestore(Stores.ROS2_HUMBLE)
Fields = dict[str, Any]
Said = tuple[str, Fields]
"""Type and fields of a message."""


def at(i: float) -> int:
    """When the i-th message of a log is."""
    return START_NS + round(i * PERIOD_NS)


def coded(image: np.ndarray, suffix: str = ".jpg") -> bytes:
    picture = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    good, data = cv2.imencode(suffix, picture, [cv2.IMWRITE_JPEG_QUALITY, 98])
    assert good
    return data.tobytes()


def header(stamp_ns: int, frame_id: str = "front_optical") -> Fields:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame_id}


def compressed(
    image: Image, stamp_ns: int, format_: str = "bgr8; jpeg compressed bgr8", data: bytes | None = None
) -> Said:
    """data: in place of the coded picture."""
    data = coded(image, ".png" if "png" in format_ else ".jpg") if data is None else data
    return "sensor_msgs/msg/CompressedImage", {"header": header(stamp_ns), "format": format_, "data": data}


def raw(pixels: np.ndarray, encoding: str, stamp_ns: int = START_NS, width: int = 0, height: int = 0) -> Said:
    """Of rows; width and height where they are not those of the array."""
    sizes = {"height": height or pixels.shape[0], "width": width or pixels.shape[1], "step": pixels.strides[0]}
    fields = {"header": header(stamp_ns), "encoding": encoding, "data": pixels.tobytes(), **sizes}
    return "sensor_msgs/msg/Image", fields


def odometry(x: float, stamp_ns: int, yaw_deg: float = 0.0) -> Said:
    half = np.radians(yaw_deg) / 2
    pose = {"position": {"x": x}, "orientation": {"z": float(np.sin(half)), "w": float(np.cos(half))}}
    fields = {"header": header(stamp_ns, "odom"), "child_frame_id": "base_link", "pose": {"pose": pose}}
    return "nav_msgs/msg/Odometry", fields


def transform(parent: str, child: str, x: float, turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Fields:
    moved = {"translation": {"x": x}, "rotation": dict(zip("xyzw", turn, strict=True))}
    return {"header": header(START_NS, parent), "child_frame_id": child, "transform": moved}


def camera_info(
    width: int, height: int, *, focal: float = 60.0, d: Sequence[float] = (-0.1, 0.01, 0.001, 0.002, 0.0)
) -> Said:
    cx, cy = width / 2, height / 2
    k = [focal, 0.0, cx, 0.0, focal + 1, cy, 0.0, 0.0, 1.0]
    p = [focal - 5, 0.0, cx, 0.0, 0.0, focal - 4, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    sizes = {"height": height, "width": width}
    fields = {"header": header(START_NS), "distortion_model": "plumb_bob", "d": list(d), "k": k, "p": p, **sizes}
    return "sensor_msgs/msg/CameraInfo", fields


@contextmanager
def ros_log(
    path: Path, *, compression: CompressionType = CompressionType.ZSTD, chunk_size: int = 1 << 16, checked: bool = True
) -> Generator[Callable[..., None]]:
    """What adds a message to an MCAP file; log times rise by PERIOD_NS unless given. checked: with checksums."""
    times = count(START_NS + 5_000_000, PERIOD_NS)
    with path.open("wb") as file:
        writer = RosWriter(file, chunk_size=chunk_size, compression=compression, enable_crcs=checked)

        def say(topic: str, kind: str, fields: Fields, *, log_ns: int | None = None, sequence: int = 0) -> None:
            schema = writer.register_msgdef(kind, TYPES.generate_msgdef(kind, ros_version=2)[0])
            now_ns = next(times) if log_ns is None else log_ns
            writer.write_message(topic, schema, fields, log_time=now_ns, publish_time=now_ns, sequence=sequence)

        yield say
        writer.finish()


def write_log(path: Path, images: Sequence[Image], **options: Any) -> Path:
    """JPEG pictures at 10 a second, numbered. options: of ros_log()."""
    with ros_log(path, **options) as say:
        for i, image in enumerate(images):
            say(TOPIC, *compressed(image, at(i)), sequence=i)
    return path


def of_pictures(path: Path, pictures: Sequence[Said]) -> LogSource:
    """A log of these on /front/image, open."""
    with ros_log(path) as say:
        for picture in pictures:
            say("/front/image", *picture)
    return LogSource(path)


def write_bag(
    path: Path,
    messages: Sequence[tuple[str, Said]],
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A ROS 1 bag if `path` ends in .bag, packed by bz2, else a folder of ROS 2; a message every PERIOD_NS."""
    is_ros1 = path.suffix == ".bag"
    writer = Bag1Writer(path) if is_ros1 else Bag2Writer(path, version=9, storage_plugin=storage)
    if isinstance(writer, Bag2Writer):
        writer.set_compression(compression, CompressionFormat.ZSTD)
    else:
        writer.set_compression(Bag1Writer.CompressionFormat.BZ2)
    with writer:
        connections: dict[str, Any] = {}
        for i, (topic, (kind, fields)) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ros1_types() if is_ros1 else TYPES)
            data = serialize_dynamic(kind, TYPES.generate_msgdef(kind, ros_version=2)[0])[kind](fields)
            writer.write(connections[topic], at(i), bytes(TYPES.cdr_to_ros1(data, kind)) if is_ros1 else data)
    return path


def write_foxglove(path: Path, messages: Sequence[Message], **options: Any) -> Path:
    """Pictures on /camera/image, calibrations on /camera/calibration. options: of the writer."""
    with path.open("wb") as file:
        writer = ProtobufWriter(file, **options)
        for i, message in enumerate(messages):
            topic = "/camera/calibration" if type(message).__name__ == "CameraCalibration" else "/camera/image"
            writer.write_message(topic, message, log_time=at(i), publish_time=at(i), sequence=i)
        writer.finish()
    return path


def foxglove(kind: Callable[..., Any], stamp_ns: int, data: bytes, format_: str = "jpeg") -> Any:
    """One of its pictures."""
    message = kind(frame_id="cam", data=data, format=format_)
    message.timestamp.seconds, message.timestamp.nanos = stamp_ns // 10**9, stamp_ns % 10**9
    return message


def stamps(frames: Sequence[Frame]) -> list[int]:
    return [frame.stamp_ns for frame in frames]
