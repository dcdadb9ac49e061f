"""Pixels of a message as arrays: raw and JPEG pictures, class maps, visibility, inverse depth; each in colour. And the
cells of a grid."""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gcd_client.endpoints import SetupError
from gcd_client.protocol import ClassRecord, GridMessage, MessageError, ViewMessage

PAINTED, SEEN_BEFORE, SEEN_NOW = 0, 1, 2  # pixels of kind vis
VISIBILITY = (
    ClassRecord(id=PAINTED, name="painted", colour=(245, 158, 11)),
    ClassRecord(id=SEEN_BEFORE, name="seen_before", colour=(147, 197, 253)),
    ClassRecord(id=SEEN_NOW, name="seen_now", colour=(29, 78, 216)),
)
UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # occupancy of a cell, as in nav_msgs/OccupancyGrid
_MIDDLE_GREY = 0.1  # 1/m: 10 m away is shown at half brightness


def images(message: ViewMessage) -> NDArray[np.uint8]:
    """Pixels u8 [T, H, W, C], read-only; RGB, or class numbers for class8. Raw encodings are not copied.

    Raises:
        MessageError: a JPEG frame is damaged or has another size; or the message is of kind depth.
        SetupError: the view is JPEG and cv2 is not installed here.
    """
    header = message.header
    if header.encoding == "invdepth16":
        raise MessageError(f"{message.topic} has no 8-bit pixels; read its inverse_depth")
    if header.offsets is None:
        return np.frombuffer(message.payload, np.uint8).reshape(header.shape)
    return decode_jpegs(message.payload, header.offsets, header.shape)


def inverse_depth(message: ViewMessage) -> NDArray[np.float32]:
    """Of kind depth: inverse depth along the view's axis, 1/m, float32 [T, H, W]; 0: none, or infinitely far. Under
    painted pixels it is a guess. Raises MessageError: another kind, or a value that is negative or not finite."""
    if message.header.encoding != "invdepth16":
        raise MessageError(f"{message.topic} has no depth; subscribe to kind depth")
    inverse = np.frombuffer(message.payload, "<f2").reshape(message.header.shape[:3]).astype(np.float32)
    if not (np.isfinite(inverse) & (inverse >= 0)).all():
        raise MessageError("inverse depth must be finite and not negative")
    return inverse


def depth_m(message: ViewMessage) -> NDArray[np.float32]:
    """The same as depth in metres, NaN: none. Raises MessageError as inverse_depth()."""
    inverse = inverse_depth(message)
    return np.divide(1, inverse, out=np.full_like(inverse, np.nan), where=inverse > 0)


def colours(message: ViewMessage) -> NDArray[np.uint8]:
    """Pixels for display, u8 RGB [T, H, W, 3], read-only: a class map in its colours, levels as grey, depth as grey,
    brighter the nearer. Raises as images() and paint()."""
    if message.header.encoding == "invdepth16":
        inverse = inverse_depth(message)[..., None]
        pixels = np.rint(255 * inverse / (inverse + _MIDDLE_GREY)).astype(np.uint8)
    else:
        pixels = images(message)
    if message.header.classes is not None:
        return paint(pixels[..., 0], message.header.classes)
    return np.broadcast_to(pixels, (*pixels.shape[:3], 3))


def paint(numbers: NDArray[np.uint8], classes: Sequence[ClassRecord]) -> NDArray[np.uint8]:
    """A class map u8 [...] in colour, RGB [..., 3], read-only. Raises MessageError: a number without a class."""
    known, palette = np.zeros(256, np.bool_), np.zeros((256, 3), np.uint8)
    for each in classes:
        known[each.id], palette[each.id] = True, each.colour
    if not known[numbers].all():
        raise MessageError(f"a class map must hold its class numbers, got {numbers[~known[numbers]][0]}")
    painted = palette[numbers]
    painted.flags.writeable = False
    return painted


class GridLayers(NamedTuple):
    """The cells of a grid, [H, W] each: rows along y, columns along x.

    occupancy: int8, UNKNOWN, FREE or OCCUPIED. visibility: uint8, SEEN_NOW, SEEN_BEFORE or 0, never seen. classes:
    uint8. height_m: float32, over the ground. age_ms: uint16, since it was seen. 0 in cells that were never seen.
    """

    occupancy: NDArray[np.int8]
    visibility: NDArray[np.uint8]
    classes: NDArray[np.uint8]
    height_m: NDArray[np.float32]
    age_ms: NDArray[np.uint16]


_LAYERS = ("i1", "u1", "u1", "<f2", "<u2")


def layers(message: GridMessage) -> GridLayers:
    """Raises MessageError: a value that no such layer has, such as NaN; or free or occupied, and never seen."""
    shape, payload, at, found = message.header.shape, message.payload, 0, list[NDArray[Any]]()
    for kind in map(np.dtype, _LAYERS):
        size = shape[0] * shape[1]
        found.append(np.frombuffer(payload, kind, size, at).reshape(shape))
        at += size * kind.itemsize
    occupancy, visibility, classes, height_m, age_ms = found
    known, numbers = occupancy != UNKNOWN, [each.id for each in message.header.classes]
    if not (
        np.isin(occupancy, (UNKNOWN, FREE, OCCUPIED)).all()
        and (visibility <= SEEN_NOW).all()
        and visibility[known].all()
        and np.isin(classes[visibility > 0], numbers).all()
        and np.isfinite(height_m).all()
    ):
        raise MessageError(f"{message.topic} holds cells that contradict themselves")
    return GridLayers(occupancy, visibility, classes, height_m.astype(np.float32), age_ms)


def grid_payload(cells: GridLayers) -> bytes:
    """Inverse of layers()."""
    return b"".join(layer.astype(kind).tobytes() for layer, kind in zip(cells, _LAYERS, strict=True))


def payload_of(pixels: NDArray[np.uint8]) -> memoryview:
    """An array as a raw payload: read-only bytes, copied only if `pixels` is not contiguous."""
    return np.ascontiguousarray(pixels).data.toreadonly().cast("B")


def encode_jpegs(frames: NDArray[np.uint8], quality: int = 90) -> tuple[bytes, tuple[int, ...]]:
    """RGB [T, H, W, 3] as a payload and its T+1 byte offsets; quality 0 to 100. Raises SetupError as images()."""
    cv2, parts = _cv2(), list[bytes]()
    for frame in frames:
        coded = cv2.imencode(".jpg", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        parts.append(coded.tobytes())
    return b"".join(parts), tuple(np.cumsum([0, *map(len, parts)]).tolist())


def decode_jpegs(payload: bytes | memoryview, offsets: Sequence[int], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Inverse of encode_jpegs(), read-only; `shape` is [T, H, W, 3]. Raises as images()."""
    cv2, frames = _cv2(), np.empty(shape, np.uint8)
    for index in range(shape[0]):
        coded = bytes(memoryview(payload)[offsets[index] : offsets[index + 1]])
        if jpeg_size(coded) != shape[1:3]:  # before decoding: a small file can claim a huge picture
            raise MessageError(f"JPEG frame {index} must have height and width {shape[1:3]}, got {jpeg_size(coded)}")
        try:
            picture = cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error as error:
            raise MessageError(f"JPEG frame {index} cannot be decoded: {error}") from error
        if picture is None or picture.shape != shape[1:]:
            raise MessageError(f"JPEG frame {index} is damaged")
        frames[index] = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    frames.flags.writeable = False
    return frames


def _cv2() -> Any:
    """Only JPEG needs it."""
    try:
        import cv2
    except ImportError as error:
        raise SetupError(f"JPEG needs cv2, which has no import here ({error}); pip install gcd-client[jpeg]") from error
    return cv2


def jpeg_size(coded: bytes) -> tuple[int, int] | None:
    """Height and width by the segment that starts the frame; None: there is none."""
    at = 2
    while at + 9 <= len(coded) and coded[at] == 0xFF:
        marker, length, height, width = struct.unpack_from(">xBHxHH", coded, at)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return height, width
        at += 2 + length
    return None
