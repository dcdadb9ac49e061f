"""Recordings: what each kind gives and refuses; what all sources have in common: test_source_conformance.py."""

import logging
import struct
import subprocess
import sys
import time
import zlib
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from media import HEIGHT, WIDTH, environment, flat, ramp, write_pictures, write_video

from gcd_node.errors import SourceError
from gcd_node.sources import resolve_path
from gcd_node.sources.files import ImageFolder, MovingPattern, VideoFile, list_pictures, read_picture, rising_stamp_ns
from gcd_node.window import WindowBuilder

COUNT = 12


@pytest.mark.parametrize("suffix", ["mp4", "avi", "mkv", "webm"])
def test_every_container_is_read_with_its_stamps(suffix: str, tmp_path: Path) -> None:
    video = VideoFile(write_video(tmp_path / f"clip.{suffix}", ramp(COUNT)))
    steps_s = np.diff([frame.stamp_ns for frame in video.frames()]) / 1e9
    assert video.info.fps_nominal == pytest.approx(10.0)
    np.testing.assert_allclose(steps_s, [0.1] * (COUNT - 1), atol=2e-3)


@pytest.mark.parametrize("suffix", ["png", "bmp", "tiff", "webp", "jpg"])
def test_red_stays_red_through_every_picture_format(suffix: str, tmp_path: Path) -> None:
    folder = write_pictures(tmp_path, {f"red.{suffix}": flat(250, 10, 20)})
    image = read_picture(folder / f"red.{suffix}")
    tolerance = 6 if suffix in {"jpg", "webp"} else 0
    assert np.abs(image.astype(int) - (250, 10, 20)).max() <= tolerance


def test_a_raw_stream_without_stamps_is_counted_at_its_rate(tmp_path: Path) -> None:
    coded = write_video(tmp_path / "clip.avi", ramp(8), fps=25.0).read_bytes()
    pictures = [b"\xff\xd8\xff" + part for part in coded.split(b"\xff\xd8\xff")[1:]]
    (tmp_path / "raw.mjpeg").write_bytes(b"".join(picture[: picture.rindex(b"\xff\xd9") + 2] for picture in pictures))
    stamps = [frame.stamp_ns for frame in VideoFile(tmp_path / "raw.mjpeg", fps=20.0).frames()]
    assert stamps == [50_000_000 * i for i in range(8)]


@pytest.mark.parametrize(
    ("stated_ms", "wanted_ms"),
    [
        ([0, 0, 0, 0], [0, 100, 200, 300]),  # a raw stream
        ([0, 41.7, 166.7, 208.4], [0, 41.7, 166.7, 208.4]),  # a variable rate
        ([80, 180, 280], [80, 180, 280]),  # begins late
        ([0, 100, 90, 300], [0, 100, 200, 300]),  # one step back
        ([0, 100, 9e12, 9e12 + 100], [0, 100, 200, 300]),  # a leap
        ([float("nan"), -5, 200], [0, 100, 200]),
        ([-9.2e18, 100, 200], [0, 100, 200]),
    ],
)
def test_stamps_rise_whatever_the_container_says(stated_ms: list[float], wanted_ms: list[float]) -> None:
    stamps: list[int] = []
    for ms in stated_ms:
        stamps.append(rising_stamp_ns(ms, stamps[-1] if stamps else None, 100_000_000))
    assert [stamp / 1e6 for stamp in stamps] == pytest.approx(wanted_ms)


def test_a_looped_video_keeps_counting_and_each_pass_is_another_epoch(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mkv", ramp(5))
    frames = list(islice(VideoFile(path, loop=True).frames(), 12))
    assert [frame.seq for frame in frames] == list(range(12))
    steps_ms = np.diff([frame.stamp_ns for frame in frames]) / 1e6
    np.testing.assert_allclose(np.delete(steps_ms, [4, 9]), 100.0, atol=1.0)
    np.testing.assert_array_equal(frames[7].image, frames[2].image)
    for length in (1, 14):
        builder = WindowBuilder(frames=length, fps=10.0)
        for frame in frames:
            builder.push(frame, frame.seq * 100_000_000)
        assert builder.epoch == 2


def test_a_looped_recording_plays_on_at_its_pace() -> None:
    arrivals: list[float] = []
    for _ in islice(MovingPattern(fps=10.0, frames=2, pace="realtime", loop=True).frames(), 6):
        arrivals.append(time.monotonic())
    assert 0.4 < arrivals[-1] - arrivals[0] < 5


def test_a_video_cut_short_gives_what_is_left_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (30, HEIGHT, WIDTH, 3), np.uint8)
    path = write_video(tmp_path / "clip.mkv", list(noise))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with caplog.at_level(logging.WARNING):
        count = len(list(VideoFile(path).frames()))
    assert 5 < count < 25
    assert "truncated" in caplog.text


def test_a_bad_video_is_refused_in_one_line_when_it_is_opened(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "whole.mp4", ramp(10)).read_bytes()
    data_at = whole.index(b"mdat") + 4
    data_end = data_at - 8 + int.from_bytes(whole[data_at - 8 : data_at - 4], "big")
    write_video(tmp_path / "good.mkv", ramp(3))
    contents = {
        "empty.mp4": b"",
        "junk.mp4": b"\x07" * 5000,
        "letters.txt": b"Dear video player,\n" * 400,
        "playlist.m3u8": b"#EXTM3U\n#EXTINF:1,\ngood.mkv\n",
        "truncated.mp4": whole[: len(whole) // 2],
        "head.mkv": b"\x1a\x45\xdf\xa3" + b"\0" * 400,
        "av1.mp4": cv2.imencode(".avif", ramp(3)[1])[1].tobytes(),
        "blank.mp4": whole[:data_at] + bytes(data_end - data_at) + whole[data_end:],
        "still.png": cv2.imencode(".png", flat(1, 2, 3))[1].tobytes(),
        "log.mcap": b"\x89MCAP0\r\n" + bytes(300),
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    for name in (*contents, "missing.mp4", ""):
        with pytest.raises(SourceError) as caught:
            VideoFile(tmp_path / name)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)
        assert caught.value.exit_code == 66


def test_the_decoder_itself_says_nothing(tmp_path: Path) -> None:
    (tmp_path / "head.mkv").write_bytes(b"\x1a\x45\xdf\xa3" + bytes(400))
    code = "from pathlib import Path; from gcd_node.sources.files import VideoFile; VideoFile(Path('head.mkv'))"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=tmp_path, env=environment())
    assert "SourceError" in done.stderr
    assert "EBML" not in done.stderr


def test_a_video_that_vanishes_between_loops_is_lost(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mkv", ramp(3))
    frames = VideoFile(path, loop=True).frames()
    list(islice(frames, 3))
    path.unlink()
    with pytest.raises(SourceError):
        list(frames)


def test_pictures_are_sorted_as_people_count(tmp_path: Path) -> None:
    names = ["b1.png", "a10.png", "a2.PNG", "a02b.jpg", "A1.png", ".hidden.png"]
    folder = write_pictures(tmp_path, {name.lower() if "hidden" in name else name: flat(0, 0, 0) for name in names})
    (folder / "notes.txt").write_text("not a picture")
    assert [path.name for path in list_pictures(folder)] == ["A1.png", "a2.PNG", "a02b.jpg", "a10.png", "b1.png"]


OTHER = cv2.imencode(".png", flat(0, 0, 0, width=60))[1].tobytes()


@pytest.mark.parametrize("content", [OTHER, OTHER[:60], OTHER[:20], b"x" * 99], ids=["other size", *"abc"])
def test_a_damaged_picture_or_one_of_another_size_is_named_when_it_comes(content: bytes, tmp_path: Path) -> None:
    folder = write_pictures(tmp_path, {f"{i}.png": flat(0, 0, 0) for i in range(3)})
    (folder / "1.png").write_bytes(content)
    with pytest.raises(SourceError, match=r"1\.png"):
        list(ImageFolder(folder, fps=10.0).frames())


def png_stating(width: int, height: int) -> bytes:
    """A small PNG whose header states any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")


def test_a_picture_that_would_fill_the_memory_is_refused_before_it_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    (tmp_path / "bomb.png").write_bytes(png_stating(12000, 12000))
    with pytest.raises(SourceError):
        read_picture(tmp_path / "bomb.png")


@pytest.mark.parametrize("name", ["package:none.mp4", "package:../errors.py", "package:"])
def test_only_packaged_files_are_found_under_package(name: str) -> None:
    with pytest.raises(SourceError):
        resolve_path(name)
