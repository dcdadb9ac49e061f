"""Damaged robot logs: what is damaged costs no more than itself, and what is no log is refused in one line."""

import logging
import os
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf import timestamp_pb2
from google.protobuf.descriptor_pb2 import FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import CompressionType
from media import HEIGHT, WIDTH, flat, ramp
from mutations import BYTE_PIECES, ROUNDS, Mutator, outcomes
from robot_logs import (
    COMPRESSED,
    IMAGE,
    INFO,
    TOPIC,
    at,
    camera_info,
    coded,
    compressed,
    raw,
    ros_log,
    stamped,
    stamps,
    write_foxglove,
    write_log,
)

from gcd_node.errors import SourceError
from gcd_node.frame import Image
from gcd_node.sources.logs import LogSource


def noisy(count: int) -> list[Image]:
    return list(np.random.default_rng(0).integers(0, 255, (count, HEIGHT, WIDTH, 3), np.uint8))


def test_a_log_that_was_cut_plays_to_its_last_whole_chunk(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_log(tmp_path / "log.mcap", noisy(60), chunk_size=1 << 13)
    assert len(list(LogSource(path).frames())) == 60
    assert caplog.text == ""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = LogSource(path)
    frames = list(source.frames())
    assert 20 <= len(frames) <= 33
    assert stamps(frames) == [at(i) for i in range(len(frames))]
    assert "was not finished" in caplog.text
    assert source.corrupt == 0


def test_damaged_pictures_are_counted_and_left_out(tmp_path: Path) -> None:
    bad = [b"", b"\xff\xd8\xff nothing", coded(flat(1, 2, 3))[:200], b"GIF89a" + bytes(99)]
    with ros_log(tmp_path / "log.mcap") as log:
        for i in range(8):
            message = compressed(flat(9, 9, 9), at(i))
            log.say(TOPIC, COMPRESSED, message if i % 2 else message | {"data": bad[i // 2]}, sequence=i)
    source = LogSource(tmp_path / "log.mcap")
    assert [frame.seq for frame in source.frames()] == [1, 3, 5, 7]
    assert source.corrupt == 4


def test_a_damaged_chunk_is_left_out_whole(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", noisy(30), compression=CompressionType.NONE, chunk_size=1 << 14)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    source = LogSource(path)
    played = stamps(list(source.frames()))
    assert source.corrupt == 1
    assert played == sorted(played)
    assert 24 <= len(played) < 30


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
    stamp, pool = timestamp_pb2.DESCRIPTOR, DescriptorPool()
    file = FileDescriptorProto(name="odd.proto", package="foxglove", syntax="proto3", dependency=[stamp.name])
    fields = file.message_type.add(name="CameraCalibration").field
    fields.add(name="timestamp", number=1, type=11, label=1, type_name=".google.protobuf.Timestamp")
    fields.add(name="frame_id", number=2, type=9, label=1)
    pool.AddSerializedFile(stamp.serialized_pb)
    pool.Add(file)
    odd = GetMessageClass(pool.FindMessageTypeByName("foxglove.CameraCalibration"))(frame_id="cam")
    picture = CompressedImage(frame_id="cam", data=coded(flat(9, 9, 9)), format="jpeg")
    drawn = [stamped(CompressedImage.FromString(picture.SerializeToString()), at(i)) for i in range(3)]
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
    picture = CompressedImage(frame_id="cam", data=coded(flat(9, 9, 9)), format="jpeg")
    drawn = [camera, *(stamped(CompressedImage.FromString(picture.SerializeToString()), at(i)) for i in range(3))]
    seeds.append(write_foxglove(folder / "b.mcap", drawn, compression=none, checked=False).read_bytes())
    with ros_log(folder / "c.mcap", compression=none, checked=False) as log:
        log.say("/camera_info", INFO, camera_info(8, 8))
        for i in range(3):
            log.say("/image", IMAGE, raw(bytes(8 * 8 * 3), 8, 8, "bgr8", 24, at(i)))
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
