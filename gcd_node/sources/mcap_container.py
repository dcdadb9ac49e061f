"""The MCAP container: messages of a log, in the order they were written, to the last whole one.

Logs come from robots that lost power, and from strangers. The reference library (`mcap` 1.6 and `mcap-ros2-support`
0.6 were tried) is not made for either, which is why containers, CDR and protobuf are read by code of our own:

- of a chunk that was cut it gives nothing; with one chunk a log, that is the whole log. Here its whole messages count.
- it unfolds a chunk without a bound: 9 kB that state 1000 bytes became 285 MB. Here a chunk has what it states.
- its ROS 2 messages are decoded as definitions in the log say, whatever these ask for. Here nothing of a log decides
  what is done with it (log_messages.py).

The tests compare with what the reference writers wrote, and with what the reference readers read of it. Needed are
that library's two decompressors, zstandard and lz4, and these only for chunks that use them.

Source: the MCAP format specification, version 0 of the magic.
"""

import logging
import os
import struct
import zlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path

from gcd_node.errors import SourceError
from gcd_node.sources.byte_cursor import ByteCursor
from gcd_node.sources.log_patience import LogPatience

_LOG = logging.getLogger(__name__)

MAGIC = b"\x89MCAP0\r\n"
MAX_BYTES = 256 * 2**20
"""Larger records, and chunks that unfold to more, are refused."""

_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA, _DATA_END, _FOOTER = 3, 4, 5, 6, 12, 15, 2
_MOST_METADATA, _MAX_METADATA = 64, 2**16
_LONGEST_NAME = 1024  # of topics, encodings, schemas: they are kept, and a few kB can unfold to gigabytes of them
_LAST_KNOWN, _FIRST_PRIVATE = 15, 128
_HEAD = struct.Struct("<BQ")
_PIECE = 2**20


@dataclass(frozen=True, kw_only=True, slots=True)
class LogChannel:
    """Where messages of one kind were sent. encoding: of the messages: "cdr", "protobuf", ... schema: their type."""

    topic: str
    encoding: str
    schema: str


@dataclass(frozen=True, kw_only=True, slots=True)
class LogMessage:
    """One message. sequence: as recorded, may stay 0. log_ns, published_ns: when it was recorded and sent."""

    channel: LogChannel
    sequence: int
    log_ns: int
    published_ns: int
    data: memoryview


class McapContainer:
    """One reading of an MCAP file, front to back."""

    def __init__(self, path: Path, patience: LogPatience | None = None) -> None:
        """Look at the file's first bytes. patience: for going through it; None goes to its end, however far.

        Raises:
            SourceError: missing, empty, or no MCAP.
        """
        check_mcap(path)
        self._path, self._patience = path, patience
        self._schemas: dict[int, str] = {0: ""}
        self._channels: dict[int, LogChannel] = {}
        self._metadata: dict[str, dict[str, str]] = {}
        self._whole = False
        self._damaged = 0

    @property
    def whole(self) -> bool:
        """Whether the end of the log was reached, and not just the end of what was written of it."""
        return self._whole

    @property
    def damaged(self) -> int:
        """Chunks so far that were left out: too large, cannot be unfolded, or their checksum is wrong."""
        return self._damaged

    @property
    def channels(self) -> Collection[LogChannel]:
        """Those met so far."""
        return self._channels.values()

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """What the log has said of itself so far, by name; of several of one name the latest."""
        return self._metadata

    def messages(self) -> Iterator[LogMessage]:
        """Every message.

        Raises:
            SourceError: the file cannot be read, or a decompressor is not installed. TiredError: see LogPatience.
        """
        try:
            with self._path.open("rb") as file:
                yield from self._walk(file, os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise SourceError(f"cannot read {self._path}: {error.strerror}; check the disk") from error

    def _walk(self, file: BufferedReader, size: int) -> Iterator[LogMessage]:
        file.seek(len(MAGIC))
        while (place := file.tell()) + _HEAD.size <= size:
            self._spend()
            kind, length = _HEAD.unpack(file.read(_HEAD.size))
            if kind in (_DATA_END, _FOOTER):
                self._whole = True
                return
            left = size - place - _HEAD.size
            if kind == 0 or _LAST_KNOWN < kind < _FIRST_PRIVATE or (length > left and kind != _CHUNK):
                return
            length, cut = min(length, left), length > left
            if kind not in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA) or length > MAX_BYTES:
                self._damaged += length > MAX_BYTES and kind in (_MESSAGE, _CHUNK)
                file.seek(length, os.SEEK_CUR)
                continue
            body = memoryview(file.read(length))
            yield from self._chunk(body, cut=cut) if kind == _CHUNK else self._record(kind, body)

    def _spend(self) -> None:
        if self._patience is not None:
            self._patience.spend()

    def _chunk(self, body: memoryview, *, cut: bool) -> Iterator[LogMessage]:
        try:
            records = unfolded(body, cut=cut)
        except ImportError as error:
            raise SourceError(
                f"to read {self._path}, {error.name} is needed: pip install 'gcd-node[record]'"
            ) from error
        except SourceError as error:
            level = logging.DEBUG if self._damaged else logging.WARNING  # once is enough
            _LOG.log(level, "%s: a part of the log is left out: %s", self._path, error)
            self._damaged += not cut
            return
        place = 0
        while place + _HEAD.size <= len(records):
            self._spend()
            kind, length = _HEAD.unpack_from(records, place)
            place += _HEAD.size
            if kind == 0 or length > len(records) - place:
                return
            if kind != _METADATA:  # which stands outside of chunks
                yield from self._record(kind, records[place : place + length])
            place += length

    def _record(self, kind: int, body: memoryview) -> Iterator[LogMessage]:
        cursor = ByteCursor(body)
        try:
            if kind == _SCHEMA:
                number = cursor.integer("H")
                self._schemas[number] = _name(cursor)
            elif kind == _CHANNEL:
                self._add_channel(cursor)
            elif kind == _METADATA:
                self._add_metadata(cursor)
            elif kind == _MESSAGE:
                yield from self._message(cursor)
        except SourceError as error:
            _LOG.debug("%s: a record is left out: %s", self._path, error)

    def _add_channel(self, cursor: ByteCursor) -> None:
        number, schema = cursor.integer("H"), cursor.integer("H")
        topic, encoding = _name(cursor), _name(cursor)
        self._channels[number] = LogChannel(topic=topic, encoding=encoding, schema=self._schemas.get(schema, ""))

    def _add_metadata(self, cursor: ByteCursor) -> None:
        if cursor.left > _MAX_METADATA:
            raise SourceError(f"{cursor.left} bytes of metadata, more than {_MAX_METADATA}")
        name, pairs = cursor.text(), ByteCursor(cursor.blob(cursor.integer("I")))
        found: dict[str, str] = {}
        while pairs.left:
            key = pairs.text()
            found[key] = pairs.text()
        if name in self._metadata or len(self._metadata) < _MOST_METADATA:
            self._metadata[name] = found

    def _message(self, cursor: ByteCursor) -> Iterator[LogMessage]:
        channel = self._channels.get(cursor.integer("H"))
        if channel is None:
            return
        sequence, log_ns, published_ns = cursor.integer("I"), cursor.integer("Q"), cursor.integer("Q")
        data = cursor.blob(cursor.left)
        yield LogMessage(channel=channel, sequence=sequence, log_ns=log_ns, published_ns=published_ns, data=data)


def _name(cursor: ByteCursor) -> str:
    """Raises SourceError for one that is too long to be kept, or that a terminal would obey when it is shown."""
    name = cursor.text()
    if len(name) > _LONGEST_NAME or not name.isprintable():
        raise SourceError(f"a name of {len(name)} characters, wanted are at most {_LONGEST_NAME} that can be printed")
    return name


def check_mcap(path: Path) -> None:
    """Raise SourceError unless `path` is a file that begins as an MCAP log does."""
    if not path.exists():
        raise SourceError(f"no such log: {path}; check the path")
    if path.is_dir():
        inside = ", ".join(sorted(each.name for each in path.glob("*.mcap"))[:3])
        raise SourceError(f"{path} is a folder; give the .mcap file{f' in it: {inside}' if inside else ''}")
    if not path.is_file():
        raise SourceError(f"{path} is not a regular file; give an MCAP log")
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}; check its permissions") from error
    if not head:
        raise SourceError(f"{path} is empty (0 bytes); copy or record it again")
    if not head.startswith(MAGIC):
        raise SourceError(f"{path} is not an MCAP log: its first bytes are {head[:8]!r}; {_remedy(head)}")


def _remedy(head: bytes) -> str:
    if head.startswith(b"#ROSBAG"):
        return "it is a ROS 1 bag, convert it: mcap convert LOG.bag LOG.mcap"
    if head.startswith(b"SQLite"):
        return "it is a ROS 2 bag in SQLite, convert it: ros2 bag convert"
    return "give an MCAP log"


def unfolded(body: memoryview, *, cut: bool) -> memoryview:
    """The records of a chunk; of a cut one as far as they go. Raises SourceError, ImportError."""
    cursor = ByteCursor(body)
    cursor.blob(16)  # first and last time
    size, checksum = cursor.integer("Q"), cursor.integer("I")
    compression, length = cursor.text(), cursor.integer("Q")
    if size > MAX_BYTES:
        raise SourceError(f"a chunk states {size} bytes, more than {MAX_BYTES}")
    folded = cursor.blob(min(length, cursor.left) if cut else length)
    records = _decompressed(folded, compression, size)
    if not cut and len(records) != size:
        raise SourceError(f"a chunk states {size} bytes and holds {len(records)}: it is damaged")
    if not cut and checksum and zlib.crc32(records) != checksum:
        raise SourceError("the checksum of a chunk is wrong: it is damaged")
    return records


def _decompressed(folded: memoryview, compression: str, size: int) -> memoryview:
    """At most `size` bytes, fewer if the input ends before. Raises SourceError, ImportError."""
    if compression == "":
        return folded[:size]
    if compression not in ("zstd", "lz4"):
        raise SourceError(f"a chunk is compressed by {compression[:20]!r}; known are zstd and lz4")
    return memoryview(_zstd(folded, size) if compression == "zstd" else _lz4(folded, size))


def _zstd(folded: memoryview, size: int) -> bytearray:
    import zstandard

    found = bytearray()
    try:
        with zstandard.ZstdDecompressor().stream_reader(folded, read_across_frames=True) as reader:
            while len(found) < size and (piece := reader.read(min(_PIECE, size - len(found)))):
                found += piece
    except zstandard.ZstdError as error:
        _LOG.debug("zstd: %s", error)  # what came before it is good, the checksum says if it is all
    return found


def _lz4(folded: memoryview, size: int) -> bytes:
    import lz4.frame

    try:
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(bytes(folded), max_length=size))
    except (RuntimeError, ValueError, EOFError) as error:
        raise SourceError(f"a chunk cannot be unfolded: {error}") from error
