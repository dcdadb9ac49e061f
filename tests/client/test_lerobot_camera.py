"""The camera for LeRobot: by LeRobot's own interface where it is installed, else by a stand-in of it."""

import importlib.util
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace as dataclass_replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_stand_in import stand_in
from msgspec.structs import replace
from test_subscriber import Sender
from wire_messages import pixels, window

from gcd_client.protocol import ViewMessage

if importlib.util.find_spec("lerobot") is None:
    stand_in()
from lerobot.cameras import Camera, CameraConfig

from gcd_client.lerobot import GcdCamera, GcdCameraConfig

pytestmark = pytest.mark.timeout(30)


def frame(seed: int, *, valid_for_ms: int = 60_000, ood: tuple[str, ...] = ()) -> ViewMessage:
    """One frame at the goal, of 8 x 6 pixels."""
    message = window(seed)
    picture = pixels(seed, 1, 6, 8)
    header = replace(
        message.header,
        shape=(1, 6, 8, 3),
        t_publish_ns=time.time_ns(),
        valid_for_ms=valid_for_ms,
        t_capture_ns=message.header.t_capture_ns[:1],
        frame_role=message.header.frame_role[:1],
        src=replace(message.header.src, seq=message.header.src.seq[:1]),
        pose=None,
        source_from_view=None,
        quality=replace(message.header.quality, ood=ood),
    )
    return replace(message, topic="view/top/frm", header=header, payload=picture.tobytes())


@pytest.fixture
def sender(tmp_path: Path) -> Iterator[Sender]:
    made = Sender(f"ipc://{tmp_path}/data")
    yield made
    made.context.destroy(linger=0)


@pytest.fixture
def camera(sender: Sender) -> Iterator[GcdCamera]:
    made = GcdCamera(GcdCameraConfig(view="top", endpoint=sender.endpoint, width=8, height=6))
    made.connect(warmup=False)
    sender.wait()
    yield made
    if made.is_connected:
        made.disconnect()


def test_a_policy_changes_one_line_of_its_config(sender: Sender) -> None:
    config = GcdCameraConfig(view="top", endpoint=sender.endpoint, width=8, height=6, fps=10)  # as robots demand
    assert isinstance(config, CameraConfig)
    assert config.type == "gcd"
    if importlib.util.find_spec("draccus") is not None:  # the real one
        from lerobot.cameras import make_cameras_from_configs

        assert isinstance(make_cameras_from_configs({"front": config})["front"], GcdCamera)
    assert issubclass(GcdCamera, Camera)


def test_a_view_is_given_once_and_the_newest_again_when_that_is_wished(sender: Sender, camera: GcdCamera) -> None:
    with pytest.raises(RuntimeError):
        camera.read_latest()
    sender.numbered(0, frame(1))
    assert np.array_equal(camera.async_read(5000), pixels(1, 1, 6, 8)[0])
    with pytest.raises(TimeoutError):
        camera.async_read(50)
    assert np.array_equal(camera.read_latest(), pixels(1, 1, 6, 8)[0])
    sender.numbered(1, frame(2))
    sender.numbered(2, frame(3))
    time.sleep(0.2)
    assert np.array_equal(camera.async_read(5000), pixels(3, 1, 6, 8)[0])  # never a queue


def test_a_view_that_no_longer_holds_is_never_given(sender: Sender, camera: GcdCamera) -> None:
    sender.numbered(0, frame(1, valid_for_ms=50))
    time.sleep(0.2)
    with pytest.raises(TimeoutError):
        camera.async_read(100)
    with pytest.raises(TimeoutError):
        camera.read_latest(max_age_ms=10_000)


@contextmanager
def said_again(sender: Sender) -> Iterator[None]:
    """One picture after the other, as nobody knows when a reader is there."""
    done = threading.Event()

    def say() -> None:
        number = 0
        while not done.wait(0.05):
            sender.numbered(number, frame(number + 1))
            number += 1

    thread = threading.Thread(target=say)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def test_it_connects_once_within_its_time_and_only_to_a_view_of_the_stated_size(sender: Sender) -> None:
    silent = GcdCameraConfig(view="top", endpoint=sender.endpoint, timeout_ms=100)
    camera = GcdCamera(silent)
    with pytest.raises(ConnectionError):
        camera.connect()
    assert not camera.is_connected
    for use in (camera.read, camera.async_read, camera.read_latest, camera.disconnect):
        with pytest.raises(ConnectionError):
            use()
    camera = GcdCamera(dataclass_replace(silent, width=9, height=6, timeout_ms=5000))
    with said_again(sender), pytest.raises(RuntimeError, match="8 x 6"):
        camera.connect()
    assert not camera.is_connected
    camera.connect(warmup=False)
    with pytest.raises(ConnectionError):
        camera.connect()
    with said_again(sender):  # in mid-stream a node may be started with another size, or a view set elsewhere
        for read in (camera.async_read, camera.read_latest):
            with pytest.raises(RuntimeError, match="8 x 6"):
                read(5000)
    camera.disconnect()


def test_colours_come_in_the_order_that_is_asked_for(sender: Sender) -> None:
    camera: Any = GcdCamera(GcdCameraConfig(view="top", endpoint=sender.endpoint, width=8, height=6, color_mode="bgr"))
    camera.connect(warmup=False)
    sender.wait()
    sender.numbered(0, frame(1))
    assert np.array_equal(camera.async_read(5000), pixels(1, 1, 6, 8)[0, ..., ::-1])
    camera.disconnect()
