"""Live cameras that do what a test tells them, and the bench they are plugged into."""

import base64
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path

import cv2
import numpy as np

from gcd_client import ClientKeys, FramePusher
from gcd_node.errors import SourceAbsentError, SourceLostError
from gcd_node.frame import Frame, Image, SourceInfo
from gcd_node.sources.live import LiveCamera

FPS = 24.0


class Camera(LiveCamera):
    """Gives what `feed` and `shoot` put in; silent otherwise. Open at once, without a thread."""

    corrupt = 0
    info: SourceInfo = None

    def __init__(self, *, size: tuple[int, int] = (96, 64), fps: float = FPS) -> None:
        self.info = SourceInfo(
            kind="v4l2", id="bench", width=size[0], height=size[1], fps_nominal=fps, clock="realtime"
        )
        self.last_s = 0.0
        self.closed = threading.Event()
        self._seq = 0
        self._items: queue.Queue[Frame | Exception | None] = queue.Queue()

    def feed(self, item: Frame | Exception | None) -> None:
        """A frame to give, an error to raise, or None for an end."""
        self._items.put(item)

    def shoot(self, image: Image | None = None, stamp_ns: int | None = None) -> None:
        """Take a picture now; its level is its number, so that no two are the same."""
        width, height = self.info.width, self.info.height
        drawn = np.full((height, width, 3), 20 + self._seq % 200, np.uint8) if image is None else image
        at_ns = time.monotonic_ns() if stamp_ns is None else stamp_ns
        self.last_s = time.monotonic()
        self.feed(Frame(image=drawn, stamp_ns=at_ns, seq=self._seq))
        self._seq += 1

    def run(self, count: int, *, pause_s: float | None = None) -> None:
        """Take pictures at the camera's rate, stamped on an even grid."""
        start_ns, period_s = time.monotonic_ns(), 1 / self.info.fps_nominal
        for i in range(count):
            self.shoot(stamp_ns=start_ns + round(i * 1e9 * period_s))
            time.sleep(period_s if pause_s is None else pause_s)

    def take(self, timeout_s: float | None = None) -> Frame | None:
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while not self.closed.is_set():
            try:
                item = self._items.get(timeout=0.01)
            except queue.Empty:
                if end_s is not None and time.monotonic() > end_s:
                    return None
                continue
            if item is None:
                raise SourceLostError("the stream ended")
            if isinstance(item, Exception):
                raise item
            return item
        return None

    def close(self) -> None:
        self.closed.set()


class Bench:
    """Opens the cameras plugged in, one after another; without one it says so as a driver does."""

    def __init__(self, *cameras: Camera) -> None:
        self._plugged: queue.Queue[Camera] = queue.Queue()
        self.opened: list[Camera] = []
        self.tries = 0
        for camera in cameras:
            self.plug(camera)

    def plug(self, camera: Camera) -> Camera:
        self._plugged.put(camera)
        return camera

    def open(self) -> Camera:
        """Raises SourceError without a camera."""
        self.tries += 1
        try:
            camera = self._plugged.get_nowait()
        except queue.Empty:
            raise SourceAbsentError("there is no camera bench; there are: none") from None
        self.opened.append(camera)
        return camera


@contextmanager
def pushing(
    endpoint: str, act: Callable[[FramePusher, int], object], keys: ClientKeys | None = None, fps: float = 50.0
) -> Iterator[None]:
    """Somebody calls `act` at this rate with a pusher of his own, and the number of the call."""
    done, start_s = threading.Event(), time.monotonic()

    def run() -> None:
        with FramePusher(endpoint, keys=keys) as pusher:
            for i in count():
                act(pusher, i)
                if done.wait(max(0.0, start_s + (i + 1) / fps - time.monotonic())):
                    return

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield
    done.set()
    thread.join(20)


def until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Wait for something that other threads bring about; a hang guard, generous because machines are slow."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come about in time"
        time.sleep(0.005)


# A camera behind cv2.VideoCapture that needs no hardware: it does what a test tells it, in real time.


class FakeVideoCapture:
    """Stands in for cv2.VideoCapture on a Video4Linux device.

    picture: RGB, given again and again. stamps: "driver" are monotonic as of a USB camera, "zero" are none,
    "wall" are of another clock. Give the instance's `open` as `open_capture`.
    """

    def __init__(
        self, picture: Image, *, fps: float = 25.0, stamps: str = "driver", fixed: dict[int, float] | None = None
    ) -> None:
        self.calls: list[tuple[int, float]] = []
        self.released = threading.Event()
        self.awake = threading.Event()
        self.awake.set()
        self.gone = self.breaks = False
        self.there = True
        self.damaged: set[int] = set()
        self.grabbed = -1
        self.stated_ms: list[float] = []
        self._picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        self._fps, self._stamps, self._fixed = fps, stamps, fixed or {}
        height, width = picture.shape[:2]
        self._values = {
            cv2.CAP_PROP_FRAME_WIDTH: float(width),
            cv2.CAP_PROP_FRAME_HEIGHT: float(height),
            cv2.CAP_PROP_FPS: fps,
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV")),
        } | self._fixed

    def open(self, name: str, backend: int, parameters: Sequence[int] = ()) -> "FakeVideoCapture":
        return self

    def isOpened(self) -> bool:  # noqa: N802
        return self.there

    def set(self, prop: int, value: float) -> bool:
        self.calls.append((prop, value))
        if prop not in self._fixed:
            self._values[prop] = value
        return True

    def get(self, prop: int) -> float:
        if prop != cv2.CAP_PROP_POS_MSEC:
            return self._values.get(prop, 0.0)
        stated_ms = {"driver": time.monotonic() * 1e3 - 5.0, "zero": 0.0, "wall": time.time() * 1e3}[self._stamps]
        self.stated_ms.append(stated_ms)
        return stated_ms

    def grab(self) -> bool:
        time.sleep(1.0 / self._fps)
        while not self.awake.wait(0.01):
            if self.gone:
                return False
        if self.breaks:
            raise cv2.error("the driver gave up")
        self.grabbed += 1
        return not self.gone

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        if self.grabbed in self.damaged:
            return False, None
        return True, self._picture.copy()

    def release(self) -> None:
        self.released.set()


@contextmanager
def serving(images: Iterable[Image], password: str = "") -> Iterator[tuple[str, threading.Event]]:
    """A network camera on loopback, which FFmpeg reads: pictures as JPEG over HTTP, 25 a second after the first 40.

    Gives its address and an event; while that is clear pictures pile up. The password is that of `admin`.
    """
    pictures, awake = [cv2.imencode(".jpg", image[..., ::-1])[1].tobytes() for image in images], threading.Event()
    awake.set()
    secret = "Basic " + base64.b64encode(f"admin:{password}".encode()).decode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            is_known = not password or self.headers["Authorization"] == secret
            self.send_response(200 if is_known else 401)
            self.send_header("WWW-Authenticate", 'Basic realm="camera"')
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
            self.end_headers()
            begun_s = time.monotonic()
            with suppress(OSError):
                for i, data in enumerate(pictures if is_known else ()):
                    while time.monotonic() < begun_s + (i - 40) / 25 or not awake.is_set():
                        time.sleep(0.002)
                    head = b"--next\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(data)
                    self.wfile.write(head + data + b"\r\n")

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/live", awake
        server.shutdown()


# Small recordings for tests, written with OpenCV; pictures are RGB. And what processes of tests need.


WIDTH, HEIGHT = 64, 48
CODECS = {"mp4": "mp4v", "avi": "MJPG", "mkv": "FFV1", "webm": "VP80"}


def environment() -> dict[str, str]:
    """Of a process that finds what this one finds."""
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}


def flat(red: int, green: int, blue: int, width: int = WIDTH, height: int = HEIGHT) -> Image:
    return np.full((height, width, 3), (red, green, blue), np.uint8)


def ramp(count: int, width: int = WIDTH, height: int = HEIGHT) -> list[Image]:
    """Pictures that get brighter, each with the same coarse pattern."""
    pattern = (np.indices((height, width)).sum(axis=0) // 8 % 2 * 40).astype(np.uint8)
    return [np.repeat((pattern + 5 * i)[:, :, None], 3, axis=2) for i in range(count)]


def write_video(path: Path, images: Iterable[Image], fps: float = 10.0, codec: str | None = None) -> Path:
    images = list(images)
    height, width = images[0].shape[:2]
    code = cv2.VideoWriter.fourcc(*(codec or CODECS[path.suffix[1:]]))
    writer = cv2.VideoWriter(str(path), code, fps, (width, height))
    assert writer.isOpened(), f"OpenCV cannot write {path.name}"
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def write_pictures(folder: Path, images: dict[str, Image]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, image in images.items():
        assert cv2.imwrite(str(folder / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return folder


def noise(folder: Path, height: int, width: int) -> Path:
    """Fourteen pictures, enough for a clip."""
    drawn = np.random.default_rng(0).integers(0, 256, (14, height, width, 3), np.uint8)
    return write_pictures(folder, {f"{i:02d}.png": image for i, image in enumerate(drawn)})


def frames_at(stamps_ms: Iterable[float], width: int = 4, height: int = 2) -> list[Frame]:
    """Tiny frames whose pixels hold their sequence number."""
    return [
        Frame(image=np.full((height, width, 3), seq % 256, np.uint8), stamp_ns=round(ms * 1e6), seq=seq)
        for seq, ms in enumerate(stamps_ms)
    ]


def calibration(folder: Path, size: tuple[int, int], focal: float, d: Sequence[float] = (-0.1, 0.01, 0, 0, 0)) -> Path:
    """A file as ROS writes it."""
    path, (width, height) = folder / "camera.yaml", size
    matrix = [focal, 0, width / 2 - 0.5, 0, focal, height / 2 - 0.5, 0, 0, 1]
    path.write_text(
        f"image_width: {width}\nimage_height: {height}\ncamera_matrix: {{rows: 3, cols: 3, data: {matrix}}}\n"
        f"distortion_model: plumb_bob\ndistortion_coefficients: {{rows: 1, cols: 5, data: {list(d)}}}\n"
    )
    return path
