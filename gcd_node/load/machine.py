"""Which machine figures come from, in words, and what else it had to do."""

import os
import platform
from pathlib import Path

import msgspec
import torch

_GIGABYTE = 1e9


class Machine(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """cores: this process may use. memory_gb: of the machine. device: the GPU's name, None without one."""

    cpu: str
    cores: int
    memory_gb: float
    device: str | None
    torch: str
    python: str

    @property
    def words(self) -> str:
        """One line for people."""
        cores = f"{self.cores} core{'' if self.cores == 1 else 's'}"
        device = "no GPU" if self.device is None else self.device
        return f"{self.cpu}, {cores}, {self.memory_gb:.0f} GB, {device}, torch {self.torch}, Python {self.python}"


def this_machine() -> Machine:
    """Look at it. Linux."""
    return Machine(
        cpu=_cpu_name(Path("/proc/cpuinfo").read_text()) or platform.machine(),
        cores=len(os.sched_getaffinity(0)),
        memory_gb=os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / _GIGABYTE,
        device=torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        torch=str(torch.__version__),
        python=platform.python_version(),
    )


def _cpu_name(cpuinfo: str) -> str | None:
    """Of an x86; an ARM core does not say."""
    for line in cpuinfo.splitlines():
        key, _, value = line.partition(":")
        if key.strip() == "model name":
            return " ".join(value.split())
    return None
