"""ROS bags: which files are one recording, how they are packed, and what rosbags reads, within limits of ours."""

import bz2
import functools
import io
import re
import shutil
import stat
import tempfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import lz4.frame
import zstandard
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gcd_model import FileError, read_small
from gcd_node.errors import SourceError

MAX_BYTES = 96 * 2**20
"""Of a record, of an unfolded chunk, and of an unfolded message."""
_HEADS = {b"\x89MCAP0\r\n": ".mcap", b"#ROSBAG V": ".bag", b"SQLite format 3\0": ".db3"}
_MODE = re.compile(r"compression_mode:\s*[\"']?(message|file)", re.IGNORECASE)


def kind_of_log(path: Path) -> str | None:
    """By its first bytes: ".mcap", ".bag" of ROS 1, ".db3" of ROS 2; "folder" of such; None if it is none."""
    if path.is_dir():
        return "folder" if any((path / name).is_file() for name in ("metadata.yaml", *_names(path))) else None
    if not stat.S_ISREG(path.stat().st_mode):  # to open a pipe would wait for its writer
        return None
    with path.open("rb") as file:
        head = file.read(max(map(len, _HEADS)))
    return next((kind for begin, kind in _HEADS.items() if head.startswith(begin)), None)


def _names(folder: Path) -> list[str]:
    return [path.name for pattern in ("*.mcap", "*.db3", "*.zstd") for path in folder.glob(pattern)]


def files_of(folder: Path) -> tuple[tuple[Path, ...], str]:
    """What is read one after another, the files of one recording in the order of their numbers; and what is packed:
    each "message", each "file", or "". Raises SourceError: there are several logs."""
    metadata, mode = folder / "metadata.yaml", None
    if metadata.is_file():
        try:
            mode = _MODE.search(read_small(metadata))
        except FileError as error:
            raise SourceError(f"{metadata} {error}; run ros2 bag reindex") from error
    packed = "" if mode is None else mode[1].lower()
    end = ".zstd" if packed == "file" else ""
    found: list[Path] = []
    for suffix in (".mcap", ".db3"):
        found = found or sorted(folder.glob(f"*{suffix}{end}"), key=lambda file: (len(file.name), file.name))
    if not metadata.is_file() and len({re.sub(r"_?\d*$", "", file.stem) for file in found}) > 1:
        raise SourceError(f"{folder} is a folder of several logs; give one of them, such as {found[0].name}")
    return tuple(found), packed


@contextmanager
def unpacked(file: Path) -> Generator[Path]:
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


def bag_messages(path: Path, *, is_ros1: bool, topics: dict[str, str], kinds: frozenset[str]) -> Iterator[Any]:
    """Topic, type, time in nanoseconds and bytes of every message of some types.

    topics: is filled with all there are and their types. kinds: of ROS. Raises what rosbags, SQLite or a decompressor
    raises, SourceError for too large a chunk.
    """
    with Ros1Reader(path) if is_ros1 else Ros2Reader(path) as reader:
        topics |= {each.topic: each.msgtype for each in reader.connections}
        wanted = [each for each in reader.connections if each.msgtype in kinds]
        if isinstance(reader, Ros1Reader):
            for place, chunk in reader.chunks.items():
                kind = "bz2" if chunk.decompressor is bz2.decompress else "lz4"
                if chunk.decompressor in (bz2.decompress, lz4.frame.decompress):
                    limited = functools.partial(unfolded, compression=kind)
                    reader.chunks[place] = chunk._replace(decompressor=limited)
        for connection, at_ns, data in reader.messages(connections=wanted) if wanted else ():
            yield connection.topic, connection.msgtype, at_ns, data


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
