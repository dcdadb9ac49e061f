"""Pictures, depth and rotations as the published files have them and as the compact ones do, written and read."""

import colorsys
import io
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import imagesize
import numpy as np
from numpy.typing import NDArray

from gcd_train.data.files import FileFault, read, read_npz
from gcd_train.errors import DataError, RenderError

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Number = TypeVar("Number", bound=np.generic)

NEAR_M, FAR_M = 0.05, 30_000.0
"""The range that depth codes keep; the farthest code also stands for the sky."""
SKY_M = FAR_M
"""What both layouts write where there is nothing but sky (the published reader cuts there)."""


def _png_options(level: int, filters: int, strategy: int) -> list[int]:
    filtered = [cv2.IMWRITE_PNG_FILTER, filters, cv2.IMWRITE_PNG_STRATEGY, strategy]
    return [cv2.IMWRITE_PNG_COMPRESSION, level, *filtered]


# photographs: 2.5 times faster than OpenCV's own choice of filters, and smaller
_FAST_PNG = _png_options(1, cv2.IMWRITE_PNG_FILTER_SUB, cv2.IMWRITE_PNG_STRATEGY_RLE)
_DEPTH_PNG = _png_options(6, cv2.IMWRITE_PNG_FILTER_PAETH, cv2.IMWRITE_PNG_STRATEGY_FILTERED)
# only what changes from row to row, in runs: a third of the time of searching for repetitions
_ID_PNG = _png_options(1, cv2.IMWRITE_PNG_FILTER_UP, cv2.IMWRITE_PNG_STRATEGY_RLE)
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_PALETTE = 3  # a kind of PNG
_MOST_PIXELS = 1 << 27
_PLAIN_TIFF = [cv2.IMWRITE_TIFF_COMPRESSION, 1]  # not compressed: every reader can
_WEBP_EFFORT = 2  # half the time of OpenCV's effort, which is 4, for 3 % more bytes


@dataclass(frozen=True, slots=True)
class DepthCode:
    """Depth as whole numbers: 0 where nothing is known, 1 for the nearest, `last` for the farthest and the sky.

        code = 1 + round((ln(1 / NEAR + 1 / bend) - ln(1 / z + 1 / bend)) / step)

    Nearer and farther values take the ends; what is not a positive number is 0. With no bend these are equal steps of
    the logarithm; with one, depths beyond it go in equal steps of the inverse, as of a stereo camera.
    """

    step: float
    bend_m: float = math.inf

    @property
    def last(self) -> int:
        """The farthest code."""
        return 1 + round((self._top - math.log(1 / FAR_M + 1 / self.bend_m)) / self.step)

    @property
    def _top(self) -> float:
        return math.log(1 / NEAR_M + 1 / self.bend_m)

    def encode(self, metres: Floats) -> NDArray[np.uint16]:
        """Codes of a depth or distance picture, same shape."""
        code = np.clip(metres, np.float32(NEAR_M), np.float32(FAR_M))
        bent = math.isfinite(self.bend_m)
        if bent:
            np.reciprocal(code, out=code)
            code += np.float32(1 / self.bend_m)
        np.log(code, out=code)
        code *= np.float32((-1 if bent else 1) / self.step)
        code += np.float32(1.5 + self._top / self.step)  # cutting the decimals off then rounds
        code[~(metres > 0)] = 0  # NaN too
        return code.astype(np.uint16)

    def table(self) -> Floats:
        """Metres of every code, [65536]; 0 where nothing is known."""
        inverse = np.exp(self._top - np.arange(-1, 2**16 - 1) * self.step) - 1 / self.bend_m
        metres = 1 / np.maximum(inverse, 1 / FAR_M)
        metres[0] = 0.0
        metres[self.last :] = FAR_M
        return metres.astype(np.float32)


STAGE_DEPTH = DepthCode(step=0.001)
"""For stages, seen all around. Half a step is 0.05 % of the depth, 7 mm at 15 m: as fine as the float16 of the
published point clouds."""
STREET_DEPTH = DepthCode(step=0.0025, bend_m=20.0)
"""For streets: two thirds of the bytes. Half a step is 0.125 % * (1 + z / 20 m) of the depth: 8 mm at 5 m, 5 cm at
20 m, 0.75 m at 100 m; a camera that moves by some metres does not see the difference."""
_STAGE_METRES, _STREET_METRES = STAGE_DEPTH.table(), STREET_DEPTH.table()


def with_sky(metres: Floats) -> Floats:
    """A drawn depth picture, 0 where there is only sky, with the sky as far as it is written."""
    return np.where(metres > 0, metres, np.float32(SKY_M))


def colour_png(rgb: Bytes, *, alpha: bool = False) -> bytes:
    """[H, W, 3] as a PNG without loss. alpha: with a channel that is opaque everywhere."""
    return _encoded(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGRA if alpha else cv2.COLOR_RGB2BGR), _FAST_PNG)


def pillow() -> Any:
    """Pillow's module Image. Raises RenderError without the extra `scenes`."""
    try:
        from PIL import Image  # OpenCV has neither palettes nor a choice of effort
    except ImportError as error:
        raise RenderError(
            "compact scenes and palettes need the extra `scenes`: pip install 'gcd-node[scenes]'"
        ) from error
    return Image


def webp(rgb: Bytes, *, quality: int) -> bytes:
    """[H, W, 3] as WebP of a quality up to 100. Raises RenderError without the extra `scenes`."""
    file = io.BytesIO()
    pillow().fromarray(rgb).save(file, "WEBP", quality=quality, method=_WEBP_EFFORT)
    return file.getvalue()


def float_tiff(values: Floats) -> bytes:
    """[H, W] as a float32 TIFF, not compressed."""
    return _encoded(".tiff", values, _PLAIN_TIFF)


def float_npz(values: Floats) -> bytes:
    """[H, W] as an npz with an array `data`, not compressed."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, data=values)
    return file.getvalue()


def depth_png(metres: Floats) -> bytes:
    """[H, W] as a 16-bit PNG of depth codes, for stages."""
    return _encoded(".png", STAGE_DEPTH.encode(metres), _DEPTH_PNG)


def street_depth_png(metres: Floats) -> bytes:
    """[H, W] as an 8-bit PNG [2 H, W] of depth codes for streets: the low bytes above the high ones.

    The high bytes are nearly all alike; beside the low ones, as in 16 bit, they would hide what these repeat.
    """
    codes = STREET_DEPTH.encode(metres)
    return _encoded(".png", np.concatenate([codes.astype(np.uint8), (codes >> 8).astype(np.uint8)]), _DEPTH_PNG)


def id_png(ids: Bytes) -> bytes:
    """[H, W] as an RGB PNG with each id as R + 256 G + 65536 B."""
    bgr = np.zeros((*ids.shape, 3), np.uint8)
    bgr[..., 2] = ids
    return _encoded(".png", bgr, _ID_PNG)


def packed_id_png(ids: Bytes) -> bytes:
    """[H, W] as a palette PNG whose colours are the ids in R: decoded to RGB it is `id_png`, at a third of the size."""
    return indexed_png(ids, [(number, 0, 0) for number in range(256)])


def indexed_png(ids: Bytes, palette: Sequence[tuple[int, int, int]]) -> bytes:
    """[H, W] as a palette PNG: the pixels are the ids, a viewer shows their colours (OpenCV writes no palettes)."""
    grey = _encoded(".png", ids, _ID_PNG)
    header = grey[12:25] + bytes([_PNG_PALETTE]) + grey[26:29]
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


def quaternions(turns: Doubles) -> Doubles:
    """Rotation matrices [..., 3, 3] as unit quaternions w, x, y, z [..., 4], w >= 0; inverse of `rotations`.

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix, so no case is singular.
    Source: Bar-Itzhack 2000, version 1.
    """
    m = np.asarray(turns, np.float64)
    k = np.empty((*m.shape[:-2], 4, 4))
    trace = np.trace(m, axis1=-2, axis2=-1)
    k[..., 0, 0] = trace
    k[..., 1:, 1:] = m + np.swapaxes(m, -1, -2) - trace[..., None, None] * np.eye(3)
    axial = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
    k[..., 0, 1:], k[..., 1:, 0] = axial, axial
    largest = np.linalg.eigh(k)[1][..., -1]
    return np.where(largest[..., :1] < 0, -largest, largest)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _encoded(suffix: str, picture: NDArray[np.generic], options: list[int]) -> bytes:
    done, data = cv2.imencode(suffix, picture, options)  # pyright: ignore[reportCallIssue, reportArgumentType]
    if not done:
        raise DataError(f"OpenCV could not write a {suffix} of {picture.dtype} {list(picture.shape)}")
    return data.tobytes()


def read_colour(path: Path) -> Bytes:
    """RGB picture of a PNG, WebP or JPEG file, u8 [H, W, 3]; alpha is dropped. Raises FileFault."""
    picture = decoded(path, read(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def read_depth(path: Path) -> Floats:
    """Metres, f32 [H, W], of a float TIFF, an npz with an array `data`, or a PNG of ours (`DepthCode`).

    0 is kept as "nothing known"; beyond 30 000 m is cut there, as published.
    Raises: FileFault if it is damaged, or holds NaN, negative numbers, or nothing that is known or within those.
    """
    match path.suffix:
        case ".npz":
            stored = read_npz(path).get("data")
            if stored is None:
                raise FileFault(path, "lacks its array `data`")
        case ".png":
            stored = _from_codes(path)
        case _:
            stored = decoded(path, read(path), cv2.IMREAD_UNCHANGED)
    shape = stored.shape[:2]
    if stored.dtype.kind != "f" or stored.ndim < 2 or stored.size == 0 or stored.size != shape[0] * shape[1]:
        raise FileFault(path, f"should hold float32 depth [H, W], got {stored.dtype} {list(stored.shape)}")
    metres = stored.reshape(shape).astype(np.float32, copy=False)
    nearest, farthest = float(metres.min()), float(metres.max())
    if not nearest >= 0:  # NaN is the least of all
        bad = int(np.count_nonzero(~(metres >= 0)))
        raise FileFault(path, f"has {bad} of {metres.size} depths that are NaN or negative")
    if farthest == 0:
        raise FileFault(path, "has no depth above 0 in any pixel")
    if nearest > FAR_M:
        raise FileFault(path, f"has depths beyond {FAR_M:g} m in every pixel: no scene is so far away")
    return np.minimum(metres, np.float32(FAR_M)) if farthest > FAR_M else metres


def _from_codes(path: Path) -> Floats:
    """Metres of a depth PNG: 16-bit codes of a stage, or of a street the low bytes above the high ones."""
    content = read(path)
    _require_whole_png(path, content)
    picture = decoded(path, content, cv2.IMREAD_UNCHANGED)
    if picture.ndim == 2 and picture.dtype == np.uint16:
        return _STAGE_METRES[picture]
    if picture.ndim != 2 or picture.dtype != np.uint8 or picture.shape[0] % 2:
        got = f"{picture.dtype} {list(picture.shape)}"
        raise FileFault(path, f"should hold 16-bit depth codes, or their low bytes above their high ones, got {got}")
    low, high = np.split(picture, 2)
    return _STREET_METRES[low + high.astype(np.uint16) * 256]


def read_ids(path: Path) -> NDArray[np.int32]:
    """Ids, i32 [H, W], of a PNG that stores them as R + 256 G + 65536 B. Raises FileFault."""
    content = read(path)
    _require_whole_png(path, content)
    picture = decoded(path, content, cv2.IMREAD_COLOR)
    ids = cv2.extractChannel(picture, 2).astype(np.int32)
    for channel, unit in ((1, 256), (0, 65536)):
        more = cv2.extractChannel(picture, channel)
        if cv2.countNonZero(more):  # mostly there is nothing in them
            ids += more.astype(np.int32) * unit
    return ids


def read_palette_indices(path: Path) -> Bytes:
    """Indices, u8 [H, W], of a palette PNG; of a grey one its values.

    Raises: FileFault; RenderError without the extra `scenes`, as OpenCV would give the palette's colours.
    """
    content = read(path)
    _require_whole_png(path, content)
    try:
        with pillow().open(io.BytesIO(content)) as picture:
            if picture.width * picture.height > _MOST_PIXELS:
                raise ValueError(f"it states {picture.width} x {picture.height} pixels")
            mode, indices = picture.mode, np.array(picture)
    except RenderError:
        raise
    except Exception as error:  # of any kind, where a file is damaged
        raise FileFault(path, f"is damaged ({error})") from error
    if mode not in ("P", "L", "1"):
        raise FileFault(path, "holds neither a palette nor grey of 8 bits: instance numbers cannot be told from it")
    brighter = 255 // (2 ** content[24] - 1) if mode == "L" else 1  # grey of fewer bits is spread over all levels
    return indices.astype(np.uint8, copy=False) // brighter


def sized(path: Path, picture: NDArray[Number], height: int, width: int, other: str) -> NDArray[Number]:
    """The picture. Raises FileFault if it has another size than `other` says."""
    if picture.shape[:2] != (height, width):
        got = f"{picture.shape[1]} x {picture.shape[0]}"
        raise FileFault(path, f"is {got} where {other} says {width} x {height}: sizes are mixed")
    return picture


def decoded(path: Path, content: bytes, flags: int) -> NDArray[Any]:
    """The picture in a file's content, as OpenCV decodes it with these flags. Raises FileFault."""
    try:
        width, height = imagesize.get(io.BytesIO(content), exif_rotation=False)
    except Exception as error:  # of any kind, where a header is damaged
        raise FileFault(path, f"is damaged: its size cannot be read ({error})") from error
    if width * height > _MOST_PIXELS:
        raise FileFault(path, f"states {width} x {height} pixels, more than {_MOST_PIXELS}")
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error as error:
        raise FileFault(path, f"cannot be decoded ({error.err or error})") from error
    if picture is None:  # pyright: ignore[reportUnnecessaryComparison]  the stub does not tell
        raise FileFault(path, f"is damaged: its {len(content)} bytes hold no whole picture")
    return picture  # pyright: ignore[reportReturnType]


def _require_whole_png(path: Path, content: bytes) -> None:
    """Some versions of libpng fill what is cut off with zeros; those would be ids."""
    if not content.startswith(_PNG_SIGNATURE) or len(content) < 33:
        raise FileFault(path, "is damaged: it is no PNG")
    if content[-8:-4] != b"IEND":
        raise FileFault(path, f"is damaged: it is cut off after {len(content)} bytes")
