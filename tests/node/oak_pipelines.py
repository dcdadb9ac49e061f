"""DepthAI pipelines that need no device, for tests of the OAK source. Importing this needs DepthAI."""

import threading
import time
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import cv2
import numpy as np
from cameras import HEIGHT, WIDTH

from gcd_node.frame import Image, LensModel
from gcd_node.sources.oak import OakStream, load_depthai

load_depthai()

import depthai as dai  # noqa: E402 - only after load_depthai has set its environment

NAME = "host-only"
FPS = 100.0
Script = Callable[["HostCamera"], None]


class HostCamera(dai.node.ThreadedHostNode):
    """A camera that is a Python function; it must return soon after `isRunning` turns false."""

    def __init__(self) -> None:
        super().__init__()
        self.out = self.createOutput("out")
        self.body: Callable[[], None] = lambda: None

    def run(self) -> None:
        self.body()

    def idle(self) -> None:
        """Silence until the pipeline is stopped."""
        while self.isRunning():
            time.sleep(0.01)


class WatchedPipeline(dai.Pipeline):
    """A host-only pipeline whose device states a test can make up."""

    def setDeviceStateCallback(self, callback: Callable[[Any, dai.DeviceState], None]) -> None:  # noqa: N802
        super().setDeviceStateCallback(callback)
        self.on_state = callback


class Scripted:
    """A pipeline factory: a host-only pipeline with one camera that does what the script says."""

    def __init__(
        self, script: Script, *, fps: float = FPS, lens: Callable[[int, int], LensModel | None] | None = None
    ) -> None:
        self._script, self._fps, self._lens = script, fps, lens or (lambda width, height: None)
        self.pipeline: WatchedPipeline | None = None

    def __call__(self) -> OakStream:
        self.pipeline = WatchedPipeline(createImplicitDevice=False)
        camera = self.pipeline.create(HostCamera)
        camera.body = lambda: self._script(camera)
        return OakStream(pipeline=self.pipeline, output=camera.out, id=NAME, fps=self._fps, lens=self._lens)

    def device_turns(self, state: dai.DeviceState) -> None:
        """What DepthAI would call on a thread of its own."""
        self.pipeline.on_state(None, state)


def picture(
    seq: int,
    image: Image | None = None,
    *,
    stamp_ns: int | None = None,
    exposure_us: int = 0,
    layout: dai.ImgFrame.Type = dai.ImgFrame.Type.BGR888i,
) -> dai.ImgFrame:
    """A message as a camera would send it; image is RGB, stamped now unless told otherwise."""
    rgb = np.full((HEIGHT, WIDTH, 3), seq % 256, np.uint8) if image is None else image
    message = dai.ImgFrame()
    message.setCvFrame(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), layout)
    message.setSequenceNum(seq)
    message.setTimestamp(timedelta(microseconds=(time.monotonic_ns() if stamp_ns is None else stamp_ns) // 1000))
    settings = message.cam
    settings.exposureTimeUs = exposure_us
    message.cam = settings
    return message


def steady(
    make: Callable[[int], dai.ImgFrame] = picture, *, fps: float = FPS, awake: threading.Event | None = None
) -> Script:
    """Numbered pictures until the pipeline is stopped; make: the one of a number. awake: none are sent without."""

    def script(camera: HostCamera) -> None:
        seq = 0
        while camera.isRunning():
            if awake is None or awake.is_set():
                camera.out.send(make(seq))
            seq += 1
            time.sleep(1 / fps)

    return script


class Handed:
    """A script: the first message at once, which opening takes, each other one when it is handed out; then silence."""

    def __init__(self, *messages: dai.Buffer) -> None:
        self._messages = messages
        self._handed = threading.Semaphore(1)

    def hand(self) -> None:
        """Send the next message."""
        self._handed.release()

    def __call__(self, camera: HostCamera) -> None:
        waiting = list(self._messages)
        while waiting and camera.isRunning():
            if self._handed.acquire(timeout=0.05):
                camera.out.send(waiting.pop(0))
        camera.idle()
