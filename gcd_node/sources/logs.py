"""Robot logs as a source: pictures with their stamps, and the lens, depth and odometry that belong to them."""

import contextlib
import logging
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from gcd_model import printable
from gcd_node.errors import SourceError, TooShortError
from gcd_node.frame import MAX_FPS, Frame, SourceInfo
from gcd_node.sources.depth import clean_depth
from gcd_node.sources.files import Pace, Recording
from gcd_node.sources.log_messages import Cameras, ImageDecoder, depth_of, head_of, pose_of
from gcd_node.sources.log_reader import IMAGES, ODOMETRY, LogLimitError, LogMessage, LogReader, line_of

_LOG = logging.getLogger(__name__)
_SEARCH_S = 15.0  # of reading, for what is needed to begin, and from one picture to the next
_SURVEYED_NS = 5_000_000_000
_MOST_STAMPS = 500
_LISTED, _SHOWN = 8, 100
_LATEST_NS = 2**63  # in the year 2262
_HEADER_UNCERTAINTY_US = 10_000  # drivers stamp anything from the begin of the exposure to the picture's arrival
_WAIT_NS, _MOST_WAITING = 500_000_000, 30  # of the log's time, for what was recorded after the picture it belongs to
_LOWEST_FPS = 0.05


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
        self._path = path.absolute()
        self._found = _Survey(self._path, topic, depth_topic, odometry_topic)
        self.info, self.topic = self._found.info, self._found.topic

    def _one_pass(self) -> Iterator[Frame]:
        reader, matcher, count = LogReader(self._path, _SEARCH_S, self._stopped.is_set), _Matcher(self._found), 0
        before = self.corrupt
        try:
            for message in reader.messages():
                for frame in matcher.take(message):
                    count += 1
                    yield frame
                    reader.renew()  # what was done with it took its own time
                self.corrupt = before + matcher.corrupt + reader.damaged
        except LogLimitError as error:
            if not self._stopped.is_set():
                raise SourceError(
                    f"{self._path}: {error} after {count} pictures on {self.topic}, and the log goes on; cut it to the "
                    f"pictures: mcap filter LOG -y {self.topic} -o NEW"
                ) from None
        self.corrupt = before + matcher.corrupt + reader.damaged
        yield from matcher.rest()


class _Matcher:
    """Puts the frames of one pass together: a picture waits until its depth and odometry have come."""

    def __init__(self, found: "_Survey") -> None:
        self._found, self._decoder = found, ImageDecoder()
        self._waiting: deque[tuple[int, Frame]] = deque()  # and when each was recorded
        most = {found.depth_topic: 32, found.odometry_topic: 2048}
        # stamp, type and fields of the latest, by topic
        self._latest = {topic: deque[tuple[int, str, Any]](maxlen=n) for topic, n in most.items() if topic is not None}
        self._seq = -1
        self.corrupt = 0

    def take(self, message: LogMessage) -> Iterator[Frame]:
        """Frames that are complete with this message."""
        latest = self._latest.get(message.topic)
        try:
            if latest is not None:
                fields = message.decode()
                latest.append((self._stamp_ns(message, fields), message.kind, fields))
            elif message.topic == self._found.topic and message.kind in IMAGES:
                fields = message.decode()
                decoded, stamp_ns = self._decoder.decode(message.kind, fields), self._stamp_ns(message, fields)
                if decoded is not None:
                    # numbers rise: as they were recorded, or counted on, as many recorders leave them 0
                    self._seq = max(message.sequence, self._seq + 1)
                    self._waiting.append((message.log_ns, Frame(image=decoded[0], stamp_ns=stamp_ns, seq=self._seq)))
        except Exception as error:  # of a library, or SourceError: the message is damaged
            self.corrupt += latest is None
            _LOG.debug("a message on %s is left out: %s", message.topic, line_of(error))
        while self._waiting and self._is_complete(message.log_ns):
            yield self._complete()

    def rest(self) -> Iterator[Frame]:
        """Those that waited for more."""
        while self._waiting:
            yield self._complete()

    def _stamp_ns(self, message: LogMessage, fields: Any) -> int:
        stamp_ns = head_of(fields)[0] if self._found.header_stamps else message.sent_ns
        if stamp_ns >= _LATEST_NS:
            raise SourceError(f"a message states {stamp_ns} ns since 1970 as its time: it is damaged")
        return stamp_ns

    def _is_complete(self, now_ns: int) -> bool:
        recorded_ns, frame = self._waiting[0]
        has_come = all(latest and latest[-1][0] >= frame.stamp_ns for latest in self._latest.values())
        return has_come or len(self._waiting) > _MOST_WAITING or now_ns - recorded_ns > _WAIT_NS

    def _complete(self) -> Frame:
        _, frame = self._waiting.popleft()
        depth = self._nearest(self._found.depth_topic, frame.stamp_ns)
        odometry = self._nearest(self._found.odometry_topic, frame.stamp_ns)
        try:
            if depth is not None:
                frame = replace(frame, depth=clean_depth(depth_of(*depth), frame.image.shape[:2]))
            if odometry is not None:
                pose = odometry[1].pose.pose
                world_from_body = pose_of(pose.position, pose.orientation)
                frame = replace(frame, odometry=world_from_body @ self._found.body_from_camera)
        except Exception as error:  # as above
            _LOG.warning("frame %d goes without depth or odometry: %s", frame.seq, line_of(error))
        return frame

    def _nearest(self, topic: str | None, stamp_ns: int) -> tuple[str, Any] | None:
        """Type and fields of the message stamped nearest, None if it is farther than half a frame period."""
        latest, half_ns = self._latest.get(topic or ""), 0.5e9 / self._found.info.fps_nominal
        while latest and latest[0][0] < stamp_ns - half_ns:
            latest.popleft()
        nearest = min(latest or (), key=lambda each: abs(each[0] - stamp_ns), default=None)
        return None if nearest is None or abs(nearest[0] - stamp_ns) > half_ns else nearest[1:]


@dataclass(slots=True)
class _Topic:
    """What was seen of one picture topic. Stamps in nanoseconds; reason: why a picture cannot be read."""

    decoder: ImageDecoder = field(default_factory=ImageDecoder)
    header_ns: list[int] = field(default_factory=list[int])
    sent_ns: list[int] = field(default_factory=list[int])
    frame_id: str = ""
    size: tuple[int, int] = (0, 0)
    codec: str = ""
    reason: str = "none is whole"

    def add(self, message: LogMessage) -> None:
        """Count a message; pictures are decoded until one could be. Raises as a library does if it is damaged."""
        fields = message.decode()
        stamp_ns, self.frame_id = head_of(fields)
        if not self.codec and (decoded := self.decoder.decode(message.kind, fields)) is not None:
            self.size, self.codec = decoded[0].shape[1::-1], decoded[1]
        self.header_ns.append(stamp_ns)
        self.sent_ns.append(message.sent_ns)

    @property
    def has_header_stamps(self) -> bool:
        """Whether they are there at all, and go on from most messages to the next."""
        rising = [later > earlier for earlier, later in pairwise(self.header_ns)]
        return all(self.header_ns) and 2 * sum(rising) > len(rising)


class _Survey:
    """The first seconds of a log, or as much of it as it takes to find the pictures and what goes along with them.

    topic: where the pictures are. header_stamps: their own stamps hold, else when they were sent. body_from_camera:
    where the camera stands on what odometry speaks of.
    """

    def __init__(self, path: Path, topic: str | None, depth_topic: str | None, odometry_topic: str | None) -> None:
        """See LogSource."""
        self._path, self.depth_topic, self.odometry_topic = path, depth_topic, odometry_topic
        self._reader, self._topics = LogReader(path, _SEARCH_S), dict[str, _Topic]()
        self._cameras, self._body, limit = Cameras(), "", ""
        try:
            self._read(topic)
        except LogLimitError as error:
            limit = f"; {error}: cut it to the pictures: mcap filter LOG -y TOPIC -o NEW"
        for name in (depth_topic, odometry_topic):
            if name is not None and name not in self._reader.topics:
                raise SourceError(f"{path} has no topic {name!r}; it has {_shown(self._reader.topics)}{limit}")
        recording = self._reader.metadata.get("gcd-node")  # what one of this node says of itself
        own_topic = None if recording is None else recording.get("input_topic")
        wanted = topic or own_topic
        usable = self._usable(wanted)
        if len(usable) != 1:
            raise SourceError(f"{path} {self._trouble(wanted, usable)}{limit}")
        self.topic, chosen = usable[0], self._topics[usable[0]]
        # stamps of this node's recordings may begin at 0
        self.header_stamps = recording is not None or chosen.has_header_stamps
        self.info = self._describe(chosen)
        if self.topic == own_topic:
            self.info = _as_recorded(self.info, self._reader.metadata.get("gcd-node/source", {}))
        self.body_from_camera = np.eye(4)
        if odometry_topic is not None:
            self.body_from_camera = self._cameras.body_from_camera(self._body, chosen.frame_id)

    def _read(self, wanted: str | None) -> None:
        """As much as it takes."""
        companions, end_ns = {self.depth_topic, self.odometry_topic} - {None}, None
        for message in self._reader.messages():
            self._add(message)
            end_ns = end_ns or message.log_ns + _SURVEYED_NS
            if message.log_ns > end_ns and companions <= self._reader.topics.keys():
                own = self._reader.metadata.get("gcd-node", {}).get("input_topic")
                if any(len(self._topics[name].sent_ns) > 1 for name in self._usable(wanted or own)):
                    return

    def _add(self, message: LogMessage) -> None:
        topic = None
        if message.kind in IMAGES and message.topic != self.depth_topic:
            topic = self._topics.setdefault(message.topic, _Topic())
        try:
            if topic is not None:
                if len(topic.sent_ns) < _MOST_STAMPS:
                    topic.add(message)
            elif message.kind == ODOMETRY and message.topic == self.odometry_topic:
                self._body = self._body or message.decode().child_frame_id
            else:
                self._cameras.add(message)
        except Exception as error:  # of a library, or SourceError: the message is damaged
            if topic is None:
                _LOG.warning("a message on %s is left out: %s", message.topic, line_of(error))
            else:
                topic.reason = line_of(error)

    def _usable(self, wanted: str | None) -> list[str]:
        return [name for name, topic in self._topics.items() if topic.codec and wanted in (None, name)]

    def _trouble(self, wanted: str | None, usable: list[str]) -> str:
        """Why it cannot be played, to be read after its name."""
        if usable:
            return f"has pictures on {len(usable)} topics, {_shown(usable)}: say which with topic in [source]"
        for name, topic in self._topics.items():
            if wanted in (None, name):
                return f"has no picture on {name} that can be decoded: {topic.reason}"
        kinds = [f"{name} ({kind})" for name, kind in self._reader.topics.items()]
        return f"has no pictures{'' if wanted is None else f' on the topic {wanted!r}'}; its topics are {_shown(kinds)}"

    def _describe(self, chosen: _Topic) -> SourceInfo:
        stamps = chosen.header_ns if self.header_stamps else chosen.sent_ns
        steps = [later - earlier for earlier, later in pairwise(stamps) if later > earlier]
        if not steps:
            raise TooShortError(f"TOO_SHORT n={len(stamps)}: pictures on {self.topic} of {self._path} make no video")
        fps = 1e9 / median(steps)
        if not _LOWEST_FPS <= fps <= MAX_FPS:
            raise SourceError(f"pictures on {self.topic} of {self._path} come {fps:g} times a second by their stamps")
        return SourceInfo(
            kind="mcap",
            id=self._path.name,
            width=chosen.size[0],
            height=chosen.size[1],
            fps_nominal=fps,
            clock="replay",
            codec=chosen.codec,
            lens=self._cameras.lens(self.topic, chosen.frame_id, chosen.size),
            stamp_uncertainty_us=_HEADER_UNCERTAINTY_US if self.header_stamps else round(1e6 / fps),
        )


def _as_recorded(info: SourceInfo, facts: Mapping[str, str]) -> SourceInfo:
    """With what was known of the source when this node recorded it. A field of view is not made a lens of: that would
    be another way to the model's picture."""
    with contextlib.suppress(KeyError, ValueError):  # none was written, or by somebody else
        info = replace(info, stamp_uncertainty_us=int(facts["stamp_uncertainty_us"]))
    if facts.get("calibrated") == "yes":
        return info
    with contextlib.suppress(KeyError, ValueError):
        hfov_deg = float(facts["hfov_deg"])
        return replace(info, lens=None, hfov_deg=hfov_deg if 0 < hfov_deg < 180 else None)
    return replace(info, lens=None)


def _shown(names: Iterable[str]) -> str:
    """A few names, as a terminal can show them."""
    return ", ".join(printable(name, _SHOWN) for name in sorted(names)[:_LISTED]) or "none"
