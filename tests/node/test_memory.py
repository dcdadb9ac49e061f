"""What is not needed any more goes back to the system, and what was imported is not searched for garbage."""

import ctypes
import gc
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


_TWO_WINDOWS = """
import resource
import torch
from gcd_node.life.memory import settle_process
settle_process()
faults = []
for _ in range(2):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(12 * 2**20)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(*faults)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "gnu_get_libc_version"), reason="needs the GNU C library")
def test_a_window_works_in_the_memory_of_the_one_before() -> None:
    ran = subprocess.run([sys.executable, "-c", _TWO_WINDOWS], capture_output=True, text=True, check=True)
    first, second = map(int, ran.stdout.split())
    assert second < 0.1 * first


def test_another_c_library_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_glibc", lambda: None)
    ring: list[object] = []
    ring.append(ring)
    del ring
    give_back_memory()
    assert gc.collect() == 0
