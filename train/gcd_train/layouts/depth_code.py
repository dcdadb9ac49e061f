"""Depth as whole numbers: one code for stages, which are seen all around, and a coarser one for streets.

Stages: equal steps of the logarithm, so that the relative error is the same near and far. Streets: near the same, far
off equal steps of the inverse, as of a stereo camera; a camera that moves by some metres does not see the difference.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

NEAR_M, FAR_M = 0.05, 30_000.0
"""The range that is kept; the farthest code also stands for the sky."""
SKY_M = FAR_M
"""What both layouts write where there is nothing but sky (the published reader cuts there)."""
_STEP = 0.001
_LAST = 1 + round(math.log(FAR_M / NEAR_M) / _STEP)
_STREET_STEP, _STREET_BEND_M = 0.0025, 20.0
_STREET_TOP = math.log(1 / NEAR_M + 1 / _STREET_BEND_M)
_STREET_LAST = 1 + round((_STREET_TOP - math.log(1 / FAR_M + 1 / _STREET_BEND_M)) / _STREET_STEP)


def with_sky(metres: NDArray[np.float32]) -> NDArray[np.float32]:
    """A drawn depth picture, 0 where there is only sky, with the sky as far as it is written."""
    return np.where(metres > 0, metres, np.float32(SKY_M))


def encode_depth(metres: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Codes of a stage's depth or distance picture, same shape.

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


def encode_street_depth(metres: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Codes of a street's depth picture, same shape: two thirds of the bytes that `encode_depth` would take.

        code = 1 + round((ln(1 / NEAR + 1 / 20 m) - ln(1 / z + 1 / 20 m)) / 0.0025),    0 where nothing is known

    Half a step is 0.125 % * (1 + z / 20 m) of the depth: 8 mm at 5 m, 5 cm at 20 m, 0.75 m at 100 m. The ends are 1
    and 2 398, the sky.
    """
    code = np.clip(metres, np.float32(NEAR_M), np.float32(FAR_M))
    np.reciprocal(code, out=code)
    code += np.float32(1 / _STREET_BEND_M)
    np.log(code, out=code)
    code *= np.float32(-1 / _STREET_STEP)
    code += np.float32(1.5 + _STREET_TOP / _STREET_STEP)  # cutting the decimals off then rounds
    code[~(metres > 0)] = 0  # NaN too
    return code.astype(np.uint16)


def decode_street_depth(codes: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Metres of `encode_street_depth`'s codes, same shape; 0 where nothing is known."""
    return _STREET_METRES[codes]


def stored_depth(picture: NDArray[Any]) -> NDArray[np.float32] | None:
    """Metres [H, W] of a depth PNG as it is decoded, None if it can be neither a stage's nor a street's.

    picture: u16 [H, W], codes of a stage, or u8 [2 H, W], codes of a street: low bytes above, high bytes below.
    """
    if picture.ndim != 2:
        return None
    if picture.dtype == np.uint16:
        return decode_depth(picture)
    if picture.dtype != np.uint8 or picture.shape[0] % 2:
        return None
    low, high = np.split(picture, 2)
    return decode_street_depth(low + high.astype(np.uint16) * 256)


def _table() -> NDArray[np.float32]:
    metres = np.minimum(NEAR_M * np.exp(np.arange(-1, 2**16 - 1) * _STEP), FAR_M)
    metres[0] = 0.0
    metres[_LAST] = FAR_M
    return metres.astype(np.float32)


def _street_table() -> NDArray[np.float32]:
    inverse = np.exp(_STREET_TOP - np.arange(-1, 2**16 - 1) * _STREET_STEP) - 1 / _STREET_BEND_M
    metres = 1 / np.maximum(inverse, 1 / FAR_M)
    metres[0] = 0.0
    metres[_STREET_LAST:] = FAR_M
    return metres.astype(np.float32)


_METRES = _table()
_STREET_METRES = _street_table()
