"""Pictures as the bytes of a file: the published encodings, and the compact ones."""

import colorsys
import io
import struct
import zlib
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError, RenderError
from gcd_train.layouts.depth_code import encode_depth, encode_street_depth
from gcd_train.layouts.parallel_domain4d_names import DEPTH_KEY

Bytes = NDArray[np.uint8]

_FAST_PNG = [  # photographs: 2.5 times faster than OpenCV's own choice of filters, and smaller
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_SUB,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
]
_DEPTH_PNG = [
    cv2.IMWRITE_PNG_COMPRESSION,
    6,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_PAETH,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_FILTERED,
]
_ID_PNG = [  # only what changes from row to row, in runs: a third of the time of searching for repetitions
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_UP,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
]
_BY_PALETTE = 3  # the kind of a PNG
_PLAIN_TIFF = [cv2.IMWRITE_TIFF_COMPRESSION, 1]  # not compressed: every reader can
_WEBP_EFFORT = 2  # half the time of OpenCV's effort, which is 4, for 3 % more bytes


def rgba_png(rgb: Bytes) -> bytes:
    """[H, W, 3] as a PNG with an alpha channel that is opaque everywhere."""
    return _encoded(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGRA), _FAST_PNG)


def rgb_png(rgb: Bytes) -> bytes:
    """[H, W, 3] as a PNG without loss."""
    return _encoded(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), _FAST_PNG)


def webp(rgb: Bytes, *, quality: int) -> bytes:
    """[H, W, 3] as WebP of a quality up to 100. Raises RenderError without the extra `scenes`."""
    try:
        from PIL import Image  # an optional dependency, as drawing is; OpenCV has no choice of effort
    except ImportError as error:
        raise RenderError("compact scenes need the extra `scenes`: pip install 'gcd-node[scenes]'") from error
    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "WEBP", quality=quality, method=_WEBP_EFFORT)
    return file.getvalue()


def float_tiff(values: NDArray[np.float32]) -> bytes:
    """[H, W] as a float32 TIFF, not compressed."""
    return _encoded(".tiff", values, _PLAIN_TIFF)


def float_npz(values: NDArray[np.float32]) -> bytes:
    """[H, W] as an npz with the array `data`, not compressed."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{DEPTH_KEY: values})
    return file.getvalue()


def depth_png(metres: NDArray[np.float32]) -> bytes:
    """[H, W] as a 16-bit PNG of depth codes, for stages."""
    return _encoded(".png", encode_depth(metres), _DEPTH_PNG)


def street_depth_png(metres: NDArray[np.float32]) -> bytes:
    """[H, W] as an 8-bit PNG [2 H, W] of depth codes for streets: the low bytes above the high ones.

    The high bytes are nearly all alike; beside the low ones, as in 16 bit, they would hide what these repeat.
    """
    codes = encode_street_depth(metres)
    return _encoded(".png", np.concatenate([codes.astype(np.uint8), (codes >> 8).astype(np.uint8)]), _DEPTH_PNG)


def id_png(ids: Bytes) -> bytes:
    """[H, W] as an RGB PNG whose pixels tell an id as R + 256 G + 65536 B."""
    bgr = np.zeros((*ids.shape, 3), np.uint8)
    bgr[..., 2] = ids
    return _encoded(".png", bgr, _ID_PNG)


def packed_id_png(ids: Bytes) -> bytes:
    """[H, W] as a palette PNG whose colours are the ids in R: decoded to RGB it is `id_png`, at a third of the size."""
    return indexed_png(ids, [(number, 0, 0) for number in range(256)])


def indexed_png(ids: Bytes, palette: Sequence[tuple[int, int, int]]) -> bytes:
    """[H, W] as a palette PNG: the pixels are the ids, a viewer shows their colours (OpenCV writes no palettes)."""
    grey = _encoded(".png", ids, _ID_PNG)
    header = grey[12:25] + bytes([_BY_PALETTE]) + grey[26:29]
    colours = bytes(channel for colour in palette for channel in colour)
    return grey[:8] + _chunk(header[:4], header[4:]) + _chunk(b"PLTE", colours) + grey[33:]


def instance_palette() -> tuple[tuple[int, int, int], ...]:
    """256 distinct colours by instance id; 0, the background, is black."""
    colours = [(0, 0, 0)]
    for number in range(1, 256):
        hue, value = number * 0.618034 % 1.0, 0.98 - 0.12 * (number % 4)
        red, green, blue = colorsys.hsv_to_rgb(hue, 0.55 + 0.15 * (number % 3), value)
        colours.append((round(255 * red), round(255 * green), round(255 * blue)))
    return tuple(colours)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _encoded(suffix: str, picture: NDArray[np.generic], options: list[int]) -> bytes:
    done, data = cv2.imencode(suffix, picture, options)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if not done:
        raise DataError(f"OpenCV could not write a {suffix} of {picture.dtype} {list(picture.shape)}")
    return data.tobytes()
