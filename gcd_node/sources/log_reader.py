"""Messages of robot logs, front to back: MCAP files, ROS 2 bags (folders and .db3 files) and ROS 1 bags; and the
pictures and depth in them.

`mcap` and `rosbags` read what is there; how much and how long is limited here, because a log of a few kB can unfold
into gigabytes. ROS messages are read by the definitions that ship with rosbags, whatever the log says of them. What is
damaged in a way that is not looked for raises whatever the library does that found it.
"""

import functools
import io
import logging
import re
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeVar, cast

import cv2
import msgspec
import numpy as np
import zstandard
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from gcd_model import printable
from gcd_node.errors import SourceError
from gcd_node.frame import MAX_PIXELS, Image
from gcd_node.sources.files import decode_picture, raw_picture, raw_rows
from gcd_node.sources.ros_bags import (
    MAX_BYTES,
    bag_messages,
    files_of,
    kind_of_log,
    ros1_types,
    ros2_types,
    unfolded,
    unpacked,
)

_LOG = logging.getLogger(__name__)
_Record = TypeVar("_Record", Schema, Channel, Metadata)

CODED_IMAGES = frozenset({"sensor_msgs/msg/CompressedImage", "foxglove.CompressedImage"})
VIDEOS = frozenset({"foxglove.CompressedVideo", "foxglove_msgs/msg/CompressedVideo"})
IMAGES = CODED_IMAGES | VIDEOS | {"sensor_msgs/msg/Image", "foxglove.RawImage"}
CAMERAS = frozenset({"sensor_msgs/msg/CameraInfo", "foxglove.CameraCalibration"})
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
_READABLE = IMAGES | CAMERAS | {ODOMETRY, TRANSFORMS}

_MAX_KEPT = 16 * 2**20  # of all topics and definitions together
_ROS1_TYPE = re.compile(r"^(\w+)/(\w+)$")
_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_CODECS = ("jpeg", "png", "webp")
_DEPTH = ("16UC", "32FC", "64FC", "16SC", "32SC")
_PNG = b"\x89PNG\r\n\x1a\n"
_VIDEO_DECODERS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}


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
            self._files, self._packed = files_of(path) if path.is_dir() else ((path,), "")
            if kind_of_log(path) is None:
                raise SourceError(f"{path} is no log, or empty; give an MCAP file, a ROS bag or the folder of one")
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
                with unpacked(file) if self._packed == "file" else nullcontext(file) as plain:
                    yield from self._messages(plain)
            except zstandard.ZstdError as error:
                raise SourceError(f"{file} cannot be unpacked: {line_of(error)}") from error
            except OSError as error:
                raise SourceError(f"cannot read {file}: {error.strerror or error}; check the disk") from error

    def _messages(self, file: Path) -> Iterator[LogMessage]:
        kind = kind_of_log(file)
        if kind is None and not file.is_file():
            raise SourceError(f"{file} is no log; take it out of the folder")
        yield from self._bag(file, is_ros1=kind == ".bag") if kind in (".bag", ".db3") else self._mcap(file)

    def _check(self) -> None:
        if time.monotonic() > self._end_s or self._stopped():
            raise LogLimitError(f"nothing was found in {self._search_s:g} s of reading")

    def _mcap(self, file: Path) -> Iterator[LogMessage]:
        schemas: dict[int, Schema] = {0: Schema(id=0, data=b"", encoding="", name="")}
        channels: dict[int, Channel] = {}
        readable: dict[int, tuple[str, Callable[[bytes], Any]]] = {}
        for record in self._records(functools.partial(file.open, "rb")):
            if isinstance(record, Message):
                if record.channel_id in readable:
                    kind, decode = readable[record.channel_id]
                    yield LogMessage(
                        topic=channels[record.channel_id].topic,
                        kind=kind,
                        sequence=record.sequence,
                        log_ns=record.log_time,
                        sent_ns=record.publish_time,
                        decode=functools.partial(self._unpacked, decode, record.data),
                    )
            elif isinstance(record, Schema) and schemas.get(record.id) != record:  # many writers repeat them
                schemas[record.id] = self._kept(record)
            elif isinstance(record, Channel) and channels.get(record.id) != record:
                channels[record.id] = self._kept(record)
                kind, decode = _decoder_of(record, schemas.get(record.schema_id, schemas[0]))
                self.topics[record.topic] = kind
                if decode is not None:
                    readable[record.id] = kind, decode
            elif isinstance(record, Metadata) and record.name.startswith("gcd-node"):
                self.metadata[record.name] = self._kept(record).metadata

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

    def _kept(self, record: _Record) -> _Record:
        """The same, its bytes counted. Raises LogLimitError."""
        self._kept_bytes += len(msgspec.json.encode(vars(record)))
        if self._kept_bytes > _MAX_KEPT:
            raise LogLimitError(f"topics and definitions alone are more than {_MAX_KEPT} bytes")
        return record

    def _bag(self, path: Path, *, is_ros1: bool) -> Iterator[LogMessage]:
        decode = ros1_types().deserialize_ros1 if is_ros1 else ros2_types().deserialize_cdr
        try:
            for topic, kind, at_ns, data in bag_messages(path, is_ros1=is_ros1, topics=self.topics, kinds=_READABLE):
                self._check()
                read = functools.partial(self._unpacked, functools.partial(decode, typename=kind), data)
                yield LogMessage(topic=topic, kind=kind, sequence=0, log_ns=at_ns, sent_ns=at_ns, decode=read)
        except (LogLimitError, OSError):
            raise
        except Exception as error:  # of rosbags, SQLite or a decompressor
            raise SourceError(
                f"{path} cannot be read as a ROS bag: {line_of(error)}; try ros2 bag reindex, or rosbag reindex"
            ) from error

    def _unpacked(self, decode: Callable[[bytes], Any], data: bytes) -> Any:
        """What a message says, unfolded first where each is packed for itself."""
        return decode(unfolded(data, "zstd") if self._packed == "message" else data)


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


def _decoder_of(channel: Channel, schema: Schema) -> tuple[str, Callable[[bytes], Any] | None]:
    """The type of a channel's messages, and what reads them; None if nothing does, or nobody needs them."""
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


# Pictures.


class ImageDecoder:
    """Pictures of one topic. Of a video it must be given every message, in order."""

    def __init__(self) -> None:
        self._video: Any = None

    def decode(self, kind: str, fields: Any) -> tuple[Image, str] | None:
        """The picture, u8 [H, W, 3] RGB, and what it was coded as; None while a video waits for its key frame.

        Args:
            kind: of IMAGES. fields: of the message.
        Raises:
            SourceError: damaged, too large, in a layout that is not read, or PyAV is not installed.
        """
        if kind in VIDEOS:
            return self._decode_video(str(fields.format).lower(), _bytes_of(fields.data))
        if kind not in CODED_IMAGES:
            return raw_picture(fields), str(fields.encoding)
        format_ = str(fields.format)
        if format_.startswith(_DEPTH) or "compressedDepth" in format_:
            raise SourceError(f"{format_[:40]!r} is a map of depths, not a picture")
        picture = decode_picture(_bytes_of(fields.data), _COLOUR)
        if "compressed rgb" not in format_:  # the order image_transport handed to the coder, which takes all for BGR
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
        codec = next((each for each in _CODECS if each in format_.lower()), "jpeg")
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


def depth_of(kind: str, fields: Any) -> NDArray[Any]:
    """A depth picture as it was sent, [H, W]: uint16 millimetres or float32 metres.

    Raises:
        SourceError: damaged, or no depth.
    """
    if kind in CODED_IMAGES:
        return _decoded_depth(str(fields.format), _bytes_of(fields.data))
    types = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
    if kind in VIDEOS or fields.encoding not in types:
        raise SourceError(f"depth is read from 16UC1, mono16 and 32FC1, got {getattr(fields, 'encoding', kind)!r}")
    order = ">" if getattr(fields, "is_bigendian", 0) else "<"
    stored = np.dtype(order + types[fields.encoding])
    rows = np.ascontiguousarray(raw_rows(fields, stored.itemsize, fields.height))
    return rows.view(stored).astype(stored.newbyteorder("="))


def _bytes_of(data: Any) -> bytes:
    """Of a message, whose own definition may have anything in their place. Raises SourceError."""
    if isinstance(data, np.ndarray) and data.dtype == np.uint8:
        return data.tobytes()
    if not isinstance(data, bytes | bytearray | memoryview):
        raise SourceError(f"its data are no bytes, but {type(data).__name__}")
    return bytes(data)


def _decoded_depth(format_: str, coded: bytes) -> NDArray[Any]:
    """A 16-bit PNG of millimetres; behind the 12 bytes of image_transport's compressedDepth also of inverse depth."""
    start = coded.find(_PNG, 0, 64)
    levels = decode_picture(coded[max(start, 0) :], cv2.IMREAD_UNCHANGED)
    if start < 0 or levels.dtype != np.uint16 or levels.ndim != 2:
        raise SourceError(f"depth in {format_[:40]!r} must be a PNG of one channel of 16 bits")
    if not format_.startswith("32FC1"):
        return levels
    if start < 12:
        raise SourceError("depth in 32FC1 lacks the numbers that scale it: it is damaged")
    a, b = struct.unpack_from("<ff", coded, 4)  # level = a / metres + b
    with np.errstate(all="ignore"):
        return np.where(levels > 0, a / (levels - np.float32(b)), 0).astype(np.float32)
