"""Messages of robot logs, front to back: MCAP files, ROS 2 bags (folders and .db3 files) and ROS 1 bags.

`mcap` and `rosbags` read what is there; how much and how long is limited here, because a log of a few kB can unfold
into gigabytes. ROS messages are read by the definitions that ship with rosbags, whatever the log says of them. What is
damaged in a way that is not looked for raises whatever the library does that found it.
"""

import bz2
import functools
import io
import logging
import re
import shutil
import tempfile
import time
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

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

from gcd_model import FileError, printable, read_small
from gcd_node.errors import SourceError

_LOG = logging.getLogger(__name__)

CODED_IMAGES = frozenset({"sensor_msgs/msg/CompressedImage", "foxglove.CompressedImage"})
VIDEOS = frozenset({"foxglove.CompressedVideo", "foxglove_msgs/msg/CompressedVideo"})
IMAGES = CODED_IMAGES | VIDEOS | {"sensor_msgs/msg/Image", "foxglove.RawImage"}
CAMERAS = frozenset({"sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration"})
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
_READABLE = IMAGES | CAMERAS | {ODOMETRY, TRANSFORMS}

MAX_BYTES = 96 * 2**20
"""Of a record, of an unfolded chunk, and of an unfolded message."""
_MAX_KEPT = 16 * 2**20  # of all topics and definitions together
_HEADS = {b"\x89MCAP0\r\n": ".mcap", b"#ROSBAG V": ".bag", b"SQLite format 3\0": ".db3"}
_MODE = re.compile(r"compression_mode:\s*[\"']?(message|file)", re.IGNORECASE)
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
    """One reading of a log. `messages` gives those of the types in this file.

    damaged: chunks left out so far. topics: every one so far, and the type of its messages. metadata: what a recording
    of this node says of itself, by name.
    """

    def __init__(self, path: Path, search_s: float, stopped: Callable[[], bool] = lambda: False) -> None:
        """Look at what is there.

        Args:
            search_s: time to find something in it; `renew` it with every find. stopped: whether to give up at once.
        Raises:
            SourceError: it is missing, empty or no log.
        """
        self._path, self._search_s, self._stopped = path, search_s, stopped
        try:
            self._files, self._packed = _files_of(path) if path.is_dir() else ([path], "")
            if not self._files or (not path.is_dir() and _kind_of(path) is None):
                raise SourceError(f"{path} is no log, empty or missing; give an MCAP file, a ROS bag or its folder")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise SourceError(f"cannot read the log {path}: {reason}; check path and permissions") from error
        self.renew()
        self.damaged = self._kept_bytes = 0
        self.topics: dict[str, str] = {}
        self.metadata: dict[str, dict[str, str]] = {}

    def renew(self) -> None:
        """Begin to search anew, now."""
        self._end_s = time.monotonic() + self._search_s

    def messages(self) -> Iterator[LogMessage]:
        """Messages of one file after the other.

        Raises:
            SourceError: it cannot be read at all. LogLimitError: see there.
        """
        for file in self._files:
            try:
                with _unpacked(file) if self._packed == "file" else nullcontext(file) as plain:
                    kind = _kind_of(plain)
                    yield from (
                        self._bag(plain, is_ros1=kind == ".bag") if kind in (".bag", ".db3") else self._mcap(plain)
                    )
            except zstandard.ZstdError as error:
                raise SourceError(f"{file} cannot be unpacked: {line_of(error)}") from error
            except OSError as error:
                raise SourceError(f"cannot read {file}: {error.strerror or error}; check the disk") from error

    def _check(self) -> None:
        if time.monotonic() > self._end_s or self._stopped():
            raise LogLimitError(f"nothing was found in {self._search_s:g} s of reading")

    def _mcap(self, file: Path) -> Iterator[LogMessage]:
        known: dict[tuple[type, int], Schema | Channel] = {}
        readable: dict[int, tuple[str, str, Callable[[bytes], Any]]] = {}  # topic, type and what reads it
        for record in self._records(functools.partial(file.open, "rb")):
            if isinstance(record, Message):
                if record.channel_id in readable:
                    topic, kind, decode = readable[record.channel_id]
                    yield LogMessage(
                        topic=topic,
                        kind=kind,
                        sequence=record.sequence,
                        log_ns=record.log_time,
                        sent_ns=record.publish_time,
                        decode=functools.partial(self._decoded, decode, record.data),
                    )
            elif isinstance(record, Schema | Channel):
                if known.get(key := (type(record), record.id)) != record:  # many writers repeat them
                    self._keep(record)
                    known[key] = record
                    if isinstance(record, Channel):
                        kind, decode = _decoder_of(record, known.get((Schema, record.schema_id)))
                        self.topics[record.topic] = kind
                        if decode is not None:
                            readable[record.id] = record.topic, kind, decode
            elif isinstance(record, Metadata) and record.name.startswith("gcd-node"):
                self._keep(record)
                self.metadata[record.name] = record.metadata

    def _records(self, open_stream: Callable[[], IO[bytes]], *, in_chunk: bool = False) -> Iterator[McapRecord]:
        """Everything before the index, chunks unfolded; of what was cut or is damaged, what is whole."""
        try:
            with open_stream() as stream:
                limited = cast(IO[bytes], _LimitedStream(stream, self._check))
                reader = StreamReader(limited, skip_magic=in_chunk, emit_chunks=True, record_size_limit=MAX_BYTES)
                for record in reader.records:
                    if isinstance(record, DataEnd):
                        return
                    if isinstance(record, Chunk) and not in_chunk:
                        yield from self._records(functools.partial(_unfolded, record), in_chunk=True)
                    else:
                        yield record
        except (LogLimitError, OSError):
            raise
        except Exception as error:  # of the library, or of its decompressors
            if in_chunk and isinstance(error, EndOfFile):
                return  # of the chunk
            what = "a part is left out" if in_chunk else "it was not finished, or is damaged, and is read up to there"
            _LOG.log(
                logging.DEBUG if in_chunk and self.damaged else logging.WARNING,
                "%s: %s: %s",
                self._path,
                what,
                line_of(error),
            )
            self.damaged += in_chunk

    def _keep(self, record: McapRecord) -> None:
        self._kept_bytes += len(msgspec.json.encode(vars(record)))
        if self._kept_bytes > _MAX_KEPT:
            raise LogLimitError(f"topics and definitions alone are more than {_MAX_KEPT} bytes")

    def _bag(self, path: Path, *, is_ros1: bool) -> Iterator[LogMessage]:
        decode = ros1_types().deserialize_ros1 if is_ros1 else ros2_types().deserialize_cdr
        try:
            with Ros1Reader(path) if is_ros1 else Ros2Reader(path) as reader:
                self.topics |= {each.topic: each.msgtype for each in reader.connections}
                if isinstance(reader, Ros1Reader):  # which lets a chunk unfold to whatever it holds
                    for place, chunk in reader.chunks.items():
                        kinds = {bz2.decompress: "bz2", lz4.frame.decompress: "lz4"}
                        if kind := kinds.get(chunk.decompressor):
                            limited = functools.partial(unfolded, compression=kind)
                            reader.chunks[place] = chunk._replace(decompressor=limited)
                wanted = [each for each in reader.connections if each.msgtype in _READABLE]
                for connection, at_ns, data in reader.messages(connections=wanted) if wanted else ():
                    self._check()
                    kind = connection.msgtype
                    read = functools.partial(self._decoded, functools.partial(decode, typename=kind), data)
                    yield LogMessage(
                        topic=connection.topic, kind=kind, sequence=0, log_ns=at_ns, sent_ns=at_ns, decode=read
                    )
        except (LogLimitError, OSError):
            raise
        except Exception as error:  # of rosbags, SQLite or a decompressor
            raise SourceError(
                f"{path} cannot be read as a ROS bag: {line_of(error)}; try ros2 bag reindex, or rosbag reindex"
            ) from error

    def _decoded(self, decode: Callable[[bytes], Any], data: bytes) -> Any:
        """What a message says, unfolded first where each is packed for itself."""
        return decode(unfolded(data, "zstd") if self._packed == "message" else data)


# Files, and how they are packed.


def _kind_of(file: Path) -> str | None:
    """By its first bytes: ".mcap", ".bag" of ROS 1, ".db3" of ROS 2; None if it is none, or no regular file."""
    if not file.is_file():  # to open a pipe would wait for its writer
        return None
    with file.open("rb") as stream:
        head = stream.read(max(map(len, _HEADS)))
    return next((kind for begin, kind in _HEADS.items() if head.startswith(begin)), None)


def _files_of(folder: Path) -> tuple[list[Path], str]:
    """What is read one after another, the files of one recording in the order of their numbers; and what is packed:
    each "message", each "file", or "". Raises SourceError: there are several logs."""
    metadata, mode = folder / "metadata.yaml", None
    if metadata.is_file():
        try:
            mode = _MODE.search(read_small(metadata))
        except FileError as error:
            raise SourceError(f"{metadata} {error}; run ros2 bag reindex") from error
    packed = "" if mode is None else mode[1].lower()
    found: list[Path] = []
    for suffix in (".mcap", ".db3"):
        pattern = f"*{suffix}{'.zstd' if packed == 'file' else ''}"
        files = [file for file in folder.glob(pattern) if file.is_file()]
        found = found or sorted(files, key=lambda file: (len(file.name), file.name))
    if not metadata.is_file() and len({re.sub(r"_?\d*$", "", file.stem) for file in found}) > 1:
        raise SourceError(f"{folder} is a folder of several logs; give one of them, such as {found[0].name}")
    return found, packed


@contextmanager
def _unpacked(file: Path) -> Generator[Path]:
    """A file that was packed whole, in a folder of its own for as long. It takes half of the free room at most."""
    with tempfile.TemporaryDirectory(prefix="gcd-node-") as folder:
        most, plain = shutil.disk_usage(folder).free // 2, Path(folder, file.stem)
        with file.open("rb") as packed, plain.open("wb") as out:
            for part in zstandard.ZstdDecompressor().read_to_iter(packed):
                most -= len(part)
                if most < 0:
                    raise SourceError(f"{file} unpacks to more than half of the room in {folder}; unpack it elsewhere")
                out.write(part)
        yield plain


def unfolded(data: bytes, compression: str, most: int | None = None) -> bytes:
    """The content of a packed message or chunk: "zstd", "lz4" or "bz2". most: bytes, None for MAX_BYTES.

    Raises SourceError if there are more.
    """
    most = MAX_BYTES if most is None else most
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as unfolding:
            content = io.BufferedReader(cast(io.RawIOBase, unfolding)).read(most + 1)
    else:
        decompressor = bz2.BZ2Decompressor() if compression == "bz2" else lz4.frame.LZ4FrameDecompressor()
        content = cast(Any, decompressor).decompress(data, max_length=most + 1)
    if len(content) > most:
        raise SourceError(f"a packed part holds more than {most} bytes")
    return content


class _LimitedStream:
    """What `mcap` reads from: only while `check` raises nothing, and never very much at once."""

    def __init__(self, stream: IO[bytes], check: Callable[[], None]) -> None:
        self._stream, self._check = stream, check

    def read(self, size: int) -> bytes:
        """As of a file. Raises LogLimitError; EndOfFile for a length that cannot be."""
        self._check()
        if size > MAX_BYTES:
            raise EndOfFile(f"{size} bytes at once, more than {MAX_BYTES}")
        return self._stream.read(size)


def _unfolded(chunk: Chunk) -> IO[bytes]:
    """Its records. The library itself would let a decompressor write more than the chunk states."""
    size = chunk.uncompressed_size
    if size > MAX_BYTES:
        raise SourceError(f"a chunk states {size} bytes, more than {MAX_BYTES}")
    records = unfolded(chunk.data, chunk.compression, size) if chunk.compression in ("zstd", "lz4") else chunk.data
    if len(records) != size:
        raise SourceError(f"a chunk states {size} bytes and holds {len(records)}: it is damaged")
    if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
        raise SourceError("the checksum of a chunk is wrong: it is damaged")
    return io.BytesIO(records)


def _decoder_of(channel: Channel, schema: Any) -> tuple[str, Callable[[bytes], Any] | None]:
    """The type of a channel's messages, and what reads them; None if nothing does, or nobody needs them."""
    if schema is None:
        return "", None
    encoding = channel.message_encoding
    kind = _ROS1_TYPE.sub(r"\1/msg/\2", schema.name) if encoding == "ros1" else schema.name
    if kind not in _READABLE:
        return kind, None
    if encoding in ("cdr", "ros1"):
        decode = ros2_types().deserialize_cdr if encoding == "cdr" else ros1_types().deserialize_ros1
        return kind, lambda data: decode(data, kind)
    try:
        return kind, DecoderFactory().decoder_for(encoding, schema)
    except Exception as error:  # of protobuf: the definition is damaged
        _LOG.warning("messages of type %s cannot be read: %s", kind, line_of(error))
        return kind, None


def line_of(error: Exception) -> str:
    """What a library says, in one line that a terminal can show."""
    return printable(" ".join(str(error)[:2000].split()), 200) or type(error).__name__


# Types of messages.


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
