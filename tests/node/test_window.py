"""Frames become windows: the grid, its holes, restarts and the end of a stream."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest
from cameras import frames_at, until
from fakes import FakeSource, Steady

from gcd_node.errors import ReaderError
from gcd_node.frame import Frame
from gcd_node.stream_context import choose_fps
from gcd_node.window import FrameWindow, PartialWindow, WindowBuilder, WindowSlot, read


def run(
    builder: WindowBuilder, frames: Sequence[Frame], *, flush: bool = True, at_once: bool = False
) -> list[FrameWindow]:
    """at_once: they arrive together, whatever their stamps say."""
    windows = [w for frame in frames for w in builder.push(frame, 5 if at_once else frame.stamp_ns + 5)]
    return windows + (builder.flush() if flush else [])


def even(count: int, fps: float, first_ms: float = 0.0) -> list[Frame]:
    return frames_at(first_ms + i * 1000 / fps for i in range(count))


def jittered(count: int, fps: float, spread: float, seed: int = 0) -> list[Frame]:
    noise = np.random.default_rng(seed).uniform(-spread, spread, count)
    return frames_at((np.arange(count) + noise) * 1000 / fps + 1000)


def seqs(windows: Sequence[FrameWindow]) -> list[int]:
    return [seq for window in windows for seq in window.seqs]


@pytest.mark.parametrize("spread", [0.0, 0.3, 0.45])
def test_every_frame_is_a_window_of_one_at_once(spread: float) -> None:
    builder = WindowBuilder(frames=1, fps=10.0, source_fps=10.0)
    for frame in jittered(60, 10.0, spread):
        (window,) = builder.push(frame, frame.stamp_ns + 5)
        assert window.stamps_ns == (frame.stamp_ns,)
    for source_fps in (24.0, 30.0, 60.0):  # they keep a lower rate
        windows = run(WindowBuilder(frames=1, fps=10.0, source_fps=source_fps), even(int(10 * source_fps), source_fps))
        assert len(windows) == pytest.approx(100, abs=1)
        assert np.diff([window.stamps_ns[0] for window in windows]).max() / 1e6 <= 100 + 1000 / source_fps


def test_a_camera_that_was_silent_is_no_clock_that_was_set() -> None:
    builder = WindowBuilder(frames=14, fps=24.0, source_fps=24.0)
    frames = [*even(5, 24.0), *even(20, 24.0, first_ms=1700.0)]
    run(builder, frames)  # they arrive as they were taken
    assert builder.reasons == {"WIN_GAP": 1}
    for frame in frames_at([4000.0, 9000.0]):
        builder.push(frame, frames[-1].stamp_ns + 10**8)  # these do not
    assert builder.reasons["CLOCK_STEP"] == 2


@pytest.mark.parametrize(("source_fps", "fps"), [(24000 / 1001, 24.0), (24.1, 24.0), (23.9, 24.0), (5.0, 5.0)])
def test_at_the_trained_rate_or_nearly_every_frame_is_used_once(source_fps: float, fps: float) -> None:
    builder = WindowBuilder(frames=14, fps=fps, source_fps=source_fps)
    windows = run(builder, even(14 * 300, source_fps))
    assert seqs(windows) == list(range(14 * 300))
    assert builder.reasons == {}


@pytest.mark.parametrize("source_fps", [24.0, 25.0, 30000 / 1001, 60.0])
@pytest.mark.parametrize("fps", [6.0, 24.0])
def test_each_place_in_time_gets_the_nearest_frame(source_fps: float, fps: float) -> None:
    frames = even(400, source_fps, first_ms=123.0)
    stamps = np.array([frame.stamp_ns for frame in frames])
    windows = run(WindowBuilder(frames=14, fps=fps, source_fps=source_fps), frames)
    assert len(windows) >= int(400 / source_fps * fps) // 14 - 1
    for place, seq in enumerate(seqs(windows)):
        wanted_ns = stamps[0] + round(place * 1e9 / fps)
        assert abs(stamps[seq] - wanted_ns) <= np.abs(stamps - wanted_ns).min() + 1e6


@pytest.mark.parametrize("source_fps", [7.0, 24.0, 29.97])
@pytest.mark.parametrize("stride", [1, 14, 20])
def test_no_frame_is_repeated_and_time_never_runs_back(source_fps: float, stride: int) -> None:
    fps, _ = choose_fps(source_fps, (6.0, 24.0))
    builder = WindowBuilder(frames=14, fps=fps, stride=stride, source_fps=source_fps)
    windows = run(builder, jittered(300, source_fps, spread=0.15))
    assert windows
    for window in windows:
        assert (np.diff(window.seqs) > 0).all()
        assert (np.diff(window.stamps_ns) > 0).all()
        skew = np.diff(window.stamps_ns) * window.fps / 1e9 - 1
        assert np.abs(skew).max() <= 1.0


@pytest.mark.parametrize("stride", [1, 3, 4, 6, 9])
def test_windows_begin_one_stride_apart(stride: int) -> None:
    windows = run(WindowBuilder(frames=4, fps=10.0, stride=stride), even(40, 10.0))
    assert [window.seqs for window in windows] == [tuple(range(s, s + 4)) for s in range(0, 37, stride)]


@pytest.mark.parametrize("stride", [1, 3, 4, 6])
def test_what_a_window_holds_so_far_is_how_the_whole_one_will_begin(stride: int) -> None:
    frames, builder = even(30, 10.0), WindowBuilder(frames=4, fps=10.0, stride=stride)
    seen: list[PartialWindow] = []
    for frame in frames:
        for window in builder.push(frame, frame.stamp_ns):
            assert window.images[:, 0, 0, 0].tolist() == list(window.seqs)
            begun = [each for each in seen if each.seqs == window.seqs[: len(each.seqs)]]
            assert max(len(each.frames) for each in begun) == 3
            assert all(each.frames == window.frames[: len(each.frames)] for each in begun)
        seen.append(builder.filling)


def test_a_window_carries_pictures_stamps_and_arrival_and_only_its_frames_are_fitted() -> None:
    frames = even(8, 10.0, first_ms=50.0)
    window = run(WindowBuilder(frames=4, fps=10.0), frames)[1]
    assert window.images.shape == (4, 2, 4, 3)
    assert window.images[:, 0, 0, 0].tolist() == [4, 5, 6, 7]
    assert not window.frames[0].image.flags.writeable
    assert window.stamps_ns == tuple(frame.stamp_ns for frame in frames[4:])
    assert (window.arrival_ns, window.fps, window.epoch, window.dropped) == (frames[7].stamp_ns + 5, 10.0, 0, 0)
    fitted: list[int] = []

    def fit(image: np.ndarray) -> np.ndarray:
        fitted.append(int(image[0, 0, 0]))
        return np.zeros((3, 5, 3), np.uint8)

    windows = run(WindowBuilder(frames=4, fps=10.0, fit=fit), even(24, 30.0), flush=False)
    assert windows[0].images.shape == (4, 3, 5, 3)
    assert fitted == [0, 3, 6, 9, 12, 15, 18, 21]


def test_the_skew_that_is_allowed_decides_what_a_hole_is() -> None:
    frames = frames_at([0, 100, 230, 300])
    assert len(run(WindowBuilder(frames=4, fps=10.0, max_skew=0.5), frames)) == 1
    strict = WindowBuilder(frames=4, fps=10.0, max_skew=0.2)
    assert run(strict, frames) == []
    assert strict.reasons == {"WIN_GAP": 1}


def test_duplicate_and_backward_stamps_are_dropped_and_counted() -> None:
    builder = WindowBuilder(frames=4, fps=10.0, source_fps=10.0)
    windows = run(builder, frames_at([0, 100, 100, 50, 200, 300, 300, 400, 500, 600, 700]))
    assert [window.seqs for window in windows] == [(0, 1, 4, 5), (7, 8, 9, 10)]
    assert [window.dropped for window in windows] == [2, 3]
    assert builder.dropped == 3


@pytest.mark.parametrize("step_ms", [-5000.0, 60_000.0, 1e12])
def test_a_step_of_the_clock_begins_a_new_epoch(step_ms: float) -> None:
    builder = WindowBuilder(frames=4, fps=10.0, source_fps=10.0)
    early = 10_000 + np.arange(6) * 100.0
    windows = run(builder, frames_at([*early, *(early + step_ms)]), at_once=True)
    assert [(window.epoch, window.seqs) for window in windows] == [(0, (0, 1, 2, 3)), (1, (6, 7, 8, 9))]
    assert builder.reasons == {"CLOCK_STEP": 1}


def test_the_end_completes_a_window_that_only_waits_for_a_nearer_frame() -> None:
    frames = frames_at([0, 100, 200, 280])
    builder = WindowBuilder(frames=4, fps=10.0)
    assert run(builder, frames, flush=False) == []
    assert [window.seqs for window in builder.flush()] == [(0, 1, 2, 3)]
    assert builder.flush() == []

    class Hurried(FakeSource):
        def frames(self) -> Iterator[Frame]:
            yield from frames

    slot = WindowSlot()
    read(Hurried(4), WindowBuilder(frames=4, fps=10.0), slot)
    assert slot.take() is not None  # the reader flushes


def test_the_highest_rate_it_can_give_is_chosen() -> None:
    for source_fps, trained, wanted in (
        (30.0, (6, 8, 12, 24), (24, False)),
        (24.0, (6, 8, 12, 24), (24, False)),
        (24000 / 1001, (6, 8, 12, 24), (24, False)),
        (23.0, (6, 8, 12, 24), (12, False)),
        (9.99, (5, 10), (10, False)),
        (60.0, (5, 10), (10, False)),
        (4.0, (5, 10), (4.0, True)),
        (17.0, (), (17.0, False)),
    ):
        assert choose_fps(source_fps, trained) == wanted


# The slot between reader and model thread, with real threads; numbers stand for windows where any will do.

GUARD_S = 5.0


def started(target: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=target, daemon=True)
    thread.start()
    return thread


def joined(thread: threading.Thread) -> None:
    thread.join(GUARD_S)
    assert not thread.is_alive(), "a thread hangs"


def test_the_newest_item_wins_and_the_rest_is_counted_and_a_lossless_slot_hands_over_all_in_order() -> None:
    slot = WindowSlot()
    assert [slot.put(i) for i in range(5)] == [True] * 5
    assert (slot.take(), slot.dropped) == (4, 4)
    slot = WindowSlot(lossless=True)
    giver = started(lambda: ([slot.put(i) for i in range(200)], slot.finish()))
    assert list(iter(slot.take, None)) == list(range(200))
    joined(giver)
    assert slot.dropped == 0


@pytest.mark.parametrize("ending", ["close", "finish"])
def test_who_waits_to_take_or_to_give_is_let_go(ending: str) -> None:
    empty, full = WindowSlot(), WindowSlot(lossless=True)
    got: list[int | None] = []
    answers: list[bool] = []
    taker = started(lambda: got.append(empty.take()))
    giver = started(lambda: answers.extend([full.put(1), full.put(2)]))
    time.sleep(0.05)
    getattr(empty, ending)()
    full.close()
    joined(taker)
    joined(giver)
    assert (got, answers) == ([None], [True, False])
    assert full.closed
    assert full.take() is None


def test_who_waits_works_meanwhile_until_nothing_is_left_to_do_and_again_when_more_is_shown() -> None:
    slot, left, done, got = WindowSlot(), [2], [], []

    def work() -> bool:
        if not left[0]:
            return False
        left[0] -= 1
        done.append(left[0])
        return True

    taker = started(lambda: got.append(slot.take(work)))
    until(lambda: done == [1, 0])
    left[0] = 1
    slot.show(None)
    until(lambda: done == [1, 0, 0])
    slot.put(7)
    joined(taker)
    assert got == [7]


def test_what_is_shown_while_there_is_work_under_way_is_not_lost() -> None:
    slot, calls = WindowSlot(), []

    def work() -> bool:
        calls.append(len(calls))
        if len(calls) == 1:
            slot.show(None)  # from another thread, just now
        else:
            slot.put(7)
        return False

    assert slot.take(work) == 7
    assert calls == [0, 1]


def test_a_fault_in_the_source_is_not_swallowed_and_closing_is_none() -> None:
    slot, source = WindowSlot(), Steady()
    reader = started(lambda: read(source, WindowBuilder(frames=4, fps=10.0, source_fps=10.0), slot))
    time.sleep(0.05)
    slot.close()
    source.close()
    joined(reader)
    assert slot.take() is None
    slot = WindowSlot()
    read(FakeSource(0, fails=ZeroDivisionError("bug")), WindowBuilder(frames=4, fps=10.0), slot)
    with pytest.raises(ReaderError) as caught:
        slot.take()
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
