"""Network cameras: RTSP, and the http and udp streams of the same decoder (FFmpeg inside OpenCV)."""

import math
import re
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2

from gcd_node.errors import ConfigError, SourceAbsentError, SourceError
from gcd_node.frame import MAX_PIXELS
from gcd_node.sources.live_camera import LiveCamera
from gcd_node.sources.opencv_camera import Capture, OpenCvDriver

_DEFAULT_PORTS = {"rtsp": 554, "rtsps": 322, "http": 80, "https": 443, "udp": None, "tcp": None}
_UNCERTAINTY_US = 100_000
_KNOCK_TIMEOUT_S = 1.0
_HINT = "check address, path and password, and that the server runs"

OpenCapture = Callable[[str, int, Sequence[int]], Capture]
"""Opens an address with a backend and a list of parameters and their values."""


@dataclass(frozen=True, kw_only=True, slots=True)
class StreamAddress:
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
    scheme, separator, rest = url.partition("://")
    scheme = scheme.lower()
    if not separator or scheme not in _DEFAULT_PORTS:
        raise ConfigError(f"the url of a stream begins with one of {', '.join(f'{s}://' for s in _DEFAULT_PORTS)}")
    authority, *tail = re.split(r"(?=[/?#])", rest, maxsplit=1)
    host_and_port = re.fullmatch(
        r"(?:[^@]*@)?(?P<host>\[[0-9A-Fa-f:.%]+\]|[^\s:@\[\]]*)(?::(?P<port>\d{1,5}))?", authority
    )
    if host_and_port is None or "@" in "".join(tail) or re.search(r"\s", url):
        raise ConfigError(
            f"the {scheme} url is not {scheme}://user:password@host:port/path; in a user name or password write @ as "
            "%40, / as %2F and : as %3A"
        )
    port = host_and_port["port"]
    if not host_and_port["host"] and scheme != "udp":
        raise ConfigError(f"the {scheme} url names no host; write {scheme}://host/path")
    return StreamAddress(scheme=scheme, host=host_and_port["host"], port=int(port) if port else _DEFAULT_PORTS[scheme])


def open_stream(
    url: str,
    *,
    fps: float | None = None,
    open_timeout_s: float = 5.0,
    read_timeout_s: float = 5.0,
    open_capture: OpenCapture = cv2.VideoCapture,
) -> LiveCamera:
    """A network camera.

    Args:
        url: may hold user and password; no message does.
        fps: its rate; None is what the stream states.
        read_timeout_s: silence after which the stream is lost: the decoder cannot go on after it.
        open_capture: opens the stream; tests give their own.
    Raises:
        ConfigError: no URL of a stream.
        SourceAbsentError: nobody answers there, or no picture in time.
        SourceError: the pictures are too large.
    """
    address = parse_address(url)
    parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _milliseconds(open_timeout_s)]
    parameters += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, _milliseconds(read_timeout_s)]
    parameters += [cv2.CAP_PROP_N_THREADS, 1]  # every thread more delays pictures by one

    def open_driver() -> _StreamDriver:
        return _StreamDriver(lambda: open_capture(url, cv2.CAP_FFMPEG, parameters), address, fps)

    return LiveCamera(f"the stream {address}", open_driver, open_timeout_s=open_timeout_s, hint=_HINT)


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
        step_ns = self._step_ns(position_ms)
        self._arrival_ns, self._position_ms = arrival_ns, position_ms
        if waited_ns is None or waited_ns > self._silence_ns:
            self._since_ns = arrival_ns
        elif self._since_ns is not None and (
            2 * waited_ns >= step_ns or arrival_ns - self._since_ns > self._LONGEST_NS
        ):
            self._since_ns = None
        return self._since_ns is not None

    def _step_ns(self, position_ms: float) -> int:
        step_ms = position_ms - self._position_ms
        return round(step_ms * 1e6) if 0 < step_ms < 1000 else self._period_ns


class _StreamDriver(OpenCvDriver):
    """An open stream. Stamps are times of arrival: a stream's own clock has no known beginning."""

    kind, hint = "rtsp", _HINT

    def __init__(self, open_capture: Callable[[], Capture], address: StreamAddress, fps: float | None) -> None:
        self._address, self._fps = address, fps
        self.name, self.id = f"the stream {address}", address.place or address.scheme
        super().__init__(open_capture)
        self._backlog = Backlog(period_ns=round(1e9 / (self.fps or 25.0)))

    def check(self) -> None:
        """See OpenCvDriver."""
        if not self.capture.isOpened():
            raise SourceAbsentError(f"no stream from {self._address}: {_why(self._address)}; {_HINT}")
        width, height = self.capture.get(cv2.CAP_PROP_FRAME_WIDTH), self.capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if width * height > MAX_PIXELS:
            raise SourceError(
                f"{self._address} states {width:.0f} x {height:.0f} pixels, over {MAX_PIXELS}; choose a smaller stream"
            )

    def grab(self) -> int | None:
        """See OpenCvDriver."""
        while self.capture.grab():
            arrival_ns = time.monotonic_ns()
            if not self._backlog.holds(arrival_ns, self.capture.get(cv2.CAP_PROP_POS_MSEC)):
                return arrival_ns
        return None

    @property
    def fps(self) -> float | None:
        """See Driver."""
        return self._fps or super().fps

    def uncertainty_us(self, fps: float) -> int:
        """How long a network camera keeps a picture nobody knows; a tenth of a second is usual."""
        return _UNCERTAINTY_US


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


def _milliseconds(seconds: float) -> int:
    return max(1, round(1000 * seconds))
