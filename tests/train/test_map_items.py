"""Items mapped in processes: one outcome each, whatever raises or is killed."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mapped_work import always_killed, killed_once, seat_after_a_death, square, unsendable

from gcd_train.data.files import FileFault
from gcd_train.parallel import ItemError, map_items

HERE = Path(__file__).parent


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_each_item_has_one_outcome_and_errors_end_nothing(workers: int) -> None:
    outcomes = {outcome.item: outcome for outcome in map_items(square, range(6), workers=workers)}
    assert sorted(outcomes) == [0, 1, 2, 3, 4, 5]
    assert [outcomes[n].value for n in (0, 3, 5)] == [0, 9, 25]
    with pytest.raises(FileFault) as refused:
        outcomes[1].unwrap()
    assert (refused.value.path, refused.value.reason) == (Path("one.png"), "is refused")
    for number, told in ((2, "No space left"), (4, r"ZeroDivisionError.*mapped_work.py, line")):
        with pytest.raises(ItemError, match=told):
            outcomes[number].unwrap()


@pytest.mark.slow
def test_what_a_killed_worker_had_is_done_again(tmp_path: Path) -> None:
    items = [(str(tmp_path), number) for number in range(6)]
    outcomes = list(map_items(killed_once, items, workers=2))
    assert sorted((outcome.item[1], outcome.value) for outcome in outcomes) == [(n, n * n) for n in range(6)]
    attempts = {n: len((tmp_path / f"{n}-attempts").read_text().split()) for n in range(6)}
    assert attempts == {0: 1, 1: 1, 2: 1, 3: 2, 4: 2, 5: 1}


@pytest.mark.slow
def test_an_item_that_kills_every_worker_is_given_up() -> None:
    outcomes = {outcome.item: outcome for outcome in map_items(always_killed, range(4), workers=2, retries=1)}
    assert {item: outcome.value for item, outcome in outcomes.items()} == {0: 0, 1: 1, 2: None, 3: 9}
    with pytest.raises(ItemError, match=r"killed 2 times \(exit code -9\)"):
        outcomes[2].unwrap()


@pytest.mark.slow
def test_workers_take_environments_in_turn_and_a_new_one_has_that_of_the_killed(tmp_path: Path) -> None:
    items = [(str(tmp_path), number) for number in range(6)]
    environments = [{"SEAT": "a"}, {"SEAT": "b"}]
    outcomes = list(map_items(seat_after_a_death, items, workers=2, environments=environments))
    assert sorted(outcome.item for outcome in outcomes) == items
    assert {outcome.unwrap() for outcome in outcomes} == {"a", "b"}
    assert "SEAT" not in os.environ


@pytest.mark.slow
def test_a_result_that_cannot_travel_is_an_error() -> None:
    (outcome,) = map_items(unsendable, [1], workers=2)
    assert "cannot be sent" in str(outcome.error)


@pytest.mark.slow
def test_items_are_taken_as_workers_come_free() -> None:
    taken: list[int] = []

    def items() -> object:
        for number in range(100):
            taken.append(number)
            yield number

    outcomes = map_items(square, items(), workers=2)  # pyright: ignore[reportArgumentType]
    next(outcomes)
    assert len(taken) <= 4
    outcomes.close()  # pyright: ignore[reportAttributeAccessIssue]
    assert len(taken) <= 4


def started(folder: Path, function: str, items: str) -> subprocess.Popen[bytes]:
    """A script of its own that maps a function of `mapped_work`; `place` is the folder."""
    script = folder.with_name(f"{folder.name}.py")
    script.write_text(
        f"import signal, sys; sys.path.insert(0, {str(HERE)!r}); place = {str(folder)!r}\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # background jobs of a shell ignore it
        f"from mapped_work import {function}\n"
        "from gcd_train.parallel import map_items\n"
        "if __name__ == '__main__':\n"
        f"    list(map_items({function}, {items}, workers=2))\n"
    )
    return subprocess.Popen([sys.executable, str(script)], stderr=subprocess.DEVNULL)


@pytest.mark.slow
def test_leaving_early_stops_the_workers_in_an_orderly_way(tmp_path: Path) -> None:
    running = started(tmp_path, "wait_for_ever", "[place] * 3")
    pids = _wait_for(tmp_path, "begun-*", 2)
    running.send_signal(2)  # Ctrl-C
    running.wait(timeout=40)
    assert {path.name.split("-")[1] for path in tmp_path.glob("cleaned-*")} == pids
    assert not any(Path("/proc", pid).exists() for pid in pids)


@pytest.mark.slow
def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    running = started(tmp_path, "mark_and_square", "[(place, n) for n in range(10_000)]")
    _wait_for(tmp_path, "*", 2)
    running.kill()
    running.wait(timeout=30)
    pids = {path.name.split("-")[1] for path in tmp_path.iterdir()}
    deadline = time.monotonic() + 30
    while any(_is_running(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(_is_running(pid) for pid in pids)


def _is_running(pid: str) -> bool:
    """A process that nobody waited for is over, too."""
    try:
        return Path("/proc", pid, "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def _wait_for(folder: Path, pattern: str, count: int) -> set[str]:
    deadline = time.monotonic() + 60
    while len(list(folder.glob(pattern))) < count:
        assert time.monotonic() < deadline, os.listdir(folder)
        time.sleep(0.05)
    return {path.name.split("-")[1] for path in folder.glob(pattern)}
