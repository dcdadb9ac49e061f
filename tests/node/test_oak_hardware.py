"""What only a device can show of the OAK source; docs/hardware.md lists the rest. Skipped where there is none."""

import math
import time
from contextlib import closing
from itertools import islice

import numpy as np
import pytest

from gcd_node.errors import SourceError
from gcd_node.source_config import OakSource
from gcd_node.sources.live_camera import LiveCamera
from gcd_node.sources.oak import camera_pipeline, load_depthai, open_oak, open_pipeline

try:
    load_depthai()
except SourceError as missing:
    pytest.skip(str(missing), allow_module_level=True)

import depthai as dai

PATIENT_S = 30.0  # for a machine that is busy with something else


@pytest.fixture(scope="module")
def oak() -> LiveCamera:
    if not dai.Device.getAllAvailableDevices():
        pytest.skip("hardware: needs an OAK camera that is plugged in and free")
    return open_pipeline(camera_pipeline(OakSource(fps=30.0)), open_timeout_s=PATIENT_S)


@pytest.mark.hardware
def test_hardware_gives_the_size_and_rate_it_was_asked_for(oak: LiveCamera) -> None:
    frames = list(islice(oak.frames(), 90))
    rate = (frames[-1].seq - frames[0].seq) / ((frames[-1].stamp_ns - frames[0].stamp_ns) / 1e9)
    assert frames[0].size == (1280, 720)
    assert rate == pytest.approx(30, rel=0.02)
    assert oak.corrupt == 0


@pytest.mark.hardware
def test_hardware_stamps_lie_shortly_before_arrival(oak: LiveCamera) -> None:
    frames, ages_ms = oak.frames(), list[float]()
    for frame in islice(frames, 60):
        ages_ms.append((time.monotonic_ns() - frame.stamp_ns) / 1e6)
    assert min(ages_ms) > 0
    assert float(np.median(ages_ms)) < 200
    assert oak.info.stamp_uncertainty_us == 500


@pytest.mark.hardware
def test_hardware_knows_its_lens(oak: LiveCamera) -> None:
    lens = oak.info.lens
    assert lens is not None
    hfov_deg = 2 * math.degrees(math.atan(lens.width / 2 / lens.fx))
    assert 40 < hfov_deg < 150
    assert lens.cx == pytest.approx(lens.width / 2, rel=0.1)
    assert lens.cy == pytest.approx(lens.height / 2, rel=0.1)


@pytest.mark.hardware
def test_hardware_lets_go_in_a_second_and_opens_again(oak: LiveCamera) -> None:
    begin = time.monotonic()
    oak.close()
    assert time.monotonic() - begin < 1
    with closing(open_oak(OakSource(device=oak.info.id, open_timeout_s=PATIENT_S))) as again:
        assert len(list(islice(again.frames(), 3))) == 3
