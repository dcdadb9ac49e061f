"""Colours of numbers: depth by its logarithm, instances apart from each other."""

import colorsys

import cv2
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

SKY_M = 250.0
"""Beyond this it is sky: everything that scenes have is nearer."""
UNKNOWN = (38, 38, 38)
"""Colour of depth that is not known, and of sky."""
_GOLDEN = 0.61803398875


def depth_colours(depth: NDArray[np.float32], near_m: float, far_m: float) -> Bytes:
    """Depth in metres [...] as RGB u8 [..., 3]: near is red, far is dark blue, in equal steps of the logarithm."""
    known = (depth > 0) & (depth < SKY_M)
    span = max(np.log(max(far_m, 1e-6) / max(near_m, 1e-6)), 1e-6)
    share = np.log(np.maximum(depth, 1e-6) / max(near_m, 1e-6)) / span
    table = depth_table()
    coloured = table[(255 * (1 - share.clip(0, 1))).round().astype(np.uint8)]
    return np.where(known[..., None], coloured, np.array(UNKNOWN, np.uint8))


def depth_table() -> Bytes:
    """RGB of 256 steps from far to near, u8 [256, 3]."""
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_TURBO)[:, 0, ::-1], np.uint8)


def depth_ticks(near_m: float, far_m: float) -> list[float]:
    """Round numbers of metres between two depths, at most eight; in a narrow range evenly spaced."""
    rounds = [digit * 10.0**power for power in range(-2, 5) for digit in (1, 2, 3, 5, 7)]
    ticks = [number for number in rounds if near_m <= number <= far_m]
    if len(ticks) > 8:
        return [tick for tick in ticks if f"{tick:e}"[0] in "125"]
    if len(ticks) >= 3 or far_m <= near_m:
        return ticks
    step = next(number for number in rounds if number >= (far_m - near_m) / 5)
    return [round(number * step, 3) for number in range(int(near_m / step) + 1, int(far_m / step) + 1)]


def instance_colour(number: int) -> tuple[int, int, int]:
    """A colour for an instance that its neighbours in number do not have; 0, the background, is light grey."""
    if number == 0:
        return (224, 224, 224)
    lightness = (0.5, 0.62, 0.4)[number % 3]
    red, green, blue = colorsys.hls_to_rgb((number * _GOLDEN) % 1.0, lightness, 0.75)
    return round(255 * red), round(255 * green), round(255 * blue)
