"""Frames as JPEG, one after another with a table of offsets (wire protocol, section 4). Images are u8 RGB."""

import io

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import MessageError
from gcd_node.pictures.picture_header import parse_header

_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def encode_frames(frames: NDArray[np.uint8], quality: int = 90) -> tuple[bytes, tuple[int, ...]]:
    """[T, H, W, 3] to the payload and its T+1 byte offsets; quality 0 to 100."""
    parts: list[bytes] = []
    for frame in frames:
        _, coded = cv2.imencode(".jpg", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
        parts.append(coded.tobytes())
    offsets = np.cumsum([0, *map(len, parts)])
    return b"".join(parts), tuple(int(each) for each in offsets)


def decode_frames(payload: bytes | memoryview, offsets: tuple[int, ...], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Inverse of encode_frames(), read-only; `shape` is [T, H, W, 3].

    Raises:
        MessageError: a frame is no JPEG, is damaged, or has another size than `shape` says.
    """
    frames = np.empty(shape, np.uint8)
    data = memoryview(payload)
    for index in range(shape[0]):
        frames[index] = _decode(bytes(data[offsets[index] : offsets[index + 1]]), index, (shape[1], shape[2]))
    frames.flags.writeable = False
    return frames


def _decode(coded: bytes, index: int, size: tuple[int, int]) -> NDArray[np.uint8]:
    stated = _stated_size(coded)  # before decoding: a small file can claim a huge picture
    if stated != size:
        raise MessageError(f"JPEG frame {index} must be {size[0]}x{size[1]} (height x width), got {stated}")
    try:
        picture = cv2.imdecode(np.frombuffer(coded, np.uint8), _COLOUR)
    except cv2.error as error:
        raise MessageError(f"JPEG frame {index} cannot be decoded: {error.err}") from error
    if picture is None or picture.shape != (*size, 3):  # pyright: ignore[reportUnnecessaryComparison]  stub hides None
        raise MessageError(f"JPEG frame {index} is damaged")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)


def _stated_size(coded: bytes) -> tuple[int, int] | None:
    """Height and width by the frame header, None if there is none."""
    header = parse_header(io.BytesIO(coded))
    return None if header is None or header.kind != "jpeg" else (header.height, header.width)
