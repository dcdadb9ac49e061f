"""What messages of a log say: fields, as ROS or Foxglove name them, become pictures, depth, cameras and poses.

What is damaged in a way that is not looked for raises whatever the library does that found it.
"""

import logging
import math
import struct
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_node.calibration import LensModel, lens_of
from gcd_node.errors import ConfigError, SourceError, TooShortError
from gcd_node.frame import MAX_FPS, MAX_PIXELS, Image
from gcd_node.sources.files import decode_picture
from gcd_node.sources.log_reader import CAMERAS, CODED_IMAGES, TRANSFORMS, VIDEOS, LogMessage

_LOG = logging.getLogger(__name__)
_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_CODECS = ("jpeg", "png", "webp")
_DEPTH = ("16UC", "32FC", "64FC", "16SC", "32SC")
_AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # body_from_camera by REP 103
_LOWEST_FPS = 0.05
_PNG = b"\x89PNG\r\n\x1a\n"
_VIDEO_DECODERS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}

_LAYOUTS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "nv12": (1, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (1, cv2.COLOR_YUV2RGB_NV21),
}
"""Bytes a pixel, and OpenCV's way from there to RGB; None: it is RGB."""


def head_of(fields: Any) -> tuple[int, str]:
    """A message's stamp in nanoseconds, 0 if nobody filled it in, and its frame_id."""
    head = getattr(fields, "header", fields)
    time = head.stamp if hasattr(head, "stamp") else head.timestamp
    seconds, nanoseconds = (time.sec, time.nanosec) if hasattr(time, "sec") else (time.seconds, time.nanos)
    return max(0, int(seconds) * 1_000_000_000 + int(nanoseconds)), str(head.frame_id)


def are_filled_in(stamps: Sequence[int]) -> bool:
    """Whether stamps are there at all, and go on from most messages to the next."""
    steps = [later - earlier for earlier, later in pairwise(stamps)]
    return all(stamps) and 2 * sum(step > 0 for step in steps) > len(steps)


def rate_of(stamps: Sequence[int], name: str) -> float:
    """Pictures a second. name: whose they are. Raises TooShortError, SourceError."""
    steps = [later - earlier for earlier, later in pairwise(stamps) if later > earlier]
    if not steps:
        raise TooShortError(f"TOO_SHORT n={len(stamps)}: pictures on {name} make no video; give a longer log")
    fps = 1e9 / median(steps)
    if not _LOWEST_FPS <= fps <= MAX_FPS:
        raise SourceError(
            f"pictures on {name} come {fps:g} times a second by their stamps, wanted are {_LOWEST_FPS:g} to "
            f"{MAX_FPS:g}; is its clock right?"
        )
    return fps


class ImageDecoder:
    """Pictures of one topic. Of a video it must be given every message, in order."""

    def __init__(self) -> None:
        self._video: Any = None

    def decode(self, kind: str, fields: Any) -> tuple[Image, str] | None:
        """The picture, u8 [H, W, 3] RGB, and what it was coded as; None while a video waits for its key frame.

        Args:
            kind: of IMAGES. fields: of the message.
        Raises:
            SourceError: damaged, too large, in a layout that is not read, or PyAV is not installed.
        """
        if kind in VIDEOS:
            return self._decode_video(str(fields.format).lower(), bytes(fields.data))
        if kind in CODED_IMAGES:
            return _decoded(str(fields.format), bytes(fields.data))
        return _unpacked(fields), str(fields.encoding)

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


def _decoded(format_: str, coded: bytes) -> tuple[Image, str]:
    if format_.startswith(_DEPTH) or "compressedDepth" in format_:
        raise SourceError(f"{format_[:40]!r} is a map of depths, not a picture")
    picture, codec = decode_picture(coded, _COLOUR), next((each for each in _CODECS if each in format_.lower()), "jpeg")
    # image_transport names the order it handed to the coder, which takes all for BGR
    swapped = "compressed rgb" in format_
    return np.ascontiguousarray(picture if swapped else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8), codec


def _unpacked(fields: Any) -> Image:
    if fields.encoding not in _LAYOUTS:
        known = ", ".join(_LAYOUTS)
        raise SourceError(f"pictures in {str(fields.encoding)[:40]!r} are not read; known are {known}")
    width, (channels, code) = fields.width, _LAYOUTS[fields.encoding]
    rows = fields.height * 3 // 2 if fields.encoding in ("nv12", "nv21") else fields.height  # then half as much colour
    pixels = _rows(fields, channels, rows).reshape(rows, width, channels)
    return np.ascontiguousarray(pixels if code is None else cv2.cvtColor(np.ascontiguousarray(pixels), code), np.uint8)


def _rows(fields: Any, pixel_bytes: int, rows: int) -> NDArray[np.uint8]:
    """[rows, bytes], without the padding of each row."""
    _check_size(fields.width, fields.height)
    used, step = fields.width * pixel_bytes, fields.step
    if not used <= step or step * rows > len(fields.data):
        raise SourceError(
            f"a {fields.width} x {fields.height} picture in {fields.encoding} has rows of {step} bytes and "
            f"{len(fields.data)} in all, wanted are {used} and {used * rows} or more: it is damaged"
        )
    return np.frombuffer(fields.data, np.uint8, count=step * rows).reshape(rows, step)[:, :used]


def depth_of(kind: str, fields: Any) -> NDArray[Any]:
    """A depth picture as it was sent, [H, W]: uint16 millimetres or float32 metres.

    Raises:
        SourceError: damaged, or no depth.
    """
    if kind in CODED_IMAGES:
        return _decoded_depth(str(fields.format), bytes(fields.data))
    types = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
    if kind in VIDEOS or fields.encoding not in types:
        raise SourceError(f"depth is read from 16UC1, mono16 and 32FC1, got {getattr(fields, 'encoding', kind)!r}")
    order = ">" if getattr(fields, "is_bigendian", 0) else "<"
    stored = np.dtype(order + types[fields.encoding])
    rows = np.ascontiguousarray(_rows(fields, stored.itemsize, fields.height))
    return rows.view(stored).astype(stored.newbyteorder("="))


def _decoded_depth(format_: str, coded: bytes) -> NDArray[Any]:
    """A 16-bit PNG of millimetres; behind the 12 bytes of image_transport's compressedDepth also of inverse depth."""
    start = coded.find(_PNG, 0, 64)
    if start < 0:
        raise SourceError(f"depth in {format_[:40]!r} is not read; known are 16-bit PNG and compressedDepth")
    levels = decode_picture(coded[start:], cv2.IMREAD_UNCHANGED)
    if levels.dtype != np.uint16 or levels.ndim != 2:
        raise SourceError(f"depth must be one channel of 16 bits, got {levels.dtype} {list(levels.shape)}")
    if not format_.startswith("32FC1"):
        return levels
    if start < 12:
        raise SourceError("depth in 32FC1 lacks the numbers that scale it: it is damaged")
    a, b = struct.unpack_from("<ff", coded, 4)  # level = a / metres + b
    with np.errstate(all="ignore"):
        return np.where(levels > 0, a / (levels - np.float32(b)), 0).astype(np.float32)


class Cameras:
    """What a log says of the robot's cameras: their lenses, and where they are by /tf_static."""

    def __init__(self) -> None:
        self._infos: dict[str, tuple[str, Callable[..., LensModel | None]]] = {}  # by topic: frame_id and calibration
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}  # of a frame: parent, parent_from_frame

    def add(self, message: LogMessage) -> None:
        """Keep what a message says."""
        if message.kind in CAMERAS and message.topic not in self._infos:
            fields = message.decode()
            self._infos[message.topic] = head_of(fields)[1], _calibration(fields)
        elif message.kind == TRANSFORMS and message.topic.endswith("tf_static"):
            for each in message.decode().transforms:
                pose = pose_of(each.transform.translation, each.transform.rotation)
                self._parents[each.child_frame_id] = each.header.frame_id, pose

    def lens(self, topic: str, frame_id: str, size: tuple[int, int]) -> LensModel | None:
        """Of pictures on `topic`: the calibration in the nearest folder above it, as ROS drivers send it; else the one
        of the same frame. None if there is none that fits."""
        place = topic.split("/")
        above = [name for name in self._infos if place[: name.count("/")] == name.split("/")[:-1]]
        named = [name for name, (frame, _) in self._infos.items() if frame and frame == frame_id]
        name = max(above, key=lambda each: each.count("/")) if above else next(iter(named), None)
        if name is None:
            return None
        # by the conventions of image_pipeline, pictures on image_rect... are undistorted already
        rectified = any(part.startswith("image_rect") for part in place)
        try:
            lens = self._infos[name][1](rectified=rectified)
            return None if lens is None else lens.resized(*size)
        except ConfigError as error:
            remedy = "state calibration or hfov_deg in [source]"
            _LOG.warning("the calibration on %s is not used: %s; %s", name, error, remedy)
            return None

    def body_from_camera(self, body: str, camera: str) -> NDArray[np.float64]:
        """[4, 4], between two frames; if it is not known, the camera is taken to look ahead from the body's origin."""
        (body_root, root_from_body), (camera_root, root_from_camera) = self._root(body), self._root(camera)
        if body_root == camera_root:
            return np.linalg.inv(root_from_body) @ root_from_camera
        _LOG.warning("/tf_static does not say where %s is on %s: taken to look ahead from there", camera, body)
        return _AHEAD

    def _root(self, frame: str) -> tuple[str, NDArray[np.float64]]:
        """What a frame hangs on in the end, and root_from_frame."""
        pose = np.eye(4)
        for _ in range(len(self._parents)):
            if frame in self._parents:
                frame, parent_from_frame = self._parents[frame]
                pose = parent_from_frame @ pose
        return frame, pose


def _calibration(fields: Any) -> Callable[..., LensModel | None]:
    """lens_of() for the pictures of a message, but for whether they are rectified."""
    roi = getattr(fields, "roi", None)
    return partial(
        lens_of,
        width=fields.width,
        height=fields.height,
        model=fields.distortion_model,
        **{name: _numbers(fields, name) for name in "dkp"},
        binning=(getattr(fields, "binning_x", 1), getattr(fields, "binning_y", 1)),
        roi=(0, 0, 0, 0) if roi is None else (roi.x_offset, roi.y_offset, roi.width, roi.height),
    )


def _numbers(fields: Any, name: str) -> tuple[float, ...]:
    values = getattr(fields, name) if hasattr(fields, name) else getattr(fields, name.upper())  # as ROS 1 and Foxglove
    return tuple(map(float, values))


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


def _check_size(width: int, height: int) -> None:
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        raise SourceError(f"a picture states {width} x {height} pixels, wanted are 1 to {MAX_PIXELS}: it is damaged")
