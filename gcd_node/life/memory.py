"""What a process that runs for weeks does so that it neither grows nor stands still: memory of Python and of C."""

import ctypes
import gc
import os
from functools import cache

_ARENA_MAX = -8  # mallopt(3)


@cache
def settle_process() -> None:
    """Once a process, after its imports and before its threads.

    What was imported is never looked at again for garbage: that holds up every thread for 0.1 s each time. And all
    threads allocate from one heap. Otherwise each of the first 8 threads a core has one of its own, which keeps what
    was freed in it; a node begins new threads whenever a camera comes back, and frees 20 MB with every window. Where
    the environment says how many heaps there are to be, that stays.
    """
    gc.collect()
    gc.freeze()
    library = _glibc()
    if library is not None and not _heaps_are_told():
        library.mallopt(_ARENA_MAX, 1)


def _heaps_are_told() -> bool:
    """Whether somebody has told the C library how many heaps to have: he knows his machine."""
    return bool(os.environ.get("MALLOC_ARENA_MAX")) or "glibc.malloc.arena_max=" in os.environ.get("GLIBC_TUNABLES", "")


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
