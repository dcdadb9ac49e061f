"""An OAK camera through DepthAI v3 (extra `oak`), or any other DepthAI pipeline that gives pictures.

DepthAI is imported when a camera is opened, not before. Two of its habits shape this file. An unplugged camera is
silence: the device's state explains it. A pipeline that is dropped before its threads have ended can block the whole
interpreter: the thread that stops a pipeline holds it until then.
"""

import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import TYPE_CHECKING, TypeAlias

import cv2

from gcd_node.errors import ConfigError, SourceAbsentError, SourceError, SourceLostError
from gcd_node.frame import Frame, LensModel, SourceInfo, depthai_lens
from gcd_node.sources import OakSource, SourceKind
from gcd_node.sources.live import LiveCamera
from gcd_node.sources.opencv import to_rgb

if TYPE_CHECKING:
    import depthai as dai

_LOG = logging.getLogger(__name__)
_FPS = 30.0
_PATIENCE = timedelta(milliseconds=100)
_MICROSECOND = timedelta(microseconds=1)
_EXPLAIN_S = 0.5
_HINT = "check its cable and power, or allow more with open_timeout_s in [source]"
_IN_USE = threading.Lock()  # by the attempt before, even if nobody waits for that one any more
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


PipelineFactory: TypeAlias = Callable[[], OakStream]
"""Wires a pipeline. Called once, on a thread of its own."""


class _OakDriver:
    """A DepthAI pipeline as a Driver. Stamps are mid-exposure, on this host's monotonic clock."""

    def __init__(self, factory: PipelineFactory) -> None:
        """Wire and start a pipeline. Raises SourceAbsentError: there is no such camera, or it does not open."""
        self.corrupt = 0
        self._states: list[str] = []  # of the device, by name; refers to nothing, so that the pipeline can be dropped
        opened = _open(factory, self._states)
        if isinstance(opened, Exception):
            raise opened
        self._stream, self._queue = opened
        self.kind: SourceKind = "oak"
        self.id, self.fps = self._stream.id, self._stream.fps
        self._newest: dai.ImgFrame | None = None

    def read(self) -> Frame | None:
        """See Driver. The newest picture each time."""
        import depthai as dai

        if any(each != "RUNNING" for each in self._states):  # to reconnect is the node's affair
            raise self._lost("")
        try:
            message = self._queue.get(_PATIENCE)
            later = self._queue.tryGetAll()
        except dai.MessageQueue.QueueException:  # pyright: ignore[reportGeneralTypeIssues] - the stub's own mistake
            time.sleep(_EXPLAIN_S)  # the state callback may be a moment behind, and knows why
            raise self._lost("its pipeline ended") from None
        except RuntimeError as error:  # what DepthAI makes of a link that broke
            raise self._lost(f"reading from it failed ({error})") from error
        newest = later[-1] if later else message
        if isinstance(newest, dai.ImgFrame):
            return self._frame(newest)
        self.corrupt += newest is not None  # pyright: ignore[reportUnnecessaryComparison] - after a time-out it is None
        return None

    def _lost(self, reason: str) -> SourceLostError:
        """The device's state says more than the reason, if it does not run."""
        states = [f"device {each.lower()}" for each in self._states if each != "RUNNING"]
        return SourceLostError(f"OAK {self._stream.id} is lost: {(*states, reason)[0]}; check its cable and power")

    def describe(self, info: SourceInfo) -> SourceInfo:
        message = self._newest
        assert message is not None
        fps = message.getFps() if message.getFps() > 0 else info.fps_nominal
        uncertainty_us = _SYNCED_US if message.getExposureTime() > timedelta(0) else round(0.5e6 / fps)
        lens = self._lens(message, (info.width, info.height))
        return replace(info, fps_nominal=fps, lens=lens, stamp_uncertainty_us=uncertainty_us)

    def _lens(self, message: "dai.ImgFrame", size: tuple[int, int]) -> LensModel | None:
        """Of the picture itself, which knows what the sensor's mode cuts off; else of the device's memory."""
        seen = message.getTransformation()
        matrix = seen.getIntrinsicMatrix()
        try:
            if seen.isValid() and seen.getSize() == size and matrix[0][0] > 1:  # the identity: it does not know
                return depthai_lens(matrix, seen.getDistortionCoefficients(), seen.getDistortionModel().name, size)
            return self._stream.lens(*size)
        except (ConfigError, RuntimeError) as error:  # DepthAI raises for what its memory lacks
            _LOG.warning("an OAK's calibration is missing, or makes no sense: it counts as uncalibrated: %s", error)
            return None

    def close(self) -> None:
        _stop(self._stream.pipeline)

    def _frame(self, message: "dai.ImgFrame") -> Frame | None:
        """The message as a Frame; None, and counted, if it is damaged."""
        import depthai as dai

        try:
            image = to_rgb(message.getCvFrame())  # a copy, BGR whatever the message's own order, or grey
        except (RuntimeError, cv2.error):
            self.corrupt += 1
            return None
        self._newest = message
        stamp_us = message.getTimestamp(dai.CameraExposureOffset.MIDDLE) // _MICROSECOND
        return Frame(image=image, stamp_ns=stamp_us * 1000, seq=message.getSequenceNum())


def open_oak(config: OakSource) -> LiveCamera:
    """The OAK camera a launch file asks for. Raises as open_pipeline()."""
    return open_pipeline(lambda: camera_pipeline(config), open_timeout_s=config.open_timeout_s)


def open_pipeline(factory: PipelineFactory, *, open_timeout_s: float) -> LiveCamera:
    """A pipeline that is being started. An attempt that was given up is over before the next begins: two that open one
    device reset it under each other for ever.

    Args:
        factory: of a real camera, calls camera_pipeline().
        open_timeout_s: for all of it. What DepthAI is still busy with then is left to a thread.
    Raises:
        SourceError: DepthAI is not installed.
    """
    load_depthai()
    return LiveCamera(
        "the OAK camera", lambda: _OakDriver(factory), open_timeout_s=open_timeout_s, hint=_HINT, alone=_IN_USE
    )


def load_depthai() -> None:
    """Import DepthAI the way this node needs it; what the environment already states stays.

    Without its crash handlers, which would take signals from Python; without its log, which goes to standard output;
    and with a search that gives up an address nobody answers at before the default open time-out does.
    Raises SourceError if it is not installed.
    """
    os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
    os.environ.setdefault("DEPTHAI_LEVEL", "off")
    os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", "2500")
    try:
        import depthai  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise SourceError(f"an OAK camera needs DepthAI ({error}): pip install 'gcd-node[oak]'") from error


def camera_pipeline(config: OakSource) -> OakStream:
    """Wires a real camera: a sensor's pictures, scaled to a size, what is over cut off, not undistorted: that is done
    here, by the lens that the device knows, with the user's calibration before the factory's.

    Raises:
        SourceAbsentError: there is no such camera, or several.
    """
    import depthai as dai

    opened = _open_device(config.device)
    opened.setMaxReconnectionAttempts(0)  # the node reconnects, with a new epoch
    pipeline = dai.Pipeline(opened)
    sockets = () if config.socket is None else (dai.CameraBoardSocket.__members__[config.socket],)
    camera = pipeline.create(dai.node.Camera).build(*sockets)
    _set_up(camera.initialControl, config)
    size, fps = (config.width, config.height), config.fps or _FPS
    output = camera.requestOutput(size, dai.ImgFrame.Type.NV12, fps=fps, enableUndistortion=False)
    try:
        memory = opened.getCalibration()  # the user's if the device has one, else the factory's
    except RuntimeError:
        memory = opened.readCalibration()  # the memory alone; of an empty one a default
    socket = camera.getBoardSocket()
    return OakStream(
        pipeline=pipeline,
        output=output,
        id=opened.getDeviceId(),
        fps=fps,
        lens=lambda width, height: lens_in_memory(memory, socket, width, height),
    )


def _set_up(control: "dai.CameraControl", config: OakSource) -> None:
    """Focus, exposure and anti-banding as stated; the rest as the camera has it."""
    import depthai as dai

    if config.focus is not None:
        control.setManualFocus(config.focus)
    if config.exposure_us is not None and config.iso is not None:
        control.setManualExposure(config.exposure_us, config.iso)
    if config.anti_banding is not None:
        modes = dai.CameraControl.AntiBandingMode
        known = {"off": modes.OFF, "50hz": modes.MAINS_50_HZ, "60hz": modes.MAINS_60_HZ, "auto": modes.AUTO}
        control.setAntiBandingMode(known[config.anti_banding])


def _open_device(wanted: str | None) -> "dai.Device":
    """The one camera that is meant: by id, name or address; without one, the only one there is.

    Raises:
        SourceAbsentError: none, or several; the message lists what there is.
    """
    import depthai as dai

    free = dai.Device.getAllAvailableDevices()
    fitting = [each for each in free if wanted in (None, each.deviceId)]
    if wanted is not None and "." in wanted:  # an address, or a USB path
        fitting = [dai.DeviceInfo(wanted)]
    reason = f"{len(fitting)} fit"
    if len(fitting) == 1:
        try:
            return dai.Device(fitting[0])
        except RuntimeError as error:
            reason = str(error)
    ids = {each.deviceId for each in free}
    there = [
        f"{each.deviceId} (at {each.name}{'' if each.deviceId in ids else ', in use by another process'})"
        for each in dai.Device.getAllConnectedDevices()
    ]
    raise SourceAbsentError(
        f"OAK {wanted or 'camera'} cannot be opened, {reason}; found {', '.join(there) or 'none'}; "
        "plug it in, or correct device in [source]; on Linux its udev rule must be there too"
    )


def lens_in_memory(
    memory: "dai.CalibrationHandler", socket: "dai.CameraBoardSocket", width: int, height: int
) -> LensModel:
    """Calibration of one sensor for pictures that were scaled to width x height, what is over cut off.

    Raises RuntimeError, ConfigError: the memory holds none for it, or one that no camera has.
    """
    matrix, model = memory.getCameraIntrinsics(socket, width, height), memory.getDistortionModel(socket).name
    stored = dict(memory.eepromToJson()["cameraData"])[socket.value]["distortionCoeff"]
    if model == "Fisheye" and len(stored) < 4:  # which is no fish-eye without distortion, but one never calibrated
        raise ConfigError(f"the memory has no coefficients for the fish-eye lens of {socket.name}")
    return depthai_lens(matrix, stored, model, (width, height))


def _open(factory: PipelineFactory, states: list[str]) -> "tuple[OakStream, dai.MessageQueue] | Exception":
    """A started pipeline and its queue, or why there is none: raised here, it would keep the device open."""
    stream: OakStream | None = None
    try:
        stream = factory()
        stream.pipeline.setDeviceStateCallback(lambda _, state: states.append(state.name))
        queue = stream.output.createOutputQueue(maxSize=4, blocking=False)
        stream.pipeline.start()
    except Exception as error:
        if stream is not None:
            _stop(stream.pipeline)
        if not isinstance(error, RuntimeError):
            return error
        refused = SourceAbsentError(
            f"the OAK camera cannot be opened: {error}; check its cable and power, and that it is free"
        )
        refused.__cause__ = error.with_traceback(None)  # its frames would keep the device open
        return refused
    return stream, queue


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
