"""A live source over all its openings: stalled, lost, opened again, given up, closed."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn
from unittest.mock import create_autospec

import pytest
from cameras import FPS, Bench, Camera, until
from fake_camera import FakeVideoCapture
from media import flat

from gcd_node.errors import SourceAbsentError, SourceError, SourceLostError
from gcd_node.frame import Frame, FrameSource, SourceInfo
from gcd_node.health import SourceState
from gcd_node.sources import V4l2Source
from gcd_node.sources.live import LiveCamera, SourceWatch, WatchListener, backoff_s, patience_s
from gcd_node.sources.opencv import open_v4l2
from gcd_node.window import Reason


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


def test_a_silent_camera_stalls_and_goes_on() -> None:
    camera = Camera()
    with watching(camera, stall_ms=100.0) as reader:
        camera.shoot()
        until(lambda: "stalled" in reader.told)
        camera.shoot()
        until(lambda: len(reader.frames) == 2)
    assert reader.told == ["connecting", "opened", "streaming", "stalled", "streaming"]


@pytest.mark.parametrize("ending", [SourceLostError("USB said goodbye"), SourceError("torn"), None])
def test_a_camera_that_says_it_is_gone_is_believed_at_once(ending: Exception | None) -> None:
    camera, second = Camera(), Camera()
    with watching(camera, Bench(second)) as reader:
        camera.shoot()
        camera.feed(ending)
        until(lambda: "lost" in reader.told)
        second.shoot()
        until(lambda: len(reader.frames) == 2)
    assert reader.told == ["connecting", "opened", "streaming", "lost", "SRC_LOST", "opened", "streaming"]
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


def test_after_so_many_failed_attempts_in_a_row_it_is_given_up() -> None:
    camera, bench = Camera(), Bench()
    with watching(camera, bench, max_reconnects=3) as reader:
        camera.shoot()
        camera.feed(SourceLostError("gone"))
        reader.finish()
    assert isinstance(reader.failure, SourceLostError)
    assert "3 attempts" in str(reader.failure)
    assert "there is no camera" in str(reader.failure)
    assert bench.tries == 3


@pytest.mark.usefixtures("impatient")
def test_a_camera_that_opens_and_gives_nothing_counts_as_a_failed_attempt() -> None:
    camera, bench = Camera(), Bench(Camera(), Camera(), Camera())
    with watching(camera, bench, max_reconnects=2, open_timeout_s=0.05, stall_ms=10.0) as reader:
        camera.shoot()
        reader.finish()
    assert isinstance(reader.failure, SourceLostError)
    assert len(bench.opened) == 2


def test_a_fault_of_ours_in_a_source_is_not_taken_for_a_lost_camera() -> None:
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


@pytest.mark.parametrize("lost", [False, True])
def test_closing_ends_a_silent_watch_and_one_that_looks_for_its_camera(lost: bool) -> None:
    camera = Camera()
    with watching(camera) as reader:
        if lost:
            camera.feed(None)
            until(lambda: "lost" in reader.told)
        started_s = time.monotonic()
    assert time.monotonic() - started_s < 10
    assert camera.closed.is_set()


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


def test_waiting_doubles_up_to_its_limit_and_never_passes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for part in (0.8, 1.0, 1.2):
        monkeypatch.setattr("random.uniform", lambda *_, part=part: part)
        even = [part * wait for wait in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)]
        assert [backoff_s("v4l2", i) for i in range(7)] == pytest.approx([min(10.0, wait) for wait in even])
        assert [backoff_s("push", i) for i in range(3)] == pytest.approx([min(0.5, wait) for wait in even[:3]])


def test_patience_follows_the_rate_and_two_seconds() -> None:
    assert patience_s(V4l2Source(), FPS) == (0.2, 1.8)
    assert patience_s(V4l2Source(), 5.0) == pytest.approx((0.6, 1.8))
    assert patience_s(V4l2Source(), 1.0) == pytest.approx((3.0, 6.0))
    assert patience_s(V4l2Source(stall_ms=500.0), FPS) == (0.5, 1.8)


def test_an_opening_that_waits_for_the_one_before_has_its_own_time_afterwards() -> None:
    alone = threading.Lock()

    def absent() -> NoReturn:
        time.sleep(0.6)
        raise SourceAbsentError("it opened too late to be there")

    assert alone.acquire()
    threading.Timer(0.7, alone.release).start()
    with pytest.raises(SourceAbsentError, match="too late"):
        assert LiveCamera("slow", absent, open_timeout_s=1.0, hint="wait", alone=alone).info
