"""The MCAP files of recordings: how one is written, and how much room all of them may take.

Chunks of 64 KiB, and one at least once a second: what a reader can lose of a file that was never finished is the last.
"""

import contextlib
import logging
import os
import time
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from gcd_node.config import RecordConfig
from gcd_node.ros_messages import RosMessage, definition, serialized

_LOG = logging.getLogger(__name__)
_CHUNK_BYTES = 64 * 1024
_LARGEST_SEQUENCE = 2**32
_MB = 10**6


class RoomError(Exception):
    """Recordings must not take more room. code: stable, of the event."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def check_room(config: RecordConfig, root: Path) -> float:
    """Whether recordings in `root` may take more room, by max_total_mb and keep_free_mb.

    Returns:
        MB that are free on its disk.
    Raises:
        RoomError, OSError.
    """
    taken_mb = sum(each.stat().st_size for each in root.rglob("*.mcap")) / _MB if config.max_total_mb else 0.0
    if taken_mb > config.max_total_mb:
        limit = f"max_total_mb is {config.max_total_mb:g}: move some away"
        raise RoomError("TOTAL_LIMIT", f"recordings in {root} take {taken_mb:.0f} MB, {limit}")
    disk = os.statvfs(root)
    free_mb = disk.f_bavail * disk.f_frsize / _MB
    if free_mb < config.keep_free_mb:
        limit = f"keep_free_mb is {config.keep_free_mb:g}: make room on it"
        raise RoomError("DISK_LOW", f"the disk of {root} has {free_mb:.0f} MB left, {limit}")
    return free_mb


class McapFile:
    """A file being written. size, messages: so far. begun_ns: UTC. is_whole: whether it was closed with an end."""

    def __init__(self, path: Path) -> None:
        """Create `path`. Raises OSError: it is there already, or cannot be."""
        self.path, self.begun_ns, self.is_whole = path, time.time_ns(), False
        self._file = path.open("xb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library=f"gcd-node; mcap-python/{version('mcap')}")
        self._ids: dict[str, int] = {}  # of a type its schema's, of a topic its channel's
        self.size = self.messages = 0
        self._flushed = (0, 0)  # size and messages that are on the disk for certain

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Add metadata."""
        self._writer.add_metadata(name, dict(facts))

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file."""
        self._writer.add_attachment(self.begun_ns, self.begun_ns, name, media_type, data)

    def write(self, messages: Iterable[RosMessage]) -> None:
        """Add messages that belong together: all of them, or none if one cannot be made. Raises OSError."""
        for each, data in [(each, serialized(each.fields)) for each in messages]:
            kind = each.fields.__msgtype__
            if kind not in self._ids:
                self._ids[kind] = self._writer.register_schema(kind, "ros2msg", definition(kind).encode())
            if each.topic not in self._ids:
                self._ids[each.topic] = self._writer.register_channel(each.topic, "cdr", self._ids[kind])
            self._writer.add_message(
                channel_id=self._ids[each.topic],
                log_time=each.log_ns,
                data=data,  # pyright: ignore[reportArgumentType]  it is copied
                publish_time=each.sent_ns,
                sequence=each.sequence % _LARGEST_SEQUENCE,
            )
            self.messages += 1
        self.size = self._file.tell()

    def flush(self, *, sync: bool = False) -> None:
        """Close the chunk in work, so that a reader gets it whatever happens next. sync: even without power. Raises
        OSError: the disk is full or broken."""
        self._writer.flush()
        if sync:
            os.fdatasync(self._file.fileno())
        self.size = self._file.tell()
        self._flushed = self.size, self.messages

    def close(self, *, is_broken: bool = False) -> None:
        """Write index and end. is_broken: a write has failed; then the file ends behind what was flushed, without an
        index, and if that is nothing, it is removed. Once is enough."""
        if self._file.closed:
            return
        try:
            if not is_broken:
                self._writer.finish()
                self.flush(sync=True)
                self._file.close()
                self.is_whole = True
        except Exception as error:
            _LOG.warning("%s: %s", self.path, error)
        if not self.is_whole:
            self._cut_back()

    def _cut_back(self) -> None:
        self.size, self.messages = self._flushed
        builder = RecordBuilder()
        DataEnd(data_section_crc=0).write(builder)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
        end = builder.end() + MCAP0_MAGIC
        with contextlib.suppress(OSError), contextlib.closing(self._file.raw):  # what is buffered has no place any more
            if self.size == 0:
                self.path.unlink()
                return
            os.ftruncate(self._file.fileno(), self.size)
            self.size += os.pwrite(self._file.fileno(), end, self.size)
        self.is_whole = self.size == self._flushed[0] + len(end)
