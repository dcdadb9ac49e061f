"""Frames that somebody else pushes: who may, what is refused, what travels with a picture, and how it comes back."""

import logging
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
import zmq
from cameras import pushing, until
from media import environment, flat, write_video

from gcd_client import AuthError, ClientKeys, FramePusher
from gcd_client.frames import encode_frame
from gcd_node.auth import Client, ServerSecurity, new_key_pair
from gcd_node.errors import ConfigError, EndpointError, SourceLostError
from gcd_node.frame import Frame
from gcd_node.sources import PushSource
from gcd_node.sources.live import LiveCamera
from gcd_node.sources.push import open_push

RED = flat(250, 10, 20)
SHAPE = RED.shape[:2]
FPS = 50.0
GUARD_S = 30.0
NODE, VIEWER, OPERATOR = (new_key_pair() for _ in range(3))
CLIENTS = {VIEWER.public: Client(name="eye", role="viewer"), OPERATOR.public: Client(name="hand", role="operator")}
SECURITY = ServerSecurity(keys=NODE, find_client=CLIENTS.get)


def red(pusher: FramePusher, _: int) -> None:
    pusher.push(RED, time.time_ns())


@contextmanager
def opened(endpoint: str, security: ServerSecurity | None = None) -> Iterator[LiveCamera]:
    source = open_push(PushSource(endpoint=endpoint, fps=FPS, open_timeout_s=GUARD_S), security)
    try:
        assert source.info.kind == "push"  # it is open
        yield source
    finally:
        source.close()


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/frames"


def taken(source: LiveCamera) -> Frame:
    frame = source.take(GUARD_S)
    assert frame is not None
    return frame


def test_depth_and_odometry_come_with_their_picture(endpoint: str) -> None:
    depth, pose = np.full(SHAPE, 2.5), np.eye(4)
    depth[0] = [np.nan, np.inf, -1.0, 0.0] * (SHAPE[1] // 4)
    pose[:3, 3] = 1, 2, 3
    with pushing(endpoint, lambda pusher, _: pusher.push(RED, time.time_ns(), depth, pose)), opened(endpoint) as source:
        frame = taken(source)
    assert np.array_equal(frame.image, RED)
    assert frame.depth is not None
    assert frame.odometry is not None
    assert not frame.depth[0].any()
    assert (frame.depth[1:] == 2.5).all()
    assert np.array_equal(frame.odometry, pose)


def test_depth_of_another_shape_is_left_out_with_one_line(endpoint: str, caplog: pytest.LogCaptureFixture) -> None:
    square = np.ones((SHAPE[0], SHAPE[0]), np.float32)
    with (
        caplog.at_level(logging.WARNING),
        pushing(endpoint, lambda pusher, _: pusher.push(RED, time.time_ns(), square)),
        opened(endpoint) as source,
    ):
        assert [taken(source).depth for _ in range(5)] == [None] * 5
    assert source.corrupt == 0
    assert [each.getMessage().partition(":")[0][-22:] for each in caplog.records] == ["goes without its depth"]


def test_what_is_no_frame_is_refused_and_counted_and_the_next_is_taken(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    who = "0" * 32
    bad = [b"", b"junk", encode_frame(who, 0, RED, time.time_ns())[:-1], encode_frame(who, 0, RED, 12345)]
    context = zmq.Context()
    with caplog.at_level(logging.WARNING), pushing(endpoint, red), opened(endpoint) as source:
        with context.socket(zmq.PUSH) as socket:
            socket.connect(endpoint)
            for part in bad:
                socket.send(part)
            socket.send_multipart([b"two", b"parts"])
            until(lambda: source.corrupt == len(bad) + 1)
        until(lambda: taken(source).stamp_ns > time.monotonic_ns() - 500_000_000)
    context.destroy(linger=0)
    assert len(caplog.records) == 1


def test_a_second_pusher_is_refused_until_the_first_has_gone(endpoint: str) -> None:
    with ExitStack() as first:
        first.enter_context(pushing(endpoint, red))
        with opened(endpoint) as source, pushing(endpoint, red):
            until(lambda: source.corrupt > 3)
            first.close()
            with pytest.raises(SourceLostError):
                until(lambda: taken(source).seq < 0)
    with pushing(endpoint, red), opened(endpoint) as source:  # as the node opens it again
        taken(source)


def test_nobody_waits_for_a_node_that_is_not_there(endpoint: str) -> None:
    with FramePusher(endpoint) as pusher:
        assert [pusher.push(RED, time.time_ns()) for _ in range(20)] == [False] * 20
        assert pusher.skipped == 20
        waiting = threading.Thread(target=lambda: until(lambda: pusher.push(RED, time.time_ns())))
        waiting.start()
        with opened(endpoint) as source:
            assert taken(source).seq >= 20
        waiting.join(GUARD_S)


def test_an_endpoint_is_bound_as_every_other_one(endpoint: str) -> None:
    with pytest.raises(ConfigError), opened("tcp://0.0.0.0:0"):
        pass
    with pushing(endpoint, red), opened(endpoint), pytest.raises(EndpointError), opened(endpoint):
        pass


def test_over_tcp_an_operator_s_key_pushes_and_a_viewer_s_does_not() -> None:
    with zmq.Context() as context, context.socket(zmq.PUSH) as probe:
        endpoint = f"tcp://127.0.0.1:{probe.bind_to_random_port('tcp://127.0.0.1')}"
    refused: list[AuthError] = []

    def try_to(pusher: FramePusher, _: int) -> None:
        try:
            pusher.push(RED, time.time_ns())
        except AuthError as error:
            refused.append(error)

    hand, eye = (ClientKeys(own=own, server=NODE.public) for own in (OPERATOR, VIEWER))
    with pushing(endpoint, red, hand), opened(endpoint, SECURITY) as source, pushing(endpoint, try_to, eye):
        assert np.array_equal(taken(source).image, RED)
        until(lambda: refused != [])
        assert source.corrupt == 0


def test_the_example_for_opencv_pushes_a_file(endpoint: str, tmp_path: Path) -> None:
    video = write_video(tmp_path / "clip.mkv", [RED] * 200, fps=25.0)
    script = Path(__file__).parents[2] / "launch" / "clients" / "push_opencv.py"
    command = [sys.executable, script, video, "--endpoint", endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment()) as process, opened(endpoint) as source:
        frames = [taken(source) for _ in range(5)]
        process.kill()
    assert np.abs(frames[0].image.astype(int) - (250, 10, 20)).max() <= 10
    assert (frames[-1].stamp_ns - frames[0].stamp_ns) / 1e9 > 0.1
