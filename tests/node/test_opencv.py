"""Cameras through OpenCV: a scripted Video4Linux device, and a network camera on loopback, whose password is never
repeated."""

import logging
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import islice, pairwise, takewhile
from pathlib import Path
from typing import Any, NoReturn
from unittest.mock import create_autospec

import cv2
import msgspec
import pytest
from cameras import FPS, HEIGHT, WIDTH, Bench, Camera, FakeVideoCapture, environment, flat, serving, until

from gcd_node.errors import ConfigError, SourceAbsentError, SourceError, SourceLostError
from gcd_node.frame import Frame, FrameSource, SourceInfo
from gcd_node.health import SourceState
from gcd_node.sources import RtspSource, V4l2Source, open_source, opencv
from gcd_node.sources.live import LiveCamera, SourceWatch, WatchListener, backoff_s, patience_s
from gcd_node.sources.opencv import Backlog, list_v4l2, open_stream, open_v4l2, shown_address
from gcd_node.window import Reason

RED = flat(250, 10, 20)
GUARD_S = 20.0
SECRET = "s3cret"


# Video4Linux.


def camera(fake: FakeVideoCapture, open_timeout_s: float = GUARD_S, **asked: float) -> LiveCamera:
    """A Video4Linux source over a fake; /dev/null stands in for the device file."""
    section = {"kind": "v4l2", "device": "/dev/null", "open_timeout_s": open_timeout_s, **asked}
    source = open_v4l2(msgspec.convert(section, V4l2Source), fake.open)
    assert source.info.kind == "v4l2"  # it is open
    return source


def test_the_pixel_format_is_set_before_the_size_and_what_differs_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    fake = FakeVideoCapture(RED, fixed={cv2.CAP_PROP_FRAME_WIDTH: 640.0})
    with caplog.at_level(logging.WARNING):
        source = camera(fake, width=1280, height=720, fps=30.0)
    source.close()
    size_and_rate = [cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS]
    assert [prop for prop, _ in fake.calls] == [cv2.CAP_PROP_FOURCC, *size_and_rate]
    assert ["640" in record.getMessage() for record in caplog.records] == [True]
    assert (source.info.codec, source.info.fps_nominal) == ("MJPG", 30.0)


@pytest.mark.parametrize(("stamps", "uncertainty_us"), [("driver", 20_000), ("zero", 80_000), ("wall", 80_000)])
def test_stamps_of_the_driver_are_used_unless_they_are_of_another_clock(stamps: str, uncertainty_us: int) -> None:
    fake, begin_ns = FakeVideoCapture(RED, stamps=stamps), time.monotonic_ns()
    with closing(camera(fake)) as source:
        frame = next(source.frames())
    assert begin_ns < frame.stamp_ns <= time.monotonic_ns()
    assert (frame.stamp_ns in [round(stated * 1e6) for stated in fake.stated_ms]) == (stamps == "driver")
    assert source.info.stamp_uncertainty_us == uncertainty_us
    rate = {"driver": 0.0, "zero": 90_000.0, "wall": float("nan")}[stamps]  # which cannot be, and is measured
    with closing(camera(FakeVideoCapture(RED, fps=20.0, fixed={cv2.CAP_PROP_FPS: rate}))) as source:
        assert 5.0 < source.info.fps_nominal < 22.0


def test_a_damaged_picture_is_counted_and_leaves_a_gap() -> None:
    fake = FakeVideoCapture(RED, fps=50.0)
    fake.damaged = {0, 4, 5}
    with closing(camera(fake)) as source:
        seqs = [frame.seq for frame in takewhile(lambda frame: frame.seq < 9, source.frames())]
    assert source.corrupt == 3
    assert not fake.damaged & set(seqs)


@pytest.mark.parametrize("trouble", ["gone", "breaks", "silent", "in use"])
def test_a_camera_that_gives_no_picture_any_more_is_lost_every_time_it_is_asked_and_absent_then(trouble: str) -> None:
    fake = FakeVideoCapture(RED)
    if trouble in ("gone", "breaks"):
        source = camera(fake)
        setattr(fake, trouble, True)
        for _ in range(2):
            with pytest.raises(SourceLostError):
                list(source.frames())
        assert fake.released.wait(GUARD_S)
        fake.released.clear()
    fake.there = trouble != "in use"
    if trouble == "silent":
        fake.awake.clear()
    with pytest.raises(SourceAbsentError):
        camera(fake, open_timeout_s=0.2 if trouble == "silent" else GUARD_S)
    fake.awake.set()
    assert trouble == "in use" or fake.released.wait(GUARD_S)


def test_an_absent_camera_is_told_with_those_there_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opencv, "_DEVICES", tmp_path)
    (tmp_path / "v4l" / "by-id").mkdir(parents=True)
    there = [tmp_path / "v4l" / "by-id" / "usb-Front_camera-video-index0", tmp_path / "video2"]
    for path in there:
        path.touch()
    assert list_v4l2() == there
    with pytest.raises(SourceAbsentError, match=f"{there[0]}, {there[1]}"):
        open_source(V4l2Source())
    with pytest.raises(SourceAbsentError):
        _ = open_source(V4l2Source(device="2")).info  # a file, and no device


@pytest.mark.hardware
def test_a_real_camera_gives_a_second_of_pictures() -> None:
    if not Path("/dev/video0").exists():
        pytest.skip("needs a camera at /dev/video0")
    source = open_source(V4l2Source())
    frames = list(islice(source.frames(), 15))
    source.close()
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(frames))
    assert 0 <= time.monotonic_ns() - frames[-1].stamp_ns < 1_000_000_000


# Network streams.


def test_an_address_is_shown_without_what_may_be_secret() -> None:
    for url, shown in (
        (f"rtsp://admin:{SECRET}@cam.local/stream1", "rtsp://cam.local"),
        (f"RTSP://admin:{SECRET}@10.0.0.7:8554/x?token={SECRET}", "rtsp://10.0.0.7:8554"),
        (f"rtsp://cam.local:554/user=admin_password={SECRET}_channel=1.sdp", "rtsp://cam.local:554"),
        (f"http://[fe80::1]:8080/video?key={SECRET}", "http://[fe80::1]:8080"),
        ("udp://@:5000", "udp://:5000"),
    ):
        assert shown_address(url) == shown


def test_what_is_no_address_of_a_stream_is_refused_and_not_repeated_and_one_too_large_to_decode() -> None:
    for url in (
        *(f"file:///etc/{SECRET}", f"concat://{SECRET}", "", f"rtsp:{SECRET}", f"rtsp://u:{SECRET}/x@host/y"),
        *(f"rtsp://u:{SECRET}@x@host/y", f"rtsp://u:{SECRET}@host:port/", f"rtsp://u:{SECRET}@/y", "rtsp://"),
    ):
        with pytest.raises(ConfigError) as caught:
            open_source(RtspSource(url=url))
        assert SECRET not in str(caught.value)
    huge = {cv2.CAP_PROP_FRAME_WIDTH: 60_000.0, cv2.CAP_PROP_FRAME_HEIGHT: 60_000.0}
    with pytest.raises(SourceError):
        _ = open_stream(RtspSource(url="rtsp://host/x"), open_capture=FakeVideoCapture(RED, fixed=huge).open).info


def test_a_burst_is_old_and_what_follows_in_time_is_not() -> None:
    for arrivals_ms, old in (
        ([0.0, 1.0, 2.0, 3.0, 43.0, 83.0, 90.0], [0, 1, 2, 3]),  # what piled up before the start
        ([0.0, 40.0, 80.0, 900.0, 901.0, 902.0, 941.0], [0, 3, 4, 5]),  # and in a silence
        ([0.0, 40.0, 110.0, 115.0, 160.0, 239.0, 241.0], [0]),  # jitter is no burst
        ([10.0 * i for i in range(220)], [*range(201)]),  # what never waits is believed after two seconds
    ):
        backlog = Backlog(period_ns=40_000_000)
        assert [i for i, each in enumerate(arrivals_ms) if backlog.holds(round(each * 1e6))] == old


RISING = [flat(i // 3, 60, 200) for i in range(600)]
"""24 s whose red channel rises by 1 every 3 pictures."""


def test_what_piled_up_in_a_silence_is_not_new_and_after_a_long_one_it_is_lost() -> None:
    with serving(RISING) as (url, awake):
        source = open_stream(RtspSource(url=url, open_timeout_s=GUARD_S), read_timeout_s=2.5)
        frames = source.frames()
        before = next(frames)
        awake.clear()
        time.sleep(1.5)
        awake.set()
        after = next(frame for frame in frames if frame.stamp_ns - before.stamp_ns > 1_400_000_000)
        shown_s = (int(after.image[20, 20, 0]) - int(before.image[20, 20, 0])) * 3 / 25
        assert shown_s >= (after.stamp_ns - before.stamp_ns) / 1e9 - 1.0  # what piled up is older than its arrival
        awake.clear()
        begin = time.monotonic()
        with pytest.raises(SourceLostError):
            list(frames)
        assert 1.0 < time.monotonic() - begin < GUARD_S


def test_a_password_opens_a_stream_and_is_never_repeated(
    capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    with serving(RISING, SECRET) as (url, _):
        right = url.replace("//", f"//admin:{SECRET}@")
        source = open_stream(RtspSource(url=right, open_timeout_s=GUARD_S))
        assert next(source.frames()).size == (WIDTH, HEIGHT)
        assert SECRET not in f"{source.info}{threading.enumerate()}"
        source.close()
        with pytest.raises(SourceAbsentError) as caught:
            _ = open_stream(RtspSource(url=right.replace(SECRET, "wr0ng"), open_timeout_s=GUARD_S)).info
    told = f"{caught.value}{caplog.text}{capfd.readouterr()}"
    assert SECRET not in told
    assert "wr0ng" not in told


@pytest.mark.slow
def test_a_process_ends_although_a_read_never_returns() -> None:
    code = (
        "import sys; from gcd_node.sources.opencv import RtspSource, open_stream\n"
        "source = open_stream(RtspSource(url=sys.argv[1], open_timeout_s=20), read_timeout_s=600)\n"
        "next(source.frames()); print('open', flush=True); sys.stdin.readline()\n"
        "source.close(); print('closed')\n"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with (
        serving(RISING) as (url, awake),
        subprocess.Popen([sys.executable, "-c", code, url], env=environment(), **pipes) as process,
    ):
        assert process.stdout.readline() == "open\n"
        awake.clear()
        time.sleep(0.3)
        out, errors = process.communicate("go\n", timeout=60)
    assert (process.returncode, out) == (0, "closed\n")
    assert errors.count("\n") == 1  # that its thread is left behind


# A live source over all its openings: stalled, lost, opened again, given up, closed.


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is tried again soon."""
    monkeypatch.setattr("gcd_node.sources.live.backoff_s", lambda *_: 0.02)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera is lost sooner than two seconds after its last frame."""
    monkeypatch.setattr("gcd_node.sources.live._LOST_S", 0.3)


class Reader:
    """Iterates a watch in a thread, as the node does, and writes down what it is told."""

    def __init__(self, first: FrameSource, reopen: Callable[[SourceInfo], FrameSource], **patience: Any) -> None:
        self.told: list[str] = []
        self.details: list[str] = []
        self.infos: list[SourceInfo] = []
        self.frames: list[Frame] = []
        self.failure: Exception | None = None
        self.watch = SourceWatch(first, reopen, self, V4l2Source(**patience))
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()

    def _read(self) -> None:
        try:
            for frame in self.watch.frames():
                self.frames.append(frame)
        except Exception as error:
            self.failure = error

    def source_state(self, state: SourceState, detail: str) -> None:
        self.details.append(detail)
        self.told.append(state)

    def source_frame(self, frame: Frame) -> None:
        """It is one of `frames` then."""

    def source_broken(self, reason: Reason) -> None:
        self.told.append(reason)

    def source_opened(self, info: SourceInfo) -> bool:
        self.told.append("opened")
        self.infos.append(info)
        return True

    def finish(self) -> None:
        self.thread.join(20)
        assert not self.thread.is_alive()


@contextmanager
def watching(
    first: FrameSource, bench: Bench | Callable[[SourceInfo], FrameSource] | None = None, **patience: Any
) -> Iterator[Reader]:
    """A reader, until the block is left; bench: what it is opened from again."""
    plugged = bench or Bench()
    reopen = (lambda _: plugged.open()) if isinstance(plugged, Bench) else plugged
    reader = Reader(first, reopen, **patience)
    yield reader
    reader.watch.close()
    reader.finish()


@pytest.mark.parametrize("ending", [SourceLostError("USB said goodbye"), SourceError("torn"), None])
def test_a_silent_camera_stalls_and_one_that_says_it_is_gone_is_believed(ending: Exception | None) -> None:
    camera, second = Camera(), Camera()
    with watching(camera, Bench(second), stall_ms=100.0) as reader:
        camera.shoot()
        until(lambda: "stalled" in reader.told)
        camera.shoot()
        until(lambda: len(reader.frames) == 2)
        camera.feed(ending)
        until(lambda: "lost" in reader.told)
        second.shoot()
        until(lambda: len(reader.frames) == 3)
    assert reader.told[:6] == ["connecting", "opened", "streaming", "stalled", "streaming", "lost"]
    assert reader.told[6:9] == ["SRC_LOST", "opened", "streaming"]
    assert str(ending or "the stream ended") in reader.details


@pytest.mark.usefixtures("impatient")
def test_a_device_that_never_answers_again_is_left_behind() -> None:
    deaf, second = FakeVideoCapture(flat(9, 9, 9)), Camera()
    with watching(open_v4l2(V4l2Source(device="/dev/null"), deaf.open), Bench(second), stall_ms=50.0) as reader:
        until(lambda: reader.frames != [])
        deaf.awake.clear()
        until(lambda: len(reader.infos) == 2)
        second.shoot()
        until(lambda: reader.frames[-1].size == (96, 64))
        deaf.awake.set()  # too late: nobody reads it any more
        assert deaf.released.wait(20)
    assert reader.frames[-1].size == (96, 64)


@pytest.mark.usefixtures("impatient")
def test_after_so_many_failed_attempts_in_a_row_it_is_given_up_but_a_fault_of_ours_is_none() -> None:
    camera, bench = Camera(), Bench()
    with watching(camera, bench, max_reconnects=3) as reader:
        camera.shoot()
        camera.feed(SourceLostError("gone"))
        reader.finish()
    assert isinstance(reader.failure, SourceLostError)
    assert all(words in str(reader.failure) for words in ("3 attempts", "there is no camera"))
    assert bench.tries == 3
    camera, bench = Camera(), Bench(Camera(), Camera(), Camera())  # which open and give nothing
    with watching(camera, bench, max_reconnects=2, open_timeout_s=0.05, stall_ms=10.0) as reader:
        camera.shoot()
        reader.finish()
    assert isinstance(reader.failure, SourceLostError)
    assert len(bench.opened) == 2
    camera = Camera()
    with watching(camera, Bench(Camera())) as reader:
        camera.feed(ZeroDivisionError("a bug"))
        reader.finish()
    assert isinstance(reader.failure, ZeroDivisionError)


def test_a_slow_reader_gets_the_newest_frames_and_the_rest_is_counted() -> None:
    fake = FakeVideoCapture(flat(9, 9, 9), fps=200.0)
    camera = open_v4l2(V4l2Source(device="/dev/null"), fake.open)
    watch = SourceWatch(camera, lambda _: camera, create_autospec(WatchListener), V4l2Source())
    frames = watch.frames()
    seqs = [next(frames).seq]
    until(lambda: fake.grabbed > 50)
    fake.awake.clear()
    time.sleep(0.1)
    seqs += [next(frames).seq for _ in range(4)]
    watch.close()
    fake.awake.set()
    assert list(frames) == []
    assert seqs[1:] == list(range(fake.grabbed - 3, fake.grabbed + 1))
    assert watch.skipped + len(seqs) == fake.grabbed + 1 - seqs[0]  # nobody misses those before the first


def test_closing_does_not_wait_for_a_camera_that_is_being_opened() -> None:
    camera, late = Camera(), Camera()
    answer, asked_for = threading.Event(), list[SourceInfo]()

    def open_slowly() -> Camera:
        answer.wait(60)
        return late

    def reopen(before: SourceInfo) -> LiveCamera:
        asked_for.append(before)
        return LiveCamera("slow", open_slowly, open_timeout_s=60.0, hint="wait")

    with watching(camera, reopen):
        camera.feed(None)
        until(lambda: asked_for == [camera.info])
    assert not late.closed.is_set()
    answer.set()
    until(late.closed.is_set)  # nobody wants it any more


def test_patience_follows_the_rate_and_waiting_doubles_up_to_its_limit() -> None:
    for fps, patience in ((FPS, (0.2, 1.8)), (5.0, (0.6, 1.8)), (1.0, (3.0, 6.0))):
        assert patience_s(V4l2Source(), fps) == pytest.approx(patience)
    assert patience_s(V4l2Source(stall_ms=500.0), FPS) == (0.5, 1.8)
    for kind, waits in (("v4l2", [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0]), ("push", [0.5] * 7)):
        assert [backoff_s(kind, i) for i in range(7)] == pytest.approx(waits, rel=0.21)


def test_an_opening_that_waits_for_the_one_before_has_its_own_time_afterwards() -> None:
    alone = threading.Lock()

    def absent() -> NoReturn:
        time.sleep(0.6)
        raise SourceAbsentError("it opened too late to be there")

    assert alone.acquire()
    threading.Timer(0.7, alone.release).start()
    with pytest.raises(SourceAbsentError, match="too late"):
        assert LiveCamera("slow", absent, open_timeout_s=1.0, hint="wait", alone=alone).info
