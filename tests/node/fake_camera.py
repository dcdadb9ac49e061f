"""A camera behind cv2.VideoCapture that needs no hardware: it does what a test tells it, in real time."""

import threading
import time
from collections.abc import Sequence

import cv2
import numpy as np

from gcd_node.frame import Image


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
