"""Pages of weights that were read and are not needed for a while: given back, where a file still has them.

Weights are mapped from their files. What is read once a window, such as the projections of an embedding, stays in
memory beside what every step reads, unless somebody says that it may go. Reading it again brings it back.
"""

import ctypes
import mmap
import sys
from functools import cache

import torch
from torch import Tensor, nn

LEAST_BYTES = 2**20
"""Smaller weights are not worth a word with the system."""

_DONT_NEED = 4  # MADV_DONTNEED in Linux' uapi/asm-generic/mman-common.h
_ENTRY, _OF_FILE, _SWAPPED = 8, 61, 62  # of /proc/PID/pagemap, a page: bytes, and two bits; bit 63, the sign: present


def let_go(*modules: nn.Module | None) -> None:
    """Give back the memory of their large weights that are unchanged pages of a mapped file.

    Nothing changes but time: whoever reads them next waits for the file. Weights that are nobody's but this process'
    own, or that were changed since they were mapped, stay, as on other systems than Linux and on other devices.
    """
    for module in modules:
        for parameter in () if module is None else module.parameters():
            _let_go(parameter.detach())


def _let_go(weight: Tensor) -> None:
    size = weight.numel() * weight.element_size()
    library, page = _library(), mmap.PAGESIZE
    if library is None or weight.device.type != "cpu" or size < LEAST_BYTES or not weight.is_contiguous():
        return
    first, end = -(-weight.data_ptr() // page), (weight.data_ptr() + size) // page  # whole pages: others share the rest
    if _all_of_file(first, end - first):
        library.madvise(ctypes.c_void_p(first * page), ctypes.c_size_t((end - first) * page), _DONT_NEED)


def _all_of_file(first: int, pages: int) -> bool:
    """Whether each of these pages that is in memory is one of a file, as it is there; else it must not be dropped."""
    try:
        with open("/proc/self/pagemap", "rb", buffering=0) as pagemap:
            pagemap.seek(first * _ENTRY)
            told = pagemap.read(pages * _ENTRY)
    except OSError:
        return False
    if len(told) != pages * _ENTRY:
        return False
    entries = torch.frombuffer(bytearray(told), dtype=torch.int64)
    own = (entries < 0) & ((entries >> _OF_FILE) & 1 == 0) | ((entries >> _SWAPPED) & 1 == 1)
    return not bool(own.any())


@cache
def _library() -> ctypes.CDLL | None:
    """The C library of Linux; None elsewhere."""
    return ctypes.CDLL(None) if sys.platform == "linux" else None
