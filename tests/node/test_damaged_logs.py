"""Damaged and hostile robot logs: a file plays up to where it was cut or is damaged; what is no log, or made to keep
its reader busy for ever or to fill its memory, is refused in one line, in time."""

import json
import logging
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.descriptor_pb2 import FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import CompressionType
from media import HEIGHT, WIDTH, flat, ramp
from mutations import BYTE_PIECES, ROUNDS, Mutator, outcomes
from robot_logs import (
    at,
    camera_info,
    coded,
    compressed,
    foxglove,
    of_pictures,
    raw,
    ros_log,
    stamps,
    write_bag,
    write_foxglove,
    write_log,
)
from rosbags.rosbag2 import CompressionMode

from gcd_node.errors import SourceError
from gcd_node.sources import log_reader, logs
from gcd_node.sources.logs import LogSource

MOST_BYTES = 2**31  # of a process that meets such a log
BIG = 60 * 2**20  # a chunk may hold as much


@pytest.mark.parametrize("is_cut", [True, False], ids=["cut", "damaged"])
def test_a_log_plays_to_where_it_was_cut_or_is_damaged_and_says_so(
    is_cut: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    images = list(np.random.default_rng(0).integers(0, 255, (60, HEIGHT, WIDTH, 3), np.uint8))
    path = write_log(tmp_path / "log.mcap", images, compression=CompressionType.NONE, chunk_size=1 << 13)
    assert len(list(LogSource(path).frames())) == 60
    assert caplog.text == ""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF  # which the checksum of its chunk tells
    path.write_bytes(data[: len(data) // 2] if is_cut else data)
    source = LogSource(path)
    frames = list(source.frames())
    assert 20 <= len(frames) <= 33
    assert stamps(frames) == [at(i) for i in range(len(frames))]
    assert "was not finished, or is damaged" in caplog.text
    assert source.corrupt == 0


def test_damaged_pictures_are_counted_and_left_out(tmp_path: Path) -> None:
    bad = [b"", b"\xff\xd8\xff nothing", coded(flat(1, 2, 3))[:200], b"GIF89a" + bytes(99)]
    sent = [compressed(flat(9, 9, 9), at(i), data=None if i % 2 else bad[i // 2]) for i in range(8)]
    source = of_pictures(tmp_path / "log.mcap", sent)
    assert stamps(list(source.frames())) == [at(i) for i in (1, 3, 5, 7)]
    assert source.corrupt == 4


def test_what_is_no_log_is_refused_in_one_line(tmp_path: Path) -> None:
    cases = {
        "empty.mcap": b"",
        "junk.mcap": b"\x07" * 500,
        "head.mcap": b"\x89MCAP0\r\n",
        "cut.bag": b"#ROSBAG V2.0\n" + bytes(99),
        "cut.db3": b"SQLite format 3\0" + bytes(99),
    }
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "folder").mkdir()
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    (tmp_path / "pipes").mkdir()
    for pipe in ("pipe.mcap", "pipes/a.mcap"):
        os.mkfifo(tmp_path / pipe)
    (tmp_path / "zeros.mcap").symlink_to("/dev/zero")
    odd = ("folder", "bag", "none.mcap", "a" * 5000, "nul\0", "pipe.mcap", "pipes", "zeros.mcap")
    for name in (*cases, *odd):
        with pytest.raises(SourceError) as caught:
            LogSource(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_a_calibration_that_lacks_what_its_name_promises_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Of protobuf messages the log itself says what fields there are."""
    pool = DescriptorPool()
    file = FileDescriptorProto(name="odd.proto", package="foxglove", syntax="proto3")
    file.message_type.add(name="CameraCalibration").field.add(name="frame_id", number=2, type=9, label=1)
    pool.Add(file)
    odd = GetMessageClass(pool.FindMessageTypeByName("foxglove.CameraCalibration"))(frame_id="cam")
    drawn = [foxglove(CompressedImage, at(i), coded(flat(9, 9, 9))) for i in range(3)]
    log = LogSource(write_foxglove(tmp_path / "log.mcap", [odd, *drawn]))
    assert len(list(log.frames())) == 3
    assert log.info.lens is None
    assert "is not used" in caplog.text


def mutation_seeds(folder: Path) -> list[bytes]:
    """Without checksums, what is damaged inside a chunk reaches the readers of messages; one of them has some."""
    small, none = [image[:16, :16] for image in ramp(4)], CompressionType.NONE
    seeds = [write_log(folder / "a.mcap", small, compression=none).read_bytes()]
    for kind in CompressionType:
        seeds.append(write_log(folder / "a.mcap", small, compression=kind, checked=False).read_bytes())
    camera = CameraCalibration(width=16, height=16, K=[9.0, 0, 8, 0, 9.0, 8, 0, 0, 1.0], D=[0.1] * 5)
    drawn = [camera, *(foxglove(CompressedImage, at(i), coded(flat(9, 9, 9))) for i in range(3))]
    seeds.append(write_foxglove(folder / "b.mcap", drawn, compression=none, enable_crcs=False).read_bytes())
    with ros_log(folder / "c.mcap", compression=none, checked=False) as say:
        say("/camera_info", *camera_info(8, 8))
        for i in range(3):
            say("/image", *raw(np.zeros((8, 8, 3), np.uint8), "bgr8", at(i)))
    return [*seeds, (folder / "c.mcap").read_bytes()]


@pytest.mark.timeout(max(120, ROUNDS // 10))
def test_mutated_logs_end_as_frames_or_source_errors(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR, "gcd_node")  # pytest would keep every line
    path = tmp_path / "mutated.mcap"

    def play(part: bytes) -> str:
        path.write_bytes(part)
        log = LogSource(path)
        for frame in islice(log.frames(), 50):
            assert 0 <= frame.stamp_ns < 2**63
        return "damaged" if log.corrupt else "whole"

    ended = outcomes(play, Mutator(4, mutation_seeds(tmp_path), BYTE_PIECES), SourceError)
    assert min(ended["refused"], ended["damaged"], ended["whole"]) > ROUNDS // 100


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def channel(topic: str = "/x", number: int = 1, encoding: str = "json", schema: int = 0) -> bytes:
    return record(4, struct.pack("<HH", number, schema) + text(topic) + text(encoding) + struct.pack("<I", 0))


def message(number: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, 0, 0))


def chunk(records: bytes, compression: str = "zstd", states: int | None = None) -> bytes:
    folded = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}[compression](records)
    head = struct.pack("<QQQI", 0, 0, len(records) if states is None else states, 0)
    return record(6, head + text(compression) + struct.pack("<Q", len(folded)) + folded)


HEAD = b"\x89MCAP0\r\n" + record(1, text("") + text(""))
IMAGES = record(3, struct.pack("<H", 1) + text("sensor_msgs/msg/CompressedImage") + text("ros2msg") + bytes(4))
HOSTILE: dict[str, Callable[[], bytes]] = {
    "a billion tiny records": lambda: chunk(record(200, b"") * (BIG // 9)) * 45,
    "a million empty messages": lambda: channel() + chunk(message() * 1_000_000) * 9,
    "a million empty pictures": lambda: IMAGES + channel("/x", 1, "cdr", 1) + chunk(message() * 1_000_000),
    "a chunk that is larger than it states": lambda: chunk(bytes(2**30), states=1000) * 9,
    "a chunk that is larger than it states, in lz4": lambda: chunk(bytes(2**28), "lz4", states=1000) * 9,
    "a chunk that states a gigabyte": lambda: chunk(bytes(2**30)) * 9,
    "an index without end": lambda: chunk(record(7, struct.pack("<HI", 0, 0xFFFFFFF0)) + bytes(BIG)) * 9,
    "names that unfold to gigabytes": lambda: (
        chunk(b"".join(channel("n" * 60_000 + str(i), i) for i in range(1000))) * 9
    ),
    "notes about itself that unfold to gigabytes": lambda: (
        chunk(record(12, text("gcd-node/source") + struct.pack("<I", 8 + BIG) + text("") + text("v" * BIG))) * 20
    ),
    "a length of gigabytes": lambda: struct.pack("<BQ", 12, 20) + struct.pack("<I", 0xFFFFFFF0) + bytes(1000),
    "records without end that were never sent": lambda: record(200, b"") * 3_000_000,
    "a summary that points backwards": lambda: channel() + message() + record(2, struct.pack("<QQI", 8, 8, 0)),
}


READER = """
import json, pathlib, sys, time
from gcd_node.sources import logs
logs._SEARCH_S = 0.4
for path in sys.argv[1:]:
    begun = time.monotonic()
    try: logs.LogSource(pathlib.Path(path))
    except logs.SourceError as error: line = str(error)
    taken = next(int(each.split()[1]) for each in open("/proc/self/status") if each.startswith("VmHWM"))
    print(json.dumps([line, time.monotonic() - begun, 1024 * taken]))
"""


def test_hostile_logs_are_refused_in_one_line_in_time_and_memory(tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.mcap" for number in range(len(HOSTILE))]
    for path, content in zip(paths, HOSTILE.values(), strict=True):
        path.write_bytes(HEAD + content())
    command = [sys.executable, "-c", READER, *map(str, paths)]  # in a process of its own, for its memory
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    for kind, answer in zip(HOSTILE, done.stdout.splitlines(), strict=True):
        line, seconds, most_bytes = json.loads(answer)
        assert "no picture" in line, kind
        assert "\n" not in line, kind
        assert len(line) < 2000, kind
        assert seconds < 15, kind
        assert most_bytes < MOST_BYTES, kind  # so far


def endless(path: Path) -> Path:
    """Three pictures, and then records without end, as time goes here."""
    data = write_log(path, ramp(3)).read_bytes()
    path.write_bytes(data[: data.rindex(struct.pack("<BQ", 15, 4))] + chunk(record(200, b"") * 10_000_000))
    return path


def test_a_log_whose_pictures_never_come_again_plays_and_then_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "_SEARCH_S", 0.5)
    log = LogSource(endless(tmp_path / "log.mcap"))  # what is known of them is enough to open it
    frames = log.frames()
    assert len(list(islice(frames, 3))) == 3
    with pytest.raises(SourceError):
        next(frames)
    frames = log.frames()
    next(frames)
    log.close()
    assert list(frames) == []


@pytest.mark.parametrize("name", ["log.bag", "message"])
def test_a_bag_that_unfolds_to_more_than_it_may_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = [("/front/image", compressed(image, at(i))) for i, image in enumerate(ramp(3))]
    path = write_bag(tmp_path / name, sent, compression=CompressionMode.MESSAGE)
    assert len(list(LogSource(path).frames())) == 3
    monkeypatch.setattr(log_reader, "MAX_BYTES", 500)
    with pytest.raises(SourceError):
        list(LogSource(path).frames())
