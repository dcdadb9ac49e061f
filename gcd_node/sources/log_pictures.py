"""A logged picture to RGB: compressed ones, and raw ones in the layouts cameras send."""

import io
from collections.abc import Mapping
from types import MappingProxyType

import cv2
import numpy as np

from gcd_node.errors import SourceError
from gcd_node.frame import Image
from gcd_node.pictures.picture_header import MAX_PIXELS, parse_header
from gcd_node.sources.log_messages import CodedPicture, Picture, RawPicture

_CODECS = ("jpeg", "png", "webp")
_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_DEPTH = ("16UC", "32FC", "64FC", "16SC", "32SC")

_PACKED: Mapping[str, tuple[int, int | None]] = MappingProxyType(
    {
        "rgb8": (3, None),
        "bgr8": (3, cv2.COLOR_BGR2RGB),
        "8UC3": (3, cv2.COLOR_BGR2RGB),
        "rgba8": (4, cv2.COLOR_RGBA2RGB),
        "bgra8": (4, cv2.COLOR_BGRA2RGB),
        "8UC4": (4, cv2.COLOR_BGRA2RGB),
        "mono8": (1, cv2.COLOR_GRAY2RGB),
        "8UC1": (1, cv2.COLOR_GRAY2RGB),
        "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
        "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
        "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
        "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
        "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
        "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
        "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
        "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    }
)
"""Bytes a pixel, and OpenCV's way from there to RGB; None: it is RGB."""

_PLANES: Mapping[str, int] = MappingProxyType({"nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21})
"""A plane of brightness, then half as many rows of colour."""


def to_rgb(picture: Picture) -> tuple[Image, str]:
    """The picture, u8 [H, W, 3] RGB, and what it was coded as.

    Raises:
        SourceError: damaged, too large, or in a layout this node does not read.
    """
    return _decoded(picture) if isinstance(picture, CodedPicture) else (_unpacked(picture), picture.encoding)


def _decoded(picture: CodedPicture) -> tuple[Image, str]:
    if picture.format.startswith(_DEPTH) or "compressedDepth" in picture.format:
        raise SourceError(f"{picture.format[:40]!r} is a map of depths, not a picture")
    coded = bytes(picture.data)
    header = parse_header(io.BytesIO(coded))  # before decoding: a small message can claim a huge picture
    if header is None or header.kind not in _CODECS:
        raise SourceError(f"a picture of format {picture.format[:40]!r} is damaged, or none of {', '.join(_CODECS)}")
    _check_size(header.width, header.height)
    try:
        found = cv2.imdecode(np.frombuffer(coded, np.uint8), _COLOUR)
    except cv2.error as error:
        raise SourceError(f"a {header.kind} picture cannot be decoded: {error.err}") from error
    if found is None or found.shape != (header.height, header.width, 3):  # pyright: ignore[reportUnnecessaryComparison]  stub hides None
        raise SourceError(f"a {header.kind} picture is damaged")
    # image_transport names the order it handed to the coder, which takes all for BGR
    swapped = "compressed rgb" in picture.format
    return np.ascontiguousarray(found if swapped else cv2.cvtColor(found, cv2.COLOR_BGR2RGB), np.uint8), header.kind


def _unpacked(picture: RawPicture) -> Image:
    _check_size(picture.width, picture.height)
    if picture.encoding in _PLANES:
        rows = _rows(picture, 1, picture.height * 3 // 2)
        return _converted(rows[:, :, 0], _PLANES[picture.encoding], picture)
    if picture.encoding not in _PACKED:
        known = ", ".join([*_PACKED, *_PLANES])
        raise SourceError(f"pictures in {picture.encoding[:40]!r} are not read; known are {known}")
    channels, code = _PACKED[picture.encoding]
    rows = _rows(picture, channels, picture.height)
    return rows.copy() if code is None else _converted(rows, code, picture)


def _rows(picture: RawPicture, channels: int, height: int) -> Image:
    """[height, W, channels] without the padding of each row, not copied."""
    used, step = picture.width * channels, picture.step
    if not used <= step or step * height > len(picture.data):
        raise SourceError(
            f"a {picture.width} x {picture.height} picture in {picture.encoding} has rows of {step} bytes and "
            f"{len(picture.data)} in all, wanted are {used} and {used * height} or more: it is damaged"
        )
    rows = np.frombuffer(picture.data, np.uint8, count=step * height).reshape(height, step)
    return rows[:, :used].reshape(height, picture.width, channels)


def _converted(rows: Image, code: int, picture: RawPicture) -> Image:
    try:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), code), np.uint8)
    except cv2.error as error:
        raise SourceError(
            f"a {picture.width} x {picture.height} picture cannot be in {picture.encoding}: {error.err}"
        ) from error


def _check_size(width: int, height: int) -> None:
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        raise SourceError(f"a picture states {width} x {height} pixels, wanted are 1 to {MAX_PIXELS}: it is damaged")
