"""The contract of gcd_node.frame.FrameSource, one suite over every kind of source a launch file can name.

KINDS says how to open one of each kind that shows flat red, and how to silence it, MISSING one that is not there.
"""

import importlib.util
import logging
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import get_args

import cv2
import msgspec
import numpy as np
import pytest
import robot_logs
from cameras import (
    HEIGHT,
    WIDTH,
    FakeVideoCapture,
    environment,
    flat,
    pushing,
    ramp,
    serving,
    until,
    write_pictures,
    write_video,
)

from gcd_client import FramePusher
from gcd_node.errors import SourceAbsentError, SourceError
from gcd_node.frame import Frame, FrameSource
from gcd_node.sources import (
    LIVE_KINDS,
    FileSource,
    FolderSource,
    McapSource,
    OakSource,
    PushSource,
    RtspSource,
    SourceConfig,
    SourceKind,
    V4l2Source,
    open_source,
    resolve_path,
)
from gcd_node.sources.files import ImageFolder, MovingPattern, VideoFile, list_pictures, read_picture, rising_stamp_ns
from gcd_node.sources.opencv import open_v4l2
from gcd_node.window import WindowBuilder

COUNT = 12
COLOUR = (200, 60, 20)
RED = flat(*COLOUR)
OPEN_S = 20.0
GUARD_S = 30.0


Opened = tuple[FrameSource, Callable[[], None]]
"""A source, and what makes a live one silent."""


@contextmanager
def closing(source: FrameSource, hush: Callable[[], None] = lambda: None) -> Generator[Opened]:
    try:
        yield source, hush
    finally:
        source.close()


def open_recording(kind: SourceKind, folder: Path, slow: bool) -> AbstractContextManager[Opened]:
    """slow: a frame every 2 s, in real time; else 25 in a second of the recording, in lockstep."""
    pace, fps = ("realtime", 0.5) if slow else ("lockstep", 25.0)
    path = folder / ("in.mcap" if kind == "mcap" else "in.mkv")
    section = {"kind": kind, "pace": pace, "path": str(path)}
    match kind:
        case "synthetic":
            return closing(MovingPattern(size=(WIDTH, HEIGHT), fps=fps, frames=COUNT, pace=pace))
        case "file":
            write_video(path, [RED] * COUNT, fps=fps)
        case "folder":
            write_pictures(path, {f"{i}.png": RED for i in range(COUNT)})
            section["fps"] = fps
        case _:  # a ROS 2 log, written by the reference library
            with robot_logs.ros_log(path) as say:
                for i in range(COUNT):
                    at_ns = robot_logs.START_NS + round(i * 1e9 / fps)
                    say(robot_logs.TOPIC, *robot_logs.compressed(RED, at_ns), log_ns=at_ns, sequence=i)
    return closing(open_source(msgspec.convert(section, SourceConfig)))


@contextmanager
def open_v4l2_camera(folder: Path, slow: bool) -> Generator[Opened]:
    fake = FakeVideoCapture(RED)
    source = open_v4l2(V4l2Source(device="/dev/null", open_timeout_s=OPEN_S), fake.open)
    with closing(source, fake.awake.clear) as opened:
        yield opened
    fake.awake.set()


@contextmanager
def open_rtsp(folder: Path, slow: bool) -> Generator[Opened]:
    with serving([RED] * 600) as (url, awake):
        source = open_source(RtspSource(url=url, open_timeout_s=OPEN_S))
        with closing(source, awake.clear) as opened:
            yield opened


def open_oak(folder: Path, slow: bool) -> AbstractContextManager[Opened]:
    """DepthAI on this host alone: a scripted node stands in for the camera."""
    import oak_pipelines as pipelines

    from gcd_node.sources.oak import open_pipeline

    awake = threading.Event()
    awake.set()
    script = pipelines.steady(lambda seq: pipelines.picture(seq, RED), fps=25.0, awake=awake)
    return closing(open_pipeline(pipelines.Scripted(script, fps=25.0), open_timeout_s=OPEN_S), awake.clear)


@contextmanager
def open_push(folder: Path, slow: bool) -> Generator[Opened]:
    """Somebody pushes, before and after the node listens; by stamps on an even grid."""
    endpoint, awake, start_ns = f"ipc://{folder}/frames", threading.Event(), time.time_ns()
    awake.set()

    def push(pusher: FramePusher, number: int) -> None:
        if awake.is_set():
            pusher.push(RED, start_ns + number * 40_000_000)

    with pushing(endpoint, push, fps=25.0):
        source = open_source(PushSource(endpoint=endpoint, open_timeout_s=OPEN_S))
        with closing(source, awake.clear) as opened:
            yield opened


KINDS: dict[SourceKind, Callable[[Path, bool], AbstractContextManager[Opened]]] = {
    **{kind: partial(open_recording, kind) for kind in ("file", "folder", "synthetic", "mcap")},
    "v4l2": open_v4l2_camera,
    "rtsp": open_rtsp,
    "oak": open_oak,
    "push": open_push,
}
"""A live one gives 25 FPS, slow or not."""
MISSING: dict[SourceKind, Callable[[Path], SourceConfig]] = {
    "file": lambda folder: FileSource(path=str(folder / "none.mp4")),
    "folder": lambda folder: FolderSource(path=str(folder / "none"), fps=5.0),
    "mcap": lambda folder: McapSource(path=str(folder / "none.mcap")),
    "v4l2": lambda folder: V4l2Source(device=str(folder / "video7")),
    "rtsp": lambda folder: RtspSource(url="rtsp://127.0.0.1:1/live"),
    "oak": lambda folder: OakSource(device="14442C10NOSUCHDEVICE"),
    "push": lambda folder: PushSource(endpoint=f"ipc://{folder}/frames", open_timeout_s=0.3),
}
LIVE: list[SourceKind] = [kind for kind in KINDS if kind in LIVE_KINDS]
RECORDED: list[SourceKind] = [kind for kind in KINDS if kind not in LIVE_KINDS]
LACKING = {} if importlib.util.find_spec("depthai") else {"oak": pytest.mark.skip(reason="needs the extra `oak`")}


def each_of(kinds: Iterable[SourceKind]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("kind", [pytest.param(kind, marks=LACKING.get(kind, ())) for kind in kinds])


every_kind, live_kinds, recorded_kinds = each_of(KINDS), each_of(LIVE), each_of(RECORDED)


def test_every_kind_of_a_launch_file_is_in_this_suite() -> None:
    assert set(KINDS) == set(get_args(SourceKind))


@every_kind
def test_a_source_says_what_it_is_and_gives_such_frames(kind: SourceKind, tmp_path: Path) -> None:
    with KINDS[kind](tmp_path, False) as (source, _):
        info = source.info
        assert (info.kind, info.clock) == (kind, "realtime" if kind in LIVE else "replay")
        assert info.fps_nominal == pytest.approx(25.0, rel=0.02)
        assert info.id
        assert "/" not in info.id
        assert info.stamp_uncertainty_us > 0
        frames = list(islice(source.frames(), COUNT))
        assert len(frames) == COUNT
        assert all(b.stamp_ns > a.stamp_ns and b.seq > a.seq for a, b in pairwise(frames))
        assert (source.corrupt, source.info) == (0, info)
        for frame in frames:
            assert (frame.image.dtype, frame.image.shape) == (np.uint8, (HEIGHT, WIDTH, 3))
            assert frame.size == (info.width, info.height)
            assert not frame.image.flags.writeable
            assert kind == "synthetic" or np.abs(frame.image[8:-8, 8:-8].astype(int) - COLOUR).max() <= 8


@live_kinds
def test_a_slow_caller_of_a_camera_gets_the_newest_by_this_host_s_clock(kind: SourceKind, tmp_path: Path) -> None:
    with KINDS[kind](tmp_path, False) as (source, _):
        first = next(iter(source.frames()))
        time.sleep(0.6)
        asked_ns = time.monotonic_ns()
        second = next(iter(source.frames()))  # a second look goes on
        assert second.seq >= first.seq + 5
        assert asked_ns - 400_000_000 < second.stamp_ns <= time.monotonic_ns()


@recorded_kinds
def test_a_recording_begins_again_with_every_look_and_waits_for_its_caller(kind: SourceKind, tmp_path: Path) -> None:
    with KINDS[kind](tmp_path, False) as (source, _):
        first: list[Frame] = []
        for frame in source.frames():
            first.append(frame)
            time.sleep(0.01)
        assert [frame.seq for frame in first] == list(range(COUNT))
        second = list(source.frames())
        assert [(frame.stamp_ns, frame.seq) for frame in first] == [(frame.stamp_ns, frame.seq) for frame in second]
        assert all(np.array_equal(a.image, b.image) for a, b in zip(first, second, strict=True))


@every_kind
def test_closing_from_another_thread_ends_a_blocked_look_within_a_second(kind: SourceKind, tmp_path: Path) -> None:
    with KINDS[kind](tmp_path, True) as (source, hush):
        seen, errors = list[Frame](), list[Exception]()

        def look() -> None:
            try:
                for frame in source.frames():
                    seen.append(frame)
            except Exception as error:  # the end of a thread
                errors.append(error)

        reader = threading.Thread(target=look, daemon=True)
        reader.start()
        until(lambda: bool(seen), GUARD_S)
        hush()
        time.sleep(0.2)  # what was on its way arrives
        closer = threading.Thread(target=source.close, daemon=True)
        closer.start()
        reader.join(1.0)
        assert not reader.is_alive()
        closer.join(GUARD_S)
        assert not closer.is_alive()
        assert errors == []


@every_kind
def test_a_closed_source_stays_closed_for_a_look_begun_and_a_new_one(kind: SourceKind, tmp_path: Path) -> None:
    with KINDS[kind](tmp_path, False) as (source, _):
        frames = source.frames()
        next(frames)
        source.close()
        source.close()
        assert list(frames) == []
        assert list(source.frames()) == []


@each_of(MISSING)
def test_what_is_missing_is_refused_in_one_line_and_in_time(kind: SourceKind, tmp_path: Path) -> None:
    begin = time.monotonic()
    with pytest.raises(SourceError) as caught:
        _ = open_source(MISSING[kind](tmp_path)).info
    assert time.monotonic() - begin < GUARD_S
    assert type(caught.value) is (SourceAbsentError if kind in LIVE else SourceError)
    assert "\n" not in str(caught.value)


# Recordings: what each kind gives and refuses; what all sources have in common: test_source_conformance.py.


@pytest.mark.parametrize("suffix", ["mp4", "avi", "mkv", "webm"])
def test_every_container_is_read_with_its_stamps_and_a_raw_stream_at_its_rate(suffix: str, tmp_path: Path) -> None:
    coded = write_video(tmp_path / "clip.avi", ramp(8), fps=25.0).read_bytes()
    pictures = [b"\xff\xd8\xff" + part for part in coded.split(b"\xff\xd8\xff")[1:]]
    (tmp_path / "raw.mjpeg").write_bytes(b"".join(picture[: picture.rindex(b"\xff\xd9") + 2] for picture in pictures))
    stamps = [frame.stamp_ns for frame in VideoFile(tmp_path / "raw.mjpeg", fps=20.0).frames()]
    assert stamps == [50_000_000 * i for i in range(8)]
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


def test_stamps_rise_whatever_the_container_says() -> None:
    for stated_ms, wanted_ms in (
        ([0, 0, 0, 0], [0, 100, 200, 300]),  # a raw stream
        ([0, 41.7, 166.7, 208.4], [0, 41.7, 166.7, 208.4]),  # a variable rate
        ([80, 180, 280], [80, 180, 280]),  # begins late
        ([0, 100, 90, 300], [0, 100, 200, 300]),  # one step back
        ([0, 100, 9e12, 9e12 + 100], [0, 100, 200, 300]),  # a leap
        ([float("nan"), -5, 200], [0, 100, 200]),
        ([-9.2e18, 100, 200], [0, 100, 200]),
    ):
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
    looped = VideoFile(path, loop=True).frames()
    list(islice(looped, 5))
    path.unlink()
    with pytest.raises(SourceError):
        list(looped)
    begun_s = time.monotonic()  # at its pace
    assert len(list(islice(MovingPattern(fps=10.0, frames=2, pace="realtime", loop=True).frames(), 6))) == 6
    assert 0.4 < time.monotonic() - begun_s < 5


def test_a_video_cut_short_gives_what_is_left_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (30, HEIGHT, WIDTH, 3), np.uint8)
    path = write_video(tmp_path / "clip.mkv", list(noise))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with caplog.at_level(logging.WARNING):
        count = len(list(VideoFile(path).frames()))
    assert 5 < count < 25
    assert "truncated" in caplog.text


def test_f6_a_bad_video_is_refused_in_one_line_when_it_is_opened(tmp_path: Path) -> None:
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
    for name in (*contents, "missing.mp4", ""):
        if name in contents:
            (tmp_path / name).write_bytes(contents[name])
        with pytest.raises(SourceError) as caught:
            VideoFile(tmp_path / name)
        assert (name in str(caught.value), "\n" in str(caught.value), caught.value.exit_code) == (True, False, 66)


@pytest.mark.slow
def test_the_decoder_itself_says_nothing(tmp_path: Path) -> None:
    (tmp_path / "head.mkv").write_bytes(b"\x1a\x45\xdf\xa3" + bytes(400))
    code = "from pathlib import Path; from gcd_node.sources.files import VideoFile; VideoFile(Path('head.mkv'))"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=tmp_path, env=environment())
    assert "SourceError" in done.stderr
    assert "EBML" not in done.stderr


def test_pictures_are_sorted_as_people_count_and_only_packaged_files_are_found_under_package(tmp_path: Path) -> None:
    names = ["b1.png", "a10.png", "a2.PNG", "a02b.jpg", "A1.png", ".hidden.png"]
    (write_pictures(tmp_path, {name: flat(0, 0, 0) for name in names}) / "notes.txt").write_text("not a picture")
    assert [path.name for path in list_pictures(tmp_path)] == ["A1.png", "a2.PNG", "a02b.jpg", "a10.png", "b1.png"]
    for name in ("package:none.mp4", "package:../errors.py", "package:"):
        with pytest.raises(SourceError):
            resolve_path(name)


OTHER = cv2.imencode(".png", flat(0, 0, 0, width=60))[1].tobytes()


@pytest.mark.parametrize("content", [OTHER, OTHER[:60], OTHER[:20], b"x" * 99], ids=["other size", *"abc"])
def test_a_damaged_picture_or_one_of_another_size_is_named_when_it_comes(content: bytes, tmp_path: Path) -> None:
    folder = write_pictures(tmp_path, {f"{i}.png": flat(0, 0, 0) for i in range(3)})
    (folder / "1.png").write_bytes(content)
    with pytest.raises(SourceError, match=r"1\.png"):
        list(ImageFolder(folder, fps=10.0).frames())


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_a_picture_that_would_fill_the_memory_is_never_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 12000, 12000, 8, 2, 0, 0, 0))  # a small file that states any size
    packed = chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head + packed)
    with pytest.raises(SourceError):
        read_picture(tmp_path / "bomb.png")
