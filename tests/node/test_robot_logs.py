"""Robot logs: what the reference libraries write is read back exactly."""

import json
import logging
import os
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from fractions import Fraction
from itertools import islice, product
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from cameras import HEIGHT, WIDTH, flat, ramp
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from google.protobuf.descriptor_pb2 import FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import CompressionType
from mutations import BYTE_PIECES, ROUNDS, Mutator, outcomes
from robot_logs import (
    TOPIC,
    WORDS,
    Said,
    at,
    camera_info,
    coded,
    compressed,
    foxglove,
    odometry,
    of_pictures,
    raw,
    ros_log,
    stamps,
    transform,
    write_bag,
    write_foxglove,
    write_log,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from gcd_node.errors import SourceError, TooShortError
from gcd_node.frame import Frame, Image
from gcd_node.sources import log_reader, logs
from gcd_node.sources.logs import LogSource

COUNT = 12
COLOUR = (250, 10, 120)
BLACK = flat(0, 0, 0)


def near(image: Image, colour: tuple[int, int, int] = COLOUR, tolerance: int = 8) -> bool:
    return bool(np.abs(image.astype(int) - colour).max() <= tolerance)


def test_every_container_gives_each_picture_with_its_own_stamp_and_number(tmp_path: Path) -> None:
    sent = [("/front/camera_info", camera_info(WIDTH, HEIGHT))]
    sent += [("/front/image", compressed(image, at(i))) for i, image in enumerate(ramp(COUNT))]
    written = [write_bag(tmp_path / "log.bag", sent)]
    for storage, mode in product(StoragePlugin, (CompressionMode.NONE, CompressionMode.MESSAGE)):
        written.append(write_bag(tmp_path / f"{storage.name}_{mode.name}", sent, storage, mode))
    for compression in CompressionType:
        written.append(tmp_path / f"{compression.name}.mcap")
        with ros_log(written[-1], compression=compression) as say:
            for i, (topic, message) in enumerate(sent):
                say(topic, *message, sequence=max(0, i - 1))
    for path in (*written, tmp_path / "SQLITE3_MESSAGE" / "SQLITE3_MESSAGE.db3"):
        source = LogSource(path)
        frames = list(source.frames())
        assert [(frame.stamp_ns, frame.seq) for frame in frames] == [(at(i), i) for i in range(COUNT)]
        for frame, image in zip(frames, ramp(COUNT), strict=True):
            assert np.abs(frame.image.astype(int) - image).max() <= 6
        assert (source.corrupt, source.topic, source.info.codec) == (0, "/front/image", "jpeg")
        assert source.info.fps_nominal == pytest.approx(10.0)
        assert source.info.lens is not None


def test_a_bag_that_was_packed_whole_is_to_be_unpacked_and_one_that_was_split_played_in_order(tmp_path: Path) -> None:
    sent = [(TOPIC, compressed(BLACK, at(i))) for i in range(2)]
    path = write_bag(tmp_path / "bag", sent, compression=CompressionMode.FILE)
    with pytest.raises(SourceError, match="zstd -d"):
        LogSource(path)
    (packed,) = path.glob("*.zstd")
    (path / packed.stem).write_bytes(zstandard.ZstdDecompressor().decompressobj().decompress(packed.read_bytes()))
    assert len(list(LogSource(path).frames())) == 2
    for part, name in enumerate(["bag_0.mcap", "bag_1.mcap", "bag_10.mcap"]):  # played by their numbers
        of_pictures(tmp_path / name, [compressed(BLACK, at(2 * part + i)) for i in range(2)])
    (tmp_path / "bag_2.mcap").write_bytes(b"")  # a recorder was killed before it wrote
    shutil.rmtree(path)
    assert stamps(list(LogSource(tmp_path).frames())) == [at(i) for i in range(6)]


def test_numbers_and_time_go_on_as_recorded_and_without_stamps_the_time_of_sending_counts(tmp_path: Path) -> None:
    with ros_log(tmp_path / "log.mcap") as say:
        for i, number in enumerate([0, 1, 5, 3, 0]):  # two were lost; a recorder began again
            say(TOPIC, *compressed(BLACK, 0), log_ns=at(i), sequence=number)
    source = LogSource(tmp_path / "log.mcap")
    played = enumerate([0, 1, 5, 6, 7])
    assert [(frame.seq, frame.stamp_ns) for frame in source.frames()] == [(number, at(i)) for i, number in played]
    assert source.info.stamp_uncertainty_us == pytest.approx(1e5)
    periods = [0, 1, 36_001, 36_002, 0, 1]  # in real time, long holes are skipped
    of_pictures(tmp_path / "log.mcap", [compressed(BLACK, at(i)) for i in periods])
    begin = time.monotonic()
    frames = list(LogSource(tmp_path / "log.mcap", pace="realtime").frames())
    assert stamps(frames) == [at(i) for i in periods]
    assert 0.29 <= time.monotonic() - begin < 60


def tiled(cell: list[list[int]], width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    return np.tile(np.array(cell, np.uint8), (height // len(cell), width // len(cell[0])))


R, G, B = COLOUR
Y = round(16 + 0.257 * R + 0.504 * G + 0.098 * B)
U, V = round(128 - 0.148 * R - 0.291 * G + 0.439 * B), round(128 + 0.439 * R - 0.368 * G - 0.071 * B)
LAYOUTS = {  # rows of bytes, from the definitions and not from OpenCV
    "rgb8": tiled([[R, G, B]], 3 * WIDTH),
    "bgr8": tiled([[B, G, R]], 3 * WIDTH),
    "rgba8": tiled([[R, G, B, 255]], 4 * WIDTH),
    "bgra8": tiled([[B, G, R, 255]], 4 * WIDTH),
    "yuv422": tiled([[U, Y, V, Y]], 2 * WIDTH),
    "yuv422_yuy2": tiled([[Y, U, Y, V]], 2 * WIDTH),
    "nv12": np.vstack([tiled([[Y]]), tiled([[U, V]], WIDTH, HEIGHT // 2)]),
    "nv21": np.vstack([tiled([[Y]]), tiled([[V, U]], WIDTH, HEIGHT // 2)]),
    "bayer_rggb8": tiled([[R, G], [G, B]]),
    "bayer_bggr8": tiled([[B, G], [G, R]]),
    "bayer_gbrg8": tiled([[G, B], [R, G]]),
    "bayer_grbg8": tiled([[G, R], [B, G]]),
}


def test_red_stays_red_in_every_layout_without_the_padding_of_rows(tmp_path: Path) -> None:
    for encoding, rows in LAYOUTS.items():
        pictures = [raw(rows, encoding, at(i), width=WIDTH, height=HEIGHT) for i in range(2)]
        source = of_pictures(tmp_path / "log.mcap", pictures)
        assert source.info.codec == encoding
        assert all(near(frame.image[2:-2, 2:-2]) for frame in source.frames())
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    padded, grey = np.pad(image.reshape(HEIGHT, -1), ((0, 0), (0, 20))), np.ascontiguousarray(image[:, :, 0])
    pictures = [raw(padded, "rgb8", at(i), width=WIDTH) for i in range(2)] + [raw(grey, "mono8", at(2))]
    frames = list(of_pictures(tmp_path / "log.mcap", pictures).frames())
    np.testing.assert_array_equal(frames[0].image, image)
    np.testing.assert_array_equal(frames[2].image, np.repeat(grey[:, :, None], 3, axis=2))
    swapped = "rgb8; jpeg compressed rgb8"  # the coder was handed RGB and took it for BGR
    for format_ in ("jpeg", "rgb8; jpeg compressed bgr8", "bgr8; png compressed bgr8", swapped):
        colour = flat(*COLOUR[::-1] if format_ == swapped else COLOUR)
        source = of_pictures(tmp_path / "log.mcap", [compressed(colour, at(i), format_) for i in range(2)])
        assert all(near(frame.image) for frame in source.frames())


def test_foxglove_pictures_are_read_with_their_stamps_and_calibration(tmp_path: Path) -> None:
    k, d = [60.0, 0.0, 32.0, 0.0, 61.0, 24.0, 0.0, 0.0, 1.0], [-0.1, 0.01, 0.0, 0.0, 0.0]
    camera = CameraCalibration(width=WIDTH, height=HEIGHT, distortion_model="plumb_bob", D=d, K=k)
    pictures = [foxglove(CompressedImage, at(i), coded(flat(*COLOUR))) for i in range(4)]
    source = LogSource(write_foxglove(tmp_path / "log.mcap", [camera, *pictures]))
    frames, lens = list(source.frames()), source.info.lens
    assert stamps(frames) == [at(i) for i in range(4)]
    assert all(near(frame.image) for frame in frames)
    assert (lens.fx, lens.fy, lens.cx, lens.coefficients) == (60.0, 61.0, 32.0, tuple(d))


def test_video_in_a_log_is_read_frame_by_frame(tmp_path: Path) -> None:
    """As Foxglove wants it: one frame a message, no frame that looks ahead."""
    av = pytest.importorskip("av")
    context = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    context.time_base, context.framerate = Fraction(1, 10), 10
    context.options = {"tune": "zerolatency", "preset": "ultrafast"}
    messages: list[CompressedVideo] = []
    for i, image in enumerate(ramp(COUNT)):
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts, frame.time_base = i, Fraction(1, 10)
        (packet,) = context.encode(frame)
        messages.append(foxglove(CompressedVideo, at(i), bytes(packet), "h264"))
    source = LogSource(write_foxglove(tmp_path / "log.mcap", messages))
    frames = list(source.frames())
    assert source.info.codec == "h264"
    assert stamps(frames) == [at(i) for i in range(COUNT)]
    for frame, image in zip(frames, ramp(COUNT), strict=True):
        assert abs(frame.image.mean() - image.mean()) < 3


def companions(path: Path, more: list[tuple[str, Said, float]]) -> list[Frame]:
    """Four black frames, at 0 to 3 periods, and what else was recorded: topic, message, and when that was."""
    sent = [(TOPIC, compressed(BLACK, at(i)), float(i)) for i in range(4)]
    with ros_log(path) as say:
        for topic, message, when in sorted([*sent, *more], key=lambda each: each[2]):
            say(topic, *message, log_ns=at(when))
    names = ({topic: topic for topic, *_ in more}.get(name) for name in ("/depth", "/odom"))
    return list(LogSource(path, topic=TOPIC, depth_topic=next(names), odometry_topic=next(names)).frames())


def test_frames_carry_the_depth_that_was_stamped_nearest_to_them_in_metres(tmp_path: Path) -> None:
    def flat_depth(millimetres: int) -> np.ndarray:
        return np.full((HEIGHT // 2, WIDTH // 2), millimetres, np.uint16)  # half the size, as many cameras send it

    more = [
        ("/depth", raw(flat_depth(1000), "16UC1", at(0.1)), 0.1),
        ("/depth", raw(flat_depth(1200), "16UC1", at(0.9)), 2.2),  # recorded late
        ("/depth", raw(flat_depth(2000).astype(np.float32) / 1000, "32FC1", at(2.3)), 2.4),
        ("/depth", raw(flat_depth(9000), "16UC1", at(3.6)), 3.6),  # too far from any picture
    ]
    frames = companions(tmp_path / "log.mcap", more)
    assert stamps(frames) == [at(i) for i in range(4)]
    for frame, metres in zip(frames, (1.0, 1.2, 2.0), strict=False):
        assert (frame.depth.dtype, frame.depth.shape) == (np.float32, (HEIGHT, WIDTH))
        np.testing.assert_allclose(frame.depth, metres)
    assert frames[3].depth is None


def test_compressed_depth_is_read_and_holes_stay_holes(tmp_path: Path) -> None:
    levels = np.full((HEIGHT, WIDTH), 1500, np.uint16)
    levels[0] = 0
    a, b = 3000.0, -500.0  # level = a / metres + b
    for format_, head, metres in (
        ("16UC1; compressedDepth png", bytes(12), 1.5),
        ("16UC1; png compressed", b"", 1.5),
        ("32FC1; compressedDepth png", b"\0" * 4 + struct.pack("<ff", a, b), a / (1500 - b)),
    ):
        sent = compressed(BLACK, at(1), format_, head + coded(levels, ".png"))
        found = companions(tmp_path / "log.mcap", [("/depth", sent, 1.0)])[1].depth
        np.testing.assert_allclose(found[1:], metres, rtol=1e-6)
        assert not found[0].any()


def test_frames_carry_the_camera_s_pose_by_odometry_and_static_transforms(tmp_path: Path) -> None:
    optical = (-0.5, 0.5, -0.5, 0.5)  # of a camera that looks ahead, by REP 103
    transforms = [transform("base_link", "mast", 2.0), transform("mast", "front_optical", 0.5, optical)]
    more = [("/tf_static", ("tf2_msgs/msg/TFMessage", {"transforms": transforms}), -1.0)]
    more += [("/odom", odometry(float(i), at(i + 0.2), yaw_deg=90.0), i + 0.2) for i in range(3)]
    more += [("/odom", odometry(9.0, at(i + 0.4)), i + 0.4) for i in range(3)]  # farther from the picture
    poses = [frame.odometry for frame in companions(tmp_path / "log.mcap", more)]
    for i, world_from_camera in enumerate(poses[:3]):
        np.testing.assert_allclose(world_from_camera[:3, 3], (i, 2.5, 0), atol=1e-9)  # 2.5 m ahead, turned to the left
        np.testing.assert_allclose(world_from_camera[:3, 2], (0, 1, 0), atol=1e-9)  # and looking there
        np.testing.assert_allclose(world_from_camera[:3, 1], (0, 0, -1), atol=1e-9)
    assert poses[3] is None


def test_of_several_topics_one_must_be_named_and_late_pictures_are_found_but_one_is_too_few(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with ros_log(path) as say:
        for i in range(4):
            say("/front/image", *compressed(flat(200, 0, 0), at(i)))
            say("/rear/image", *compressed(flat(0, 0, 200), at(i)))
            say("/words", *WORDS)
    for topic, depth_topic in ((None, None), ("/words", None), ("/rear/image", "/none")):
        with pytest.raises(SourceError, match="/rear/image"):  # which it has
            LogSource(path, topic=topic, depth_topic=depth_topic)
    assert near(next(LogSource(path, topic="/rear/image").frames()).image, (0, 0, 200))
    for count, error in ((0, SourceError), (1, TooShortError), (3, None)):
        with ros_log(path) as say:
            for _ in range(100):
                say("/words", *WORDS)
            for i in range(count):
                say(TOPIC, *compressed(BLACK, at(i)))
        with nullcontext() if error is None else pytest.raises(error):
            assert LogSource(path).topic == TOPIC


INFO_HERE = camera_info(WIDTH, HEIGHT)
PINHOLE = (WIDTH, 60.0, 61.0, "plumb_bob")
CALIBRATIONS = [
    ("/front/image_raw/compressed", "/front/camera_info", INFO_HERE, PINHOLE),
    ("/front/image_raw/compressed", "/front/image_raw/camera_info", INFO_HERE, PINHOLE),
    ("/image", "/camera_info", INFO_HERE, PINHOLE),
    ("/front/image", "/rear/camera_info", INFO_HERE, None),
    ("/front/image_rect_color", "/front/camera_info", INFO_HERE, (WIDTH, 55.0, 56.0, "none")),
    ("/a/image", "/a/camera_info", camera_info(128, 96, focal=120.0), (WIDTH, 60.0, 60.5, "plumb_bob")),
    ("/front/image", "/front/camera_info", camera_info(100, 100), None),  # of another shape
    ("/front/image", "/front/camera_info", camera_info(WIDTH, HEIGHT, d=[0.1] * 7), None),
]


def test_the_calibration_that_belongs_to_the_pictures_and_fits_them_is_used(tmp_path: Path) -> None:
    for topic, info_topic, info, lens in CALIBRATIONS:
        with ros_log(tmp_path / "log.mcap") as say:
            say(info_topic, *info)
            for i in range(3):
                say(topic, *compressed(BLACK, at(i)))
        found = LogSource(tmp_path / "log.mcap").info.lens
        assert lens == (None if found is None else (found.width, found.fx, found.fy, found.distortion))


# Damaged and hostile robot logs: a file plays up to where it was cut or is damaged; what is no log, or made to keep
# its reader busy for ever or to fill its memory, is refused in one line, in time.


MOST_BYTES = 2**31  # of a process that meets such a log
BIG = 60 * 2**20  # a chunk may hold as much


@pytest.mark.parametrize("is_cut", [True, False], ids=["cut", "damaged"])
def test_a_log_plays_to_where_it_is_damaged(is_cut: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
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


def test_what_is_no_log_is_refused_in_one_line(tmp_path: Path) -> None:
    cases = {"empty.mcap": b"", "junk.mcap": b"\x07" * 500, "head.mcap": b"\x89MCAP0\r\n"}
    cases |= {"cut.bag": b"#ROSBAG V2.0\n" + bytes(99), "cut.db3": b"SQLite format 3\0" + bytes(99)}
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


def test_damaged_pictures_are_counted_and_an_odd_calibration_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bad = [b"", b"\xff\xd8\xff nothing", coded(flat(1, 2, 3))[:200], b"GIF89a" + bytes(99)]
    sent = [compressed(flat(9, 9, 9), at(i), data=None if i % 2 else bad[i // 2]) for i in range(8)]
    source = of_pictures(tmp_path / "log.mcap", sent)
    assert stamps(list(source.frames())) == [at(i) for i in (1, 3, 5, 7)]
    assert source.corrupt == 4
    pool = DescriptorPool()  # of protobuf messages the log itself says what fields there are
    file = FileDescriptorProto(name="odd.proto", package="foxglove", syntax="proto3")
    file.message_type.add(name="CameraCalibration").field.add(name="frame_id", number=2, type=9, label=1)
    pool.Add(file)
    odd = GetMessageClass(pool.FindMessageTypeByName("foxglove.CameraCalibration"))(frame_id="cam")
    drawn = [foxglove(CompressedImage, at(i), coded(flat(9, 9, 9))) for i in range(3)]
    log = LogSource(write_foxglove(tmp_path / "log.mcap", [odd, *drawn]))
    assert (len(list(log.frames())), log.info.lens) == (3, None)
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


@pytest.mark.slow
def test_hostile_logs_are_refused_in_one_line_in_time_and_memory(tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.mcap" for number in range(len(HOSTILE))]
    for path, content in zip(paths, HOSTILE.values(), strict=True):
        path.write_bytes(HEAD + content())
    command = [sys.executable, "-c", READER, *map(str, paths)]  # in a process of its own, for its memory
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    for kind, answer in zip(HOSTILE, done.stdout.splitlines(), strict=True):
        line, seconds, most_bytes = json.loads(answer)
        assert ("\n" in line, len(line) < 2000, seconds < 15, most_bytes < MOST_BYTES) == (False, True, True, True), (
            kind
        )


def endless(path: Path) -> Path:
    """Three pictures, and then records without end, as time goes here."""
    data = write_log(path, ramp(3)).read_bytes()
    path.write_bytes(data[: data.rindex(struct.pack("<BQ", 15, 4))] + chunk(record(200, b"") * 10_000_000))
    return path


def test_a_log_whose_pictures_never_come_again_fails_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_a_bag_that_unfolds_to_more_than_it_may_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = [("/front/image", compressed(image, at(i))) for i, image in enumerate(ramp(3))]
    bags = [write_bag(tmp_path / name, sent, compression=CompressionMode.MESSAGE) for name in ("log.bag", "message")]
    assert [len(list(LogSource(bag).frames())) for bag in bags] == [3, 3]
    monkeypatch.setattr(log_reader, "MAX_BYTES", 500)
    for bag in bags:
        with pytest.raises(SourceError):
            list(LogSource(bag).frames())
