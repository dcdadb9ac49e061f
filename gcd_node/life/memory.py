"""What a process that runs for weeks does so that it neither grows nor stands still: memory of Python and of C."""

import ctypes
import gc
import os
from functools import cache

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # mallopt(3)
_KEPT_B = 512 * 2**20
"""So much free memory at the end of the heap is kept for the next window instead of being returned after each."""
_LARGEST_IN_HEAP_B = (64 * 2**20, 32 * 2**20)
"""Buffers above this are fetched from the system page by page each time; the first that the library accepts. Older ones
allow 32 MiB. Without either they find a threshold of their own, which they do no more once they were told another one.
"""
_TUNES = ("ARENA_MAX", "ARENA_TEST", "TOP_PAD_", "MMAP_MAX_", "MMAP_THRESHOLD_", "TRIM_THRESHOLD_")
"""What an operator can say of how much is kept: variables MALLOC_..., and `glibc.malloc...` in GLIBC_TUNABLES."""


@cache
def settle_process() -> None:
    """Once a process, after its imports and before its threads.

    What was imported is never looked at again for garbage: that holds up every thread for 0.1 s each time. And all
    threads allocate from one heap. Otherwise each of the first 8 threads a core has one of its own, which keeps what
    was freed in it; a node begins new threads whenever a camera comes back, and frees 20 MB with every window. What
    a window frees is kept for the next: otherwise a tenth of the time of a small model goes into fetching pages.
    Where the environment says how much is to be kept (_TUNES), nothing of that is changed.
    """
    gc.collect()
    gc.freeze()
    library = _glibc()
    if library is None or _operator_tunes():
        return
    library.mallopt(_ARENA_MAX, 1)
    if any(library.mallopt(_MMAP_THRESHOLD, largest) for largest in _LARGEST_IN_HEAP_B):
        library.mallopt(_TRIM_THRESHOLD, _KEPT_B)


def _operator_tunes() -> bool:
    """Whether somebody has told the C library by its environment how to allocate: he knows his machine."""
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    return any(os.environ.get(f"MALLOC_{name}") for name in _TUNES) or any(
        f"glibc.malloc.{name.lower().rstrip('_')}=" in tunables for name in _TUNES
    )


def give_back_memory() -> None:
    """Return to the system what is not needed any more, now and not some time: when a stream ended or was lost.

    Its pixels hang on objects that refer to each other, which Python would find only much later.
    """
    gc.collect()
    library = _glibc()
    if library is not None:
        library.malloc_trim(0)


@cache
def _glibc() -> ctypes.CDLL | None:
    """The C library; None if it is another one."""
    try:
        library = ctypes.CDLL(None)
        return library if hasattr(library, "gnu_get_libc_version") else None
    except OSError:
        return None
