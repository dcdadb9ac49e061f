"""Messages of robot logs, front to back: MCAP files, ROS 2 bags (folders and .db3 files) and ROS 1 bags.

`mcap` and `rosbags` read what is there; how much and how long is limited here, because a log of a few kB can unfold
into gigabytes. ROS messages are read by the definitions that ship with rosbags, whatever the log says of them. A file
that was cut or is damaged ends there.
"""

import bz2
import contextlib
import functools
import io
import logging
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, Literal, TypeAlias, cast

import lz4.frame
import msgspec
import zstandard
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gcd_model import printable
from gcd_node.errors import SourceError

_LOG = logging.getLogger(__name__)

Kind: TypeAlias = Literal["raw", "coded", "video", "camera", "odometry", "transforms"]
KINDS: dict[str, Kind] = {
    "sensor_msgs/msg/Image": "raw",
    "foxglove.RawImage": "raw",
    "sensor_msgs/msg/CompressedImage": "coded",
    "foxglove.CompressedImage": "coded",
    "foxglove.CompressedVideo": "video",
    "foxglove_msgs/msg/CompressedVideo": "video",
    "sensor_msgs/msg/CameraInfo": "camera",
    "foxglove.CameraCalibration": "camera",
    "nav_msgs/msg/Odometry": "odometry",
    "tf2_msgs/msg/TFMessage": "transforms",
}
"""Types of messages that are read."""
PICTURES = frozenset[Kind](("raw", "coded", "video"))

MAX_BYTES = 96 * 2**20
"""Of a record, of an unfolded chunk, and of an unfolded message."""
_MAX_KEPT = 16 * 2**20  # of all topics and definitions together
_SUFFIXES = (".mcap", ".db3", ".bag")
_ZSTD = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True, kw_only=True, slots=True)
class LogMessage:
    """One message. sequence: as recorded, may stay 0. log_ns, sent_ns: when it was recorded and sent."""

    topic: str
    kind: Kind
    read: Callable[[bytes], Any]
    data: bytes
    log_ns: int
    sent_ns: int
    sequence: int = 0

    def decode(self) -> Any:
        """Its fields, by the names its definition has. Raises whatever the library does if it is damaged."""
        return self.read(self.data)


class LogReader:
    """One reading of a log. `messages` gives those of KINDS.

    topics: every one so far, and the type of its messages. recorded: what a recording of this node says of its input.
    trouble: why a file of it ended early, "" if none did.
    """

    def __init__(self, path: Path, search_s: float, stopped: Callable[[], bool] = lambda: False) -> None:
        """Look for its files.

        Args:
            search_s: time to find something in it; `renew` it with every find. stopped: whether to give up at once.
        Raises:
            SourceError: it is missing or no log.
        """
        self._files, self._search_s, self._stopped = _files_of(path), search_s, stopped
        self._kept_bytes, self.trouble = 0, ""
        self.topics: dict[str, str] = {}
        self.recorded: dict[str, str] = {}
        self.renew()

    def renew(self) -> None:
        """Begin to search anew, now."""
        self._end_s = time.monotonic() + self._search_s

    def messages(self) -> Iterator[LogMessage]:
        """Messages of one file after the other. Raises SourceError: nothing was found in time."""
        for file in self._files:
            try:
                yield from self._mcap(file) if file.suffix == ".mcap" else self._bag(file)
            except SourceError:
                if self._stopped():
                    return
                raise
            except Exception as error:  # of a library, a decompressor or the disk
                remedy = "mcap recover" if file.suffix == ".mcap" else "ros2 bag reindex, or rosbag reindex"
                self.trouble = f"{file.name} was not finished, or is damaged: {line_of(error)}; try {remedy}"
                _LOG.warning("%s; it is read up to there", self.trouble)

    def _check(self) -> None:
        if time.monotonic() > self._end_s or self._stopped():
            raise SourceError(
                f"nothing was found in {self._search_s:g} s of reading: cut the log to the pictures: "
                "mcap filter LOG -y TOPIC -o NEW"
            )

    def _mcap(self, file: Path) -> Iterator[LogMessage]:
        known: dict[tuple[type, int], Schema | Channel] = {}
        readable: dict[int, Callable[..., LogMessage]] = {}  # what makes one, by channel
        with file.open("rb") as stream:
            for record in self._records(stream):
                if isinstance(record, Message) and record.channel_id in readable:
                    times = {"log_ns": record.log_time, "sent_ns": record.publish_time}
                    yield readable[record.channel_id](data=record.data, sequence=record.sequence, **times)
                elif isinstance(record, Metadata) and record.name == "gcd-node/source":
                    self.recorded = record.metadata
                elif isinstance(record, Schema | Channel) and known.get(key := (type(record), record.id)) != record:
                    self._keep(record)  # many writers repeat them
                    known[key] = record
                    if isinstance(record, Channel) and isinstance(
                        schema := known.get((Schema, record.schema_id)), Schema
                    ):
                        self.topics[record.topic] = schema.name
                        if schema.name in KINDS and (read := _decoder_of(record.message_encoding, schema)):
                            kind = KINDS[schema.name]
                            readable[record.id] = functools.partial(
                                LogMessage, topic=record.topic, kind=kind, read=read
                            )

    def _records(self, stream: IO[bytes], *, in_chunk: bool = False) -> Iterator[McapRecord]:
        """Everything before the index, chunks unfolded."""

        def read(size: int) -> bytes:
            self._check()
            if size > MAX_BYTES:
                raise ValueError(f"it states {size} bytes at once, more than {MAX_BYTES}")
            return stream.read(size)

        limited = cast(IO[bytes], SimpleNamespace(read=read))
        reader = StreamReader(limited, skip_magic=in_chunk, emit_chunks=True, record_size_limit=MAX_BYTES)
        for record in reader.records:
            if isinstance(record, DataEnd):
                return
            if isinstance(record, Chunk) and not in_chunk:
                with contextlib.suppress(EndOfFile):  # of the chunk
                    yield from self._records(io.BytesIO(_unfolded_chunk(record)), in_chunk=True)
            else:
                yield record

    def _keep(self, record: Schema | Channel) -> None:
        self._kept_bytes += len(msgspec.json.encode(vars(record)))
        if self._kept_bytes > _MAX_KEPT:
            raise ValueError(f"topics and definitions alone are more than {_MAX_KEPT} bytes")

    def _bag(self, file: Path) -> Iterator[LogMessage]:
        with Ros1Reader(file) if file.suffix == ".bag" else Ros2Reader(file) as reader:
            self.topics |= {each.topic: each.msgtype for each in reader.connections}
            decode = _decoded_cdr
            if isinstance(reader, Ros1Reader):  # which lets a chunk unfold to whatever it holds
                decode = ros1_types().deserialize_ros1
                for place, chunk in reader.chunks.items():
                    kinds = {bz2.decompress: "bz2", lz4.frame.decompress: "lz4"}
                    if kind := kinds.get(chunk.decompressor):
                        limited = functools.partial(unfolded, compression=kind)
                        reader.chunks[place] = chunk._replace(decompressor=limited)
            wanted = [each for each in reader.connections if each.msgtype in KINDS]
            for connection, at_ns, data in reader.messages(connections=wanted) if wanted else ():
                self._check()
                read = functools.partial(decode, typename=connection.msgtype)
                kind = KINDS[connection.msgtype]
                yield LogMessage(topic=connection.topic, kind=kind, read=read, data=data, log_ns=at_ns, sent_ns=at_ns)


def _files_of(path: Path) -> list[Path]:
    """What is read one after another: a file, or those of a folder by their numbers. Raises SourceError."""
    found: list[Path] = []
    try:
        for suffix in _SUFFIXES:
            files = path.glob(f"*{suffix}") if path.is_dir() else (path,) if path.suffix == suffix else ()
            found = found or [file for file in files if file.is_file()]  # to open a pipe would wait for its writer
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SourceError(f"cannot read the log {path}: {reason}; check path and permissions") from error
    if not found:
        raise SourceError(
            f"{path} is no log or missing; give a {', '.join(_SUFFIXES)} file, or the folder of a bag; unpack one that "
            "was recorded with --compression-mode file: zstd -d FOLDER/*.zstd"
        )
    return sorted(found, key=lambda file: (len(file.name), file.name))


def _unfolded_chunk(chunk: Chunk) -> bytes:
    """Its records. The library itself would let a decompressor write more than the chunk states."""
    data = unfolded(chunk.data, chunk.compression) if chunk.compression else chunk.data
    if len(data) != chunk.uncompressed_size or zlib.crc32(data) != (chunk.uncompressed_crc or zlib.crc32(data)):
        raise ValueError("size or checksum of a chunk is wrong")
    return data


def unfolded(data: bytes, compression: str) -> bytes:
    """The content of a packed message or chunk: "zstd", "lz4" or "bz2". Raises ValueError: over MAX_BYTES."""
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data) as unfolding:
            content = unfolding.read(MAX_BYTES + 1)
    else:
        decompressor = bz2.BZ2Decompressor() if compression == "bz2" else lz4.frame.LZ4FrameDecompressor()
        content = cast(Any, decompressor).decompress(data, max_length=MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"a packed part holds more than {MAX_BYTES} bytes")
    return content


def line_of(error: Exception) -> str:
    """What a library says, in one line that a terminal can show."""
    return printable(" ".join(str(error)[:2000].split()), 200) or type(error).__name__


# Types of messages.


def _decoder_of(encoding: str, schema: Schema) -> Callable[[bytes], Any] | None:
    """What reads messages; None if nothing does."""
    if encoding == "cdr":
        return functools.partial(_decoded_cdr, typename=schema.name)
    return DecoderFactory().decoder_for(encoding, schema)


def _decoded_cdr(data: bytes, typename: str) -> Any:
    if data.startswith(_ZSTD):  # recorded with --compression-mode message; CDR begins with a zero
        data = unfolded(data, "zstd")
    return ros2_types().deserialize_cdr(data, typename)


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
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store
