"""Size and kind of a still picture from its header, so that a small file cannot unfold into gigabytes."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

MAX_PIXELS = 64_000_000
"""Larger pictures are refused: 64 million pixels are 192 MB once decoded."""

_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BARE_MARKERS = frozenset({0x01, *range(0xD0, 0xD9)})
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_SHORT = 256, 257, 3
_TIFF_MAX_ENTRIES = 1000


@dataclass(frozen=True, kw_only=True, slots=True)
class PictureHeader:
    """kind: "png", "jpeg", "bmp", "webp" or "tiff". width, height: stored pixels, before any rotation."""

    kind: str
    width: int
    height: int


def read_header(path: Path) -> PictureHeader | None:
    """What a picture's header states; None if it is damaged or of another kind. Raises OSError."""
    with path.open("rb") as file:
        return parse_header(file)


def parse_header(file: BinaryIO) -> PictureHeader | None:
    """The same of an open file, from its beginning."""
    head = file.read(32)
    file.seek(0)
    try:
        return _parse(head, file)
    except (struct.error, IndexError):  # ends within its header
        return None


def _parse(head: bytes, file: BinaryIO) -> PictureHeader | None:
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        width, height = struct.unpack(">II", head[16:24])
        return _header("png", width, height)
    if head.startswith(b"BM"):
        width, height = struct.unpack("<ii", head[18:26])
        return _header("bmp", width, abs(height))
    if head.startswith(b"\xff\xd8\xff"):
        return _jpeg(file)
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        return _webp(head)
    if head.startswith((b"II*\0", b"MM\0*")):
        return _tiff(head, file)
    return None


def _header(kind: str, width: int, height: int) -> PictureHeader | None:
    return PictureHeader(kind=kind, width=width, height=height) if width > 0 and height > 0 else None


def _jpeg(file: BinaryIO) -> PictureHeader | None:
    """Walks the segments to the one that starts the frame."""
    file.seek(2)
    while file.read(1) == b"\xff":
        while (marker := file.read(1)) == b"\xff":
            pass
        if marker[0] in _JPEG_BARE_MARKERS:
            continue
        (length,) = struct.unpack(">H", file.read(2))
        if marker[0] in _JPEG_SIZE_MARKERS:
            height, width = struct.unpack(">xHH", file.read(5))
            return _header("jpeg", width, height)
        file.seek(length - 2, 1)
    return None


def _webp(head: bytes) -> PictureHeader | None:
    kind = head[12:16]
    if kind == b"VP8X":
        return _header("webp", int.from_bytes(head[24:27], "little") + 1, int.from_bytes(head[27:30], "little") + 1)
    if kind == b"VP8L":
        (bits,) = struct.unpack("<I", head[21:25])
        return _header("webp", (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
    if kind == b"VP8 ":
        width, height = struct.unpack("<HH", head[26:30])
        return _header("webp", width & 0x3FFF, height & 0x3FFF)
    return None


def _tiff(head: bytes, file: BinaryIO) -> PictureHeader | None:
    order = "<" if head.startswith(b"II") else ">"
    (offset,) = struct.unpack(order + "I", head[4:8])
    file.seek(offset)
    (entries,) = struct.unpack(order + "H", file.read(2))
    found: dict[int, int] = {}
    for _ in range(min(entries, _TIFF_MAX_ENTRIES)):
        tag, kind, _, value = struct.unpack(order + "HHI4s", file.read(12))
        found[tag] = struct.unpack(order + ("H2x" if kind == _TIFF_SHORT else "I"), value)[0]
    return _header("tiff", found.get(_TIFF_WIDTH, 0), found.get(_TIFF_HEIGHT, 0))
