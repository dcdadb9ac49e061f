"""Cameras of this machine through OpenCV, with a scripted Video4Linux device; what all OpenCV cameras share."""

import logging
import time
from itertools import islice, pairwise
from pathlib import Path

import cv2
import msgspec
import pytest
from fake_camera import FakeVideoCapture
from media import flat

from gcd_node.errors import SourceAbsentError, SourceLostError
from gcd_node.sources import V4l2Source, open_source, opencv
from gcd_node.sources.live import LiveCamera
from gcd_node.sources.opencv import list_v4l2, open_v4l2

RED = flat(250, 10, 20)
GUARD_S = 20.0


def camera(fake: FakeVideoCapture, open_timeout_s: float = GUARD_S, **asked: float) -> LiveCamera:
    """A Video4Linux source over a fake; /dev/null stands in for the device file."""
    section = {"kind": "v4l2", "device": "/dev/null", "open_timeout_s": open_timeout_s, **asked}
    source = open_v4l2(msgspec.convert(section, V4l2Source), fake.open)
    assert source.info.kind == "v4l2"  # it is open
    return source


def test_the_pixel_format_is_set_before_the_size_and_what_differs_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    fake = FakeVideoCapture(RED, fixed={cv2.CAP_PROP_FRAME_WIDTH: 640.0})
    with caplog.at_level(logging.WARNING):
        source = camera(fake, width=1280, height=720, fps=30.0)
    source.close()
    order = [prop for prop, _ in fake.calls]
    size_and_rate = [cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS]
    assert order == [cv2.CAP_PROP_FOURCC, *size_and_rate]
    assert [record.getMessage() for record in caplog.records] == [
        "the camera /dev/null: asked for width 1280, it gives 640"
    ]
    assert (source.info.codec, source.info.fps_nominal) == ("MJPG", 30.0)


def test_stamps_of_the_driver_are_used() -> None:
    fake = FakeVideoCapture(RED, stamps="driver")
    source = camera(fake)
    frame = next(source.frames())
    source.close()
    assert frame.stamp_ns in [round(stated * 1e6) for stated in fake.stated_ms]
    assert source.info.stamp_uncertainty_us == 20_000


@pytest.mark.parametrize("stamps", ["zero", "wall"])
def test_stamps_of_another_clock_are_replaced_by_the_time_of_arrival(stamps: str) -> None:
    begin_ns = time.monotonic_ns()
    source = camera(FakeVideoCapture(RED, stamps=stamps))
    frame = next(source.frames())
    source.close()
    assert begin_ns < frame.stamp_ns <= time.monotonic_ns()
    assert source.info.stamp_uncertainty_us == 80_000


def test_a_damaged_picture_is_counted_and_leaves_a_gap() -> None:
    fake = FakeVideoCapture(RED, fps=50.0)
    fake.damaged = {0, 4, 5}
    source = camera(fake)
    seqs: list[int] = []
    for frame in source.frames():
        seqs.append(frame.seq)
        if frame.seq > 8:
            break
    source.close()
    assert source.corrupt == 3
    assert not fake.damaged & set(seqs)


@pytest.mark.parametrize("stated", [0.0, 90_000.0, float("nan")])
def test_a_rate_that_cannot_be_is_measured_instead(stated: float) -> None:
    source = camera(FakeVideoCapture(RED, fps=20.0, fixed={cv2.CAP_PROP_FPS: stated}))
    source.close()
    assert 5.0 < source.info.fps_nominal < 22.0


@pytest.mark.parametrize("trouble", ["gone", "breaks"])
def test_an_unplugged_camera_and_a_driver_that_raises_are_lost_every_time_they_are_asked(trouble: str) -> None:
    fake = FakeVideoCapture(RED)
    source = camera(fake)
    setattr(fake, trouble, True)
    for _ in range(2):
        with pytest.raises(SourceLostError):
            list(source.frames())
    assert fake.released.wait(GUARD_S)
    with pytest.raises(SourceAbsentError):
        camera(fake)


@pytest.mark.parametrize("trouble", ["silent", "gone", "in use"])
def test_a_camera_that_gives_no_picture_is_absent(trouble: str) -> None:
    fake = FakeVideoCapture(RED)
    fake.gone, fake.there = trouble == "gone", trouble != "in use"
    if trouble == "silent":
        fake.awake.clear()
    with pytest.raises(SourceAbsentError):
        camera(fake, open_timeout_s=0.2 if trouble == "silent" else GUARD_S)
    fake.awake.set()
    assert trouble == "in use" or fake.released.wait(GUARD_S)


def test_an_absent_camera_is_told_with_those_there_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opencv, "_DEVICES", tmp_path)
    (tmp_path / "v4l" / "by-id").mkdir(parents=True)
    there = [tmp_path / "v4l" / "by-id" / "usb-Front_camera-video-index0", tmp_path / "video2"]
    for path in there:
        path.touch()
    assert list_v4l2() == there
    with pytest.raises(SourceAbsentError, match=f"{there[0]}, {there[1]}"):
        open_source(V4l2Source())
    with pytest.raises(SourceAbsentError):
        _ = open_source(V4l2Source(device="2")).info  # a file, and no device


@pytest.mark.hardware
def test_a_real_camera_gives_a_second_of_pictures() -> None:
    if not Path("/dev/video0").exists():
        pytest.skip("needs a camera at /dev/video0")
    source = open_source(V4l2Source())
    frames = list(islice(source.frames(), 15))
    source.close()
    assert all(b.stamp_ns > a.stamp_ns for a, b in pairwise(frames))
    assert 0 <= time.monotonic_ns() - frames[-1].stamp_ns < 1_000_000_000
