"""Pixels on disk without loss: all windows of a view one after the other in an FFV1 video, and each one's digest."""

import hashlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import DamagedRunError
from gcd_node.pictures.files import video_writer
from gcd_node.pictures.picture_header import MAX_PIXELS
from gcd_node.sources.opencv_log import quiet_opencv

Pixels = NDArray[np.uint8]
_MATROSKA = b"\x1a\x45\xdf\xa3"


def pixel_digest(pixels: Pixels) -> str:
    """SHA-256 of the bytes of an array in C order, 64 hex digits."""
    return hashlib.sha256(np.ascontiguousarray(pixels).data).hexdigest()


class PixelWriter:
    """Appends windows to a video. Pictures are u8 [T, H, W, 3] RGB; class maps u8 [T, H, W], stored as grey pictures.

    A full disk does not show here, because OpenCV does not tell: read the video again to be sure.
    """

    def __init__(self, path: Path, *, height: int, width: int, fps: float) -> None:
        """Raises OutputError if the video cannot be begun."""
        self._video = video_writer(path, width, height, fps)

    def write(self, pixels: Pixels) -> None:
        """Append a window."""
        conversion = cv2.COLOR_RGB2BGR if pixels.ndim == 4 else cv2.COLOR_GRAY2BGR
        for frame in pixels:
            self._video.write(cv2.cvtColor(frame, conversion))

    def close(self) -> None:
        """Finish the video; until then it may lack its end."""
        self._video.release()


class PixelReader:
    """Takes windows from a video that PixelWriter wrote."""

    def __init__(self, path: Path, *, shape: tuple[int, int, int], grey: bool) -> None:
        """shape: T, H, W. grey: it holds class maps. Raises DamagedRunError if it cannot be opened."""
        if not path.is_file():
            raise DamagedRunError(f"{path} is missing; copy the whole folder of the run, or replay it again")
        _require_matroska(path)
        self._path, self._shape, self._grey = path, shape, grey
        with quiet_opencv():
            self._video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._video.isOpened():
            raise DamagedRunError(f"{path} cannot be opened as a video: truncated or damaged; replay it again")
        width, height = self._video.get(cv2.CAP_PROP_FRAME_WIDTH), self._video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if width * height > MAX_PIXELS:  # before a picture of it is decoded
            self.close()
            raise DamagedRunError(f"{path} states {width:.0f} x {height:.0f} pixels; it was changed: replay again")

    def read(self, window_id: int, sha256: str) -> Pixels:
        """The next window, u8 [T, H, W, 3], or [T, H, W] if grey.

        Raises:
            DamagedRunError: the video ends too early, its pictures have another size, or these are not the pixels
                with that digest.
        """
        frames: list[Pixels] = []
        count, height, width = self._shape
        for index in range(count):
            good, frame = self._video.read()
            if not good:
                raise DamagedRunError(
                    f"{self._path} ends at frame {index} of {count} of window {window_id}: it is shorter than "
                    "manifest.json says; copy it again, or replay again"
                )
            if frame.shape[:2] != (height, width):
                raise DamagedRunError(
                    f"{self._path} has pictures of {frame.shape[1]} x {frame.shape[0]} pixels, manifest.json says "
                    f"{width} x {height}; one of the two was changed or damaged: replay again"
                )
            plain = frame[..., 0] if self._grey else cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
            frames.append(np.asarray(plain, np.uint8))
        pixels = np.stack(frames)
        if pixel_digest(pixels) != sha256:
            raise DamagedRunError(
                f"{self._path}: the pixels of window {window_id} do not have the SHA-256 that manifest.json states; "
                "one of the two was changed or damaged: replay again"
            )
        return pixels

    def require_end(self) -> None:
        """Raises DamagedRunError if more frames follow."""
        if self._video.read()[0]:
            raise DamagedRunError(f"{self._path} has more frames than manifest.json says; replay again")

    def close(self) -> None:
        """Let the file go."""
        self._video.release()


def _require_matroska(path: Path) -> None:
    """FFmpeg goes by the content: it would follow a play list to files and addresses nobody named."""
    try:
        with path.open("rb") as file:
            head = file.read(len(_MATROSKA))
    except OSError as error:
        raise DamagedRunError(f"cannot read {path}: {error.strerror}; check its permissions") from error
    if head != _MATROSKA:
        raise DamagedRunError(
            f"{path} cannot be opened: it is no Matroska video, its first bytes are {head!r}; replay again"
        )
