"""Depth as 16 bit: equal steps of the logarithm, so that the relative error is the same near and far."""

import math

import numpy as np
from numpy.typing import NDArray

NEAR_M, FAR_M = 0.05, 30_000.0
"""The range that is kept; the farthest code also stands for the sky."""
SKY_M = FAR_M
"""What both layouts write where there is nothing but sky (the published reader cuts there)."""
_STEP = 0.001
_LAST = 1 + round(math.log(FAR_M / NEAR_M) / _STEP)


def with_sky(metres: NDArray[np.float32]) -> NDArray[np.float32]:
    """A drawn depth picture, 0 where there is only sky, with the sky as far as it is written."""
    return np.where(metres > 0, metres, np.float32(SKY_M))


def encode_depth(metres: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Codes of a depth or distance picture, same shape.

        code = 1 + round(ln(z / NEAR) / 0.001),    0 where nothing is known

    Half a step is 0.05 % of the depth, 7 mm at 15 m: as fine as the float16 of the published point clouds. Nearer and
    farther values take the ends, 1 and 13 306; what is not a positive number is 0. (The numbers stay small because
    their differences are what a PNG packs.)
    """
    code = np.clip(metres, np.float32(NEAR_M), np.float32(FAR_M))
    np.log(code, out=code)
    code *= np.float32(1 / _STEP)
    code += np.float32(1.5 - math.log(NEAR_M) / _STEP)  # cutting the decimals off then rounds
    code[~(metres > 0)] = 0  # NaN too
    return code.astype(np.uint16)


def decode_depth(codes: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Metres of `encode_depth`'s codes, same shape; 0 where nothing is known."""
    return _METRES[codes]


def _table() -> NDArray[np.float32]:
    metres = np.minimum(NEAR_M * np.exp(np.arange(-1, 2**16 - 1) * _STEP), FAR_M)
    metres[0] = 0.0
    metres[_LAST] = FAR_M
    return metres.astype(np.float32)


_METRES = _table()
