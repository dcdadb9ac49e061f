"""What a piece of work takes: time by the clock, and time of all processor cores together."""

import time
from dataclasses import dataclass

import torch


@dataclass(frozen=True, slots=True)
class Spent:
    """wall_s: by the clock. cpu_s: of this process, user and system, all threads added up."""

    wall_s: float
    cpu_s: float

    def __add__(self, other: "Spent") -> "Spent":
        return Spent(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)


class Stopwatch:
    """Counts from where it was started last. On a GPU it waits until the device has done what it was given."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._wall_s, self._cpu_s = self._now()

    def lap(self) -> Spent:
        """What passed since the start or the last lap; starts the next."""
        wall_s, cpu_s = self._now()
        spent = Spent(wall_s - self._wall_s, cpu_s - self._cpu_s)
        self._wall_s, self._cpu_s = wall_s, cpu_s
        return spent

    def _now(self) -> tuple[float, float]:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter(), time.process_time()
