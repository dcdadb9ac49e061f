"""What a node saw, drew, said and was asked, as ROS 2 messages in MCAP files: by the definitions of rosbags, no ROS
needed."""

import json
import logging
import math
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import yaml
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from numpy.typing import NDArray

from gcd_client.images import depth_m, encode_jpegs, images, layers
from gcd_client.protocol import (
    DataMessage,
    GridMessage,
    OriginHeader,
    StatusTopic,
    ViewHeader,
    ViewMessage,
    kind_of,
    to_text,
)
from gcd_node.auth import Client
from gcd_node.config import NodeConfig, RecordConfig
from gcd_node.frame import Frame, SourceInfo
from gcd_node.health import Level
from gcd_node.verbs import VERBS

_LOG = logging.getLogger(__name__)
IMAGE_TOPIC, COMMAND_TOPIC = "/src/image", "/gcd/command"
_CHUNK_BYTES = 64 * 1024  # what a reader can lose of a file that was never finished
_VIEW_NAMES = {"win": "image", "cls": "classes", "std": "std", "vis": "visibility", "depth": "depth"}
_LEVELS = {"lost": Level.ERROR, "failed": Level.ERROR, "stalled": Level.WARN, "degraded": Level.WARN}
"""Of a part of the node in a state that is not all right."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RosMessage:
    """One message of a recording. fields: of a class of rosbags. log_ns: UTC, its place on the time line. sent_ns: when
    it left the node, of inputs when they were captured. sequence: the source's frame number, of headers the window's,
    else 0."""

    topic: str
    fields: Any
    log_ns: int
    sent_ns: int
    sequence: int = 0


def _types() -> Any:
    from gcd_node.sources.log_reader import ros2_types  # only now: a node that records nothing needs none

    return ros2_types()


class McapFile:
    """An MCAP file being written. size, messages: so far. begun_ns: UTC. counts: messages by topic and type. span_ns:
    log times of its first and last message on the time line."""

    def __init__(self, path: Path) -> None:
        """Create `path`. Raises OSError: it is there already, or cannot be."""
        self.path, self.begun_ns = path, time.time_ns()
        self._file = path.open("xb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library=f"gcd-node; mcap-python/{version('mcap')}")
        self._ids: dict[str, int] = {}  # of a type its schema's, of a topic its channel's
        self.size = self.messages = 0
        self.counts, self.span_ns = Counter[tuple[str, str]](), (2**63 - 1, 0)
        self._has_end = False
        self._flushed = (0, 0)  # size and messages that are on the disk for certain

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Add metadata."""
        self._writer.add_metadata(name, dict(facts))

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file."""
        self._writer.add_attachment(self.begun_ns, self.begun_ns, name, media_type, data)

    def write(self, messages: Iterable[RosMessage]) -> None:
        """Add messages that belong together: all of them, or none if one cannot be made. Raises OSError."""
        types = _types()
        kinds = [(each, each.fields.__msgtype__) for each in messages]
        for each, kind, data in [(each, kind, types.serialize_cdr(each.fields, kind)) for each, kind in kinds]:
            if kind not in self._ids:
                text = types.generate_msgdef(kind, ros_version=2)[0]
                self._ids[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
            if each.topic not in self._ids:
                self._ids[each.topic] = self._writer.register_channel(each.topic, "cdr", self._ids[kind])
            sequence, channel = each.sequence % 2**32, self._ids[each.topic]
            self._writer.add_message(channel, each.log_ns, data, publish_time=each.sent_ns, sequence=sequence)
            self.messages += 1
            self.counts[each.topic, kind] += 1
            self.span_ns = min(self.span_ns[0], each.log_ns), max(self.span_ns[1], each.log_ns)
        self.size = self._file.tell()

    def flush(self) -> None:
        """Close the chunk in work, so that a reader gets it whatever happens next. Raises OSError: the disk is full or
        broken."""
        self._writer.flush()
        os.fdatasync(self._file.fileno())
        self.size = self._file.tell()
        self._flushed = self.size, self.messages

    def close(self, *, is_broken: bool = False) -> bool:
        """Write index and end. is_broken: a write has failed; then it ends behind what was flushed, without an index.
        Returns whether it has an end."""
        if self._file.closed:  # before, and the next one could not be opened
            return self._has_end
        try:
            if not is_broken:
                self._writer.finish()
                self.flush()
                self._file.close()
                self._has_end = True
                return True
        except OSError as error:
            _LOG.warning("%s: %s", self.path, error)
        self.size, self.messages = self._flushed
        builder = RecordBuilder()
        DataEnd(data_section_crc=0).write(builder)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
        with suppress(OSError, ValueError), closing(self._file.raw):  # what is buffered has no place any more
            os.ftruncate(self._file.fileno(), self.size)
            return self.size > 0 and os.pwrite(self._file.fileno(), builder.end() + MCAP0_MAGIC, self.size) > 0
        return False


def write_bag_metadata(folder: Path, files: Sequence[McapFile]) -> None:
    """Write metadata.yaml, which makes a ROS 2 bag of a folder with these files. Raises OSError.

    Source: rosbag2's metadata of version 5, that of Humble, which later distributions read.
    """
    counts = sum((file.counts for file in files), Counter[tuple[str, str]]())

    def times(part: Sequence[McapFile]) -> dict[str, Any]:
        start_ns, end_ns = min(each.span_ns[0] for each in part), max(each.span_ns[1] for each in part)
        span = {"nanoseconds_since_epoch": start_ns}, {"nanoseconds": max(0, end_ns - start_ns)}
        return {"starting_time": span[0], "duration": span[1], "message_count": sum(each.messages for each in part)}

    def topic(name: str, kind: str) -> dict[str, str]:
        return {"name": name, "type": kind, "serialization_format": "cdr", "offered_qos_profiles": ""}

    bag = {
        "version": 5,
        "storage_identifier": "mcap",
        **times(files),
        "topics_with_message_count": [
            {"topic_metadata": topic(*key), "message_count": count} for key, count in sorted(counts.items())
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.path.name for file in files],
        "files": [{"path": file.path.name, **times((file,))} for file in files],
    }
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": bag}, sort_keys=False))


# Inputs and views.


def input_messages(frame: Frame, info: SourceInfo, log_ns: int, record: RecordConfig) -> Iterator[RosMessage]:
    """A frame, of a live source with its stamp in UTC, and its camera. info: with the calibration in use."""
    head, size = _header(frame.stamp_ns, info.optical_frame), frame.size
    if record.input_encoding == "raw":
        picture = _image(head, frame.image)
    else:
        picture = _jpeg(head, encode_jpegs(frame.image[None], record.jpeg_quality)[0])
    camera = _camera_info(head, size, (0.0,) * 9, "", ())  # unknown, by ROS's rule
    if info.lens is not None and info.lens.fits(*size):
        lens = info.lens.resized(*size)
        kind = "plumb_bob" if lens.distortion == "none" else lens.distortion
        camera = _camera_info(head, size, lens.matrix, kind, lens.coefficients or (0.0,) * 5)
    for topic, fields in ((IMAGE_TOPIC, picture), ("/src/camera_info", camera)):
        yield RosMessage(topic=topic, fields=fields, log_ns=log_ns, sent_ns=log_ns, sequence=frame.seq)


def data_topic(message: DataMessage) -> str | None:
    """Where the pixels of a view or the cells of a grid go; None if another message of its window has them."""
    if isinstance(message, GridMessage):
        return f"/{message.topic}"
    name = _VIEW_NAMES.get(kind_of(message.topic)) if message.topic.startswith("view/") else None
    return None if name is None else f"/view/{message.header.view_id}/{name}"


def data_messages(message: DataMessage, config: NodeConfig) -> Iterator[RosMessage]:
    """What a view or a grid becomes. Raises MessageError: it cannot be decoded."""
    return _grid_messages(message) if isinstance(message, GridMessage) else _view_messages(message, config)


def _grid_messages(message: GridMessage) -> Iterator[RosMessage]:
    """Its occupancy."""
    header, at_ns = message.header, message.header.t_publish_ns
    height, width = header.shape
    place = dict(zip("xy", header.origin_m, strict=True))
    origin = _make(
        "geometry_msgs/msg/Pose",
        position=_make("geometry_msgs/msg/Point", **place, z=0.0),
        orientation=_make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    head = _header(header.t_capture_ns[0], header.frame_id)
    fields = {"map_load_time": head.stamp, "resolution": header.cell_m, "width": width, "height": height}
    grid = _make(
        "nav_msgs/msg/OccupancyGrid",
        header=head,
        info=_make("nav_msgs/msg/MapMetaData", **fields, origin=origin),
        data=layers(message).occupancy.reshape(-1),
    )
    topic, sequence = data_topic(message) or "", header.src.seq[0]
    yield RosMessage(topic=topic, fields=grid, log_ns=at_ns, sent_ns=at_ns, sequence=sequence)


def _view_messages(message: ViewMessage, config: NodeConfig) -> Iterator[RosMessage]:
    """A window: its frames and their camera, its header, age and poses. Raises MessageError: it cannot be decoded.

    It leaves the node as one; on the time line its frames follow each other as they were taken, from then on, and end
    before the next window begins. In lockstep there is no rhythm to keep.
    """
    header, kind = message.header, kind_of(message.topic)
    place, at_ns, frames = f"/view/{header.view_id}", header.t_publish_ns, header.shape[0]
    heads = [_head(header, index) for index in range(frames)]
    if kind in ("win", "std"):
        name = "header" if kind == "win" else "std_header"
        yield _text(f"{place}/{name}", to_text(header, {}), at_ns, at_ns, header.window_id)
    if kind == "win":
        age = _make("std_msgs/msg/Float64", data=header.age_ms)
        yield RosMessage(topic=f"{place}/age_ms", fields=age, log_ns=at_ns, sent_ns=at_ns)
        if header.source_from_view is not None and header.pose_units == "m":
            moved = [_transform(header, _head(header, i).stamp, pose) for i, pose in enumerate(header.source_from_view)]
            transforms = _make("tf2_msgs/msg/TFMessage", transforms=moved)
            yield RosMessage(topic="/tf", fields=transforms, log_ns=at_ns, sent_ns=at_ns)
    paced = config.source.pace == "realtime"
    step_s = (config.window.stride or frames) / (frames * header.src.fps_cond) if paced else 0.0
    pictures = _pictures(message, heads, config.record.jpeg_quality)
    for index, (head, picture) in enumerate(zip(heads, pictures, strict=True)):
        parts = {data_topic(message) or "": picture}
        if kind == "win" and header.intrinsics is not None:
            parts[f"{place}/camera_info"] = _camera_info(head, (header.shape[2], header.shape[1]), header.intrinsics)
        log_ns, sequence = at_ns + round(index * step_s * 1e9), header.src.seq[min(index, len(header.src.seq) - 1)]
        for topic, fields in parts.items():
            yield RosMessage(topic=topic, fields=fields, log_ns=log_ns, sent_ns=at_ns, sequence=sequence)


def _pictures(message: ViewMessage, heads: Sequence[Any], quality: int) -> list[Any]:
    header = message.header
    if header.encoding not in ("rgb8", "jpeg"):
        pixels = depth_m(message)[..., None] if header.encoding == "invdepth16" else images(message)
        return [_image(head, each) for head, each in zip(heads, pixels, strict=True)]
    payload, offsets = message.payload, header.offsets
    if offsets is None:
        payload, offsets = encode_jpegs(images(message), quality)
    parts = [memoryview(payload)[begin:end] for begin, end in pairwise(offsets)]
    return [_jpeg(head, part) for head, part in zip(heads, parts, strict=True)]


# What the node says and is asked.


def note_messages(
    kind: StatusTopic, header: OriginHeader, fields: Mapping[str, Any], begun_ns: int
) -> Iterator[RosMessage]:
    """A status, an event or the metadata; a status also as diagnostics. begun_ns: of the file; what was said before is
    said again at its begin."""
    times = {"log_ns": max(header.t_publish_ns, begun_ns), "sent_ns": header.t_publish_ns}
    yield _text(f"/gcd/{kind}", to_text(header, fields), **times)
    if kind == "status":
        parts = list(_diagnostics(header.node_id, fields))
        array = _make("diagnostic_msgs/msg/DiagnosticArray", header=_header(header.t_publish_ns, ""), status=parts)
        yield RosMessage(topic="/diagnostics", fields=array, **times)


def _diagnostics(node_id: str, fields: Mapping[str, Any]) -> Iterator[Any]:
    """One line for the node and one for each of its parts, whose message is its state, so that it can be plotted."""
    node = {key: value for key, value in fields.items() if not isinstance(value, Mapping)}
    for name, part in [("node", node), *((key, part) for key, part in fields.items() if isinstance(part, Mapping))]:
        state = str(part.get("state", ""))
        level = int(fields.get("level", 0)) if part is node else _LEVELS.get(state, Level.OK)
        texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in part.items()}
        values = [_make("diagnostic_msgs/msg/KeyValue", key=key, value=text) for key, text in texts.items()]
        status = {"name": f"{node_id}: {name}", "message": state, "hardware_id": node_id, "values": values}
        yield _make("diagnostic_msgs/msg/DiagnosticStatus", level=int(level), **status)


def command_messages(request: bytes, reply: bytes, client: Client, log_ns: int) -> Iterator[RosMessage]:
    """A request and its reply, as one object. Questions that were answered change nothing and are left out."""
    asked, answered = _object(request), _object(reply)
    verb = VERBS.get(str(asked.get("verb")))
    if not (answered.get("ok") is True and verb is not None and verb.role == "viewer"):
        fields = asked | answered | {"client": client.name, "role": client.role}
        yield _text(COMMAND_TOPIC, msgspec.json.encode(fields), log_ns, log_ns)


def _object(text: bytes) -> dict[str, Any]:
    """What a client sent, if it is a JSON object."""
    try:
        return msgspec.json.decode(text, type=dict[str, Any])
    except (ValueError, RecursionError):
        return {}


# Parts of messages.


def _make(kind: str, **fields: Any) -> Any:
    return _types().types[kind](**fields)


def _text(topic: str, text: bytes, log_ns: int, sent_ns: int, sequence: int = 0) -> RosMessage:
    fields = _make("std_msgs/msg/String", data=text.decode())
    return RosMessage(topic=topic, fields=fields, log_ns=log_ns, sent_ns=sent_ns, sequence=sequence)


def _header(stamp_ns: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = _make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return _make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _head(header: ViewHeader, index: int) -> Any:
    stamps = header.t_capture_ns
    return _header(stamps[min(index, len(stamps) - 1)], header.frame_id)


def _jpeg(head: Any, coded: bytes | memoryview) -> Any:
    data = np.frombuffer(coded, np.uint8)
    return _make("sensor_msgs/msg/CompressedImage", header=head, format="jpeg", data=data)


def _image(head: Any, pixels: NDArray[Any]) -> Any:
    """u8 [H, W, 3] as rgb8 and [H, W, 1] as mono8; depth in metres [H, W, 1] as 32FC1 (REP 118)."""
    height, width, channels = pixels.shape
    encoding = "32FC1" if pixels.dtype == np.float32 else "rgb8" if channels == 3 else "mono8"
    shape = {"height": height, "width": width, "step": width * channels * pixels.itemsize}
    data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    return _make("sensor_msgs/msg/Image", header=head, encoding=encoding, is_bigendian=0, data=data, **shape)


def _camera_info(
    head: Any,
    size: tuple[int, int],
    k: Sequence[float] | NDArray[np.float64],
    distortion: str = "plumb_bob",
    d: Sequence[float] = (0.0,) * 5,
) -> Any:
    """size: width and height. k: row by row."""
    matrix, p = np.array(k, np.float64).reshape(3, 3), np.zeros((3, 4))
    p[:, :3] = matrix
    return _make(
        "sensor_msgs/msg/CameraInfo",
        header=head,
        height=size[1],
        width=size[0],
        distortion_model=distortion,
        d=np.array(d, np.float64),
        k=matrix.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=p.reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=_make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def _transform(header: ViewHeader, stamp: Any, numbers: Sequence[float]) -> Any:
    """Where the virtual camera stands in the source camera's axes."""
    pose = np.asarray(numbers, np.float64).reshape(4, 4)
    turn = cv2.Rodrigues(pose[:3, :3])[0].reshape(3)  # the axis, as long as the angle
    angle = float(np.linalg.norm(turn))
    x, y, z = (turn * (math.sin(angle / 2) / angle if angle > 0 else 0.5)).tolist()
    place = _make("geometry_msgs/msg/Vector3", **dict(zip("xyz", pose[:3, 3].tolist(), strict=True)))
    rotation = _make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=math.cos(angle / 2))
    return _make(
        "geometry_msgs/msg/TransformStamped",
        header=_make("std_msgs/msg/Header", stamp=stamp, frame_id=header.src_frame_id),
        child_frame_id=header.frame_id,
        transform=_make("geometry_msgs/msg/Transform", translation=place, rotation=rotation),
    )
