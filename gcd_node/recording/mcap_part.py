"""One MCAP file of a recording, readable on its own. The only file that needs the package `mcap`.

Chunks of 64 KiB, and at least one a second: what a reader can lose of a file that was never finished is the last one.
"""

import contextlib
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import cast

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from gcd_node.recording.disk_file import DiskFile
from gcd_node.recording.entries import Entry
from gcd_node.recording.schemas import Schema

_LOG = logging.getLogger(__name__)
_CHUNK = 64 * 1024
_LARGEST_SEQUENCE = 2**32


class McapPart:
    """A file being written. Whatever raises OSError leaves a file that is whole up to there."""

    def __init__(self, path: Path, *, profile: str) -> None:
        """Create `path`. profile: "ros2" if every message is one. Raises OSError."""
        self.path = path
        self._disk = DiskFile(path)
        stream = cast(BytesIO, self._disk)  # all the writer calls is write, tell and flush
        self._writer = Writer(stream, chunk_size=_CHUNK, compression=CompressionType.ZSTD)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._added = self._chunked = self._safe = 0  # messages: so far, in closed chunks, of these on the disk
        self._finished: int | None = None
        self._writer.start(profile=profile, library=f"gcd-node; mcap-python/{version('mcap')}")

    @property
    def size(self) -> int:
        """Bytes on the disk."""
        return self._disk.size

    @property
    def messages(self) -> int:
        """Added so far; once it was finished, those that a reader finds in it."""
        return self._added if self._finished is None else self._finished

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Add metadata."""
        self._writer.add_metadata(name, dict(facts))

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file."""
        now_ns = time.time_ns()
        self._writer.add_attachment(now_ns, now_ns, name, media_type, data)

    def write(self, entries: Sequence[Entry]) -> None:
        """Add messages that belong together. Raises OSError."""
        for entry in entries:
            self._add(entry)
        self._commit()

    def flush(self) -> None:
        """Close the chunk in work, so that a reader gets it whatever happens next. Raises OSError."""
        self._writer.flush()
        self._chunked = self._added
        self._commit()

    def sync(self) -> None:
        """Make it survive a power cut. Raises OSError."""
        self._disk.sync()

    def finish(self) -> bool:
        """Write index and end, on a full disk into the room kept for them, and close. Without any room the file ends
        at its last whole chunk: with an end mark and no index if even that fits.

        Returns:
            Whether the file has an end.
        """
        self._disk.make_room()
        try:
            whole = self._tried(self._end)
            self._finished = self._added if whole else self._safe
            return whole or self._tried(self._cut_short)
        finally:
            with contextlib.suppress(OSError):
                self._disk.sync()
            with contextlib.suppress(OSError):
                self._disk.close()

    def _tried(self, end: Callable[[], None]) -> bool:
        try:
            end()
        except Exception as error:  # whatever keeps a file from its end: it stays whole up to there
            _LOG.warning("%s: %s", self.path, error)
            return False
        return True

    def _add(self, entry: Entry) -> None:
        channel = self._channel(entry)
        before = self._disk.tell()
        self._writer.add_message(
            channel_id=channel,
            log_time=entry.log_ns,
            data=entry.data,
            publish_time=entry.publish_ns,
            sequence=entry.sequence % _LARGEST_SEQUENCE,
        )
        self._added += 1
        self._chunked = self._added if self._disk.tell() != before else self._chunked

    def _commit(self) -> None:
        self._disk.commit()
        self._safe = self._chunked

    def _end(self) -> None:
        self._commit()  # what found no room before
        self._writer.finish()
        self._disk.commit()

    def _cut_short(self) -> None:
        """The writer's index knows of chunks that are not there: end without one, so that readers go front to back."""
        self._disk.forget()
        builder = RecordBuilder()
        DataEnd(data_section_crc=0).write(builder)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
        self._disk.write(builder.end() + MCAP0_MAGIC)
        self._disk.commit()

    def _channel(self, entry: Entry) -> int:
        if entry.topic not in self._channels:
            before = self._disk.tell()
            self._channels[entry.topic] = self._writer.register_channel(
                entry.topic, entry.schema.data, self._schema(entry.schema)
            )
            self._chunked = self._added if self._disk.tell() != before else self._chunked  # it may close a chunk too
        return self._channels[entry.topic]

    def _schema(self, schema: Schema) -> int:
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(
                schema.name, schema.encoding, schema.text.encode()
            )
        return self._schemas[schema.name]
