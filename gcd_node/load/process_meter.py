"""What another process, or this one, has used so far. Linux.

The peak of resident memory is the kernel's own (VmHWM). Not ru_maxrss: a process that a larger one has started begins
with the peak of that.
"""

import os
import threading
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

_KILOBYTE = 1024
_LOOK_S = 0.02


@dataclass(frozen=True, kw_only=True, slots=True)
class Memory:
    """Bytes. peak_resident: the most so far, pages of mapped files included. private: now, without them."""

    peak_resident: int
    private: int


def cpu_s(pid: int) -> float:
    """User and system time of a process, all its threads. Raises ProcessLookupError if there is none."""
    fields = _read(pid, "stat").rpartition(")")[2].split()
    user, system = int(fields[11]), int(fields[12])  # the 14th and 15th, counted from the name on
    return (user + system) / os.sysconf("SC_CLK_TCK")


def memory(pid: int) -> Memory:
    """Of a process. Raises ProcessLookupError if there is none."""
    found = dict(line.split(":", 1) for line in _read(pid, "status").splitlines() if ":" in line)
    return Memory(peak_resident=_bytes(found.get("VmHWM", "0 kB")), private=_bytes(found.get("RssAnon", "0 kB")))


def _bytes(text: str) -> int:
    return int(text.split()[0]) * _KILOBYTE


def _read(pid: int, name: str) -> str:
    try:
        return Path(f"/proc/{pid}/{name}").read_text()
    except OSError as error:
        raise ProcessLookupError(f"there is no process {pid} any more: {error.strerror}") from error


class PrivatePeak:
    """Looks at a process every 20 ms, in a thread, and keeps the most private memory it saw. A context manager."""

    def __init__(self, pid: int) -> None:
        self._pid, self._over = pid, threading.Event()
        self._most = 0
        self._thread = threading.Thread(target=self._look, name="memory", daemon=True)

    @property
    def bytes(self) -> int:
        """So far."""
        return self._most

    def __enter__(self) -> "PrivatePeak":
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        while True:
            try:
                self._most = max(self._most, memory(self._pid).private)
            except ProcessLookupError:
                return
            if self._over.wait(_LOOK_S):
                return
