"""The OAK source on DepthAI pipelines without a device: the same queue, stamps, losses and ends as with one; which
device is meant, and what is known of its lens."""

import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from itertools import islice
from unittest.mock import MagicMock, create_autospec

import numpy as np
import pytest
from cameras import HEIGHT, WIDTH, environment, flat, until
from fakes import fake_config

from gcd_node.errors import ConfigError, SourceAbsentError, SourceError, SourceLostError
from gcd_node.frame import Frame, LensModel
from gcd_node.sources import OakSource
from gcd_node.sources.live import LiveCamera
from gcd_node.sources.oak import camera_pipeline, lens_in_memory, open_oak, open_pipeline

try:
    import oak_pipelines as pipelines
except SourceError as missing:
    pytest.skip(str(missing), allow_module_level=True)

import depthai as dai

PATIENT_S = 30.0  # for a machine that is busy with something else
Layout = dai.ImgFrame.Type
SOCKET = dai.CameraBoardSocket.CAM_A


def opened(script: pipelines.Script, lens: Callable[[int, int], LensModel] | None = None) -> LiveCamera:
    camera = open_pipeline(pipelines.Scripted(script, lens=lens), open_timeout_s=PATIENT_S)
    assert camera.info.id == pipelines.NAME  # it is open
    return camera


def take(camera: LiveCamera, count: int) -> list[Frame]:
    return list(islice(camera.frames(), count))


@pytest.mark.parametrize("layout", [Layout.BGR888i, Layout.RGB888i, Layout.BGR888p, Layout.NV12, Layout.GRAY8])
def test_colours_are_rgb_whatever_the_order_of_the_message(layout: dai.ImgFrame.Type) -> None:
    orange = flat(90, 90, 90) if layout == Layout.GRAY8 else flat(230, 120, 20)
    with closing(opened(pipelines.steady(lambda seq: pipelines.picture(seq, orange, layout=layout)))) as camera:
        (frame,) = take(camera, 1)
    assert frame.image.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(frame.image, orange, atol=3)


def test_a_stamp_is_the_middle_of_the_exposure_and_the_rate_the_sensors_own() -> None:
    end_ns = 5_000_000_000
    exposed = pipelines.steady(lambda seq: pipelines.picture(seq, stamp_ns=end_ns, exposure_us=20_000))
    with closing(opened(exposed)) as camera:
        (frame,) = take(camera, 1)
    assert frame.stamp_ns == end_ns - 10_000_000
    assert camera.info.stamp_uncertainty_us == 500
    first = pipelines.picture(0)
    settings = first.cam
    settings.fps = 29.5
    first.cam = settings
    with closing(opened(pipelines.Handed(first))) as camera:  # which states no exposure: half a period then
        assert (camera.info.fps_nominal, camera.info.stamp_uncertainty_us) == (29.5, round(0.5e6 / 29.5))


def test_damaged_and_foreign_messages_are_counted_and_not_yielded() -> None:
    torn = pipelines.picture(1)
    torn.setData(bytes(100))
    handed = pipelines.Handed(pipelines.picture(0), torn, dai.Buffer(), dai.ImgFrame(), pipelines.picture(4))
    with closing(opened(handed)) as camera:
        take(camera, 1)
        for count in (1, 2, 3):
            handed.hand()
            until(lambda count=count: camera.corrupt == count)
        handed.hand()
        assert [frame.seq for frame in take(camera, 1)] == [4]


@pytest.mark.parametrize("state", ["DISCONNECTED", "FAILED", None])
def test_a_device_that_goes_is_a_loss_and_its_state_named(state: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = MagicMock()
    broken.get.side_effect = broken.tryGetAll.side_effect = RuntimeError("X_LINK_ERROR")
    factory = pipelines.Scripted(pipelines.steady())
    with closing(open_pipeline(factory, open_timeout_s=PATIENT_S)) as camera:
        frames = camera.frames()
        next(frames)
        if state is None:  # the link breaks while it is read
            monkeypatch.setattr(camera._driver, "_queue", broken)
        else:
            factory.device_turns(dai.DeviceState.__members__[state])
        words = "X_LINK_ERROR" if state is None else f"device {state.lower()}"
        with pytest.raises(SourceLostError, match=words) as caught:
            list(frames)
    assert caught.value.exit_code == 75


def test_opening_again_and_again_leaves_no_thread_and_no_file_behind() -> None:
    def held() -> tuple[int, int]:
        return len(os.listdir("/proc/self/task")), len(os.listdir("/proc/self/fd"))

    def once() -> None:
        with closing(opened(pipelines.steady())) as camera:
            assert len(take(camera, 2)) == 2

    once()
    before = held()
    for _ in range(8):
        once()
    until(lambda: held() <= (before[0] + 1, before[1] + 1))
    assert held()[0] <= before[0] + 1


def test_an_attempt_that_was_given_up_ends_before_the_next_one_begins() -> None:
    first, second = pipelines.Scripted(pipelines.steady()), pipelines.Scripted(pipelines.steady())
    running: list[bool] = []
    answer = threading.Event()

    def slow() -> pipelines.OakStream:
        answer.wait(PATIENT_S)
        return first()

    def next_one() -> pipelines.OakStream:
        running.append(first.pipeline is None or first.pipeline.isRunning())
        return second()

    for factory in (slow, next_one):
        with pytest.raises(SourceAbsentError):
            _ = open_pipeline(factory, open_timeout_s=0.2).info
    answer.set()
    with closing(open_pipeline(next_one, open_timeout_s=PATIENT_S)) as camera:
        assert camera.info.id == pipelines.NAME
    assert running == [False]


# Which device, and how it is set up.


def device(serial: str, name: str = "1.2") -> dai.DeviceInfo:
    info = dai.DeviceInfo(name)
    info.deviceId = serial
    return info


ONE, TWO = device("18443010A1B2C3D4E5", "1.2"), device("19443010AABBCCDDEE", "192.168.1.20")


def test_without_a_name_there_must_be_one_device_and_a_named_one_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEPTHAI_SEARCH_TIMEOUT", "300")
    with pytest.raises(SourceAbsentError) as caught:
        _ = open_oak(OakSource(device="127.0.0.1", open_timeout_s=PATIENT_S)).info
    assert caught.value.exit_code == 69
    devices = create_autospec(dai.Device)
    monkeypatch.setattr(dai, "Device", devices)
    devices.getAllConnectedDevices.return_value = [ONE, TWO]
    for found in ([], [ONE, TWO]):
        devices.getAllAvailableDevices.return_value = found
        with pytest.raises(SourceAbsentError) as caught:
            camera_pipeline(OakSource())
        assert all(each.deviceId in str(caught.value) for each in (ONE, TWO))
    monkeypatch.setitem(sys.modules, "depthai", None)  # the extra is missing
    with pytest.raises(SourceError):
        open_oak(OakSource())
    for wrong in ("exposure_us=8000", "socket=left", "focus=300", "anti_banding=100hz"):
        with pytest.raises(ConfigError, match=wrong.partition("=")[0]):
            fake_config(f"source.{wrong}", source='kind = "oak"')


def test_a_real_camera_is_wired_by_depthais_own_names(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = create_autospec(dai.Device, instance=True)
    camera = create_autospec(dai.node.Camera, instance=True)
    pipeline = create_autospec(dai.Pipeline, instance=True)
    opened.getDeviceId.return_value, camera.getBoardSocket.return_value = ONE.deviceId, SOCKET
    control = camera.initialControl = create_autospec(dai.CameraControl, instance=True)
    opened.getCalibration.return_value = memory([0.0] * 14)
    pipeline.create.return_value = camera.build.return_value = camera
    devices = create_autospec(dai.Device, return_value=opened)
    devices.getAllAvailableDevices.return_value = [ONE]
    monkeypatch.setattr(dai, "Device", devices)
    monkeypatch.setattr(dai, "Pipeline", lambda device: pipeline if device is opened else None)
    config = OakSource(fps=15.0, socket="CAM_B", focus=130, exposure_us=8000, iso=400, anti_banding="50hz")
    stream = camera_pipeline(config)
    opened.setMaxReconnectionAttempts.assert_called_once_with(0)
    camera.build.assert_called_once_with(dai.CameraBoardSocket.CAM_B)
    nv12 = dai.ImgFrame.Type.NV12
    camera.requestOutput.assert_called_once_with((1280, 720), nv12, fps=15.0, enableUndistortion=False)
    control.setManualFocus.assert_called_once_with(130)
    control.setManualExposure.assert_called_once_with(8000, 400)
    control.setAntiBandingMode.assert_called_once_with(dai.CameraControl.AntiBandingMode.MAINS_50_HZ)
    assert (stream.id, stream.fps, stream.lens(1280, 720).width) == (ONE.deviceId, 15.0, 1280)


RATIONAL = [0.5, -0.25, 0.125, 0.0625, 2.0, 0.75, -0.5, 1.5]


def memory(coefficients: list[float], model: str = "Perspective", width: int = 4056) -> dai.CalibrationHandler:
    sensor = dai.CameraInfo()
    sensor.width, sensor.height = width, 3040
    sensor.intrinsicMatrix = [[3100.0, 0.0, 2020.0], [0.0, 3101.0, 1530.0], [0.0, 0.0, 1.0]]
    sensor.distortionCoeff = coefficients
    sensor.cameraType = dai.CameraModel.__members__[model]
    stored = dai.EepromData()
    stored.version = 7
    stored.cameraData = {SOCKET: sensor}
    return dai.CalibrationHandler(stored)


def test_the_lens_in_memory_is_scaled_and_cut_to_the_picture_and_has_our_names() -> None:
    for coefficients, model, wanted in (
        ([0.0] * 14, "Perspective", ("none", ())),
        ([0.5, 0.25], "Perspective", ("rational_polynomial", (0.5, 0.25, *[0.0] * 6))),
        ([*RATIONAL, 0.5, *[0.0] * 5], "Perspective", ("rational_polynomial", (*RATIONAL, 0.5, *[0.0] * 5))),
        ([0.5, 0.25, 2.0, 4.0, *[0.0] * 10], "Fisheye", ("equidistant", (0.5, 0.25, 2.0, 4.0))),
    ):
        lens = lens_in_memory(memory(coefficients, model), SOCKET, 1280, 720)
        scale = 1280 / 4056  # the width is kept, rows are cut off above and below
        assert (lens.width, lens.height) == (1280, 720)
        assert (lens.fx, lens.fy) == pytest.approx((3100 * scale, 3101 * scale), rel=1e-5)
        assert (lens.cx, lens.cy) == pytest.approx((2020 * scale, 1530 * scale - (3040 * scale - 720) / 2), abs=1)
        assert (lens.distortion, lens.coefficients) == wanted


def test_a_lens_that_makes_no_sense_is_no_lens_and_that_of_the_picture_itself_comes_before_the_memory() -> None:
    for stored in (
        dai.CalibrationHandler(dai.EepromData()),
        memory(RATIONAL, width=1000),
        memory(RATIONAL, "RadialDivision"),
        memory([], "Fisheye"),  # DepthAI ends the process if it is asked for them
        memory([0.1, 0.0, 0.0], "Fisheye"),
    ):
        with closing(opened(pipelines.steady(), partial(lens_in_memory, stored, SOCKET))) as camera:
            assert camera.info.lens is None
    first = pipelines.picture(0)
    matrix = [[80.0, 0.0, 32.0], [0.0, 81.0, 24.0], [0.0, 0.0, 1.0]]
    first.transformation = dai.ImgTransformation(WIDTH, HEIGHT, matrix, dai.CameraModel.Perspective, RATIONAL)
    with closing(opened(pipelines.Handed(first), partial(lens_in_memory, memory(RATIONAL), SOCKET))) as camera:
        lens = camera.info.lens
    assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.coefficients) == (80.0, 81.0, 32.0, 24.0, tuple(RATIONAL))


# What only a process of its own can show.

SIGNALS = """
import os, signal, sys, time
import gcd_node.sources
from gcd_node.sources import oak
assert "depthai" not in sys.modules, "imported before a camera was wanted"
got = []
for number in (signal.SIGTERM, signal.SIGINT):
    signal.signal(number, lambda number, _: got.append(number))
import oak_pipelines as pipelines
from contextlib import closing
with closing(oak.open_pipeline(pipelines.Scripted(pipelines.steady()), open_timeout_s=30)) as camera:
    next(camera.frames())
    for number in (signal.SIGTERM, signal.SIGINT):
        os.kill(os.getpid(), number)
    time.sleep(0.1)
assert got == [signal.SIGTERM, signal.SIGINT], got
"""


@pytest.mark.slow
def test_depthai_comes_late_leaves_our_signal_handlers_alone_and_standard_output_clean() -> None:
    command = [sys.executable, "-c", SIGNALS]
    ended = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=100, check=False)
    assert (ended.returncode, ended.stdout) == (0, ""), ended.stderr


# With a device; CONTRIBUTING.md lists the rest.


@pytest.mark.hardware
def test_hardware_gives_the_size_and_rate_it_was_asked_for_fresh_and_with_its_lens_and_opens_again() -> None:
    if not dai.Device.getAllAvailableDevices():
        pytest.skip("hardware: needs an OAK camera that is plugged in and free")
    oak = open_oak(OakSource(fps=30.0))
    seen = [(frame, (time.monotonic_ns() - frame.stamp_ns) / 1e6) for frame in islice(oak.frames(), 90)]
    frames, ages_ms = zip(*seen, strict=True)
    rate = (frames[-1].seq - frames[0].seq) / ((frames[-1].stamp_ns - frames[0].stamp_ns) / 1e9)
    assert rate == pytest.approx(30, rel=0.02)
    assert min(ages_ms) > 0
    assert float(np.median(ages_ms)) < 200
    assert (frames[0].size, oak.corrupt, oak.info.stamp_uncertainty_us) == ((1280, 720), 0, 500)
    lens = oak.info.lens
    assert 40 < 2 * math.degrees(math.atan(lens.width / 2 / lens.fx)) < 150
    assert (lens.cx, lens.cy) == pytest.approx((lens.width / 2, lens.height / 2), rel=0.1)
    begin = time.monotonic()
    oak.close()
    assert time.monotonic() - begin < 1
    with closing(open_oak(OakSource(device=oak.info.id))) as again:
        assert len(take(again, 3)) == 3
