"""Robot logs: what the reference libraries write is read back exactly."""

import struct
import time
from contextlib import nullcontext
from fractions import Fraction
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import zstandard
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from mcap.writer import CompressionType
from media import HEIGHT, WIDTH, flat, ramp
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
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from gcd_node.errors import SourceError, TooShortError
from gcd_node.frame import Frame, Image
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


def test_a_bag_that_was_packed_whole_is_to_be_unpacked(tmp_path: Path) -> None:
    sent = [(TOPIC, compressed(BLACK, at(i))) for i in range(2)]
    path = write_bag(tmp_path / "bag", sent, compression=CompressionMode.FILE)
    with pytest.raises(SourceError, match="zstd -d"):
        LogSource(path)
    (packed,) = path.glob("*.zstd")
    (path / packed.stem).write_bytes(zstandard.ZstdDecompressor().decompressobj().decompress(packed.read_bytes()))
    assert len(list(LogSource(path).frames())) == 2


def test_the_split_files_of_a_bag_are_played_by_their_numbers(tmp_path: Path) -> None:
    for part, name in enumerate(["bag_0.mcap", "bag_1.mcap", "bag_10.mcap"]):
        of_pictures(tmp_path / name, [compressed(BLACK, at(2 * part + i)) for i in range(2)])
    (tmp_path / "bag_2.mcap").write_bytes(b"")  # a recorder was killed before it wrote
    assert stamps(list(LogSource(tmp_path).frames())) == [at(i) for i in range(6)]


def test_numbers_rise_and_without_stamps_the_time_of_sending_counts(tmp_path: Path) -> None:
    with ros_log(tmp_path / "log.mcap") as say:
        for i, number in enumerate([0, 1, 5, 3, 0]):  # two were lost; a recorder began again
            say(TOPIC, *compressed(BLACK, 0), log_ns=at(i), sequence=number)
    source = LogSource(tmp_path / "log.mcap")
    played = enumerate([0, 1, 5, 6, 7])
    assert [(frame.seq, frame.stamp_ns) for frame in source.frames()] == [(number, at(i)) for i, number in played]
    assert source.info.stamp_uncertainty_us == pytest.approx(1e5)


def test_realtime_takes_as_long_as_the_recording_but_skips_long_holes(tmp_path: Path) -> None:
    periods = [0, 1, 36_001, 36_002, 0, 1]
    of_pictures(tmp_path / "log.mcap", [compressed(BLACK, at(i)) for i in periods])
    begin = time.monotonic()
    frames = list(LogSource(tmp_path / "log.mcap", pace="realtime").frames())
    assert stamps(frames) == [at(i) for i in periods]
    assert 0.29 <= time.monotonic() - begin < 60


# --- what pictures look like -------------------------------------------------------------------------------------


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


def test_red_stays_red_in_every_layout(tmp_path: Path) -> None:
    for encoding, rows in LAYOUTS.items():
        pictures = [raw(rows, encoding, at(i), width=WIDTH, height=HEIGHT) for i in range(2)]
        source = of_pictures(tmp_path / "log.mcap", pictures)
        assert source.info.codec == encoding
        assert all(near(frame.image[2:-2, 2:-2]) for frame in source.frames())
    swapped = "rgb8; jpeg compressed rgb8"  # the coder was handed RGB and took it for BGR
    for format_ in ("jpeg", "rgb8; jpeg compressed bgr8", "bgr8; png compressed bgr8", swapped):
        colour = flat(*COLOUR[::-1] if format_ == swapped else COLOUR)
        source = of_pictures(tmp_path / "log.mcap", [compressed(colour, at(i), format_) for i in range(2)])
        assert all(near(frame.image) for frame in source.frames())


def test_padding_at_the_end_of_rows_is_left_out_and_grey_becomes_rgb(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    padded, grey = np.pad(image.reshape(HEIGHT, -1), ((0, 0), (0, 20))), np.ascontiguousarray(image[:, :, 0])
    pictures = [raw(padded, "rgb8", at(i), width=WIDTH) for i in range(2)] + [raw(grey, "mono8", at(2))]
    frames = list(of_pictures(tmp_path / "log.mcap", pictures).frames())
    np.testing.assert_array_equal(frames[0].image, image)
    np.testing.assert_array_equal(frames[2].image, np.repeat(grey[:, :, None], 3, axis=2))


def test_foxglove_pictures_are_read_with_their_stamps_and_calibration(tmp_path: Path) -> None:
    k, d = [60.0, 0.0, 32.0, 0.0, 61.0, 24.0, 0.0, 0.0, 1.0], [-0.1, 0.01, 0.0, 0.0, 0.0]
    camera = CameraCalibration(width=WIDTH, height=HEIGHT, distortion_model="plumb_bob", D=d, K=k)
    pictures = [foxglove(CompressedImage, at(i), coded(flat(*COLOUR))) for i in range(4)]
    source = LogSource(write_foxglove(tmp_path / "log.mcap", [camera, *pictures]))
    frames, lens = list(source.frames()), source.info.lens
    assert stamps(frames) == [at(i) for i in range(4)]
    assert all(near(frame.image) for frame in frames)
    assert lens is not None
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


# --- depth and odometry ------------------------------------------------------------------------------------------


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
        assert frame.depth is not None
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
        assert found is not None
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
        assert world_from_camera is not None
        np.testing.assert_allclose(world_from_camera[:3, 3], (i, 2.5, 0), atol=1e-9)  # 2.5 m ahead, turned to the left
        np.testing.assert_allclose(world_from_camera[:3, 2], (0, 1, 0), atol=1e-9)  # and looking there
        np.testing.assert_allclose(world_from_camera[:3, 1], (0, 0, -1), atol=1e-9)
    assert poses[3] is None


# --- what is found -----------------------------------------------------------------------------------------------


def test_of_several_topics_one_must_be_named(tmp_path: Path) -> None:
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


def test_pictures_that_begin_late_are_found_and_one_is_too_few(tmp_path: Path) -> None:
    for count, error in ((0, SourceError), (1, TooShortError), (3, None)):
        with ros_log(tmp_path / "log.mcap") as say:
            for _ in range(100):
                say("/words", *WORDS)
            for i in range(count):
                say(TOPIC, *compressed(BLACK, at(i)))
        with nullcontext() if error is None else pytest.raises(error):
            assert LogSource(tmp_path / "log.mcap").topic == TOPIC


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
