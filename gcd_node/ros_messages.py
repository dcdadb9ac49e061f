"""What a node saw, drew, said and was asked, as ROS 2 messages: by the definitions of rosbags, no ROS needed."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_client.images import depth_m, encode_jpegs, images
from gcd_client.protocol import OriginHeader, StatusTopic, ViewHeader, ViewMessage, kind_of, to_text
from gcd_node.auth import Client
from gcd_node.config import NodeConfig, RecordConfig
from gcd_node.frame import Frame, LensModel, SourceInfo
from gcd_node.health import Level
from gcd_node.verbs import VERBS

IMAGE_TOPIC, COMMAND_TOPIC = "/src/image", "/gcd/command"
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_CAMERA_INFO, _STRING = "sensor_msgs/msg/CameraInfo", "std_msgs/msg/String"
_VIEW_NAMES = {"win": "image", "cls": "classes", "std": "std", "vis": "visibility", "depth": "depth"}
_LATEST_S = 2**31 - 1  # builtin_interfaces/Time ends in 2038
_LONGEST_ARGS = 4096
_WORSE: Mapping[str, Mapping[str, Level]] = {
    "source": {"lost": Level.ERROR, "stalled": Level.WARN},
    "model": {"failed": Level.ERROR, "degraded": Level.WARN},
    "rec": {"failed": Level.WARN},
}
"""Levels of a part of the node by its state."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RosMessage:
    """One message of a recording. kind: its type. log_ns: UTC, its place on the time line. sent_ns: when it left the
    node, of inputs when they were captured. sequence: the source's frame number, of headers the window's, else 0."""

    topic: str
    kind: str
    data: memoryview
    log_ns: int
    sent_ns: int
    sequence: int = 0


def definition(kind: str) -> str:
    """The text that says what messages of a type hold, with every type in it."""
    return _types().generate_msgdef(kind, ros_version=2)[0]


@dataclass(frozen=True, kw_only=True, slots=True)
class Source:
    """A source, and what is known of its camera: its lens, else its field of view, else neither."""

    info: SourceInfo
    lens: LensModel | None
    hfov_deg: float | None

    def facts(self) -> dict[str, str]:
        """What its pictures do not say, for a replay. calibrated: whether camera_info holds a lens."""
        info, calibrated = self.info, "no" if self.lens is None else "yes"
        facts = {"kind": info.kind, "id": info.id, "stamp_uncertainty_us": str(info.stamp_uncertainty_us)}
        return facts | {"calibrated": calibrated} | ({"hfov_deg": repr(self.hfov_deg)} if self.hfov_deg else {})

    def camera_info(self, head: Any, size: tuple[int, int]) -> Any:
        """sensor_msgs/CameraInfo of pictures of `size` (width, height); k is zero, by ROS's rule, if unknown."""
        if self.lens is not None and self.lens.fits(*size):
            lens = self.lens.resized(*size)
            kind = "plumb_bob" if lens.distortion == "none" else lens.distortion
            return _camera_info(head, size, kind, lens.coefficients or (0.0,) * 5, lens.matrix.flatten())
        if self.lens is None and self.hfov_deg is not None:
            focal = size[0] / 2 / math.tan(math.radians(self.hfov_deg / 2))
            k = (focal, 0.0, (size[0] - 1) / 2, 0.0, focal, (size[1] - 1) / 2, 0.0, 0.0, 1.0)
            return _camera_info(head, size, "plumb_bob", (0.0,) * 5, k)
        return _camera_info(head, size, "", (), (0.0,) * 9)


def input_messages(
    frame: Frame, source: Source, stamp_ns: int, log_ns: int, record: RecordConfig
) -> Iterator[RosMessage]:
    """A frame and its camera. stamp_ns: when it was captured, UTC of a live source."""
    head = _header(stamp_ns, f"{source.info.kind}_optical")
    if record.input_encoding == "raw":
        yield _message(IMAGE_TOPIC, _IMAGE, _image(head, frame.image), log_ns, sequence=frame.seq)
    else:
        coded, _ = encode_jpegs(frame.image[None], record.jpeg_quality)
        yield _message(IMAGE_TOPIC, _COMPRESSED, _jpeg(head, coded), log_ns, sequence=frame.seq)
    camera = source.camera_info(head, frame.size)
    yield _message("/src/camera_info", _CAMERA_INFO, camera, log_ns, sequence=frame.seq)


def is_recorded(message: ViewMessage) -> bool:
    """Whether a view message has pixels that no other one of its window has."""
    return message.topic.startswith("view/") and kind_of(message.topic) in _VIEW_NAMES


def view_topic(message: ViewMessage) -> str:
    """Where its pixels go."""
    return f"/view/{message.header.view_id}/{_VIEW_NAMES[kind_of(message.topic)]}"


def view_messages(message: ViewMessage, config: NodeConfig) -> Iterator[RosMessage]:
    """A window: its frames and their camera, its header, age and poses. Raises MessageError: it cannot be decoded."""
    header, kind = message.header, kind_of(message.topic)
    place, at_ns = f"/view/{header.view_id}", header.t_publish_ns
    if kind in ("win", "std"):
        name = "header" if kind == "win" else "std_header"
        yield _text(f"{place}/{name}", to_text(header, {}), at_ns, at_ns, header.window_id)
    if kind == "win":
        yield _message(
            f"{place}/age_ms", "std_msgs/msg/Float64", _make("std_msgs/msg/Float64", data=header.age_ms), at_ns
        )
        if header.source_from_view is not None and header.pose_units == "m":
            moved = [_transform(header, i, numbers) for i, numbers in enumerate(header.source_from_view)]
            yield _message("/tf", "tf2_msgs/msg/TFMessage", _make("tf2_msgs/msg/TFMessage", transforms=moved), at_ns)
    size = (header.shape[2], header.shape[1])
    for index, (type_, picture) in enumerate(_pictures(message, config.record.jpeg_quality)):
        yield _of_frame(header, index, view_topic(message), type_, picture, config)
        if kind == "win" and header.intrinsics is not None:
            camera = _camera_info(_head(header, index), size, "plumb_bob", (0.0,) * 5, header.intrinsics)
            yield _of_frame(header, index, f"{place}/camera_info", _CAMERA_INFO, camera, config)


def _of_frame(header: ViewHeader, index: int, topic: str, kind: str, fields: Any, config: NodeConfig) -> RosMessage:
    """A window leaves the node as one; on the time line its frames follow each other as they were taken, from then on,
    and end before the next window begins. In lockstep there is no rhythm to keep."""
    frames, sequences = header.shape[0], header.src.seq
    paced = config.source.pace == "realtime"
    step_s = (config.window.stride or frames) / (frames * header.src.fps_cond) if paced else 0.0
    log_ns = header.t_publish_ns + round(index * step_s * 1e9)
    return _message(topic, kind, fields, log_ns, header.t_publish_ns, sequences[min(index, len(sequences) - 1)])


def _pictures(message: ViewMessage, quality: int) -> Iterator[tuple[str, Any]]:
    header = message.header
    if header.encoding not in ("rgb8", "jpeg"):
        is_depth = header.encoding == "invdepth16"
        for index, pixels in enumerate(depth_m(message)[..., None] if is_depth else images(message)):
            yield _IMAGE, _image(_head(header, index), pixels)
        return
    payload, offsets = message.payload, header.offsets
    if offsets is None:
        payload, offsets = encode_jpegs(images(message), quality)
    for index in range(header.shape[0]):
        yield _COMPRESSED, _jpeg(_head(header, index), memoryview(payload)[offsets[index] : offsets[index + 1]])


def note_messages(
    kind: StatusTopic, header: OriginHeader, fields: Mapping[str, Any], log_ns: int
) -> Iterator[RosMessage]:
    """A status, an event or the metadata; a status also as diagnostics. log_ns: when it was said, or is said again."""
    sent_ns = header.t_publish_ns
    yield _text(f"/gcd/{kind}", to_text(header, fields), log_ns, sent_ns)
    if kind == "status":
        array = "diagnostic_msgs/msg/DiagnosticArray"
        parts = list(_diagnostics(header.node_id, fields))
        yield _message("/diagnostics", array, _make(array, header=_header(sent_ns, ""), status=parts), sent_ns)


def _diagnostics(node_id: str, fields: Mapping[str, Any]) -> Iterator[Any]:
    """One line for the node and one for each of its parts, whose message is its state, so that it can be plotted."""
    reasons = ", ".join(map(str, fields.get("reasons", ())))
    plain = {key: value for key, value in fields.items() if not isinstance(value, Mapping | list)}
    level, state = Level(int(fields.get("level", 0))), str(fields.get("state", ""))
    yield _diagnostic(node_id, "node", level, state, {**plain, "reasons": reasons})
    for name, part in fields.items():
        if isinstance(part, Mapping):
            state = str(part.get("state", ""))
            yield _diagnostic(node_id, name, _WORSE.get(name, {}).get(state, Level.OK), state, part)


def _diagnostic(node_id: str, name: str, level: Level, state: str, values: Mapping[str, Any]) -> Any:
    pairs = [_make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in _flat(values, "")]
    kind = "diagnostic_msgs/msg/DiagnosticStatus"
    name = f"{node_id}: {name}"
    return _make(kind, level=int(level), name=name, message=state, hardware_id=node_id, values=pairs)


def _flat(fields: Mapping[str, Any], place: str) -> Iterator[tuple[str, object]]:
    for key, value in fields.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{place}{key}.")
        else:
            yield f"{place}{key}", value


def command_messages(request: bytes, reply: bytes, client: Client, log_ns: int) -> Iterator[RosMessage]:
    """A request and its reply. Questions that were answered change nothing and are left out."""
    asked, answered = _object(request), _object(reply)
    verb = VERBS.get(str(asked.get("verb")))
    if answered.get("ok") is True and verb is not None and verb.role == "viewer":
        return
    fields = {key: answered.get(key) for key in ("id", "code", "message", "state")}
    fields |= {"client": client.name, "role": client.role, "verb": str(asked.get("verb", ""))[:64]}
    fields |= {key: asked[key] for key in ("dry_run", "if_view_rev") if isinstance(asked.get(key), bool | int)}
    args = json.dumps(asked.get("args", {}))
    fields |= {"args": asked.get("args", {})} if len(args) <= _LONGEST_ARGS else {"args_cut": args[:_LONGEST_ARGS]}
    yield _text(COMMAND_TOPIC, json.dumps(fields).encode(), log_ns, log_ns)


def _object(text: bytes) -> dict[str, Any]:
    """What a client sent, if it is a JSON object; NaN, which few readers know, is no JSON."""
    try:
        return msgspec.json.decode(text, type=dict[str, Any])
    except (ValueError, RecursionError):
        return {}


# --- ROS messages ------------------------------------------------------------------------------------------------


def _types() -> Any:
    from gcd_node.sources.ros_bags import ros2_types  # only now: a node that records nothing needs none

    return ros2_types()


def _make(kind: str, **fields: Any) -> Any:
    return _types().types[kind](**fields)


def _message(
    topic: str, kind: str, fields: Any, log_ns: int, sent_ns: int | None = None, sequence: int = 0
) -> RosMessage:
    data, sent_ns = _types().serialize_cdr(fields, kind, little_endian=True), log_ns if sent_ns is None else sent_ns
    return RosMessage(topic=topic, kind=kind, data=data, log_ns=log_ns, sent_ns=sent_ns, sequence=sequence)


def _text(topic: str, text: bytes, log_ns: int, sent_ns: int, sequence: int = 0) -> RosMessage:
    return _message(topic, _STRING, _make(_STRING, data=text.decode()), log_ns, sent_ns, max(0, sequence))


def _header(stamp_ns: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = _make("builtin_interfaces/msg/Time", sec=min(seconds, _LATEST_S), nanosec=nanoseconds)
    return _make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _head(header: ViewHeader, index: int) -> Any:
    stamps = header.t_capture_ns
    return _header(stamps[min(index, len(stamps) - 1)], header.frame_id)


def _jpeg(head: Any, coded: bytes | memoryview) -> Any:
    return _make(_COMPRESSED, header=head, format="jpeg", data=np.frombuffer(coded, np.uint8))


def _image(head: Any, pixels: NDArray[Any]) -> Any:
    """u8 [H, W, 3] as rgb8 and [H, W, 1] as mono8; depth in metres [H, W, 1] as 32FC1 (REP 118)."""
    height, width, channels = pixels.shape
    encoding = "32FC1" if pixels.dtype == np.float32 else "rgb8" if channels == 3 else "mono8"
    return _make(
        _IMAGE,
        header=head,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=width * channels * pixels.itemsize,
        data=np.ascontiguousarray(pixels).reshape(-1).view(np.uint8),
    )


def _camera_info(
    head: Any, size: tuple[int, int], distortion: str, d: Sequence[float], k: Sequence[float] | NDArray[np.float64]
) -> Any:
    p = np.zeros((3, 4))
    p[:, :3] = np.reshape(k, (3, 3))
    roi = _make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return _make(
        _CAMERA_INFO,
        header=head,
        height=size[1],
        width=size[0],
        distortion_model=distortion,
        d=np.array(d, np.float64),
        k=np.array(k, np.float64),
        r=np.eye(3).reshape(-1),
        p=p.reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def _transform(header: ViewHeader, index: int, numbers: Sequence[float]) -> Any:
    """Where the virtual camera stands in the source camera's axes."""
    pose = np.asarray(numbers, np.float64).reshape(4, 4)
    turn = cv2.Rodrigues(pose[:3, :3])[0].reshape(3)  # the axis, as long as the angle
    angle = float(np.linalg.norm(turn))
    x, y, z = (turn * (math.sin(angle / 2) / angle if angle > 0 else 0.5)).tolist()
    place = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
    seen = _head(header, index)
    return _make(
        "geometry_msgs/msg/TransformStamped",
        header=_make("std_msgs/msg/Header", stamp=seen.stamp, frame_id=header.src_frame_id),
        child_frame_id=header.frame_id,
        transform=_make(
            "geometry_msgs/msg/Transform",
            translation=_make("geometry_msgs/msg/Vector3", **place),
            rotation=_make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=math.cos(angle / 2)),
        ),
    )
