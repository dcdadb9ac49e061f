"""Cameras that OpenCV reads: Video4Linux devices; RTSP, and the http and udp streams of the same decoder."""

import contextlib
import logging
import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import urlsplit

import cv2
import numpy as np
from cv2.utils import logging as cv2_logging
from numpy.typing import NDArray

from gcd_node.errors import ConfigError, SourceAbsentError, SourceError, SourceLostError
from gcd_node.frame import MAX_PIXELS, Frame, Image, SourceInfo
from gcd_node.sources import RtspSource, SourceKind, V4l2Source
from gcd_node.sources.live import LiveCamera, sane_fps

_LOG = logging.getLogger(__name__)
_DEVICES = Path("/dev")
_RAW_PIXELS = 640 * 480
_OLDEST_STAMP_NS = 1_000_000_000
_DEVICE_HINT = "check its cable, and that no other program uses it"
_SCHEMES = ("rtsp", "rtsps", "http", "https", "udp", "tcp")
_STREAM_UNCERTAINTY_US = 100_000  # how long a network camera keeps a picture nobody knows
_STREAM_HINT = "check address, path and password, and that the server runs"

OpenCapture: TypeAlias = Callable[..., cv2.VideoCapture]
"""Opens a path or an address with a backend, and maybe a list of parameters and their values; tests give their own."""


class _OpenCvDriver:
    """A cv2.VideoCapture, set up, as a Driver; each kind says what its stamps are. Sequence numbers count what the
    camera gives."""

    kind: SourceKind
    hint: str

    def __init__(self, name: str, id_: str, fps: float | None, capture: cv2.VideoCapture) -> None:
        """name: of messages. fps: as the user states it."""
        self.name, self.id, self.corrupt, self._seq = name, id_, 0, -1
        self.stated_fps, self.capture, self.close = fps, capture, capture.release

    @property
    def fps(self) -> float | None:
        return sane_fps(self.capture.get(cv2.CAP_PROP_FPS)) or self.stated_fps

    def grab(self) -> int | None:
        """Wait for the next picture. When it was taken, monotonic nanoseconds; None if the camera gives no more."""
        raise NotImplementedError

    def read(self) -> Frame | None:
        try:
            stamp_ns = self.grab()
            if stamp_ns is None:
                raise SourceLostError(f"{self.name} gives no more pictures; {self.hint}")
            self._seq += 1
            image = _retrieved(self.capture)
        except cv2.error as error:
            raise SourceLostError(f"{self.name} fails ({error.err}); {self.hint}") from error
        self.corrupt += image is None
        return None if image is None else Frame(image=image, stamp_ns=stamp_ns, seq=self._seq)

    def describe(self, info: SourceInfo) -> SourceInfo:
        codec = codec_name(self.capture.get(cv2.CAP_PROP_FOURCC))
        return replace(info, codec=codec, stamp_uncertainty_us=_STREAM_UNCERTAINTY_US)


def codec_name(code: float) -> str | None:
    """The four characters of a CAP_PROP_FOURCC, None if they are none."""
    text = (int(code) & 0xFFFFFFFF).to_bytes(4, "little").rstrip(b"\0 ").decode("ascii", "replace")
    return text if text and text.isprintable() and text.isascii() else None


def silence_opencv() -> None:
    """From here on OpenCV and FFmpeg say nothing: it is no use to a user, and may hold an address with a password."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first video is opened
    cv2_logging.setLogLevel(cv2_logging.LOG_LEVEL_SILENT)


def _retrieved(capture: cv2.VideoCapture) -> Image | None:
    """What `capture` grabbed last, u8 [H, W, 3] RGB; None if it cannot be decoded."""
    try:
        good, picture = capture.retrieve()
    except cv2.error:
        return None
    if not good or picture.size == 0 or picture.dtype != np.uint8 or picture.shape[2:] not in ((), (3,)):
        return None
    return to_rgb(picture)


def to_rgb(picture: NDArray[Any]) -> Image:
    """OpenCV's BGR or grey picture, u8, as RGB."""
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB if picture.ndim == 2 else cv2.COLOR_BGR2RGB), np.uint8)


# Video4Linux.


def open_v4l2(config: V4l2Source, open_capture: OpenCapture = cv2.VideoCapture) -> LiveCamera:
    """A camera of this machine.

    Raises:
        SourceAbsentError: no such device; the message lists the cameras there are. SourceError: it may not be used.
    """
    device = config.device
    path = _DEVICES / f"video{device or 0}" if device is None or device.isdigit() else Path(device).expanduser()
    if not path.exists():
        there = ", ".join(map(str, list_v4l2()))
        others = f"there is {there}" if there else "nor any other"
        raise SourceAbsentError(f"there is no camera {path}; {others}: plug it in, or correct device in [source]")
    if not os.access(path, os.R_OK | os.W_OK):
        raise SourceError(f"{path} may not be used by this user; add the user to the group `video` and log in again")
    silence_opencv()
    name = f"the camera {path}"

    def open_driver() -> _V4l2Driver:
        capture = open_capture(str(path), cv2.CAP_V4L2)
        if not capture.isOpened():
            raise SourceAbsentError(f"{name} cannot be opened; {_DEVICE_HINT}")
        _set_up(capture, config, name)
        return _V4l2Driver(name, path.name, config.fps, capture)

    return LiveCamera(name, open_driver, open_timeout_s=config.open_timeout_s, hint=_DEVICE_HINT)


def list_v4l2() -> list[Path]:
    """The cameras of this machine, by name where the system gives them names. One camera may have several entries."""
    return [*sorted(_DEVICES.glob("v4l/by-id/*")), *sorted(_DEVICES.glob("video*"))]


def _set_up(capture: cv2.VideoCapture, config: V4l2Source, name: str) -> None:
    """Ask for a pixel format first: sizes and rates depend on it. Then read everything back: drivers refuse silently.
    name: of the camera, for messages."""
    wanted: list[tuple[str, int, float | None]] = [
        ("width", cv2.CAP_PROP_FRAME_WIDTH, config.width),
        ("height", cv2.CAP_PROP_FRAME_HEIGHT, config.height),
        ("frame rate", cv2.CAP_PROP_FPS, config.fps),
    ]
    if (config.width or 0) * (config.height or 0) > _RAW_PIXELS:  # raw, USB 2 has no room for it at a full rate
        wanted.insert(0, ("pixel format", cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG")))
    asked = [(what, prop, value) for what, prop, value in wanted if value is not None]
    for _, prop, value in asked:
        capture.set(prop, value)
    for what, prop, value in asked:
        if abs((given := capture.get(prop)) - value) > 0.01 * value:
            shown = [codec_name(each) if prop == cv2.CAP_PROP_FOURCC else f"{each:g}" for each in (value, given)]
            _LOG.warning("%s: asked for %s %s, it gives %s", name, what, *shown)


class _V4l2Driver(_OpenCvDriver):
    """An open device. Stamps are the driver's, where they are of the monotonic clock; else the time of arrival."""

    kind: SourceKind = "v4l2"
    hint = _DEVICE_HINT
    _driver_stamps = False

    def grab(self) -> int | None:
        if not self.capture.grab():
            return None
        arrival_ns = time.monotonic_ns()
        stated_ms = self.capture.get(cv2.CAP_PROP_POS_MSEC)
        stated_ns = round(stated_ms * 1e6) if math.isfinite(stated_ms) else 0
        self._driver_stamps = 0 <= arrival_ns - stated_ns <= _OLDEST_STAMP_NS
        return stated_ns if self._driver_stamps else arrival_ns

    def describe(self, info: SourceInfo) -> SourceInfo:
        # a driver stamps the begin or the end of a picture, no more than half a period from mid-exposure
        uncertainty_us = round(1e6 / info.fps_nominal * (0.5 if self._driver_stamps else 2))
        return replace(super().describe(info), stamp_uncertainty_us=uncertainty_us)


# Network streams.


def shown_address(url: str) -> str:
    """Scheme, host and port of a stream's URL: user, password, path and query may hold a secret.

    Raises:
        ConfigError: no URL of a stream. The message does not repeat it.
    """
    with contextlib.suppress(ValueError):  # of a port, or of brackets
        parts = urlsplit(url)
        place, is_plain = parts.netloc.rpartition("@")[2], url.count("@") == parts.netloc.count("@") < 2
        has_place = parts.port != 0 and (parts.hostname is not None or parts.scheme == "udp")
        if parts.scheme in _SCHEMES and has_place and is_plain and url.split() == [url]:
            return f"{parts.scheme}://{place}"
    raise ConfigError(
        f"the url of a stream is scheme://user:password@host:port/path with one of {', '.join(_SCHEMES)}; in a "
        "user name or password write @ as %40, / as %2F, : as %3A and [ as %5B"
    )


def open_stream(
    config: RtspSource,
    *,
    read_timeout_s: float = 5.0,
    open_capture: OpenCapture = cv2.VideoCapture,
) -> LiveCamera:
    """A network camera.

    Args:
        config: its url may hold user and password; no message does.
        read_timeout_s: silence after which the stream is lost: the decoder cannot go on after it.
    Raises:
        ConfigError: no URL of a stream.
    """
    address = shown_address(config.url)
    name = f"the stream {address}"
    parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, max(1, round(1000 * config.open_timeout_s))]
    parameters += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, max(1, round(1000 * read_timeout_s))]
    parameters += [cv2.CAP_PROP_N_THREADS, 1]  # every thread more delays pictures by one

    def open_driver() -> _StreamDriver:
        capture = open_capture(config.url, cv2.CAP_FFMPEG, parameters)
        if not capture.isOpened():
            raise SourceAbsentError(f"{name} cannot be opened; {_STREAM_HINT}")
        width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if width * height > MAX_PIXELS:
            capture.release()
            raise SourceError(f"{name} has {width:.0f} x {height:.0f} pixels, over {MAX_PIXELS}; choose a smaller one")
        return _StreamDriver(name, address.partition("://")[2], config.fps, capture)

    silence_opencv()
    return LiveCamera(name, open_driver, open_timeout_s=config.open_timeout_s, hint=_STREAM_HINT)


class Backlog:
    """Tells pictures that piled up, before the first was read or over a silence, from those of now.

    They come without a wait, and stamped with their arrival they would be taken for new.
    """

    _LONGEST_NS = 2_000_000_000
    _SILENCE_NS = 200_000_000

    def __init__(self, *, period_ns: int) -> None:
        """period_ns: from picture to picture."""
        self._period_ns = period_ns
        self._silence_ns = max(self._SILENCE_NS, 3 * period_ns)
        self._arrival_ns: int | None = None
        self._since_ns: int | None = None

    def holds(self, arrival_ns: int) -> bool:
        """Whether the picture that arrived now, on the monotonic clock, is an old one."""
        waited_ns = None if self._arrival_ns is None else arrival_ns - self._arrival_ns
        self._arrival_ns = arrival_ns
        if waited_ns is None or waited_ns > self._silence_ns:
            self._since_ns = arrival_ns
        elif self._since_ns is not None and (
            2 * waited_ns >= self._period_ns or arrival_ns - self._since_ns > self._LONGEST_NS
        ):
            self._since_ns = None
        return self._since_ns is not None


class _StreamDriver(_OpenCvDriver):
    """An open stream. Stamps are times of arrival: a stream's own clock has no known beginning."""

    kind: SourceKind = "rtsp"
    hint = _STREAM_HINT

    def __init__(self, name: str, id_: str, fps: float | None, capture: cv2.VideoCapture) -> None:
        super().__init__(name, id_, fps, capture)
        self._backlog = Backlog(period_ns=round(1e9 / (self.fps or 25.0)))

    def grab(self) -> int | None:
        while self.capture.grab():
            arrival_ns = time.monotonic_ns()
            if not self._backlog.holds(arrival_ns):
                return arrival_ns
        return None

    @property
    def fps(self) -> float | None:
        return self.stated_fps or sane_fps(self.capture.get(cv2.CAP_PROP_FPS))
