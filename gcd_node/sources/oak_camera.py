"""An OAK camera through DepthAI v3 (extra `oak`), or any other DepthAI pipeline that gives pictures.

DepthAI is imported when a camera is opened, not before. Three of its habits shape this file. An exception that leaves
Python code on one of its threads ends the process: such code goes through a Guard. An unplugged camera is silence:
the device's state explains it. A pipeline that is dropped before its threads have ended can block the whole
interpreter: the thread that stops a pipeline holds it until then.

Over 300 lines, because no other file may import DepthAI.
"""

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as OpenTimeoutError
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

from gcd_node.config import SourceConfig
from gcd_node.errors import SourceAbsentError, SourceError
from gcd_node.frame import Frame, Image, SourceInfo
from gcd_node.optics.calibration import LensModel
from gcd_node.sources.oak_lens import better_lens, to_lens
from gcd_node.sources.oak_loss import Guard, Loss
from gcd_node.sources.oak_search import find_device

if TYPE_CHECKING:
    import depthai as dai

_LOG = logging.getLogger(__name__)
_WIDTH, _HEIGHT, _FPS = 1280, 720, 30.0
_PATIENCE = timedelta(milliseconds=100)
_MICROSECOND = timedelta(microseconds=1)
_EXPLAIN_S = 0.5
_STOP_TIMEOUT_S = 0.7
_SYNCED_US = 500  # how well DepthAI keeps the device's clock aligned with the host's


@dataclass(frozen=True, kw_only=True, slots=True)
class OakStream:
    """A pipeline that is wired but not started, and what is read from it.

    output: gives ImgFrame messages, of any type that `getCvFrame` turns into 8-bit colour or grey.
    id: of the device, a short name.
    fps: what the camera is asked for; used where its pictures do not say.
    lens: calibration in the device's memory for pictures of a width and height; None if it holds none.
    """

    pipeline: "dai.Pipeline"
    output: "dai.Node.Output"
    id: str
    fps: float
    lens: Callable[[int, int], LensModel | None] = lambda width, height: None


PipelineFactory: TypeAlias = Callable[[Guard], OakStream]
"""Wires a pipeline. Host nodes in it run their bodies through the Guard. Called once, on a thread of its own."""
_Opened: TypeAlias = "tuple[OakStream, dai.MessageQueue]"


class OakCamera:
    """A DepthAI pipeline as a live FrameSource. Stamps are mid-exposure, on this host's monotonic clock."""

    def __init__(self, pipeline_factory: PipelineFactory, *, open_timeout_s: float = 5.0) -> None:
        """Wire and start a pipeline, and wait for its first picture.

        Args:
            pipeline_factory: `camera_pipeline` makes the one for a real camera.
            open_timeout_s: for all of it. What DepthAI is still busy with then is left to a thread.
        Raises:
            SourceAbsentError: there is no such camera, or it does not open, or gives no picture in time.
            SourceLostError: it went away at once. SourceError: DepthAI is not installed.
        """
        deadline = time.monotonic() + open_timeout_s
        self._closed = threading.Event()
        self._corrupt = 0
        self._loss = Loss()
        load_depthai()
        self._stream, self._queue = _start(pipeline_factory, self._loss, open_timeout_s)
        self._loss.name = self._stream.id
        try:
            self._info = _describe(self._first(deadline, open_timeout_s), self._stream)
        except BaseException:
            self.close()
            raise

    @property
    def info(self) -> SourceInfo:
        """Size, rate and lens, as the first picture had them."""
        return self._info

    @property
    def corrupt(self) -> int:
        """Messages so far that were no whole picture."""
        return self._corrupt

    def frames(self) -> Iterator[Frame]:
        """The newest picture each time. See FrameSource.frames. Raises SourceLostError if device or pipeline ends."""
        while not self._closed.is_set():
            message = self._newest()
            if message is not None and (frame := self._frame(message)) is not None:
                yield frame

    def close(self) -> None:
        """End `frames` within a second, from any thread; a device that does not let go is left to a thread."""
        if self._closed.is_set():
            return
        self._closed.set()
        stopping = threading.Thread(target=_stop, args=(self._stream.pipeline,), name="oak-stop", daemon=True)
        stopping.start()
        stopping.join(_STOP_TIMEOUT_S)
        if stopping.is_alive():
            _LOG.warning("OAK %s does not stop; a thread goes on waiting for it", self._stream.id)

    def _first(self, deadline: float, timeout_s: float) -> "dai.ImgFrame":
        while time.monotonic() < deadline:
            message = self._newest()
            if message is not None and self._frame(message) is not None:
                return message
        raise SourceAbsentError(
            f"OAK {self._stream.id} opened but gave no picture within {timeout_s:g} s ({self._corrupt} damaged ones); "
            "check its cable and power, or allow more with open_timeout_s in [source]"
        )

    def _newest(self) -> "dai.ImgFrame | None":
        """The newest picture; None if none came for a moment, or the source was closed."""
        import depthai as dai

        if self._loss.told and not self._closed.is_set():  # in this order: closing, too, makes the device go away
            raise self._loss.error()
        try:
            message = self._queue.get(_PATIENCE)
            later = self._queue.tryGetAll()
        except dai.MessageQueue.QueueException:  # pyright: ignore[reportGeneralTypeIssues] - the stub's own mistake
            if self._closed.is_set():
                return None
            self._loss.wait(_EXPLAIN_S)  # the state callback may be a moment behind, and knows why
            self._loss.tell("its pipeline ended")
            raise self._loss.error() from None
        except RuntimeError as error:  # what DepthAI makes of a link that broke
            if self._closed.is_set():
                return None
            self._loss.tell(f"reading from it failed ({error})")
            raise self._loss.error() from error
        newest = later[-1] if later else message
        if isinstance(newest, dai.ImgFrame):
            return newest
        if newest is not None:  # pyright: ignore[reportUnnecessaryComparison] - after a time-out it is None
            self._corrupt += 1
        return None

    def _frame(self, message: "dai.ImgFrame") -> Frame | None:
        """The message as a Frame; None, and counted, if it is damaged."""
        import depthai as dai

        try:
            image = _picture(message)
        except (RuntimeError, cv2.error) as error:
            self._corrupt += 1
            _LOG.debug("OAK %s: picture %d is damaged: %s", self._stream.id, message.getSequenceNum(), error)
            return None
        stamp_us = message.getTimestamp(dai.CameraExposureOffset.MIDDLE) // _MICROSECOND
        return Frame(image=image, stamp_ns=stamp_us * 1000, seq=message.getSequenceNum())


def open_oak(config: SourceConfig) -> OakCamera:
    """The OAK camera a launch file asks for, open. Raises as OakCamera."""
    factory = camera_pipeline(
        device=config.device,
        width=config.width or _WIDTH,
        height=config.height or _HEIGHT,
        fps=config.fps or _FPS,
    )
    return OakCamera(factory, open_timeout_s=config.open_timeout_s)


def load_depthai() -> None:
    """Import DepthAI the way this node needs it; what the environment already states stays.

    Without its crash handlers, which would take signals from Python; without its log, which goes to standard output;
    and with a search that gives up an address nobody answers at before the default open time-out does.
    Raises SourceError if it is not installed, or older than what was tried.
    """
    os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
    os.environ.setdefault("DEPTHAI_LEVEL", "off")
    os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", "2500")
    try:
        import depthai as dai
    except ImportError as error:
        raise SourceError(f"an OAK camera needs DepthAI ({error}): pip install 'gcd-node[oak]'") from error
    if not hasattr(dai.Pipeline, "setDeviceStateCallback"):
        raise SourceError(
            f"an OAK camera needs DepthAI 3.12 or newer, found {dai.__version__}: pip install -U 'gcd-node[oak]'"
        )


def camera_pipeline(*, device: str | None, width: int, height: int, fps: float) -> PipelineFactory:
    """Wires a real camera: its default sensor, scaled to a size, what is over cut off, the lens from its memory.

    Args:
        device: id, name or address as DepthAI lists it; None takes the only one there is.
        width, height: of the pictures. fps: of the sensor.
    Returns:
        a factory that raises SourceAbsentError as `find_device`.
    """

    def build(_: Guard) -> OakStream:
        import depthai as dai

        opened = _open_device(device)
        opened.setMaxReconnectionAttempts(0)  # the node reconnects, with a new epoch
        pipeline = dai.Pipeline(opened)
        camera = pipeline.create(dai.node.Camera).build()
        output = camera.requestOutput((width, height), dai.ImgFrame.Type.NV12, fps=fps)
        memory, socket = opened.readCalibration(), camera.getBoardSocket()

        def lens(width: int, height: int) -> LensModel | None:
            return lens_in_memory(memory, socket, width, height)

        return OakStream(pipeline=pipeline, output=output, id=opened.getDeviceId(), fps=fps, lens=lens)

    return build


def _open_device(wanted: str | None) -> "dai.Device":
    import depthai as dai

    found = find_device(wanted, dai.Device.getAllAvailableDevices, dai.Device.getAllConnectedDevices)
    if found is not None:
        return dai.Device(found)
    try:
        return dai.Device(dai.DeviceInfo(wanted or ""))
    except RuntimeError as error:
        raise SourceAbsentError(
            f"no OAK camera answers at {wanted} ({error}); check the address and that this machine reaches it"
        ) from error


def lens_in_memory(
    memory: "dai.CalibrationHandler", socket: "dai.CameraBoardSocket", width: int, height: int
) -> LensModel | None:
    """Factory calibration of one sensor for pictures that were scaled to width x height, what is over cut off.

    None if the memory holds none for it.
    """
    try:
        matrix = memory.getCameraIntrinsics(socket, width, height)
        coefficients, model = memory.getDistortionCoefficients(socket), memory.getDistortionModel(socket)
    except RuntimeError as error:
        _LOG.warning("the OAK's memory has no calibration for %s: %s", socket.name, error)
        return None
    return to_lens(matrix, coefficients, model.name, (width, height))


def _describe(first: "dai.ImgFrame", stream: OakStream) -> SourceInfo:
    size = first.getWidth(), first.getHeight()
    fps = first.getFps() if first.getFps() > 0 else stream.fps
    exposure_known = first.getExposureTime() > timedelta(0)
    return SourceInfo(
        kind="oak",
        id=stream.id,
        width=size[0],
        height=size[1],
        fps_nominal=fps,
        clock="realtime",
        lens=better_lens(_lens_of(first, size), stream.lens(*size)),
        stamp_uncertainty_us=_SYNCED_US if exposure_known else round(0.5e6 / fps),
    )


def _lens_of(picture: "dai.ImgFrame", size: tuple[int, int]) -> LensModel | None:
    seen = picture.getTransformation()
    matrix = seen.getIntrinsicMatrix()
    if not seen.isValid() or seen.getSize() != size or matrix[0][0] <= 1:  # the identity: it does not know
        return None
    return to_lens(matrix, seen.getDistortionCoefficients(), seen.getDistortionModel().name, size)


def _picture(message: "dai.ImgFrame") -> Image:
    pixels = message.getCvFrame()  # a copy, BGR whatever the message's own order, or grey
    code = cv2.COLOR_GRAY2RGB if pixels.ndim == 2 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(pixels, code), np.uint8)


def _start(factory: PipelineFactory, loss: Loss, timeout_s: float) -> _Opened:
    """A started pipeline and its queue, made on a thread that is left behind when it takes too long."""
    opening: Future[_Opened] = Future()
    threading.Thread(target=_open, args=(factory, loss, opening), name="oak-open", daemon=True).start()
    try:
        return opening.result(timeout_s)
    except OpenTimeoutError:
        if not opening.cancel():
            return opening.result()
    raise SourceAbsentError(
        f"the OAK camera did not open within {timeout_s:g} s; check its cable and power, or allow more with "
        "open_timeout_s in [source]"
    )


def _open(factory: PipelineFactory, loss: Loss, opening: "Future[_Opened]") -> None:
    stream: OakStream | None = None
    try:
        stream = factory(loss.guard)
        stream.pipeline.setDeviceStateCallback(loss.on_state)
        queue = stream.output.createOutputQueue(maxSize=4, blocking=False)
        stream.pipeline.start()
    except Exception as error:  # the end of a thread: whoever opens gets it
        if stream is not None:
            _stop(stream.pipeline)
        if opening.set_running_or_notify_cancel():
            opening.set_exception(_opening_error(error))
        return
    if opening.set_running_or_notify_cancel():
        opening.set_result((stream, queue))
    else:
        _stop(stream.pipeline)


def _opening_error(error: Exception) -> Exception:
    if not isinstance(error, RuntimeError):
        return error
    refused = SourceAbsentError(
        f"the OAK camera cannot be opened: {error}; check its cable and power, and that it is free"
    )
    refused.__cause__ = error.with_traceback(None)  # its frames would keep the device open
    return refused


def _stop(pipeline: "dai.Pipeline") -> None:
    """Stop and let go. This frame holds the pipeline until its threads have ended."""
    try:
        device = pipeline.getDefaultDevice()
        pipeline.stop()
        pipeline.wait()
        if device is not None:  # pyright: ignore[reportUnnecessaryComparison] - a host-only pipeline has none
            device.close()
    except RuntimeError as error:
        _LOG.warning("stopping an OAK pipeline: %s", error)
