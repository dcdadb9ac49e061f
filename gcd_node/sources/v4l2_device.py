"""USB and other cameras of this machine (Video4Linux)."""

import logging
import math
import os
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2

from gcd_node.errors import SourceAbsentError, SourceError
from gcd_node.sources.live_camera import LiveCamera
from gcd_node.sources.opencv_camera import Capture, OpenCvDriver, codec_name

_LOG = logging.getLogger(__name__)
_DEVICES = Path("/dev")
_NAMES = Path("/sys/class/video4linux")
_RAW_PIXELS = 640 * 480
_OLDEST_STAMP_NS = 1_000_000_000
_HINT = "check its cable, and that no other program uses it"


@dataclass(frozen=True, kw_only=True, slots=True)
class V4l2Request:
    """What a camera is asked for; what is None is left as the camera has it. It may give something else."""

    width: int | None = None
    height: int | None = None
    fps: float | None = None


def open_v4l2(
    device: str | None,
    request: V4l2Request,
    *,
    open_timeout_s: float = 5.0,
    open_capture: Callable[[str, int], Capture] = cv2.VideoCapture,
) -> LiveCamera:
    """A camera of this machine.

    Args:
        device: a number, or a path such as /dev/video0 or /dev/v4l/by-id/...; None is the first camera.
        open_capture: opens a path with a backend; tests give their own.
    Raises:
        SourceAbsentError: no such device, or it gives no picture in time; the message lists the cameras there are.
        SourceError: it is no camera, or may not be used.
    """
    path = _device_path(device)
    _check_device(path)

    def open_driver() -> _V4l2Driver:
        return _V4l2Driver(path, request, open_capture)

    return LiveCamera(f"the camera {path}", open_driver, open_timeout_s=open_timeout_s, hint=_HINT)


def list_v4l2() -> list[str]:
    """The cameras of this machine as `/dev/video0 (their name)`. One camera may have several entries."""
    paths = [path for path in _DEVICES.glob("video*") if path.name.removeprefix("video").isdigit()]
    return [_described(path) for path in sorted(paths, key=lambda path: int(path.name.removeprefix("video")))]


def _described(path: Path) -> str:
    try:
        return f"{path} ({(_NAMES / path.name / 'name').read_text().strip()})"
    except OSError:
        return str(path)


def _device_path(device: str | None) -> Path:
    if device is None or device.isdigit():
        return _DEVICES / f"video{device or 0}"
    return Path(device).expanduser()


def _check_device(path: Path) -> None:
    if not path.exists():
        there = ", ".join(list_v4l2()) or "none"
        raise SourceAbsentError(
            f"there is no camera {path}; there is {there}: plug it in, or correct device in [source]"
        )
    if not stat.S_ISCHR(path.stat().st_mode):
        raise SourceError(f"{path} is no camera device; give a number or a path such as /dev/video0")
    if not os.access(path, os.R_OK | os.W_OK):
        raise SourceError(f"{path} may not be used by this user; add the user to the group `video` and log in again")


class _V4l2Driver(OpenCvDriver):
    """An open device. Stamps are the driver's, where they are of the monotonic clock; else the time of arrival."""

    kind, hint = "v4l2", _HINT

    def __init__(self, path: Path, request: V4l2Request, open_capture: Callable[[str, int], Capture]) -> None:
        self._path, self._request, self._driver_stamps = path, request, False
        self.name, self.id = f"the camera {path}", path.name
        super().__init__(lambda: open_capture(str(path), cv2.CAP_V4L2))

    def check(self) -> None:
        """See OpenCvDriver."""
        if not self.capture.isOpened():
            there = ", ".join(list_v4l2()) or "none"
            raise SourceAbsentError(f"{self.name} cannot be opened; {_HINT}. There is {there}")
        _ask_for(self.capture, self._request, self._path)

    def grab(self) -> int | None:
        """See OpenCvDriver."""
        if not self.capture.grab():
            return None
        arrival_ns = time.monotonic_ns()
        stated_ms = self.capture.get(cv2.CAP_PROP_POS_MSEC)
        stated_ns = round(stated_ms * 1e6) if math.isfinite(stated_ms) else 0
        self._driver_stamps = 0 <= arrival_ns - stated_ns <= _OLDEST_STAMP_NS
        return stated_ns if self._driver_stamps else arrival_ns

    @property
    def fps(self) -> float | None:
        """See Driver."""
        return super().fps or self._request.fps

    def uncertainty_us(self, fps: float) -> int:
        """A driver stamps the begin or the end of a picture, no more than half a period from mid-exposure."""
        return round(1e6 / fps * (0.5 if self._driver_stamps else 2))


def _ask_for(capture: Capture, request: V4l2Request, path: Path) -> None:
    """The pixel format first: sizes and rates depend on it. Then read everything back: drivers refuse silently."""
    wanted: list[tuple[str, int, float]] = []
    if (request.width or 0) * (request.height or 0) > _RAW_PIXELS:  # raw, USB 2 has no room for it at a full rate
        wanted.append(("pixel format", cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG")))
    sizes = [("width", cv2.CAP_PROP_FRAME_WIDTH, request.width), ("height", cv2.CAP_PROP_FRAME_HEIGHT, request.height)]
    wanted += [(name, prop, value) for name, prop, value in sizes if value is not None]
    if request.fps is not None:
        wanted.append(("frame rate", cv2.CAP_PROP_FPS, request.fps))
    for _, prop, value in wanted:
        capture.set(prop, value)
    for name, prop, value in wanted:
        if abs((given := capture.get(prop)) - value) > 0.01 * value:
            _LOG.warning("%s: asked for %s %s, it gives %s", path, name, _shown(prop, value), _shown(prop, given))


def _shown(prop: int, value: float) -> str:
    return str(codec_name(value)) if prop == cv2.CAP_PROP_FOURCC else f"{value:g}"
