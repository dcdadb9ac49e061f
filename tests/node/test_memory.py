"""What is not needed any more goes back to the system, and what was imported is not searched for garbage."""

import gc
import os
import subprocess
import sys
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


_WINDOWS = """
import resource
import torch
from gcd_node.life.memory import settle_process
settle_process()
faults = []
for _ in range(60):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(12 * 2**20)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(*faults)
"""


def _keeps_64_mib() -> bool:
    """Asked of a process of its own, which it changes."""
    ask = "import ctypes, sys; sys.exit(ctypes.CDLL(None).mallopt(-3, 64 * 2**20) != 1)"
    return subprocess.run([sys.executable, "-c", ask], capture_output=True, check=False).returncode == 0


@pytest.mark.skipif(not _keeps_64_mib(), reason="needs a GNU C library that keeps buffers of 64 MiB (2.36 does)")
def test_a_window_works_in_the_memory_of_the_one_before() -> None:
    ran = subprocess.run([sys.executable, "-c", _WINDOWS], capture_output=True, text=True, check=True)
    first, *others = map(int, ran.stdout.split())
    assert sum(others[-20:]) < first  # of twenty windows less than one fetches
    assert sum(others) < 20 * first  # until the holes between what stays are large enough, it takes a few


class _Library:
    """Remembers what it was told, and accepts thresholds up to one."""

    def __init__(self, highest: int) -> None:
        self.highest, self.told = highest, list[tuple[int, int]]()

    def mallopt(self, option: int, value: int) -> int:
        accepted = option != -3 or value <= self.highest
        if accepted:
            self.told.append((option, value))
        return int(accepted)


@pytest.mark.parametrize(
    ("highest_mib", "told_mib"), [(1024, [(-3, 64), (-1, 512)]), (32, [(-3, 32), (-1, 512)]), (0, [])]
)
def test_a_library_keeps_its_own_thresholds_unless_it_accepts_one(
    monkeypatch: pytest.MonkeyPatch, highest_mib: int, told_mib: list[tuple[int, int]]
) -> None:
    library = _Library(highest_mib * 2**20)
    monkeypatch.setattr(memory, "_glibc", lambda: library)
    _forget_tunes(monkeypatch)
    settle_process.__wrapped__()
    assert library.told == [(-8, 1), *((option, mib * 2**20) for option, mib in told_mib)]


def _forget_tunes(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("MALLOC_") or name == "GLIBC_TUNABLES"]:
        monkeypatch.delenv(name)


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("MALLOC_ARENA_MAX", "4", 0),
        ("MALLOC_TRIM_THRESHOLD_", "100000", 0),
        ("GLIBC_TUNABLES", "glibc.malloc.arena_max=4", 0),
        ("GLIBC_TUNABLES", "glibc.rtld.nns=3:glibc.malloc.trim_threshold=131072", 0),
        ("GLIBC_TUNABLES", "glibc.rtld.nns=3:glibc.malloc.hugetlb=1", 3),
        ("MALLOC_ARENA_MAX", "", 3),
        ("MALLOC_PERTURB_", "7", 3),  # for who looks for faults: says nothing of how much is kept
    ],
)
def test_what_an_operator_said_of_allocation_stays(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, told: int
) -> None:
    library = _Library(2**30)
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
