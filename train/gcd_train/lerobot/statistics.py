"""The statistics that a LeRobot data set keeps of each feature."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(slots=True)
class Spread:
    """Least, greatest, mean and deviation of what has passed."""

    count: int = 0
    low: Any = None
    high: Any = None
    total: Any = 0.0
    squares: Any = 0.0

    def add(self, rows: NDArray[Any]) -> None:
        """Count rows [T, N]."""
        values = rows.astype(np.float64)
        low, high = values.min(0), values.max(0)
        self.low = low if self.low is None else np.minimum(self.low, low)
        self.high = high if self.high is None else np.maximum(self.high, high)
        self.count += len(values)
        self.total = self.total + values.sum(0)
        self.squares = self.squares + (values**2).sum(0)

    def join(self, other: "Spread") -> None:
        """Count what another has counted."""
        self.low = other.low if self.low is None else np.minimum(self.low, other.low)
        self.high = other.high if self.high is None else np.maximum(self.high, other.high)
        self.count += other.count
        self.total, self.squares = self.total + other.total, self.squares + other.squares

    def told(self, *, picture: bool) -> dict[str, list[Any]]:
        """As LeRobot writes it: a number each, or [3, 1, 1] for the channels of pictures."""
        mean = self.total / self.count
        deviation = np.sqrt(np.maximum(self.squares / self.count - mean**2, 0.0))
        rows = {"min": self.low, "max": self.high, "mean": mean, "std": deviation}
        shaped = {name: (row.reshape(3, 1, 1) if picture else row).tolist() for name, row in rows.items()}
        return {**shaped, "count": [self.count]}
