"""The contract of gcd_node.frame.FrameSource, one suite over every kind of source a launch file can name.

KINDS says how to open one of each kind that shows flat red, and how to silence it, MISSING one that is not there.
"""

import importlib.util
import threading
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager, contextmanager
from itertools import islice, pairwise
from pathlib import Path
from typing import get_args

import msgspec
import numpy as np
import pytest
from cameras import pushing, until
from fake_camera import FakeVideoCapture
from media import HEIGHT, WIDTH, flat, write_pictures, write_video
from rtsp_server import serving, write_transport_stream

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
)
from gcd_node.sources.files import MovingPattern
from gcd_node.sources.opencv import open_v4l2

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


def play(kind: SourceKind, path: Path, slow: bool, fps: float | None = None) -> AbstractContextManager[Opened]:
    pace = "realtime" if slow else "lockstep"
    section = {"kind": kind, "path": str(path), "pace": pace} | ({} if fps is None else {"fps": fps})
    return closing(open_source(msgspec.convert(section, SourceConfig)))


def open_file(folder: Path, slow: bool) -> AbstractContextManager[Opened]:
    path = write_video(folder / "clip.mkv", [RED] * COUNT, fps=0.5 if slow else 25.0)
    return play("file", path, slow)


def open_folder(folder: Path, slow: bool) -> AbstractContextManager[Opened]:
    path = write_pictures(folder / "pictures", {f"{i}.png": RED for i in range(COUNT)})
    return play("folder", path, slow, fps=0.5 if slow else 25.0)


def open_synthetic(folder: Path, slow: bool) -> AbstractContextManager[Opened]:
    pace, fps = ("realtime", 0.5) if slow else ("lockstep", 25.0)
    return closing(MovingPattern(size=(WIDTH, HEIGHT), fps=fps, frames=COUNT, pace=pace))


@contextmanager
def open_v4l2_camera(folder: Path, slow: bool) -> Generator[Opened]:
    fake = FakeVideoCapture(RED)
    source = open_v4l2(V4l2Source(device="/dev/null", open_timeout_s=OPEN_S), fake.open)
    with closing(source, fake.awake.clear) as opened:
        yield opened
    fake.awake.set()


@contextmanager
def open_rtsp(folder: Path, slow: bool) -> Generator[Opened]:
    with serving(write_transport_stream(folder / "live.ts", [RED] * 600)) as server:
        source = open_source(RtspSource(url=server.url, open_timeout_s=OPEN_S))
        with closing(source, server.stall) as opened:
            yield opened


@contextmanager
def open_oak(folder: Path, slow: bool) -> Generator[Opened]:
    """DepthAI on this host alone: a scripted node stands in for the camera."""
    import oak_pipelines as pipelines

    from gcd_node.sources.oak import open_pipeline

    awake = threading.Event()
    awake.set()
    script = pipelines.steady(lambda seq: pipelines.picture(seq, RED), fps=25.0, awake=awake)
    source = open_pipeline(pipelines.Scripted(script, fps=25.0), open_timeout_s=OPEN_S)
    with closing(source, awake.clear) as opened:
        yield opened


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


def open_mcap(folder: Path, slow: bool) -> AbstractContextManager[Opened]:
    """A ROS 2 log, written by the reference library."""
    from robot_logs import START_NS, TOPIC, compressed, ros_log

    period_ns = 2_000_000_000 if slow else 40_000_000
    with ros_log(folder / "log.mcap") as say:
        for i in range(COUNT):
            stamp_ns = START_NS + i * period_ns
            say(TOPIC, "sensor_msgs/msg/CompressedImage", compressed(RED, stamp_ns), log_ns=stamp_ns, sequence=i)
    return play("mcap", folder / "log.mcap", slow)


KINDS: dict[SourceKind, Callable[[Path, bool], AbstractContextManager[Opened]]] = {
    "file": open_file,
    "folder": open_folder,
    "synthetic": open_synthetic,
    "mcap": open_mcap,
    "v4l2": open_v4l2_camera,
    "rtsp": open_rtsp,
    "oak": open_oak,
    "push": open_push,
}
"""With True a recording plays in real time, a frame every 2 s; else in lockstep. A live one gives 25 FPS, whichever."""
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
def test_a_recording_begins_again_with_every_look_and_a_slow_caller_misses_nothing(
    kind: SourceKind, tmp_path: Path
) -> None:
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
        seen: list[Frame] = []
        errors: list[Exception] = []
        reader = threading.Thread(target=lambda: look(source, seen, errors), daemon=True)
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
def test_a_closed_source_stays_closed_for_a_look_that_was_given_up_and_a_new_one(
    kind: SourceKind, tmp_path: Path
) -> None:
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


def look(source: FrameSource, seen: list[Frame], errors: list[Exception]) -> None:
    try:
        for frame in source.frames():
            seen.append(frame)
    except Exception as error:  # the end of a thread
        errors.append(error)
