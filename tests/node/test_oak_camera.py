"""The OAK source on DepthAI pipelines without a device: the same queue, stamps, losses and ends as with one."""

import math
import os
import threading
import time
from contextlib import closing
from itertools import islice

import numpy as np
import pytest
from cameras import until
from media import HEIGHT, WIDTH, flat

from gcd_node.errors import SourceError, SourceLostError
from gcd_node.frame import Frame
from gcd_node.sources import OakSource
from gcd_node.sources.live import LiveCamera
from gcd_node.sources.oak import camera_pipeline, open_oak, open_pipeline

try:
    import oak_pipelines as pipelines
except SourceError as missing:
    pytest.skip(str(missing), allow_module_level=True)

import depthai as dai

PATIENT_S = 30.0  # for a machine that is busy with something else
Layout = dai.ImgFrame.Type


def opened(script: pipelines.Script) -> LiveCamera:
    camera = open_pipeline(pipelines.Scripted(script), open_timeout_s=PATIENT_S)
    assert camera.info.id == pipelines.NAME  # it is open
    return camera


def take(camera: LiveCamera, count: int) -> list[Frame]:
    return list(islice(camera.frames(), count))


# Laws.


@pytest.mark.parametrize("layout", [Layout.BGR888i, Layout.RGB888i, Layout.BGR888p, Layout.NV12, Layout.GRAY8])
def test_colours_are_rgb_whatever_the_order_of_the_message(layout: dai.ImgFrame.Type) -> None:
    orange = flat(90, 90, 90) if layout == Layout.GRAY8 else flat(230, 120, 20)
    with closing(opened(pipelines.steady(lambda seq: pipelines.picture(seq, orange, layout=layout)))) as camera:
        (frame,) = take(camera, 1)
    assert frame.image.shape == (HEIGHT, WIDTH, 3)
    assert not frame.image.flags.writeable
    np.testing.assert_allclose(frame.image, orange, atol=3)


# Stamps, rates, sizes.


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
    got: list[Frame] = []
    with closing(opened(handed)) as camera:
        take(camera, 1)
        reader = threading.Thread(target=lambda: got.extend(take(camera, 1)))
        reader.start()
        for count in (1, 2, 3):
            handed.hand()
            until(lambda count=count: camera.corrupt == count)
        handed.hand()
        reader.join(PATIENT_S)
    assert [frame.seq for frame in got] == [4]


# Silence, ends, losses.


@pytest.mark.parametrize("state", ["DISCONNECTED", "FAILED"])
def test_a_device_that_goes_away_is_a_loss_that_names_its_state(state: str) -> None:
    factory = pipelines.Scripted(pipelines.steady())
    with closing(open_pipeline(factory, open_timeout_s=PATIENT_S)) as camera:
        frames = camera.frames()
        next(frames)
        factory.device_turns(dai.DeviceState.__members__[state])
        with pytest.raises(SourceLostError, match=f"{pipelines.NAME} is lost: device {state.lower()}") as caught:
            list(frames)
    assert caught.value.exit_code == 75


def test_a_link_that_breaks_while_it_is_read_is_a_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        def get(self, patience: object = None) -> None:
            raise RuntimeError("X_LINK_ERROR")

        tryGetAll = get  # noqa: N815

    with closing(opened(pipelines.steady())) as camera:
        monkeypatch.setattr(camera._driver, "_queue", Broken())
        with pytest.raises(SourceLostError, match=f"{pipelines.NAME} is lost: reading from it failed .X_LINK_ERROR."):
            list(camera.frames())
        camera.close()
        assert list(camera.frames()) == []


# Opening.


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


# With a device; CONTRIBUTING.md lists the rest.


@pytest.fixture(scope="module")
def oak() -> LiveCamera:
    if not dai.Device.getAllAvailableDevices():
        pytest.skip("hardware: needs an OAK camera that is plugged in and free")
    return open_pipeline(lambda: camera_pipeline(OakSource(fps=30.0)), open_timeout_s=PATIENT_S)


@pytest.mark.hardware
def test_hardware_gives_the_size_and_rate_it_was_asked_for_fresh_and_with_its_lens(oak: LiveCamera) -> None:
    frames, ages_ms = list[Frame](), list[float]()
    for frame in islice(oak.frames(), 90):
        frames.append(frame)
        ages_ms.append((time.monotonic_ns() - frame.stamp_ns) / 1e6)
    rate = (frames[-1].seq - frames[0].seq) / ((frames[-1].stamp_ns - frames[0].stamp_ns) / 1e9)
    assert frames[0].size == (1280, 720)
    assert rate == pytest.approx(30, rel=0.02)
    assert oak.corrupt == 0
    assert min(ages_ms) > 0
    assert float(np.median(ages_ms)) < 200
    assert oak.info.stamp_uncertainty_us == 500
    lens = oak.info.lens
    assert lens is not None
    assert 40 < 2 * math.degrees(math.atan(lens.width / 2 / lens.fx)) < 150
    assert (lens.cx, lens.cy) == pytest.approx((lens.width / 2, lens.height / 2), rel=0.1)


@pytest.mark.hardware
def test_hardware_lets_go_in_a_second_and_opens_again(oak: LiveCamera) -> None:
    begin = time.monotonic()
    oak.close()
    assert time.monotonic() - begin < 1
    with closing(open_oak(OakSource(device=oak.info.id, open_timeout_s=PATIENT_S))) as again:
        assert len(list(islice(again.frames(), 3))) == 3
