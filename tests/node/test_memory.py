"""What is not needed any more goes back to the system, and what was imported is not searched for garbage."""

import gc
import os
import threading

import numpy as np
import pytest

from gcd_node.life import memory
from gcd_node.life.memory import give_back_memory, settle_process
from gcd_node.load.meter import memory_mb


class Ring:
    """Holds pixels, and itself."""

    def __init__(self) -> None:
        self.pixels = [
            np.ones(2**18, np.uint8) for _ in range(800)
        ]  # 200 MiB in pieces that come from a heap; systems page out some of it
        self.itself = self


def test_pixels_that_hang_on_a_ring_go_back_to_the_system() -> None:
    gc.disable()  # Python would find them some time
    try:
        worker = threading.Thread(target=Ring)
        worker.start()
        worker.join()
        held_mb = memory_mb()
        give_back_memory()
        assert held_mb - memory_mb() > 60
    finally:
        gc.enable()


def test_a_settled_process_searches_for_new_garbage_only_and_is_settled_once() -> None:
    settle_process()
    frozen = gc.get_freeze_count()
    assert frozen > 10_000
    settle_process()
    assert gc.get_freeze_count() <= frozen
    ring = Ring()
    del ring
    assert gc.collect() > 0


class _Library:
    """Remembers what it was told."""

    def __init__(self) -> None:
        self.told = list[tuple[int, int]]()

    def mallopt(self, option: int, value: int) -> int:
        self.told.append((option, value))
        return 1


def test_all_threads_of_a_settled_process_share_one_heap(monkeypatch: pytest.MonkeyPatch) -> None:
    library = _Library()
    monkeypatch.setattr(memory, "_glibc", lambda: library)
    _forget_tunes(monkeypatch)
    settle_process.__wrapped__()
    assert library.told == [(-8, 1)]


def _forget_tunes(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("MALLOC_") or name == "GLIBC_TUNABLES"]:
        monkeypatch.delenv(name)


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("MALLOC_ARENA_MAX", "4", 0),
        ("MALLOC_ARENA_MAX", "", 1),
        ("MALLOC_TRIM_THRESHOLD_", "100000", 1),  # says nothing of heaps
        ("GLIBC_TUNABLES", "glibc.rtld.nns=3:glibc.malloc.arena_max=4", 0),
        ("GLIBC_TUNABLES", "glibc.malloc.hugetlb=1", 1),
    ],
)
def test_what_an_operator_said_of_allocation_stays(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, told: int
) -> None:
    library = _Library()
    monkeypatch.setattr(memory, "_glibc", lambda: library)
    _forget_tunes(monkeypatch)
    monkeypatch.setenv(name, value)
    settle_process.__wrapped__()
    assert len(library.told) == told


def test_another_c_library_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_glibc", lambda: None)
    ring: list[object] = []
    ring.append(ring)
    del ring
    give_back_memory()
    assert gc.collect() == 0
