"""The slot between reader and model thread, with real threads; numbers stand for windows where any will do."""

import threading
import time
from collections.abc import Callable, Iterator

import pytest
from cameras import until
from fakes import FakeSource, Steady
from media import frames_at

from gcd_node.errors import ReaderError
from gcd_node.frame import Frame
from gcd_node.window import WindowBuilder, WindowSlot, read

GUARD_S = 5.0


def started(target: Callable[[], object]) -> threading.Thread:
    thread = threading.Thread(target=target, daemon=True)
    thread.start()
    return thread


def joined(thread: threading.Thread) -> None:
    thread.join(GUARD_S)
    assert not thread.is_alive(), "a thread hangs"


def builder() -> WindowBuilder:
    return WindowBuilder(frames=4, fps=10.0, source_fps=10.0)


def test_the_newest_item_wins_and_the_rest_is_counted() -> None:
    slot = WindowSlot()
    assert [slot.put(i) for i in range(5)] == [True] * 5
    assert slot.take() == 4
    assert slot.dropped == 4


def test_a_lossless_slot_hands_over_everything_in_order() -> None:
    slot = WindowSlot(lossless=True)
    giver = started(lambda: ([slot.put(i) for i in range(200)], slot.finish()))
    got: list[int] = []
    while (item := slot.take()) is not None:
        got.append(item)
    joined(giver)
    assert got == list(range(200))
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


class Hurried(FakeSource):
    """Its last frame comes early: it could be taken for its place only by who knows that none is nearer."""

    def frames(self) -> Iterator[Frame]:
        yield from frames_at([0, 100, 200, 270])


def test_the_last_window_is_not_forgotten_at_the_end() -> None:
    slot = WindowSlot()
    read(Hurried(4), WindowBuilder(frames=4, fps=10.0), slot)
    assert slot.take() is not None


def test_a_fault_in_the_source_is_not_swallowed() -> None:
    slot = WindowSlot()
    read(FakeSource(0, fails=ZeroDivisionError("bug")), builder(), slot)
    with pytest.raises(ReaderError) as caught:
        slot.take()
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_closing_slot_and_source_stops_the_reader_without_an_error() -> None:
    slot = WindowSlot()
    source = Steady()
    reader = started(lambda: read(source, builder(), slot))
    time.sleep(0.05)
    slot.close()
    source.close()
    joined(reader)
    assert slot.take() is None
