"""Cameras that OpenCV reads: Video4Linux devices; RTSP, and the http and udp streams of the same decoder.

OpenCV's and FFmpeg's own messages are no use to a user, and may hold an address with a password in it: they are kept
quiet.
"""

import contextlib
import logging
import math
import os
import re
import socket
import stat
import threading
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple, TypeAlias
from urllib.parse import urlsplit

import cv2
import numpy as np
from cv2.utils import logging as cv2_logging

from gcd_node.errors import ConfigError, SourceAbsentError, SourceError, SourceLostError
from gcd_node.frame import MAX_PIXELS, Frame, Image, SourceInfo
from gcd_node.sources import RtspSource, SourceKind, V4l2Source
from gcd_node.sources.live import LiveCamera, sane_fps

_LOG = logging.getLogger(__name__)
_LOCK = threading.Lock()
_LEVELS: list[int] = []  # one for every block that is being kept quiet; the first is the level to go back to

_DEVICES = Path("/dev")
_NAMES = Path("/sys/class/video4linux")
_RAW_PIXELS = 640 * 480
_OLDEST_STAMP_NS = 1_000_000_000
_DEVICE_HINT = "check its cable, and that no other program uses it"

_DEFAULT_PORTS = {"rtsp": 554, "rtsps": 322, "http": 80, "https": 443, "udp": None, "tcp": None}
_STREAM_UNCERTAINTY_US = 100_000  # how long a network camera keeps a picture nobody knows
_KNOCK_TIMEOUT_S = 1.0
_STREAM_HINT = "check address, path and password, and that the server runs"

OpenCapture: TypeAlias = Callable[..., cv2.VideoCapture]
"""Opens a path or an address with a backend, and maybe a list of parameters and their values; tests give their own."""


class _OpenCvDriver:
    """A cv2.VideoCapture as a Driver; each kind says how it is set up and what its stamps are.

    name, hint: of messages. Sequence numbers count what the camera gives.
    """

    kind: SourceKind
    hint: str

    def __init__(self, name: str, id_: str, open_capture: Callable[[], cv2.VideoCapture]) -> None:
        """Raises SourceError as `set_up`."""
        self.name, self._id, self.corrupt, self._seq = name, id_, 0, -1
        with ExitStack() as stack:
            stack.enter_context(quiet_opencv())
            self.capture = open_capture()
            stack.callback(self.capture.release)
            self.set_up()
            self.close = stack.pop_all().close

    def set_up(self) -> None:
        """Look at what was just opened, and set it up. Raises SourceError."""
        raise NotImplementedError

    def grab(self) -> int | None:
        """Wait for the next picture. When it was taken, monotonic nanoseconds; None if the camera gives no more."""
        raise NotImplementedError

    def uncertainty_us(self, fps: float) -> int:
        """How far a stamp may be from mid-exposure."""
        raise NotImplementedError

    @property
    def fps(self) -> float | None:
        return sane_fps(self.capture.get(cv2.CAP_PROP_FPS))

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

    def describe(self, first: Frame, fps: float) -> SourceInfo:
        return SourceInfo(
            kind=self.kind,
            id=self._id,
            width=first.size[0],
            height=first.size[1],
            fps_nominal=fps,
            clock="realtime",
            codec=codec_name(self.capture.get(cv2.CAP_PROP_FOURCC)),
            stamp_uncertainty_us=self.uncertainty_us(fps),
        )


def codec_name(code: float) -> str | None:
    """The four characters of a CAP_PROP_FOURCC, None if they are none."""
    text = (int(code) & 0xFFFFFFFF).to_bytes(4, "little").rstrip(b"\0 ").decode("ascii", "replace")
    return text if text and text.isprintable() and text.isascii() else None


def _retrieved(capture: cv2.VideoCapture) -> Image | None:
    """What `capture` grabbed last, u8 [H, W, 3] RGB; None if it cannot be decoded."""
    try:
        good, picture = capture.retrieve()
    except cv2.error:
        return None
    if not good or picture.size == 0 or picture.dtype != np.uint8 or picture.shape[2:] not in ((), (3,)):
        return None
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB if picture.ndim == 2 else cv2.COLOR_BGR2RGB), np.uint8)


@contextmanager
def quiet_opencv() -> Generator[None]:
    """Silence for the length of a block; blocks of several threads may overlap."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first video is opened
    with _LOCK:
        _LEVELS.append(_LEVELS[0] if _LEVELS else cv2_logging.getLogLevel())
        cv2_logging.setLogLevel(cv2_logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        with _LOCK:
            level = _LEVELS.pop()
            if not _LEVELS:
                cv2_logging.setLogLevel(level)


# Video4Linux.


def open_v4l2(config: V4l2Source, open_capture: OpenCapture = cv2.VideoCapture) -> LiveCamera:
    """A camera of this machine.

    Raises:
        SourceAbsentError: no such device, or it gives no picture in time; the message lists the cameras there are.
        SourceError: it is no camera, or may not be used.
    """
    device = config.device
    path = _DEVICES / f"video{device or 0}" if device is None or device.isdigit() else Path(device).expanduser()
    if not path.exists():
        there = ", ".join(list_v4l2()) or "none"
        raise SourceAbsentError(
            f"there is no camera {path}; there is {there}: plug it in, or correct device in [source]"
        )
    if not stat.S_ISCHR(path.stat().st_mode):
        raise SourceError(f"{path} is no camera device; give a number or a path such as /dev/video0")
    if not os.access(path, os.R_OK | os.W_OK):
        raise SourceError(f"{path} may not be used by this user; add the user to the group `video` and log in again")

    return LiveCamera(
        f"the camera {path}",
        lambda: _V4l2Driver(path, config, open_capture),
        open_timeout_s=config.open_timeout_s,
        hint=_DEVICE_HINT,
    )


def list_v4l2() -> list[str]:
    """The cameras of this machine as `/dev/video0 (their name)`. One camera may have several entries."""
    numbers = [path.name.removeprefix("video") for path in _DEVICES.glob("video*")]
    found: list[str] = []
    for number in sorted(int(each) for each in numbers if each.isdigit()):
        name = ""
        with contextlib.suppress(OSError):  # it may just be pulled out
            name = f" ({(_NAMES / f'video{number}' / 'name').read_text().strip()})"
        found.append(f"{_DEVICES}/video{number}{name}")
    return found


class _V4l2Driver(_OpenCvDriver):
    """An open device. Stamps are the driver's, where they are of the monotonic clock; else the time of arrival."""

    kind, hint = "v4l2", _DEVICE_HINT

    def __init__(self, path: Path, config: V4l2Source, open_capture: OpenCapture) -> None:
        self._path, self._config, self._driver_stamps = path, config, False
        super().__init__(f"the camera {path}", path.name, lambda: open_capture(str(path), cv2.CAP_V4L2))

    def set_up(self) -> None:
        """Ask for a pixel format first: sizes and rates depend on it. Then read everything back: drivers refuse
        silently."""
        config, capture = self._config, self.capture
        if not capture.isOpened():
            there = ", ".join(list_v4l2()) or "none"
            raise SourceAbsentError(f"{self.name} cannot be opened; {_DEVICE_HINT}. There is {there}")
        wanted: list[tuple[str, int, float | None]] = [
            ("width", cv2.CAP_PROP_FRAME_WIDTH, config.width),
            ("height", cv2.CAP_PROP_FRAME_HEIGHT, config.height),
            ("frame rate", cv2.CAP_PROP_FPS, config.fps),
        ]
        if (config.width or 0) * (config.height or 0) > _RAW_PIXELS:  # raw, USB 2 has no room for it at a full rate
            wanted.insert(0, ("pixel format", cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG")))
        asked = [(name, prop, value) for name, prop, value in wanted if value is not None]
        for _, prop, value in asked:
            capture.set(prop, value)
        for name, prop, value in asked:
            if abs((given := capture.get(prop)) - value) > 0.01 * value:
                shown = [codec_name(each) if prop == cv2.CAP_PROP_FOURCC else f"{each:g}" for each in (value, given)]
                _LOG.warning("%s: asked for %s %s, it gives %s", self._path, name, *shown)

    def grab(self) -> int | None:
        if not self.capture.grab():
            return None
        arrival_ns = time.monotonic_ns()
        stated_ms = self.capture.get(cv2.CAP_PROP_POS_MSEC)
        stated_ns = round(stated_ms * 1e6) if math.isfinite(stated_ms) else 0
        self._driver_stamps = 0 <= arrival_ns - stated_ns <= _OLDEST_STAMP_NS
        return stated_ns if self._driver_stamps else arrival_ns

    @property
    def fps(self) -> float | None:
        return super().fps or self._config.fps

    def uncertainty_us(self, fps: float) -> int:
        """A driver stamps the begin or the end of a picture, no more than half a period from mid-exposure."""
        return round(1e6 / fps * (0.5 if self._driver_stamps else 2))


# Network streams.


class StreamAddress(NamedTuple):
    """Where a stream is, without user, password, path and query: any of them may hold a secret.

    host: empty for a udp stream that is sent to this machine. port: None if there is neither a stated nor a usual one.
    """

    scheme: str
    host: str
    port: int | None

    def __str__(self) -> str:
        return f"{self.scheme}://{self.place}"

    @property
    def place(self) -> str:
        """Host, and the port unless it is the usual one."""
        return self.host if self.port in (None, _DEFAULT_PORTS[self.scheme]) else f"{self.host}:{self.port}"


def parse_address(url: str) -> StreamAddress:
    """What of a stream's URL may be shown.

    Raises:
        ConfigError: no URL of a stream. The message does not repeat it.
    """
    with contextlib.suppress(ValueError):  # of a port, or of brackets
        scheme, _, rest = url.partition("://")
        authority = re.split("[/?#]", rest, maxsplit=1)[0]
        parts = urlsplit(f"{scheme}://{authority.rpartition('@')[2]}")  # users and passwords may hold brackets
        host, port = parts.hostname or "", parts.port
        is_plain = rest.count("@") == authority.count("@") < 2 and url.split() == [url]
        if parts.scheme in _DEFAULT_PORTS and (host or parts.scheme == "udp") and is_plain:
            host = f"[{host}]" if ":" in host else host
            return StreamAddress(parts.scheme, host, _DEFAULT_PORTS[parts.scheme] if port is None else port)
    raise ConfigError(
        f"the url of a stream is scheme://user:password@host:port/path with one of {', '.join(_DEFAULT_PORTS)}; in a "
        "user name or password write @ as %40, / as %2F and : as %3A"
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
        SourceAbsentError: nobody answers there, or no picture in time.
        SourceError: the pictures are too large.
    """
    address = parse_address(config.url)
    parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, max(1, round(1000 * config.open_timeout_s))]
    parameters += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, max(1, round(1000 * read_timeout_s))]
    parameters += [cv2.CAP_PROP_N_THREADS, 1]  # every thread more delays pictures by one

    def open_driver() -> _StreamDriver:
        return _StreamDriver(lambda: open_capture(config.url, cv2.CAP_FFMPEG, parameters), address, config.fps)

    return LiveCamera(f"the stream {address}", open_driver, open_timeout_s=config.open_timeout_s, hint=_STREAM_HINT)


class Backlog:
    """Tells pictures that piled up, before the first was read or over a silence, from those of now.

    They come without a wait, and stamped with their arrival they would be taken for new.
    """

    _LONGEST_NS = 2_000_000_000
    _SILENCE_NS = 200_000_000

    def __init__(self, *, period_ns: int) -> None:
        """period_ns: from picture to picture, where the stream itself does not say."""
        self._period_ns = period_ns
        self._silence_ns = max(self._SILENCE_NS, 3 * period_ns)
        self._arrival_ns: int | None = None
        self._position_ms = math.nan
        self._since_ns: int | None = None

    def holds(self, arrival_ns: int, position_ms: float) -> bool:
        """Whether the picture that arrived now is an old one.

        Args:
            arrival_ns: monotonic clock. position_ms: the picture's time in the stream; anything if there is none.
        """
        waited_ns = None if self._arrival_ns is None else arrival_ns - self._arrival_ns
        step_ms = position_ms - self._position_ms
        step_ns = round(step_ms * 1e6) if 0 < step_ms < 1000 else self._period_ns
        self._arrival_ns, self._position_ms = arrival_ns, position_ms
        if waited_ns is None or waited_ns > self._silence_ns:
            self._since_ns = arrival_ns
        elif self._since_ns is not None and (
            2 * waited_ns >= step_ns or arrival_ns - self._since_ns > self._LONGEST_NS
        ):
            self._since_ns = None
        return self._since_ns is not None


class _StreamDriver(_OpenCvDriver):
    """An open stream. Stamps are times of arrival: a stream's own clock has no known beginning."""

    kind, hint = "rtsp", _STREAM_HINT

    def __init__(self, open_capture: Callable[[], cv2.VideoCapture], address: StreamAddress, fps: float | None) -> None:
        self._address, self._fps = address, fps
        super().__init__(f"the stream {address}", address.place or address.scheme, open_capture)
        self._backlog = Backlog(period_ns=round(1e9 / (self.fps or 25.0)))

    def set_up(self) -> None:
        if not self.capture.isOpened():
            raise SourceAbsentError(f"no stream from {self._address}: {_why(self._address)}; {_STREAM_HINT}")
        width, height = self.capture.get(cv2.CAP_PROP_FRAME_WIDTH), self.capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if width * height > MAX_PIXELS:
            raise SourceError(
                f"{self._address} states {width:.0f} x {height:.0f} pixels, over {MAX_PIXELS}; choose a smaller stream"
            )

    def grab(self) -> int | None:
        while self.capture.grab():
            arrival_ns = time.monotonic_ns()
            if not self._backlog.holds(arrival_ns, self.capture.get(cv2.CAP_PROP_POS_MSEC)):
                return arrival_ns
        return None

    @property
    def fps(self) -> float | None:
        return self._fps or super().fps

    def uncertainty_us(self, fps: float) -> int:
        return _STREAM_UNCERTAINTY_US


def _why(address: StreamAddress) -> str:
    """Why a stream could not be opened; the decoder does not say."""
    if address.scheme == "udp" or address.port is None:
        return "nothing arrives"
    try:
        with socket.create_connection((address.host.strip("[]"), address.port), timeout=_KNOCK_TIMEOUT_S):
            return "the server is there, but gives none"
    except TimeoutError:
        return "the host does not answer"
    except OSError as error:
        return (error.strerror or "the host cannot be reached").lower()
