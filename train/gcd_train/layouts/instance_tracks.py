"""What one camera saw of every instance, frame by frame."""

import numpy as np
from numpy.typing import NDArray

_IDS = 256
_BITS = 64


class InstanceTracks:
    """Pixel counts [T, 256] and boxes [T, 256, 4] of instance ids; a box is its first row, first column, and the row
    and column after its last, in pixels, all 0 where the instance is not seen.
    """

    def __init__(self, frames: int) -> None:
        self.pixels = np.zeros((frames, _IDS), np.int64)
        self.boxes = np.zeros((frames, _IDS, 4), np.int64)

    def add(self, time: int, ids: NDArray[np.uint8]) -> None:
        """One picture [H, W]."""
        counts = np.bincount(ids.reshape(-1), minlength=_IDS)
        self.pixels[time] = counts
        for first in range(0, int(np.flatnonzero(counts)[-1]) + 1, _BITS):  # one bit an id: a row is seen at once
            bit_of = np.zeros(_IDS, np.uint64)
            bit_of[first : first + _BITS] = np.uint64(1) << np.arange(_BITS, dtype=np.uint64)
            bits = bit_of[ids]
            top, bottom = _span(np.bitwise_or.reduce(bits, axis=1))
            left, right = _span(np.bitwise_or.reduce(bits, axis=0))
            self.boxes[time, first : first + _BITS] = np.stack([top, left, bottom, right], -1)
        self.boxes[time][counts == 0] = 0


def _span(occupied: NDArray[np.uint64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First place with each bit, and one after the last, [64]."""
    there = (occupied[:, None] >> np.arange(_BITS, dtype=np.uint64)) & np.uint64(1)
    return there.argmax(0), len(there) - there[::-1].argmax(0)
