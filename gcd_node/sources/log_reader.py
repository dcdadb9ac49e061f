"""Messages of robot logs, front to back: MCAP files, ROS 2 bags (folders and .db3 files) and ROS 1 bags.

`mcap` and `rosbags` read what is there; how much and how long is limited here, because a log of a few kB can unfold
into gigabytes. ROS messages are read by the definitions that ship with rosbags, whatever the log says of them.
"""

import functools
import io
import logging
import re
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeVar, cast

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gcd_model import FileError, printable, read_small
from gcd_node.errors import SourceError

_LOG = logging.getLogger(__name__)
_Record = TypeVar("_Record", Schema, Channel, Metadata)

_HEADS = {b"\x89MCAP0\r\n": ".mcap", b"#ROSBAG V": ".bag", b"SQLite format 3\0": ".db3"}
RAW_IMAGES = frozenset({"sensor_msgs/msg/Image", "foxglove.RawImage"})
CODED_IMAGES = frozenset({"sensor_msgs/msg/CompressedImage", "foxglove.CompressedImage"})
VIDEOS = frozenset({"foxglove.CompressedVideo", "foxglove_msgs/msg/CompressedVideo"})
IMAGES = RAW_IMAGES | CODED_IMAGES | VIDEOS
CAMERAS = frozenset({"sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration"})
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
_READABLE = IMAGES | CAMERAS | {ODOMETRY, TRANSFORMS}

_MAX_BYTES = 96 * 2**20  # of a record, and of an unfolded chunk
_MAX_KEPT = 16 * 2**20  # of all topics and definitions together
_PACKED_MESSAGES = re.compile(r"compression_mode:\s*[\"']?message", re.IGNORECASE)
_ROS1_TYPE = re.compile(r"^(\w+)/(\w+)$")


class LogLimitError(SourceError):
    """A log takes more time or memory than it may, or nobody waits for it any more."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LogMessage:
    """One message. kind: its type. sequence: as recorded, may stay 0. log_ns, sent_ns: when it was recorded and sent.

    decode: gives its fields, by the names its definition has. Raises whatever the library does if it is damaged.
    """

    topic: str
    kind: str
    sequence: int
    log_ns: int
    sent_ns: int
    decode: Callable[[], Any]


class LogReader:
    """One reading of a log. `messages` gives those of the types in this file."""

    def __init__(self, path: Path, search_s: float, stopped: Callable[[], bool] = lambda: False) -> None:
        """Look at what is there.

        Args:
            search_s: time to find something in it; `renew` it with every find. stopped: whether to give up at once.
        Raises:
            SourceError: it is missing, empty or no log.
        """
        self._path, self._search_s, self._stopped = path, search_s, stopped
        self._files = log_files(path)
        self.renew()
        self._kept_bytes = 0
        self.damaged = 0
        """Chunks left out so far."""
        self.topics: dict[str, str] = {}
        """Every topic so far, and the type of its messages."""
        self.metadata: dict[str, dict[str, str]] = {}
        """What a recording of this node says of itself, by name."""

    def renew(self) -> None:
        """Begin to search anew, now."""
        self._end_s = time.monotonic() + self._search_s

    def _check(self) -> None:
        if time.monotonic() > self._end_s or self._stopped():
            raise LogLimitError(f"nothing was found in {self._search_s:g} s of reading")

    def messages(self) -> Iterator[LogMessage]:
        """Messages of one file after the other.

        Raises:
            SourceError: it cannot be read at all. LogLimitError: see there.
        """
        for file in self._files:
            try:
                yield from self._bag(file) if kind_of_log(file) in (".bag", ".db3") else self._mcap(file)
            except OSError as error:
                raise SourceError(f"cannot read {file}: {error.strerror or error}; check the disk") from error

    def _mcap(self, file: Path) -> Iterator[LogMessage]:
        schemas: dict[int, Schema] = {0: Schema(id=0, data=b"", encoding="", name="")}
        channels: dict[int, Channel] = {}
        readable: dict[int, tuple[str, Callable[[bytes], Any]]] = {}
        for record in self._mcap_records(file):
            if isinstance(record, Message):
                if record.channel_id in readable:
                    kind, decode = readable[record.channel_id]
                    yield LogMessage(
                        topic=channels[record.channel_id].topic,
                        kind=kind,
                        sequence=record.sequence,
                        log_ns=record.log_time,
                        sent_ns=record.publish_time,
                        decode=functools.partial(decode, record.data),
                    )
            elif isinstance(record, Schema) and schemas.get(record.id) != record:  # many writers repeat them
                schemas[record.id] = self._kept(record)
            elif isinstance(record, Channel) and channels.get(record.id) != record:
                channels[record.id] = self._kept(record)
                kind, decode = _reader_of(record, schemas.get(record.schema_id, schemas[0]))
                self.topics[record.topic] = kind
                if decode is not None:
                    readable[record.id] = kind, decode
            elif isinstance(record, Metadata) and record.name.startswith("gcd-node"):
                self.metadata[record.name] = self._kept(record).metadata

    def _mcap_records(self, file: Path) -> Iterator[McapRecord]:
        """Everything before the index, chunks unfolded; of a file that was cut, what is whole."""
        with file.open("rb") as stream:
            try:
                for record in self._records(stream, in_chunk=False):
                    if isinstance(record, DataEnd):
                        return
                    if isinstance(record, Chunk):
                        yield from self._chunk_records(record)
                    else:
                        yield record
            except (LogLimitError, OSError):
                raise
            except Exception as error:  # whatever the library says of a file that was cut
                _LOG.warning("%s was not finished, or is damaged: it was read up to there (%s)", file, line_of(error))

    def _chunk_records(self, chunk: Chunk) -> Iterator[McapRecord]:
        try:
            yield from self._records(io.BytesIO(_unfolded(chunk)), in_chunk=True)
        except EndOfFile:
            return  # of the chunk
        except LogLimitError:
            raise
        except Exception as error:  # of the library, or of its decompressors
            level = logging.DEBUG if self.damaged else logging.WARNING  # once is enough
            _LOG.log(level, "%s: a part of the log is left out: %s", self._path, line_of(error))
            self.damaged += 1

    def _records(self, stream: IO[bytes], *, in_chunk: bool) -> Iterator[McapRecord]:
        limited = cast(IO[bytes], _LimitedStream(stream, self._check))
        return StreamReader(limited, skip_magic=in_chunk, emit_chunks=True, record_size_limit=_MAX_BYTES).records

    def _kept(self, record: _Record) -> _Record:
        """The same, its bytes counted. Raises LogLimitError."""
        for value in vars(record).values():
            parts = (*value, *value.values()) if isinstance(value, dict) else (value,)
            self._kept_bytes += sum(len(part) for part in parts if isinstance(part, str | bytes))
        if self._kept_bytes > _MAX_KEPT:
            raise LogLimitError(f"topics and definitions alone are more than {_MAX_KEPT} bytes")
        return record

    def _bag(self, path: Path) -> Iterator[LogMessage]:
        is_ros1 = kind_of_log(path) == ".bag"
        decode = ros1_types().deserialize_ros1 if is_ros1 else ros2_types().deserialize_cdr
        try:
            with Ros1Reader(path) if is_ros1 else Ros2Reader(path) as reader:
                self.topics |= {each.topic: each.msgtype for each in reader.connections}
                wanted = [each for each in reader.connections if each.msgtype in _READABLE]
                for connection, at_ns, data in reader.messages(connections=wanted) if wanted else ():
                    self._check()
                    yield LogMessage(
                        topic=connection.topic,
                        kind=connection.msgtype,
                        sequence=0,
                        log_ns=at_ns,
                        sent_ns=at_ns,
                        decode=functools.partial(decode, data, connection.msgtype),
                    )
        except (LogLimitError, OSError):
            raise
        except Exception as error:  # of rosbags, SQLite, YAML or a decompressor
            raise SourceError(
                f"{path} cannot be read as a ROS bag: {line_of(error)}; try ros2 bag reindex, or rosbag reindex"
            ) from error


class _LimitedStream:
    """What `mcap` reads from: only while `check` raises nothing, and never very much at once."""

    def __init__(self, stream: IO[bytes], check: Callable[[], None]) -> None:
        self._stream, self._check = stream, check

    def read(self, size: int) -> bytes:
        """As of a file. Raises LogLimitError; EndOfFile for a length that cannot be."""
        self._check()
        if size > _MAX_BYTES:
            raise EndOfFile(f"{size} bytes at once, more than {_MAX_BYTES}")
        return self._stream.read(size)


def _unfolded(chunk: Chunk) -> bytes:
    """Its records. The library itself would let a decompressor write more than the chunk states."""
    size = chunk.uncompressed_size
    if size > _MAX_BYTES:
        raise SourceError(f"a chunk states {size} bytes, more than {_MAX_BYTES}")
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True) as unfolding:
            records = io.BufferedReader(cast(io.RawIOBase, unfolding)).read(size)
    elif chunk.compression == "lz4":
        records = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size)
    else:
        records = chunk.data
    if len(records) != size:
        raise SourceError(f"a chunk states {size} bytes and holds {len(records)}: it is damaged")
    if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
        raise SourceError("the checksum of a chunk is wrong: it is damaged")
    return records


def _reader_of(channel: Channel, schema: Schema) -> tuple[str, Callable[[bytes], Any] | None]:
    """The type of a channel's messages, and what reads them; None if nothing does, or nobody needs them."""
    encoding = channel.message_encoding
    kind = _ROS1_TYPE.sub(r"\1/msg/\2", schema.name) if encoding == "ros1" else schema.name
    if kind not in _READABLE:
        return kind, None
    if encoding == "cdr":
        return kind, lambda data: ros2_types().deserialize_cdr(data, kind)
    if encoding == "ros1":
        return kind, lambda data: ros1_types().deserialize_ros1(data, kind)
    try:
        return kind, DecoderFactory().decoder_for(encoding, schema)
    except Exception as error:  # of protobuf: the definition is damaged
        _LOG.warning("messages of type %s cannot be read: %s", kind, line_of(error))
        return kind, None


@functools.cache
def ros2_types() -> Typestore:
    """ROS 2 messages: those in this file are the same in every distribution."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    video = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
    store.register(get_types_from_msg(video, "foxglove_msgs/msg/CompressedVideo"))
    return store


@functools.cache
def ros1_types() -> Typestore:
    """The same of ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return store


def log_files(path: Path) -> tuple[Path, ...]:
    """What is read one after another: a file; the files of one recording in a folder, in the order of their numbers; or
    the folder itself, if rosbags is to make sense of its metadata.yaml.

    Raises:
        SourceError: no log, or a folder with several.
    """
    try:
        if path.is_dir():
            return _files_in(path)
        if not path.exists():
            raise SourceError(f"no such log: {path}; check the path")
        if kind_of_log(path) is None:
            raise SourceError(f"{path} is no log, or empty; give an MCAP file, a ROS bag or the folder of one")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SourceError(f"cannot read {path}: {reason}; check path and permissions") from error
    return (path,)


def _files_in(folder: Path) -> tuple[Path, ...]:
    metadata = folder / "metadata.yaml"
    is_bag = metadata.is_file()
    if is_bag:
        try:
            is_packed = _PACKED_MESSAGES.search(read_small(metadata)) is not None
        except FileError as error:
            raise SourceError(f"{metadata} {error}; run ros2 bag reindex") from error
        if is_packed or not any(folder.glob("*.mcap")):
            return (folder,)
    found = list(folder.glob("*.mcap")) or list(folder.glob("*.db3"))
    found.sort(key=lambda file: (len(file.name), file.name))
    if not found:
        raise SourceError(f"{folder} is a folder without a log; give an MCAP file, a ROS bag or the folder of one")
    if not is_bag and len({re.sub(r"_?\d*$", "", file.stem) for file in found}) > 1:
        names = ", ".join(file.name for file in found[:3])
        raise SourceError(f"{folder} is a folder of several logs; give one of them, such as {names}")
    return tuple(found)


def line_of(error: Exception) -> str:
    """What a library says, in one line that a terminal can show."""
    return printable(" ".join(str(error)[:2000].split()), 200) or type(error).__name__


def kind_of_log(path: Path) -> str | None:
    """Which kind of robot log it is, by its first bytes: ".mcap", ".bag" of ROS 1, ".db3" of ROS 2 or the folder of a
    bag; None if it is none."""
    if path.is_dir():
        named = (path / "metadata.yaml").is_file() or any(path.glob("*.mcap")) or any(path.glob("*.db3"))
        return ".db3" if named else None
    if not path.is_file():
        return None
    with path.open("rb") as file:
        head = file.read(max(map(len, _HEADS)))
    return next((kind for begin, kind in _HEADS.items() if head.startswith(begin)), None)
