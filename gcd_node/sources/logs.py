"""Robot logs as a source: pictures with their stamps, and the lens, depth and odometry that belong to them."""

import contextlib
import logging
import math
import struct
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import printable
from gcd_node.errors import SourceError, TooShortError
from gcd_node.frame import MAX_FPS, MAX_PIXELS, Frame, Image, LensModel, SourceInfo, lens_of_message
from gcd_node.sources.depth import clean_depth
from gcd_node.sources.files import Pace, Recording, decode_picture, raw_picture, raw_rows
from gcd_node.sources.log_reader import PICTURES, Kind, LogMessage, LogReader, line_of

_LOG = logging.getLogger(__name__)
_SEARCH_S = 15.0  # of reading, for what is needed to begin, and from one picture to the next
_SURVEYED_NS = 5_000_000_000
_LISTED, _SHOWN = 8, 100
_LATEST_NS = 2**63 - 1  # in the year 2262
_HEADER_UNCERTAINTY_US = 10_000  # drivers stamp anything from the begin of the exposure to the picture's arrival
_DELAY = 5  # pictures that are recorded before one goes without what belongs to it
_MOST_DEPTH, _MOST_ODOMETRY, _MOST_STAMPS = 32, 2048, 500  # kept for pictures that wait; and to tell the rate
_LOWEST_FPS = 0.05
_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_PNG = b"\x89PNG\r\n\x1a\n"
_VIDEO_DECODERS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}
_DEPTH_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # body_from_camera by REP 103

_Latest: TypeAlias = deque[tuple[int, Kind, Any]]
"""Stamp, kind and fields of a topic's newest messages."""


class LogSource(Recording):
    """One topic of a log as a FrameSource: ROS or Foxglove pictures, compressed, raw or video.

    Stamps are those of the pictures' headers, on the robot's clock; where nobody filled these in, when they were sent.
    """

    def __init__(
        self,
        path: Path,
        *,
        topic: str | None = None,
        depth_topic: str | None = None,
        odometry_topic: str | None = None,
        pace: Pace = "lockstep",
        loop: bool = False,
    ) -> None:
        """Find the pictures and decode the first, by the settings of McapSource. A folder may be a recording of this
        node, whose pictures are its input's. A file that was never finished plays up to its last whole chunk.

        Raises:
            SourceError: no log; no such topic; no pictures, or on several topics; none of them can be decoded, or none
                was found in 15 s of reading. TooShortError: one picture.
        """
        super().__init__(str(path), pace=pace, loop=loop)
        self._path, self._depth_topic, self._odometry_topic = path.absolute(), depth_topic, odometry_topic
        survey = _Survey(self._path, topic, {name for name in (depth_topic, odometry_topic) if name is not None})
        self.info, self.topic, self._header_stamps = survey.info, survey.topic, survey.header_stamps
        self._body_from_camera = np.eye(4)
        if odometry_topic is not None:
            self._body_from_camera = survey.cameras.body_from_camera(odometry_topic, survey.frame_id)

    def _one_pass(self) -> Iterator[Frame]:
        """A picture whose depth or odometry is wanted waits for a few others, as these are recorded later."""
        reader, decoder, seq = LogReader(self._path, _SEARCH_S, self._stopped.is_set), ImageDecoder(), -1
        depth, odometry = _Latest(maxlen=_MOST_DEPTH), _Latest(maxlen=_MOST_ODOMETRY)
        waiting = deque[Frame]()
        delay = 0 if self._depth_topic is None and self._odometry_topic is None else _DELAY
        for message in reader.messages():
            try:
                if message.topic in (self._depth_topic, self._odometry_topic):
                    fields = message.decode()
                    latest = depth if message.topic == self._depth_topic else odometry
                    latest.append((self._stamp_ns(message, fields), message.kind, fields))
                elif message.topic == self.topic and message.kind in PICTURES:
                    fields = message.decode()
                    decoded, stamp_ns = decoder.decode(message.kind, fields), self._stamp_ns(message, fields)
                    if decoded is not None:
                        seq = max(message.sequence, seq + 1)  # as recorded, or counted on: many recorders leave it 0
                        waiting.append(Frame(image=decoded[0], stamp_ns=stamp_ns, seq=seq))
            except Exception as error:  # of a library, or SourceError: the message is damaged
                self.corrupt += message.topic == self.topic
                _LOG.debug("a message on %s is left out: %s", message.topic, line_of(error))
            if len(waiting) > delay:
                yield self._complete(waiting.popleft(), depth, odometry)
                reader.renew()  # what was done with it took its own time
        for frame in waiting:
            yield self._complete(frame, depth, odometry)

    def _stamp_ns(self, message: LogMessage, fields: Any) -> int:
        return min(head_of(fields)[0] if self._header_stamps else message.sent_ns, _LATEST_NS)

    def _complete(self, frame: Frame, depths: _Latest, poses: _Latest) -> Frame:
        """With what was stamped nearest to it."""
        depth, odometry = self._nearest(depths, frame.stamp_ns), self._nearest(poses, frame.stamp_ns)
        try:
            if depth is not None:
                frame = replace(frame, depth=clean_depth(depth_of(*depth[1:]), frame.image.shape[:2]))
            if odometry is not None:
                pose = odometry[2].pose.pose
                world_from_body = pose_of(pose.position, pose.orientation)
                frame = replace(frame, odometry=world_from_body @ self._body_from_camera)
        except Exception as error:  # as above
            _LOG.warning("frame %d goes without depth or odometry: %s", frame.seq, line_of(error))
        return frame

    def _nearest(self, latest: _Latest, stamp_ns: int) -> tuple[int, Kind, Any] | None:
        """None if it is farther than half a frame period."""
        nearest = min(latest, key=lambda each: abs(each[0] - stamp_ns), default=None)
        is_near = nearest is not None and abs(nearest[0] - stamp_ns) <= 0.5e9 / self.info.fps_nominal
        return nearest if is_near else None


class _Survey:
    """The first seconds of a log, or as much of it as it takes to find the pictures and what goes along with them.

    topic: where the pictures are. frame_id: of theirs. header_stamps: their own stamps hold, else when they were sent.
    """

    def __init__(self, path: Path, wanted: str | None, companions: set[str]) -> None:
        """See LogSource. companions: topics of depth and odometry."""
        self._reader, self._wanted, self._companions = LogReader(path, _SEARCH_S), wanted, companions
        self._first: dict[str, tuple[str, Image, str]] = {}  # of each topic: frame_id, picture and what it was coded as
        self._stamps_ns = defaultdict[str, list[tuple[int, int]]](list)  # of the header, and when it was sent
        self.cameras = Cameras()
        try:
            notes = self._read()
        except SourceError as limit:
            notes, self._reader.trouble = {}, str(limit)
        usable, missing, topics = self._usable(), companions - self._reader.topics.keys(), self._reader.topics | notes
        if len(usable) > 1 and not missing:
            raise SourceError(f"{path} has pictures on {_shown(usable)}: say which with topic in [source]")
        if missing or not usable:
            raise SourceError(
                f"{path} has no {f'topic {_shown(missing)}' if missing else 'pictures'}; wanted are pictures on "
                f"{wanted or 'one topic'}, it has {_shown(map(' as '.join, topics.items()))}. {self._reader.trouble}"
            )
        (self.topic,) = usable
        stamps_ns = self._stamps_ns[self.topic]
        self.header_stamps = stamps_ns[-1][0] > stamps_ns[0][0]
        self.frame_id, picture, codec = self._first[self.topic]
        self.info = self._describe(path, picture, codec)

    def _read(self) -> dict[str, str]:
        """Returns why messages are damaged, by topic."""
        end_ns, troubles, decoders = None, dict[str, str](), defaultdict[str, ImageDecoder](ImageDecoder)
        for message in self._reader.messages():
            topic = message.topic
            try:
                if message.kind in PICTURES and topic not in self._companions:
                    fields = message.decode()
                    stamp_ns, frame_id = head_of(fields)
                    if topic not in self._first and (found := decoders[topic].decode(message.kind, fields)):
                        self._first[topic] = frame_id, *found
                    if len(self._stamps_ns[topic]) < _MOST_STAMPS:
                        self._stamps_ns[topic].append((stamp_ns, message.sent_ns))
                else:
                    self.cameras.add(message)
            except Exception as error:  # of a library, or SourceError
                troubles[topic] = line_of(error)
            end_ns = end_ns or message.log_ns + _SURVEYED_NS
            if (
                message.log_ns > end_ns
                and self._companions <= self._reader.topics.keys()
                and any(len(self._stamps_ns[name]) > 1 for name in self._usable())
            ):
                break
        return troubles

    def _usable(self) -> list[str]:
        """Topics whose pictures can be decoded, and are wanted; of a recording of this node its input."""
        wanted = self._wanted or self._reader.recorded.get("topic")
        return [name for name in self._first if wanted in (None, name)]

    def _describe(self, path: Path, picture: Image, codec: str) -> SourceInfo:
        height, width = picture.shape[:2]
        stamps = [header_ns if self.header_stamps else sent_ns for header_ns, sent_ns in self._stamps_ns[self.topic]]
        steps = [later - earlier for earlier, later in pairwise(stamps) if later > earlier]
        if not steps:
            raise TooShortError(f"TOO_SHORT n={len(stamps)}: pictures on {self.topic} of {path} make no video")
        fps = 1e9 / median(steps)
        if not _LOWEST_FPS <= fps <= MAX_FPS:
            raise SourceError(f"pictures on {self.topic} of {path} come {fps:g} times a second by their stamps")
        info = SourceInfo(
            kind="mcap",
            id=path.name,
            width=width,
            height=height,
            fps_nominal=fps,
            clock="replay",
            codec=codec,
            lens=self.cameras.lens(self.topic, (width, height)),
            stamp_uncertainty_us=_HEADER_UNCERTAINTY_US if self.header_stamps else round(1e6 / fps),
            optical_frame=printable(self.frame_id, _SHOWN),
            recorded_after_ns=self._stamps_ns[self.topic][0][1] - stamps[0],
        )
        recorded = self._reader.recorded
        with contextlib.suppress(KeyError, ValueError):  # none was written, or by somebody else
            if self.topic == recorded["topic"]:
                info = replace(info, stamp_uncertainty_us=int(recorded["stamp_uncertainty_us"]))
                if 0 < (hfov_deg := float(recorded["hfov_deg"])) < 180:
                    info = replace(info, hfov_deg=hfov_deg)
        return info


def _shown(names: Iterable[str]) -> str:
    """A few names, as a terminal can show them."""
    return ", ".join(printable(name, _SHOWN) for name in sorted(names)[:_LISTED]) or "none"


# What messages say, of ROS 1, ROS 2 and Foxglove: pictures and depth.


def head_of(fields: Any) -> tuple[int, str]:
    """A message's stamp in nanoseconds, 0 if nobody filled it in, and its frame_id."""
    head = getattr(fields, "header", fields)
    time = head.stamp if hasattr(head, "stamp") else head.timestamp
    seconds, nanoseconds = (time.sec, time.nanosec) if hasattr(time, "sec") else (time.seconds, time.nanos)
    return max(0, int(seconds) * 1_000_000_000 + int(nanoseconds)), str(head.frame_id)


def _bytes_of(fields: Any) -> bytes:
    """Raises TypeError: the log's own definition may have anything in their place."""
    return memoryview(fields.data).tobytes()


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
