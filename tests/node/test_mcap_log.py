"""Robot logs: what the reference libraries write is read back exactly; what is damaged costs no more than itself."""

import io
import logging
import os
import struct
import subprocess
import sys
import threading
import time
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType
from mcap_ros2.decoder import DecoderFactory
from media import HEIGHT, WIDTH, flat, ramp
from mutations import BYTE_PIECES, ROUNDS, Mutator, outcomes
from robot_logs import (
    PERIOD_NS,
    START_NS,
    TOPIC,
    camera_info,
    coded,
    compressed,
    raw,
    ros_log,
    stamped,
    write_foxglove,
    write_log,
    write_raw,
)

from gcd_node.config import SourceConfig
from gcd_node.errors import ConfigError, SourceError, TooShortError
from gcd_node.frame import Image
from gcd_node.sources import mcap_container, open_source
from gcd_node.sources.log_messages import CAMERAS, read_camera_message, read_picture_message
from gcd_node.sources.mcap_container import MAGIC, LogMessage, McapContainer
from gcd_node.sources.mcap_log import McapLog

COUNT = 12
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
COLOUR = (250, 10, 120)


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def length_of(data: bytes) -> bytes:
    """With its length before it, as MCAP writes texts."""
    return struct.pack("<I", len(data)) + data


def noisy(count: int) -> list[Image]:
    return list(np.random.default_rng(0).integers(0, 255, (count, HEIGHT, WIDTH, 3), np.uint8))


def near(image: Image, colour: tuple[int, int, int] = COLOUR, tolerance: int = 8) -> bool:
    return bool(np.abs(image.astype(int) - colour).max() <= tolerance)


# --- what was recorded -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda each: each.name)
def test_every_picture_comes_with_its_own_stamp_and_number(compression: CompressionType, tmp_path: Path) -> None:
    log = McapLog(write_log(tmp_path / "log.mcap", ramp(COUNT), compression=compression))
    frames = list(log.frames())
    assert [frame.stamp_ns for frame in frames] == [START_NS + i * PERIOD_NS for i in range(COUNT)]
    assert [frame.seq for frame in frames] == list(range(COUNT))
    for frame, image in zip(frames, ramp(COUNT), strict=True):
        assert np.abs(frame.image.astype(int) - image).max() <= 6
    assert log.corrupt == 0


def test_the_log_is_described_by_what_is_in_it(tmp_path: Path) -> None:
    log = McapLog(write_log(tmp_path / "log.mcap", ramp(COUNT)))
    info = log.info
    assert (info.kind, info.id, info.width, info.height) == ("mcap", "log.mcap", WIDTH, HEIGHT)
    assert (info.clock, info.codec, info.lens, info.live) == ("replay", "jpeg", None, False)
    assert info.fps_nominal == pytest.approx(10.0)
    assert log.topic == TOPIC


@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda each: each.name)
def test_the_reference_readers_find_the_same_in_a_log(compression: CompressionType, tmp_path: Path) -> None:
    with ros_log(tmp_path / "log.mcap", compression=compression, chunk_size=1 << 12) as log:
        log.say("/front/camera_info", INFO, camera_info(WIDTH, HEIGHT))
        for i, image in enumerate(noisy(5)):
            log.say(TOPIC, COMPRESSED, compressed(image, START_NS + i * PERIOD_NS), sequence=i)
            log.say("/raw", IMAGE, raw(image.tobytes(), WIDTH, HEIGHT, "rgb8", 3 * WIDTH, START_NS + i * PERIOD_NS))
    ours = list(McapContainer(tmp_path / "log.mcap").messages())
    with (tmp_path / "log.mcap").open("rb") as file:
        theirs = list(NonSeekingReader(file).iter_messages(log_time_order=False))
    known = [(at.channel.topic, at.channel.schema, at.sequence, at.log_ns, bytes(at.data)) for at in ours]
    assert known == [
        (chan.topic, schema.name, at.sequence, at.log_time, at.data) for schema, chan, at in theirs if schema
    ]
    for mine, (schema, channel, theirs_) in zip(ours, theirs, strict=True):
        decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
        assert decode is not None
        assert same_message(mine, decode(theirs_.data))


def same_message(mine: LogMessage, theirs: Any) -> bool:
    """Whether we read of a message what the reference library does."""
    kind = mine.channel.encoding, mine.channel.schema
    if kind in CAMERAS:
        found = read_camera_message(*kind, mine.data)
        wanted = (theirs.width, theirs.height, theirs.distortion_model, *map(tuple, (theirs.d, theirs.k, theirs.p)))
        info = found.info
        stated = (info.width, info.height, info.distortion_model, info.d, info.k, info.p)
        return (found.frame_id, stated) == (theirs.header.frame_id, wanted)
    picture = read_picture_message(*kind, mine.data)
    stamp_ns = theirs.header.stamp.sec * 10**9 + theirs.header.stamp.nanosec
    said = (picture.stamp_ns, picture.frame_id, bytes(picture.data))
    return said == (stamp_ns, theirs.header.frame_id, bytes(theirs.data))


def test_numbers_of_lost_messages_leave_a_gap_and_zeros_are_counted_on(tmp_path: Path) -> None:
    for numbers, wanted in ([0, 1, 5, 6], [0, 1, 5, 6]), ([0, 0, 0, 0], [0, 1, 2, 3]), ([7, 7, 3, 9], [7, 8, 9, 10]):
        with ros_log(tmp_path / "log.mcap") as log:
            for i, number in enumerate(numbers):
                message = compressed(flat(9, 9, 9), START_NS + i * PERIOD_NS)
                log.say(TOPIC, COMPRESSED, message, sequence=number)
        assert [frame.seq for frame in McapLog(tmp_path / "log.mcap").frames()] == wanted


def test_without_stamps_in_the_pictures_the_time_of_sending_counts(tmp_path: Path) -> None:
    with ros_log(tmp_path / "log.mcap") as log:
        for i in range(4):
            log.say(TOPIC, COMPRESSED, compressed(flat(9, 9, 9), 0), log_ns=START_NS + i * PERIOD_NS)
    source = McapLog(tmp_path / "log.mcap")
    assert [frame.stamp_ns for frame in source.frames()] == [START_NS + i * PERIOD_NS for i in range(4)]
    assert source.info.stamp_uncertainty_us == pytest.approx(1e5)


@pytest.mark.parametrize(
    ("format_", "as_coded"),
    [
        ("jpeg", COLOUR),
        ("bgr8; jpeg compressed bgr8", COLOUR),
        ("rgb8; jpeg compressed bgr8", COLOUR),
        ("bgr8; png compressed bgr8", COLOUR),
        ("rgb8; jpeg compressed rgb8", COLOUR[::-1]),  # the coder was handed RGB and took it for BGR
    ],
)
def test_red_stays_red_in_compressed_pictures(format_: str, as_coded: tuple[int, int, int], tmp_path: Path) -> None:
    with ros_log(tmp_path / "log.mcap") as log:
        for i in range(2):
            log.say(TOPIC, COMPRESSED, compressed(flat(*as_coded), START_NS + i * PERIOD_NS, format_))
    assert all(near(frame.image) for frame in McapLog(tmp_path / "log.mcap").frames())


def packed(encoding: str, colour: tuple[int, int, int]) -> tuple[bytes, int]:
    """A flat picture of WIDTH x HEIGHT in a raw layout, and its bytes a row: from the definitions, not from OpenCV."""
    red, green, blue = colour
    luma = 16 + 0.257 * red + 0.504 * green + 0.098 * blue
    u, v = 128 - 0.148 * red - 0.291 * green + 0.439 * blue, 128 + 0.439 * red - 0.368 * green - 0.071 * blue
    y, u, v = round(luma), round(u), round(v)
    cells = {
        "rgb8": [red, green, blue],
        "bgr8": [blue, green, red],
        "rgba8": [red, green, blue, 255],
        "bgra8": [blue, green, red, 255],
        "8UC3": [blue, green, red],
    }
    pairs = {"yuv422": [u, y, v, y], "uyvy": [u, y, v, y], "yuv422_yuy2": [y, u, y, v], "yuyv": [y, u, y, v]}
    mosaics = {
        "bayer_rggb8": [[red, green], [green, blue]],
        "bayer_bggr8": [[blue, green], [green, red]],
        "bayer_gbrg8": [[green, blue], [red, green]],
        "bayer_grbg8": [[green, red], [blue, green]],
    }
    if encoding in cells:
        return bytes(cells[encoding]) * (WIDTH * HEIGHT), WIDTH * len(cells[encoding])
    if encoding in pairs:
        return bytes(pairs[encoding]) * (WIDTH * HEIGHT // 2), WIDTH * 2
    if encoding in mosaics:
        return np.tile(np.array(mosaics[encoding], np.uint8), (HEIGHT // 2, WIDTH // 2)).tobytes(), WIDTH
    chroma = [u, v] if encoding == "nv12" else [v, u]
    return bytes([y]) * (WIDTH * HEIGHT) + bytes(chroma) * (WIDTH * HEIGHT // 4), WIDTH


PLAIN = ["rgb8", "bgr8", "rgba8", "bgra8", "8UC3", "yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21"]
MOSAICS = ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"]


@pytest.mark.parametrize("encoding", [*PLAIN, *MOSAICS])
def test_red_stays_red_in_every_raw_layout(encoding: str, tmp_path: Path) -> None:
    data, step = packed(encoding, COLOUR)
    messages = [raw(data, WIDTH, HEIGHT, encoding, step, START_NS + i * PERIOD_NS) for i in range(2)]
    source = McapLog(write_raw(tmp_path / "log.mcap", messages))
    assert source.info.codec == encoding
    for frame in source.frames():
        assert frame.image.shape == (HEIGHT, WIDTH, 3)
        assert near(frame.image[2:-2, 2:-2])


def test_padding_at_the_end_of_rows_is_left_out(tmp_path: Path) -> None:
    image = noisy(1)[0]
    padded = np.zeros((HEIGHT, WIDTH * 3 + 20), np.uint8)
    padded[:, : WIDTH * 3] = image.reshape(HEIGHT, -1)
    messages = [
        raw(padded.tobytes(), WIDTH, HEIGHT, "rgb8", WIDTH * 3 + 20, START_NS + i * PERIOD_NS) for i in range(2)
    ]
    for frame in McapLog(write_raw(tmp_path / "log.mcap", messages)).frames():
        np.testing.assert_array_equal(frame.image, image)


def test_grey_pictures_become_grey_rgb(tmp_path: Path) -> None:
    grey = noisy(1)[0][:, :, 0]
    messages = [raw(grey.tobytes(), WIDTH, HEIGHT, "mono8", WIDTH, START_NS + i * PERIOD_NS) for i in range(2)]
    for frame in McapLog(write_raw(tmp_path / "log.mcap", messages)).frames():
        np.testing.assert_array_equal(frame.image, np.repeat(grey[:, :, None], 3, axis=2))


def foxglove_pictures(count: int) -> list[CompressedImage]:
    messages = [CompressedImage(frame_id="cam", data=coded(flat(*COLOUR)), format="jpeg") for _ in range(count)]
    for i, message in enumerate(messages):
        stamped(message, START_NS + i * PERIOD_NS)
    return messages


@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda each: each.name)
def test_foxglove_pictures_are_read_with_their_stamps_and_calibration(
    compression: CompressionType, tmp_path: Path
) -> None:
    camera = CameraCalibration(
        frame_id="cam", width=WIDTH, height=HEIGHT, distortion_model="plumb_bob", D=[-0.1, 0.01, 0.0, 0.0, 0.0],
        K=[60.0, 0.0, 32.0, 0.0, 61.0, 24.0, 0.0, 0.0, 1.0],
    )  # fmt: skip
    drawn = [camera, *foxglove_pictures(4)]
    source = McapLog(write_foxglove(tmp_path / "log.mcap", drawn, compression=compression))
    frames = list(source.frames())
    assert [frame.stamp_ns for frame in frames] == [START_NS + i * PERIOD_NS for i in range(4)]
    assert all(near(frame.image) for frame in frames)
    lens = source.info.lens
    assert lens is not None
    assert (lens.fx, lens.fy, lens.cx, lens.coefficients) == (60.0, 61.0, 32.0, (-0.1, 0.01, 0.0, 0.0, 0.0))


def test_raw_foxglove_pictures_are_read(tmp_path: Path) -> None:
    data, step = packed("bgr8", COLOUR)
    messages = [RawImage(width=WIDTH, height=HEIGHT, encoding="bgr8", step=step, data=data) for _ in range(3)]
    for i, message in enumerate(messages):
        stamped(message, START_NS + i * PERIOD_NS)
    frames = list(McapLog(write_foxglove(tmp_path / "log.mcap", messages)).frames())
    assert len(frames) == 3
    assert all(near(frame.image, tolerance=0) for frame in frames)


# --- playing -----------------------------------------------------------------------------------------------------


def test_a_looped_log_keeps_counting(tmp_path: Path) -> None:
    frames = list(islice(McapLog(write_log(tmp_path / "log.mcap", ramp(5)), loop=True).frames(), 12))
    assert [frame.seq for frame in frames] == list(range(12))
    np.testing.assert_allclose(np.diff([frame.stamp_ns for frame in frames]), PERIOD_NS)
    np.testing.assert_array_equal(frames[7].image, frames[2].image)


def test_realtime_takes_as_long_as_the_recording_but_skips_long_holes(tmp_path: Path) -> None:
    stamps = [0, PERIOD_NS, PERIOD_NS + 3600 * 10**9, 2 * PERIOD_NS + 3600 * 10**9, 0, PERIOD_NS]
    with ros_log(tmp_path / "log.mcap") as log:
        for stamp in stamps:
            log.say(TOPIC, COMPRESSED, compressed(flat(9, 9, 9), START_NS + stamp))
    begin = time.monotonic()
    frames = list(McapLog(tmp_path / "log.mcap", pace="realtime").frames())
    assert [frame.stamp_ns - START_NS for frame in frames] == stamps
    assert 0.29 <= time.monotonic() - begin < 60


def test_closing_ends_the_wait_for_a_frame(tmp_path: Path) -> None:
    source = McapLog(write_log(tmp_path / "log.mcap", ramp(40)), pace="realtime")
    seen: list[int] = []
    reader = threading.Thread(target=lambda: seen.extend(frame.seq for frame in source.frames()), daemon=True)
    reader.start()
    time.sleep(0.15)
    source.close()
    source.close()
    reader.join(timeout=5.0)
    assert not reader.is_alive()
    assert len(seen) < 40
    assert list(source.frames()) == []


def test_a_launch_file_can_name_a_log_and_its_topic(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", ramp(3))
    source = open_source(SourceConfig(kind="mcap", path=str(path), topic=TOPIC, pace="lockstep"))
    assert len(list(source.frames())) == 3
    with pytest.raises(ConfigError, match="leave fps out"):
        open_source(SourceConfig(kind="mcap", path=str(path), fps=10.0))


# --- which topic -------------------------------------------------------------------------------------------------


def two_cameras(path: Path) -> Path:
    with ros_log(path) as log:
        for i in range(4):
            log.say("/front/image", COMPRESSED, compressed(flat(200, 0, 0), START_NS + i * PERIOD_NS))
            log.say("/rear/image", COMPRESSED, compressed(flat(0, 0, 200), START_NS + i * PERIOD_NS))
            log.say("/words", "std_msgs/msg/String", {"data": "hello"})
    return path


def test_of_several_topics_one_must_be_named(tmp_path: Path) -> None:
    path = two_cameras(tmp_path / "log.mcap")
    with pytest.raises(SourceError, match="2 topics, /front/image, /rear/image: say which"):
        McapLog(path)
    assert near(next(McapLog(path, topic="/rear/image").frames()).image, (0, 0, 200))
    with pytest.raises(SourceError, match=r"no pictures on the topic '/words'; it has pictures on /front/image"):
        McapLog(path, topic="/words")


def test_maps_of_depths_are_not_taken_for_pictures(tmp_path: Path) -> None:
    with ros_log(tmp_path / "log.mcap") as log:
        for i in range(3):
            depth = raw(bytes(WIDTH * HEIGHT * 2), WIDTH, HEIGHT, "16UC1", WIDTH * 2, START_NS + i)
            log.say("/depth/image_raw", IMAGE, depth)
            coded_depth = compressed(flat(9, 9, 9), START_NS + i, "16UC1; compressedDepth png")
            log.say("/depth/image_raw/compressedDepth", COMPRESSED, coded_depth)
            log.say("/color/image", COMPRESSED, compressed(flat(*COLOUR), START_NS + i * PERIOD_NS))
    assert McapLog(tmp_path / "log.mcap").topic == "/color/image"
    with pytest.raises(SourceError, match="'16UC1' are not read; known are rgb8"):
        McapLog(tmp_path / "log.mcap", topic="/depth/image_raw")


def test_a_log_without_pictures_says_what_it_holds(tmp_path: Path) -> None:
    with ros_log(tmp_path / "log.mcap") as log:
        log.say("/words", "std_msgs/msg/String", {"data": "hello"})
    with pytest.raises(SourceError, match=r"topics are /words \(std_msgs/msg/String, cdr\); readable are sensor_msgs"):
        McapLog(tmp_path / "log.mcap")


def test_pictures_that_begin_late_are_found(tmp_path: Path) -> None:
    with ros_log(tmp_path / "log.mcap") as log:
        for _ in range(100):
            log.say("/words", "std_msgs/msg/String", {"data": "hello"})
        for i in range(3):
            log.say(TOPIC, COMPRESSED, compressed(flat(*COLOUR), START_NS + i * PERIOD_NS))
    assert McapLog(tmp_path / "log.mcap").topic == TOPIC


def test_one_picture_is_too_short(tmp_path: Path) -> None:
    with pytest.raises(TooShortError, match="TOO_SHORT n=1"):
        McapLog(write_log(tmp_path / "log.mcap", ramp(1)))


# --- calibration -------------------------------------------------------------------------------------------------


def with_info(path: Path, topic: str, info_topic: str, info: dict[str, object]) -> McapLog:
    with ros_log(path) as log:
        log.say(info_topic, INFO, info)
        for i in range(3):
            log.say(topic, COMPRESSED, compressed(flat(9, 9, 9), START_NS + i * PERIOD_NS))
    return McapLog(path)


@pytest.mark.parametrize(
    ("topic", "info_topic", "frame_id"),
    [
        ("/front/image_raw/compressed", "/front/camera_info", "x"),
        ("/front/image_raw/compressed", "/front/image_raw/camera_info", "x"),
        ("/image", "/camera_info", "x"),
        ("/front/image", "/calibrations/front", "front_optical"),
    ],
)
def test_the_calibration_that_belongs_to_the_pictures_is_found(
    topic: str, info_topic: str, frame_id: str, tmp_path: Path
) -> None:
    info = camera_info(WIDTH, HEIGHT, frame_id=frame_id)
    lens = with_info(tmp_path / "log.mcap", topic, info_topic, info).info.lens
    assert lens is not None
    assert (lens.width, lens.height, lens.fx, lens.fy) == (WIDTH, HEIGHT, 60.0, 61.0)
    assert (lens.distortion, lens.coefficients) == ("plumb_bob", (-0.1, 0.01, 0.001, 0.002, 0.0))


def test_the_calibration_of_another_camera_is_not_used(tmp_path: Path) -> None:
    info = camera_info(WIDTH, HEIGHT, frame_id="rear_optical")
    assert with_info(tmp_path / "log.mcap", "/front/image", "/rear/camera_info", info).info.lens is None


def test_rectified_pictures_have_no_distortion_left(tmp_path: Path) -> None:
    info = camera_info(WIDTH, HEIGHT)
    lens = with_info(tmp_path / "log.mcap", "/front/image_rect_color", "/front/camera_info", info).info.lens
    assert lens is not None
    assert (lens.fx, lens.fy, lens.distortion) == (55.0, 56.0, "none")


def test_a_calibration_for_twice_the_size_is_scaled(tmp_path: Path) -> None:
    info = camera_info(2 * WIDTH, 2 * HEIGHT, focal=120.0)
    lens = with_info(tmp_path / "log.mcap", "/front/image", "/front/camera_info", info).info.lens
    assert lens is not None
    assert (lens.width, lens.fx, lens.cx) == (WIDTH, 60.0, pytest.approx((WIDTH + 0.5) / 2 - 0.5))


@pytest.mark.parametrize(
    "info",
    [camera_info(100, 100), camera_info(WIDTH, HEIGHT, model="magic"), camera_info(WIDTH, HEIGHT, d=[0.1] * 7)],
    ids=["shape", "model", "count"],
)
def test_a_calibration_that_does_not_fit_is_left_out_and_said(
    info: dict[str, object], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        source = with_info(tmp_path / "log.mcap", "/front/image", "/front/camera_info", info)
    assert source.info.lens is None
    assert "State calibration or hfov_deg" in caplog.text


# --- damage ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda each: each.name)
@pytest.mark.parametrize("chunk_size", [1 << 13, 1 << 24], ids=["small", "single"])
def test_an_unfinished_log_plays_to_its_last_whole_message(
    compression: CompressionType, chunk_size: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_log(tmp_path / "log.mcap", noisy(60), compression=compression, chunk_size=chunk_size)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = McapLog(path)
    frames = list(source.frames())
    assert 20 <= len(frames) <= 33
    assert [frame.stamp_ns for frame in frames] == [START_NS + i * PERIOD_NS for i in range(len(frames))]
    assert "last whole message" in caplog.text
    assert source.corrupt == 0


def test_a_log_nobody_finished_is_read(tmp_path: Path) -> None:
    with ros_log(tmp_path / "log.mcap", chunk_size=1 << 12, finish=False) as log:
        for i, image in enumerate(noisy(20)):
            log.say(TOPIC, COMPRESSED, compressed(image, START_NS + i * PERIOD_NS))
    assert len(list(McapLog(tmp_path / "log.mcap").frames())) >= 15


def test_a_finished_log_is_whole(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        list(McapLog(write_log(tmp_path / "log.mcap", ramp(3))).frames())
    assert caplog.text == ""


def test_damaged_pictures_are_counted_and_left_out(tmp_path: Path) -> None:
    bad = [b"", b"\xff\xd8\xff nothing", coded(flat(1, 2, 3))[:200], b"GIF89a" + bytes(99)]
    with ros_log(tmp_path / "log.mcap") as log:
        for i in range(8):
            message = compressed(flat(*COLOUR), START_NS + i * PERIOD_NS)
            log.say(TOPIC, COMPRESSED, message if i % 2 else message | {"data": bad[i // 2]}, sequence=i)
    source = McapLog(tmp_path / "log.mcap")
    assert [frame.seq for frame in source.frames()] == [1, 3, 5, 7]
    assert source.corrupt == 4


def test_a_damaged_chunk_is_left_out_whole(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", noisy(30), compression=CompressionType.NONE, chunk_size=1 << 14)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    source = McapLog(path)
    stamps = [(frame.stamp_ns - START_NS) // PERIOD_NS for frame in source.frames()]
    assert source.corrupt == 1
    assert stamps == sorted(stamps)
    assert 24 <= len(stamps) < 30


def test_a_picture_that_would_fill_the_memory_is_refused_before_it_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = coded(flat(1, 2, 3))
    at = good.index(b"\xff\xc0") + 5
    bomb = good[:at] + struct.pack(">HH", 65000, 65000) + good[at + 4 :]
    with ros_log(tmp_path / "log.mcap") as log:
        for i in range(3):
            log.say(TOPIC, COMPRESSED, compressed(flat(1, 2, 3), START_NS + i) | {"data": bomb})
    monkeypatch.setattr(cv2, "imdecode", None)  # to call it would be an error of another kind
    with pytest.raises(SourceError, match="65000 x 65000 pixels"):
        McapLog(tmp_path / "log.mcap")


def test_a_chunk_that_would_fill_the_memory_is_not_unfolded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_log(tmp_path / "log.mcap", ramp(20), chunk_size=1 << 24)
    monkeypatch.setattr(mcap_container, "MAX_BYTES", 5000)
    with pytest.raises(SourceError, match="holds no pictures"):
        McapLog(path)
    assert "more than 5000" in caplog.text


def test_names_and_metadata_that_unfold_to_gigabytes_are_not_kept(tmp_path: Path) -> None:
    long = length_of(b"a" * 2000)
    pairs = length_of(b"key") + length_of(b"a" * 70_000)
    schema = struct.pack("<H", 1) + long + bytes(8)
    channel = struct.pack("<HH", 2, 0) + long + length_of(b"cdr") + bytes(4)
    beep = struct.pack("<HH", 3, 0) + length_of(b"/beep\x07") + length_of(b"cdr") + bytes(4)
    metadata = length_of(b"name") + length_of(pairs)
    hidden = length_of(b"hidden") + length_of(length_of(b"key") + length_of(b"value"))
    inside = record(3, schema) + record(4, channel) + record(4, beep) + record(12, hidden)
    chunk = struct.pack("<QQQI", 0, 0, len(inside), 0) + length_of(b"") + struct.pack("<Q", len(inside)) + inside
    (tmp_path / "log.mcap").write_bytes(MAGIC + record(12, metadata) + record(6, chunk) + record(15, bytes(4)))
    container = McapContainer(tmp_path / "log.mcap")
    assert list(container.messages()) == []
    assert container.whole
    assert not container.channels
    assert not container.metadata


def test_a_chunk_of_nothing_is_not_counted_through(tmp_path: Path) -> None:
    inside = bytes(9) + record(4, struct.pack("<HH", 1, 0) + length_of(b"/late") + length_of(b"cdr") + bytes(4))
    chunk = struct.pack("<QQQI", 0, 0, len(inside), 0) + length_of(b"") + struct.pack("<Q", len(inside)) + inside
    (tmp_path / "log.mcap").write_bytes(MAGIC + record(6, chunk) + record(15, bytes(4)))
    container = McapContainer(tmp_path / "log.mcap")
    assert list(container.messages()) == []
    assert not container.channels


def test_a_chunk_that_lies_about_its_size_is_left_out() -> None:
    import zstandard

    folded = zstandard.ZstdCompressor().compress(bytes(50_000))
    fields = struct.pack("<QQQI", 0, 0, 1000, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(folded))
    records = mcap_container.unfolded(memoryview(fields + folded), cut=False)
    assert len(records) == 1000  # never more than it states
    fields = struct.pack("<QQQI", 0, 0, 60_000, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(folded))
    with pytest.raises(SourceError, match=r"states 60000 bytes and holds 50000"):
        mcap_container.unfolded(memoryview(fields + folded), cut=False)


def test_what_is_no_log_is_refused_in_one_line(tmp_path: Path) -> None:
    cases = {
        "empty.mcap": (b"", "is empty"),
        "junk.mcap": (b"\x07" * 500, "is not an MCAP log"),
        "old.bag": (b"#ROSBAG V2.0\n" + bytes(99), "mcap convert"),
        "log.db3": (b"SQLite format 3\0" + bytes(99), "ros2 bag convert"),
        "head.mcap": (MAGIC, "holds no pictures; its topics are none"),
    }
    for name, (content, words) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SourceError, match=words) as caught:
            McapLog(tmp_path / name)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(SourceError, match=r"is a folder; give the \.mcap file in it: empty\.mcap, head\.mcap"):
        McapLog(tmp_path)
    with pytest.raises(SourceError, match="no such log"):
        McapLog(tmp_path / "none.mcap")


def test_a_log_that_vanishes_between_loops_is_lost(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", ramp(3))
    frames = McapLog(path, loop=True).frames()
    list(islice(frames, 3))
    path.unlink()
    with pytest.raises(SourceError, match="no such log"):
        list(frames)


def mutation_seeds(folder: Path) -> list[bytes]:
    """Without checksums, what is damaged inside a chunk reaches the readers of messages; one of them has some."""
    small, none = [image[:16, :16] for image in ramp(4)], CompressionType.NONE
    seeds = [write_log(folder / "a.mcap", small, compression=none).read_bytes()]
    for kind in CompressionType:
        seeds.append(write_log(folder / "a.mcap", small, compression=kind, checked=False).read_bytes())
    camera = CameraCalibration(width=16, height=16, K=[9.0, 0, 8, 0, 9.0, 8, 0, 0, 1.0], D=[0.1] * 5)
    drawn = [camera, *foxglove_pictures(3)]
    seeds.append(write_foxglove(folder / "b.mcap", drawn, compression=none, checked=False).read_bytes())
    with ros_log(folder / "c.mcap", compression=none, checked=False) as log:
        log.say("/camera_info", INFO, camera_info(8, 8))
        for i in range(3):
            log.say("/image", IMAGE, raw(bytes(8 * 8 * 3), 8, 8, "bgr8", 24, START_NS + i * PERIOD_NS))
    return [*seeds, (folder / "c.mcap").read_bytes()]


@pytest.mark.timeout(max(120, ROUNDS // 10))
def test_mutated_logs_end_as_frames_or_source_errors(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR, "gcd_node")  # pytest would keep every line
    path = tmp_path / "mutated.mcap"

    def play(part: bytes) -> str:
        path.write_bytes(part)
        log = McapLog(path)
        for frame in islice(log.frames(), 50):
            assert 0 <= frame.stamp_ns < 2**63
        return "damaged" if log.corrupt else "whole"

    ended = outcomes(play, Mutator(4, mutation_seeds(tmp_path), BYTE_PIECES), SourceError)
    assert min(ended["refused"], ended["damaged"], ended["whole"]) > ROUNDS // 100


# --- what is needed ----------------------------------------------------------------------------------------------


def test_uncompressed_logs_need_no_library_and_compressed_ones_name_the_extra(tmp_path: Path) -> None:
    plain = write_log(tmp_path / "plain.mcap", ramp(3), compression=CompressionType.NONE)
    zstd = write_log(tmp_path / "zstd.mcap", ramp(3))
    code = (
        "import sys\n"
        "for name in ('mcap', 'mcap_ros2', 'zstandard', 'lz4', 'lz4.frame', 'google.protobuf'):\n"
        "    sys.modules[name] = None\n"
        "from pathlib import Path\n"
        "from gcd_node.sources.mcap_log import McapLog\n"
        "print(len(list(McapLog(Path(sys.argv[1])).frames())))\n"
        "try: McapLog(Path(sys.argv[2]))\n"
        "except Exception as error: print(type(error).__name__, error)\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", code, str(plain), str(zstd)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, env=environment)
    lines = done.stdout.splitlines()
    assert lines[0] == "3"
    assert lines[1].startswith("SourceError")
    assert "pip install 'gcd-node[record]'" in lines[1]


def test_messages_of_unknown_channels_and_private_records_are_passed_over(tmp_path: Path) -> None:
    out = io.BytesIO()
    out.write(MAGIC)
    out.write(record(0x80, b"private"))
    out.write(record(5, struct.pack("<HIQQ", 9, 0, 1, 1) + b"data"))
    out.write(record(15, bytes(4)))
    (tmp_path / "log.mcap").write_bytes(out.getvalue())
    container = McapContainer(tmp_path / "log.mcap")
    assert list(container.messages()) == []
    assert container.whole
