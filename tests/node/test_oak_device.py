"""Which OAK is meant, what is known of its lens, and how DepthAI comes into a process; without a camera."""

import subprocess
import sys
import time
from contextlib import closing
from functools import partial
from threading import Event
from unittest.mock import create_autospec

import pytest
from media import HEIGHT, WIDTH, environment

from gcd_node.config import parse_config
from gcd_node.errors import ConfigError, SourceAbsentError, SourceError
from gcd_node.frame import LensModel
from gcd_node.sources import OakSource
from gcd_node.sources.oak import camera_pipeline, lens_in_memory, open_oak, open_pipeline

try:
    import oak_pipelines as pipelines
except SourceError as missing:
    pytest.skip(str(missing), allow_module_level=True)

import depthai as dai

PATIENT_S = 30.0  # for a machine that is busy with something else
SOCKET = dai.CameraBoardSocket.CAM_A


# Which device.


def device(serial: str, name: str = "1.2") -> dai.DeviceInfo:
    info = dai.DeviceInfo(name)
    info.deviceId = serial
    return info


ONE, TWO = device("18443010A1B2C3D4E5", "1.2"), device("19443010AABBCCDDEE", "192.168.1.20")


@pytest.mark.parametrize("found", [[], [ONE, TWO]], ids=["none", "several"])
def test_without_a_name_there_must_be_one_device_and_all_are_listed(
    found: list[dai.DeviceInfo], monkeypatch: pytest.MonkeyPatch
) -> None:
    devices = create_autospec(dai.Device)
    devices.getAllAvailableDevices.return_value, devices.getAllConnectedDevices.return_value = found, [ONE, TWO]
    monkeypatch.setattr(dai, "Device", devices)
    with pytest.raises(SourceAbsentError) as caught:
        camera_pipeline(OakSource())
    assert all(each.deviceId in str(caught.value) for each in (ONE, TWO))


def test_no_device_is_said_within_three_seconds() -> None:
    if dai.Device.getAllConnectedDevices():
        pytest.skip("needs a machine without an OAK, found one")
    begin = time.monotonic()
    with pytest.raises(SourceAbsentError) as caught:
        _ = open_oak(OakSource(open_timeout_s=PATIENT_S)).info
    assert caught.value.exit_code == 69
    assert time.monotonic() - begin < 6  # 1.1 s on a machine that is not busy


def test_an_address_where_nobody_answers_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEPTHAI_SEARCH_TIMEOUT", "300")
    with pytest.raises(SourceAbsentError):
        _ = open_oak(OakSource(device="127.0.0.1", open_timeout_s=PATIENT_S)).info


def test_a_real_camera_is_wired_by_depthais_own_names(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = create_autospec(dai.Device, instance=True)
    camera = create_autospec(dai.node.Camera, instance=True)
    pipeline = create_autospec(dai.Pipeline, instance=True)
    opened.getDeviceId.return_value, camera.getBoardSocket.return_value = ONE.deviceId, SOCKET
    camera.initialControl = create_autospec(dai.CameraControl, instance=True)
    opened.getCalibration.return_value = memory(coefficients=[0.0] * 14, model="Perspective")
    pipeline.create.return_value = camera.build.return_value = camera
    devices = create_autospec(dai.Device, return_value=opened)
    devices.getAllAvailableDevices.return_value = [ONE]
    monkeypatch.setattr(dai, "Device", devices)
    monkeypatch.setattr(dai, "Pipeline", lambda device: pipeline if device is opened else None)
    config = OakSource(fps=15.0, socket="CAM_B", focus=130, exposure_us=8000, iso=400, anti_banding="50hz")
    stream = camera_pipeline(config)
    lens = stream.lens(1280, 720)
    devices.assert_called_once_with(ONE)
    opened.setMaxReconnectionAttempts.assert_called_once_with(0)
    pipeline.create.assert_called_once_with(dai.node.Camera)
    camera.build.assert_called_once_with(dai.CameraBoardSocket.CAM_B)
    size, nv12 = (1280, 720), dai.ImgFrame.Type.NV12
    camera.requestOutput.assert_called_once_with(size, nv12, fps=15.0, enableUndistortion=False)
    camera.initialControl.setManualFocus.assert_called_once_with(130)
    camera.initialControl.setManualExposure.assert_called_once_with(8000, 400)
    camera.initialControl.setAntiBandingMode.assert_called_once_with(dai.CameraControl.AntiBandingMode.MAINS_50_HZ)
    assert (stream.id, stream.fps, stream.pipeline) == (ONE.deviceId, 15.0, pipeline)
    assert lens is not None
    assert lens.fx == pytest.approx(3100 * 1280 / 4056, rel=1e-5)


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(SourceError):
        open_oak(OakSource())


def test_an_attempt_that_was_given_up_ends_before_the_next_one_begins() -> None:
    first, second, answer = pipelines.Scripted(pipelines.steady()), pipelines.Scripted(pipelines.steady()), Event()
    running: list[bool] = []

    def slow() -> pipelines.OakStream:
        answer.wait(PATIENT_S)
        return first()

    def next_one() -> pipelines.OakStream:
        running.append(first.pipeline is None or first.pipeline.isRunning())
        return second()

    with pytest.raises(SourceAbsentError):
        _ = open_pipeline(slow, open_timeout_s=0.2).info
    with pytest.raises(SourceAbsentError):
        _ = open_pipeline(next_one, open_timeout_s=0.2).info
    answer.set()
    with closing(open_pipeline(next_one, open_timeout_s=PATIENT_S)) as camera:
        assert camera.info.id == pipelines.NAME
    assert running == [False]


@pytest.mark.parametrize("wrong", ["exposure_us = 8000", 'socket = "left"', "focus = 300", 'anti_banding = "100hz"'])
def test_a_setting_that_no_oak_has_is_refused(wrong: str) -> None:
    text = f'[source]\nkind = "oak"\n{wrong}\n[model]\nweights = "w"\n[view.a]\n'
    with pytest.raises(ConfigError, match=wrong.split()[0]):
        parse_config(text.encode(), "test")


# The lens.


def memory(*, width: int = 4056, height: int = 3040, coefficients: list[float], model: str) -> dai.CalibrationHandler:
    sensor = dai.CameraInfo()
    sensor.width, sensor.height = width, height
    sensor.intrinsicMatrix = [[3100.0, 0.0, 2020.0], [0.0, 3101.0, 1530.0], [0.0, 0.0, 1.0]]
    sensor.distortionCoeff = coefficients
    sensor.cameraType = dai.CameraModel.__members__[model]
    stored = dai.EepromData()
    stored.version = 7
    stored.cameraData = {SOCKET: sensor}
    return dai.CalibrationHandler(stored)


RATIONAL = [0.5, -0.25, 0.125, 0.0625, 2.0, 0.75, -0.5, 1.5]


def test_the_lens_in_memory_is_scaled_and_cut_to_the_picture() -> None:
    lens = lens_in_memory(memory(coefficients=RATIONAL + [0.0] * 6, model="Perspective"), SOCKET, 1280, 720)
    scale = 1280 / 4056  # the width is kept, rows are cut off above and below
    assert (lens.width, lens.height) == (1280, 720)
    assert lens.fx == pytest.approx(3100 * scale, rel=1e-5)
    assert lens.fy == pytest.approx(3101 * scale, rel=1e-5)
    assert lens.cx == pytest.approx(2020 * scale, abs=1)
    assert lens.cy == pytest.approx(1530 * scale - (3040 * scale - 720) / 2, abs=1)
    assert (lens.distortion, lens.coefficients) == ("rational_polynomial", tuple(RATIONAL))


@pytest.mark.parametrize(
    ("coefficients", "model", "wanted"),
    [
        ([0.0] * 14, "Perspective", ("none", ())),
        ([0.5, 0.25], "Perspective", ("rational_polynomial", (0.5, 0.25, *[0.0] * 6))),
        ([*RATIONAL, 0.5, *[0.0] * 5], "Perspective", ("rational_polynomial", (*RATIONAL, 0.5, *[0.0] * 5))),
        ([0.5, 0.25, 2.0, 4.0, *[0.0] * 10], "Fisheye", ("equidistant", (0.5, 0.25, 2.0, 4.0))),
    ],
    ids=["none", "short", "with prism", "fish-eye"],
)
def test_distortion_has_our_names(coefficients: list[float], model: str, wanted: tuple[str, tuple[float, ...]]) -> None:
    lens = lens_in_memory(memory(coefficients=coefficients, model=model), SOCKET, 4056, 3040)
    assert (lens.distortion, lens.coefficients) == wanted


def test_a_lens_that_makes_no_sense_is_no_lens() -> None:
    for stored in (
        dai.CalibrationHandler(dai.EepromData()),
        memory(coefficients=RATIONAL, model="Perspective", width=1000),
        memory(coefficients=RATIONAL, model="RadialDivision"),
        memory(coefficients=[], model="Fisheye"),  # DepthAI ends the process if it is asked for them
        memory(coefficients=[0.1, 0.0, 0.0], model="Fisheye"),
    ):
        factory = pipelines.Scripted(pipelines.steady(), lens=partial(lens_in_memory, stored, SOCKET))
        with closing(open_pipeline(factory, open_timeout_s=PATIENT_S)) as camera:
            assert camera.info.lens is None


def test_the_lens_of_the_picture_itself_comes_before_the_memory() -> None:
    first = pipelines.picture(0)
    matrix = [[80.0, 0.0, 32.0], [0.0, 81.0, 24.0], [0.0, 0.0, 1.0]]
    first.transformation = dai.ImgTransformation(WIDTH, HEIGHT, matrix, dai.CameraModel.Perspective, RATIONAL)
    stored = LensModel(width=WIDTH, height=HEIGHT, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    factory = pipelines.Scripted(pipelines.Handed(first), lens=lambda width, height: stored)
    with closing(open_pipeline(factory, open_timeout_s=PATIENT_S)) as camera:
        lens = camera.info.lens
    assert lens is not None
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (80.0, 81.0, 32.0, 24.0)
    assert lens.coefficients == tuple(RATIONAL)


# What only a process of its own can show.

SIGNALS = """
import os, signal, sys, time
import gcd_node.sources
from gcd_node.sources import oak
assert "depthai" not in sys.modules, "imported before a camera was wanted"
got = []
for number in (signal.SIGTERM, signal.SIGINT):
    signal.signal(number, lambda number, _: got.append(number))

def ours():
    lines = open("/proc/self/status").read().splitlines()
    masks = {line.split(":")[0]: int(line.split()[1], 16) for line in lines if line.startswith(("SigCgt", "SigIgn"))}
    return masks["SigCgt"] & 0x7FFFFFFF, masks["SigIgn"]  # real-time signals are the C library's

before = ours()
import oak_pipelines as pipelines
from contextlib import closing
from functools import partial
from pathlib import Path
with closing(oak.open_pipeline(pipelines.Scripted(pipelines.steady()), open_timeout_s=30)) as camera:
    next(camera.frames())
    assert ours() == before, (ours(), before)
    for number in (signal.SIGTERM, signal.SIGINT):
        os.kill(os.getpid(), number)
    time.sleep(0.1)
assert got == [signal.SIGTERM, signal.SIGINT], got
"""


def test_depthai_comes_late_leaves_our_signal_handlers_alone_and_standard_output_clean() -> None:
    command = [sys.executable, "-c", SIGNALS]
    ended = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=100, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == ""
