"""What messages of robot logs say: pictures, depth, lenses and poses, of ROS 1, ROS 2 and Foxglove."""

import logging
import math
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import SourceError
from gcd_node.frame import MAX_PIXELS, Image, LensModel, lens_of_message
from gcd_node.sources.files import decode_picture, raw_picture, raw_rows
from gcd_node.sources.log_reader import Kind, LogMessage, line_of

_LOG = logging.getLogger(__name__)
_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_PNG = b"\x89PNG\r\n\x1a\n"
_VIDEO_DECODERS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}
_DEPTH_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # body_from_camera by REP 103


def head_of(fields: Any) -> tuple[int, str]:
    """A message's stamp in nanoseconds, 0 if nobody filled it in, and its frame_id."""
    head = getattr(fields, "header", fields)
    time = head.stamp if hasattr(head, "stamp") else head.timestamp
    seconds, nanoseconds = (time.sec, time.nanosec) if hasattr(time, "sec") else (time.seconds, time.nanos)
    return max(0, int(seconds) * 1_000_000_000 + int(nanoseconds)), str(head.frame_id)


def _bytes_of(fields: Any) -> bytes:
    """Raises TypeError: the log's own definition may have anything in their place."""
    return memoryview(fields.data).tobytes()


# Pictures and depth.


class ImageDecoder:
    """Pictures of one topic. Of a video it must be given every message, in order."""

    def __init__(self) -> None:
        self._video: Any = None

    def decode(self, kind: Kind, fields: Any) -> tuple[Image, str] | None:
        """The picture, u8 [H, W, 3] RGB, and what it was coded as; None while a video waits for its key frame.

        Args:
            kind: of PICTURES. fields: of the message.
        Raises:
            SourceError: damaged, too large, in a layout that is not read, or PyAV is not installed.
        """
        if kind == "video":
            return self._decode_video(str(fields.format).lower(), _bytes_of(fields))
        if kind == "raw":
            return raw_picture(fields), str(fields.encoding)
        format_ = str(fields.format)
        if format_.startswith(tuple(_DEPTH_TYPES)):
            raise SourceError(f"{format_[:40]!r} is a map of depths, not a picture")
        picture = decode_picture(_bytes_of(fields), _COLOUR)
        if "compressed rgb" not in format_:  # the order image_transport handed to the coder, which takes all for BGR
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
        codec = next((each for each in ("png", "webp") if each in format_.lower()), "jpeg")
        return np.ascontiguousarray(picture, np.uint8), codec

    def _decode_video(self, codec: str, data: bytes) -> tuple[Image, str] | None:
        try:
            import av
        except ImportError as error:
            raise SourceError(f"to read {codec[:20]} video, PyAV is needed: pip install 'gcd-node[video]'") from error
        if codec not in _VIDEO_DECODERS:
            raise SourceError(f"video in {codec[:20]!r} is not read; known are {', '.join(_VIDEO_DECODERS)}")
        if self._video is None:
            self._video = av.CodecContext.create(_VIDEO_DECODERS[codec], "r")
            self._video.thread_count = 1  # more would keep frames back
            self._video.options = {"max_pixels": str(MAX_PIXELS)}
        frames = self._video.decode(av.Packet(data))
        return (frames[-1].to_ndarray(format="rgb24"), codec) if frames else None


def depth_of(kind: Kind, fields: Any) -> NDArray[Any]:
    """A depth picture as it was sent, [H, W]: uint16 millimetres or float32 metres.

    Raises:
        SourceError: damaged, or no depth.
    """
    if kind == "coded":
        return _decoded_depth(str(fields.format), _bytes_of(fields))
    if kind != "raw" or fields.encoding not in _DEPTH_TYPES:
        known = ", ".join(_DEPTH_TYPES)
        raise SourceError(f"depth is read from {known}, got {str(getattr(fields, 'encoding', kind))[:40]!r}")
    stored = np.dtype((">" if getattr(fields, "is_bigendian", 0) else "<") + _DEPTH_TYPES[fields.encoding])
    rows = np.ascontiguousarray(raw_rows(fields, stored.itemsize, fields.height))
    return rows.view(stored).astype(stored.newbyteorder("="))


def _decoded_depth(format_: str, coded: bytes) -> NDArray[Any]:
    """A 16-bit PNG of millimetres; behind the 12 bytes of image_transport's compressedDepth also of inverse depth."""
    start = coded.find(_PNG, 0, 64)
    levels = decode_picture(coded[max(start, 0) :], cv2.IMREAD_UNCHANGED)
    if start < 0 or levels.dtype != np.uint16 or levels.ndim != 2:
        raise SourceError(f"depth in {format_[:40]!r} must be a PNG of one channel of 16 bits")
    if not format_.startswith("32FC1"):
        return levels
    a, b = struct.unpack_from("<ff", coded, 4)  # level = a / metres + b
    with np.errstate(all="ignore"):
        return np.where(levels > 0, a / (levels - np.float32(b)), 0).astype(np.float32)


# Lenses and poses.


class Cameras:
    """What a log says of the robot's cameras: their lenses, and where they are by odometry and /tf_static."""

    def __init__(self) -> None:
        self._infos: dict[str, Any] = {}  # by topic: fields
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}  # of a frame: parent, parent_from_frame
        self._bodies: dict[str, str] = {}  # by topic of odometry: the frame it speaks of

    def add(self, message: LogMessage) -> None:
        """Keep what a message says, if it is one of these. Raises as a library does if it is damaged."""
        if message.kind == "camera" and message.topic not in self._infos:
            self._infos[message.topic] = message.decode()
        elif message.kind == "odometry" and message.topic not in self._bodies:
            self._bodies[message.topic] = message.decode().child_frame_id
        elif message.kind == "transforms" and message.topic.endswith("tf_static"):
            for each in message.decode().transforms:
                pose = pose_of(each.transform.translation, each.transform.rotation)
                self._parents[each.child_frame_id] = each.header.frame_id, pose

    def lens(self, topic: str, size: tuple[int, int]) -> LensModel | None:
        """Of pictures on `topic`: the calibration in the nearest folder above it, as ROS drivers send it. None if there
        is none that fits."""
        place = topic.split("/")
        above = [name for name in self._infos if place[: name.count("/")] == name.split("/")[:-1]]
        if not above:
            return None
        name = max(above, key=lambda each: each.count("/"))
        # by the conventions of image_pipeline, pictures on image_rect... are undistorted already
        rectified = any(part.startswith("image_rect") for part in place)
        try:
            lens = lens_of_message(self._infos[name], rectified=rectified)
            return None if lens is None else lens.resized(*size)
        except Exception as error:  # the log's own definition may lack anything
            _LOG.warning("the calibration on %s is not used, state one in [source]: %s", name, line_of(error))
            return None

    def body_from_camera(self, odometry_topic: str, camera: str) -> NDArray[np.float64]:
        """[4, 4], of what the odometry speaks of and a camera's frame; if it is not known, the camera is taken to look
        ahead from the body's origin."""
        body = self._bodies.get(odometry_topic, "")
        (body_root, root_from_body), (camera_root, root_from_camera) = self._root(body), self._root(camera)
        if body_root != camera_root:
            _LOG.warning("/tf_static does not say where %s is on %s: taken to look ahead from there", camera, body)
            return _AHEAD
        return np.linalg.inv(root_from_body) @ root_from_camera

    def _root(self, frame: str) -> tuple[str, NDArray[np.float64]]:
        """What a frame hangs on in the end, and root_from_frame."""
        pose = np.eye(4)
        for _ in range(len(self._parents)):
            if frame in self._parents:
                frame, parent_from_frame = self._parents[frame]
                pose = parent_from_frame @ pose
        return frame, pose


def pose_of(place: Any, turn: Any) -> NDArray[np.float64]:
    """parent_from_child, [4, 4], of a ROS position or translation and a quaternion. Raises SourceError: it is none."""
    axis, norm = np.array([turn.x, turn.y, turn.z]), math.hypot(turn.x, turn.y, turn.z, turn.w)
    pose = np.eye(4)
    pose[:3, 3] = place.x, place.y, place.z
    if not (0.5 < norm < 2 and np.isfinite(pose).all()):
        raise SourceError(f"a pose has a quaternion of length {norm:g}: nobody filled it in")
    sine = float(np.linalg.norm(axis))
    pose[:3, :3] = cv2.Rodrigues(axis * (2 * math.atan2(sine, turn.w) / sine if sine > 0 else 2.0))[0]
    return pose
