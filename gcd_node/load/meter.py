"""What this process holds now: memory, threads, file descriptors. Linux."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_MEGABYTE = 2**20


@dataclass(frozen=True, kw_only=True, slots=True)
class Holding:
    """memory_mb: resident, MiB. threads: of this process, those of libraries too. files: open descriptors."""

    memory_mb: float
    threads: int
    files: int


def holding() -> Holding:
    """Look at this process."""
    return Holding(memory_mb=memory_mb(), threads=len(os.listdir("/proc/self/task")), files=len(open_files()))


def memory_mb() -> float:
    """Resident memory, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / _MEGABYTE


def open_files() -> dict[int, str]:
    """Open descriptors and what they are."""
    found: dict[int, str] = {}
    for name in os.listdir("/proc/self/fd"):
        try:
            found[int(name)] = os.readlink(f"/proc/self/fd/{name}")
        except OSError:
            continue  # the one that listed the folder, or closed meanwhile
    return found


def percentile(values: Sequence[float], share: float) -> float:
    """The value that `share` per cent lie at or below; one that was measured, never between two. NaN of nothing."""
    return float(np.percentile(values, share, method="higher")) if len(values) else float("nan")
