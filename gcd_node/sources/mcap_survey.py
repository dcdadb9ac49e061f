"""What is in a log, by its first seconds: which topic has the pictures, how many a second, through which lens."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from statistics import median

from gcd_node.errors import ConfigError, SourceError, TooShortError
from gcd_node.frame import MAX_FPS, SourceInfo
from gcd_node.optics.calibration import LensModel, lens_of
from gcd_node.sources.log_messages import (
    CAMERAS,
    PICTURES,
    StatedCamera,
    read_camera_message,
    read_picture_message,
)
from gcd_node.sources.log_patience import LogPatience, TiredError
from gcd_node.sources.log_pictures import to_rgb
from gcd_node.sources.mcap_container import LogChannel, LogMessage, McapContainer
from gcd_node.sources.own_recording import OwnRecording, own_recording

_LOG = logging.getLogger(__name__)
_SURVEYED_NS = 5_000_000_000
_MOST_STAMPS = 500
_MOST_TRIES = 5
_MOST_TOPICS = 1000
_MOST_RECORDS, _LONGEST_S = 10_000_000, 30.0
_LISTED, _SHOWN = 8, 100
_LOWEST_FPS = 0.05
_HEADER_UNCERTAINTY_US = 10_000  # drivers stamp anything from the begin of the exposure to the picture's arrival


@dataclass(kw_only=True, slots=True)
class _Topic:
    """What was seen of one picture topic. Stamps in nanoseconds; reason: why its pictures cannot be read."""

    channel: LogChannel
    header_ns: list[int] = field(default_factory=list[int])
    published_ns: list[int] = field(default_factory=list[int])
    frame_id: str = ""
    size: tuple[int, int] | None = None
    codec: str = ""
    tries: int = 0
    reason: str = ""

    @property
    def settled(self) -> bool:
        """Whether enough is known: its pictures can be decoded and have a rate, or they cannot."""
        return self.tries >= _MOST_TRIES if self.size is None else len(self.published_ns) > 1

    def add(self, message: LogMessage) -> None:
        """Count a message; pictures are decoded until one could be, a few at most. Damaged ones do not count."""
        if len(self.published_ns) >= _MOST_STAMPS:
            return
        try:
            picture = read_picture_message(self.channel.encoding, self.channel.schema, message.data)
            if self.size is None and self.tries < _MOST_TRIES:
                self.tries += 1
                image, self.codec = to_rgb(picture)
                self.size = (image.shape[1], image.shape[0])
                self.frame_id = picture.frame_id
        except SourceError as error:
            self.reason = str(error)
            return
        self.header_ns.append(picture.stamp_ns)
        self.published_ns.append(message.published_ns)


@dataclass(frozen=True, kw_only=True, slots=True)
class Survey:
    """topic: whose pictures are played. header_stamps: their own stamps hold, else when they were sent."""

    topic: str
    header_stamps: bool
    info: SourceInfo


@dataclass(kw_only=True, slots=True)
class _Seen:
    """What was met on the way. topics: with pictures. cameras: the first calibration on each topic that has some.
    channels: every one. own: what this node said of its own recording. first_ns: when the first message was recorded.
    """

    topics: dict[str, _Topic] = field(default_factory=dict[str, _Topic])
    cameras: dict[str, StatedCamera] = field(default_factory=dict[str, StatedCamera])
    channels: list[LogChannel] = field(default_factory=list[LogChannel])
    own: OwnRecording | None = None
    first_ns: int | None = None


def survey(path: Path, files: Sequence[Path], wanted: str | None) -> Survey:
    """Look at the first seconds of a log, or as far as it takes to find the pictures.

    Args:
        path: what to call it. files: played one after another.
        wanted: the topic; None if there is just one with pictures, or for the input of this node's own recording.
    Raises:
        SourceError: no MCAP; no such topic; no pictures, or on several topics; none of them can be decoded, or none
            was found in 10 million records or 30 s.
        TooShortError: one picture.
    """
    seen = _collect(path, files, wanted)
    chosen = _choose(path, seen, _topic_of(seen, wanted))
    if chosen.size is None:
        raise SourceError(f"{path}: no picture on {chosen.channel.topic} can be decoded: {chosen.reason}")
    own = seen.own
    header_stamps = own is not None or _rise(chosen.header_ns)  # ours may begin at 0
    stamps = chosen.header_ns if header_stamps else chosen.published_ns
    fps = _rate(path, chosen.channel.topic, stamps)
    info = SourceInfo(
        kind="mcap",
        id=path.name,
        width=chosen.size[0],
        height=chosen.size[1],
        fps_nominal=fps,
        clock="replay",
        codec=chosen.codec,
        lens=_lens(path, chosen, seen.cameras),
        stamp_uncertainty_us=_HEADER_UNCERTAINTY_US if header_stamps else round(1e6 / fps),
    )
    info = _as_recorded(info, own) if own is not None and own.input_topic == chosen.channel.topic else info
    return Survey(topic=chosen.channel.topic, header_stamps=header_stamps, info=info)


def _as_recorded(info: SourceInfo, own: OwnRecording) -> SourceInfo:
    """With what was known of the source when it was recorded. A field of view is not made a lens of: that would be
    another way to the model's picture."""
    uncertainty_us = own.stamp_uncertainty_us
    return replace(
        info,
        lens=info.lens if own.calibrated else None,
        hfov_deg=None if own.calibrated else own.hfov_deg,
        stamp_uncertainty_us=info.stamp_uncertainty_us if uncertainty_us is None else uncertainty_us,
    )


def _topic_of(seen: _Seen, wanted: str | None) -> str | None:
    return seen.own.input_topic if wanted is None and seen.own is not None else wanted


def _collect(path: Path, files: Sequence[Path], wanted: str | None) -> _Seen:
    """Raises SourceError: not enough was found in what may be gone through."""
    seen, patience = _Seen(), LogPatience(records=_MOST_RECORDS, seconds=_LONGEST_S)
    try:
        for file in files:
            if _look_through(seen, McapContainer(file, patience), wanted):
                break
    except TiredError as tired:
        if not _settled(seen.topics, _topic_of(seen, wanted)):
            raise SourceError(
                f"{path}: no pictures{'' if wanted is None else f' on {wanted!r}'} that can be played were found in "
                f"the first {tired}; {_listed(seen)}. Cut it to the pictures: mcap filter LOG -y TOPIC -o NEW"
            ) from None
    return seen


def _look_through(seen: _Seen, container: McapContainer, wanted: str | None) -> bool:
    """One file; whether enough is known. Raises SourceError, TiredError."""
    try:
        for message in container.messages():
            seen.own = own_recording(container.metadata) or seen.own
            _look(seen, message)
            seen.first_ns = message.log_ns if seen.first_ns is None else seen.first_ns
            if message.log_ns - seen.first_ns > _SURVEYED_NS and _settled(seen.topics, _topic_of(seen, wanted)):
                return True
    finally:
        seen.channels.extend(container.channels)
    return False


def _look(seen: _Seen, message: LogMessage) -> None:
    channel = message.channel
    kind = channel.encoding, channel.schema
    if max(len(seen.topics), len(seen.cameras)) >= _MOST_TOPICS and channel.topic not in seen.topics:
        return
    if kind in PICTURES:
        seen.topics.setdefault(channel.topic, _Topic(channel=channel)).add(message)
    elif kind in CAMERAS and channel.topic not in seen.cameras:
        try:
            seen.cameras[channel.topic] = read_camera_message(*kind, message.data)
        except SourceError as error:
            _LOG.warning("a calibration on %s is left out: %s", channel.topic, error)


def _settled(topics: dict[str, _Topic], wanted: str | None) -> bool:
    """Whether to look no further: the topic is known, or of all there are one is good or every one is not."""
    found = [topic for name, topic in topics.items() if wanted in (None, name)]
    good = any(topic.settled and topic.size is not None for topic in found)
    return good or (bool(found) and all(topic.settled for topic in found))


def _choose(path: Path, seen: _Seen, wanted: str | None) -> _Topic:
    topics = seen.topics
    if wanted is not None and wanted in topics:
        return topics[wanted]
    if wanted is not None:
        raise SourceError(f"{path} has no pictures on the topic {wanted!r}; {_listed(seen)}")
    usable = [topic for topic in topics.values() if topic.size is not None]
    if len(usable) > 1:
        names = ", ".join(sorted(topic.channel.topic for topic in usable)[:_LISTED])
        raise SourceError(f"{path} has pictures on {len(usable)} topics, {names}: say which with topic in [source]")
    if usable:
        return usable[0]
    if topics:
        topic = next(iter(topics.values()))
        raise SourceError(f"{path}: no picture on {topic.channel.topic} can be decoded: {topic.reason}")
    raise SourceError(f"{path} holds no pictures; {_listed(seen)}")


def _listed(seen: _Seen) -> str:
    if seen.topics:
        return f"it has pictures on {', '.join(name[:_SHOWN] for name in sorted(seen.topics)[:_LISTED])}"
    others = sorted({f"{each.topic} ({each.schema}, {each.encoding})"[:_SHOWN] for each in seen.channels})[:_LISTED]
    readable = ", ".join(f"{schema} ({encoding})" for encoding, schema in PICTURES)
    return f"its topics are {', '.join(others) or 'none'}; readable are {readable}"


def _rise(stamps: Sequence[int]) -> bool:
    """Whether stamps are filled in, and go on from most pictures to the next."""
    steps = [later - earlier for earlier, later in pairwise(stamps)]
    return all(stamps) and 2 * sum(step > 0 for step in steps) > len(steps)


def _rate(path: Path, topic: str, stamps: Sequence[int]) -> float:
    steps = [later - earlier for earlier, later in pairwise(stamps) if later > earlier]
    if not steps:
        raise TooShortError(
            f"TOO_SHORT n={len(stamps)}: the {len(stamps)} pictures on {topic} of {path} make no video; "
            "give a longer log"
        )
    fps = 1e9 / median(steps)
    if not _LOWEST_FPS <= fps <= MAX_FPS:
        raise SourceError(
            f"{path}: pictures on {topic} come {fps:g} times a second by their stamps, wanted are {_LOWEST_FPS:g} to "
            f"{MAX_FPS:g}; is its clock right?"
        )
    return fps


def _lens(path: Path, topic: _Topic, cameras: dict[str, StatedCamera]) -> LensModel | None:
    """The calibration that belongs to the pictures, None if there is none that fits."""
    name = _camera_topic(topic, cameras)
    if name is None or topic.size is None:
        return None
    # by the conventions of image_pipeline, pictures on image_rect... are undistorted already
    rectified = any(part.startswith("image_rect") for part in topic.channel.topic.split("/"))
    try:
        lens = lens_of(cameras[name].info, rectified=rectified)
        return None if lens is None else lens.resized(*topic.size)
    except ConfigError as error:
        _LOG.warning(
            "%s: the calibration on %s is not used: %s. State calibration or hfov_deg in [source]", path, name, error
        )
        return None


def _camera_topic(topic: _Topic, cameras: dict[str, StatedCamera]) -> str | None:
    """The calibration in the nearest folder above the pictures, as ROS drivers send it; else the one of that frame."""
    place = topic.channel.topic.split("/")
    depths = {name: name.count("/") for name in cameras if place[: name.count("/")] == name.split("/")[:-1]}
    if depths:
        return max(depths, key=lambda name: depths[name])
    return next((name for name, each in cameras.items() if each.frame_id and each.frame_id == topic.frame_id), None)
