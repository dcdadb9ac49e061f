"""Robot logs: pictures, their stamps and their calibration out of an MCAP file."""

import logging
from collections.abc import Iterator
from pathlib import Path

from gcd_node.errors import SourceError
from gcd_node.frame import Frame, Image, SourceInfo
from gcd_node.sources.log_messages import PICTURES, read_picture_message
from gcd_node.sources.log_patience import LogPatience, TiredError
from gcd_node.sources.log_pictures import to_rgb
from gcd_node.sources.mcap_container import LogChannel, LogMessage, McapContainer
from gcd_node.sources.mcap_survey import survey
from gcd_node.sources.own_recording import log_files
from gcd_node.sources.pace import Pace, Pacer

_LOG = logging.getLogger(__name__)
_LONGEST_STEP_NS = 10_000_000_000
_MOST_RECORDS, _LONGEST_S = 50_000_000, 120.0  # from one picture to the next
_LATEST_NS = 2**63  # in the year 2262


class McapLog:
    """One topic of an MCAP log as a FrameSource: ROS 2 or Foxglove pictures, compressed or raw.

    Stamps are those of the pictures' headers, on the clock of the robot; where nobody filled these in, when they were
    sent. They may repeat or step back if the robot's did.
    """

    def __init__(self, path: Path, *, topic: str | None = None, pace: Pace = "lockstep", loop: bool = False) -> None:
        """Find the pictures and decode the first.

        Args:
            path: a .mcap file, or the folder of a recording that this node made; an unfinished file plays to its last
                whole message.
            topic: where the pictures are; may be left out if just one topic has some, or in this node's recordings,
                whose input it is.
            pace: "realtime" yields every frame at its time (holes over 10 s are skipped), "lockstep" as soon as it is
                asked for.
            loop: begin again at the end; stamps and sequence numbers keep rising.
        Raises:
            SourceError: see log_files() and survey().
        """
        self._path = path.resolve()
        self._pacer = Pacer(pace)
        self._loop = loop
        self._corrupt = 0
        self._files = log_files(self._path)
        self._survey = survey(self._path, self._files, topic)
        self._container = McapContainer(self._files[0])

    @property
    def info(self) -> SourceInfo:
        """Size of the first picture, rate by the first seconds' stamps, lens if the log states one."""
        return self._survey.info

    @property
    def topic(self) -> str:
        """Where the pictures are."""
        return self._survey.topic

    @property
    def corrupt(self) -> int:
        """Pictures, and damaged parts of the log, left out so far."""
        return self._corrupt + self._container.damaged

    def frames(self) -> Iterator[Frame]:
        """Every picture that can be decoded. See FrameSource.frames.

        Raises:
            SourceError: none can any more; or the next one does not come in 50 million records or 2 minutes.
        """
        offset_ns, newest_ns = 0, None
        for frame in self._played():
            step_ns = None if newest_ns is None else frame.stamp_ns - newest_ns
            if step_ns is None or not 0 <= step_ns <= _LONGEST_STEP_NS:
                offset_ns = self._pacer.start(frame.stamp_ns)
            newest_ns = frame.stamp_ns
            if not self._pacer.wait(frame.stamp_ns, offset_ns):
                return
            yield frame

    def close(self) -> None:
        """End `frames` soon, from any thread."""
        self._pacer.stop()

    def _played(self) -> Iterator[Frame]:
        """One pass, or pass after pass, each going on where the last one ended."""
        begin_ns, begin_seq, period_ns = 0, 0, round(1e9 / self.info.fps_nominal)
        while not self._pacer.stopped:
            first = newest = None
            for frame in self._one_pass():
                first = frame if first is None else first
                newest = Frame(image=frame.image, stamp_ns=frame.stamp_ns + begin_ns, seq=frame.seq + begin_seq)
                yield newest
            if first is None or newest is None:
                if self._pacer.stopped:
                    return
                raise SourceError(f"{self._path} gives no pictures any more; was it replaced while it was playing?")
            if not self._loop:
                return
            begin_ns = newest.stamp_ns + period_ns - first.stamp_ns
            begin_seq = newest.seq + 1 - first.seq

    def _one_pass(self) -> Iterator[Frame]:
        numbers = _Numbers()
        patience = LogPatience(records=_MOST_RECORDS, seconds=_LONGEST_S, stopped=lambda: self._pacer.stopped)
        try:
            for file in self._files:
                yield from self._one_file(file, numbers, patience)
        except TiredError as tired:
            if not self._pacer.stopped:
                raise SourceError(
                    f"{self._path}: after {numbers.given} pictures on {self.topic} none came in {tired}, and the log "
                    f"goes on; cut it to the pictures: mcap filter LOG -y {self.topic} -o NEW"
                ) from None

    def _one_file(self, file: Path, numbers: "_Numbers", patience: LogPatience) -> Iterator[Frame]:
        self._corrupt += self._container.damaged
        container = self._container = McapContainer(file, patience)
        for message in container.messages():
            if self._pacer.stopped:
                return
            if self._is_picture(message.channel) and (read := self._read(message)) is not None:
                image, stamp_ns = read
                yield Frame(image=image, stamp_ns=stamp_ns, seq=numbers.next(message.sequence))
                patience.renew()  # what was done with it took its own time
        if not container.whole:
            _LOG.warning("%s was not finished, or is damaged: it was read to its last whole message", file)

    def _is_picture(self, channel: LogChannel) -> bool:
        return channel.topic == self.topic and (channel.encoding, channel.schema) in PICTURES

    def _read(self, message: LogMessage) -> tuple[Image, int] | None:
        """The picture and its stamp; None if it is damaged."""
        try:
            picture = read_picture_message(message.channel.encoding, message.channel.schema, message.data)
            stamp_ns = picture.stamp_ns if self._survey.header_stamps else message.published_ns
            if stamp_ns >= _LATEST_NS:
                raise SourceError(f"a picture states {stamp_ns} ns since 1970 as its time: it is damaged")
            return to_rgb(picture)[0], stamp_ns
        except SourceError as error:
            self._corrupt += 1
            _LOG.debug("%s: a message on %s is left out: %s", self._path, self.topic, error)
            return None


class _Numbers:
    """Rising numbers: those recorded where they rise, else counted on. Many recorders leave them 0."""

    def __init__(self) -> None:
        self._newest = -1
        self.given = 0

    def next(self, recorded: int) -> int:
        """The number of a message that was recorded with this one."""
        self.given += 1
        self._newest = max(recorded, self._newest + 1)
        return self._newest
