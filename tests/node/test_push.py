"""Frames that somebody else pushes: who may, what is refused, what travels with a picture, and how it comes back."""

import logging
import subprocess
import sys
import threading
import time
import types
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from cameras import environment, flat, pushing, until, write_video
from fakes import NODE, OPERATOR, SECURITY, VIEWER
from msgspec.structs import replace
from wire_messages import class_map, depth, received, visibility

from gcd_client import AuthError, ClientKeys, FramePusher
from gcd_client.frames import encode_frame
from gcd_client.protocol import ClassRecord
from gcd_client.subscriber import ReceivedView
from gcd_node.auth import ServerSecurity
from gcd_node.errors import ConfigError, EndpointError, SourceLostError
from gcd_node.frame import Frame
from gcd_node.sources import PushSource
from gcd_node.sources.live import LiveCamera
from gcd_node.sources.push import open_push

RED = flat(250, 10, 20)
SHAPE = RED.shape[:2]
FPS = 50.0
GUARD_S = 30.0


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


def test_depth_and_odometry_come_with_their_picture(endpoint: str, caplog: pytest.LogCaptureFixture) -> None:
    depth, pose = np.full(SHAPE, 2.5), np.eye(4)
    depth[0] = [np.nan, np.inf, -1.0, 0.0] * (SHAPE[1] // 4)
    pose[:3, 3] = 1, 2, 3
    with pushing(endpoint, lambda pusher, _: pusher.push(RED, time.time_ns(), depth, pose)), opened(endpoint) as source:
        frame = taken(source)
    assert np.array_equal(frame.image, RED)
    assert not frame.depth[0].any()
    assert (frame.depth[1:] == 2.5).all()
    assert np.array_equal(frame.odometry, pose)
    square = np.ones((SHAPE[0], SHAPE[0]), np.float32)  # which is left out, with one line
    with pushing(endpoint, lambda pusher, _: pusher.push(RED, time.time_ns(), square)), opened(endpoint) as source:
        assert [taken(source).depth for _ in range(5)] == [None] * 5
    assert source.corrupt == 0
    assert [each.getMessage().partition(":")[0][-22:] for each in caplog.records] == ["goes without its depth"]


def test_what_is_no_frame_is_counted_and_the_next_taken(endpoint: str, caplog: pytest.LogCaptureFixture) -> None:
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
        with pytest.raises(EndpointError), opened(endpoint):  # bound as every other endpoint
            pass
    with pytest.raises(ConfigError), opened("tcp://0.0.0.0:0"):
        pass


def test_nobody_waits_for_a_node_that_is_not_there(endpoint: str) -> None:
    with FramePusher(endpoint) as pusher:
        assert [pusher.push(RED, time.time_ns()) for _ in range(20)] == [False] * 20
        assert pusher.skipped == 20
        waiting = threading.Thread(target=lambda: until(lambda: pusher.push(RED, time.time_ns())))
        waiting.start()
        with opened(endpoint) as source:
            assert taken(source).seq >= 20
        waiting.join(GUARD_S)


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


@pytest.mark.slow
def test_the_example_for_opencv_pushes_a_file(endpoint: str, tmp_path: Path) -> None:
    video = write_video(tmp_path / "clip.mkv", [RED] * 200, fps=25.0)
    script = Path(__file__).parents[2] / "launch" / "clients" / "push_opencv.py"
    command = [sys.executable, script, video, "--endpoint", endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment()) as process, opened(endpoint) as source:
        frames = [taken(source) for _ in range(5)]
        process.kill()
    assert np.abs(frames[0].image.astype(int) - (250, 10, 20)).max() <= 10
    assert (frames[-1].stamp_ns - frames[0].stamp_ns) / 1e9 > 0.1


# The planners of launch/clients follow a live node, and take nothing that must not be used.


def planner(name: str = "planner") -> dict[str, Any]:
    """What a program in launch/clients defines."""
    path = Path(__file__).parents[2] / "launch" / "clients" / f"{name}.py"
    defined: dict[str, Any] = {"__name__": name}
    exec(compile(path.read_text(), path, "exec"), defined)
    return defined


class Scripted:
    """A subscriber that gives what a test lists, leaves out a stale view, or ends."""

    ended, stale = False, 0

    def __init__(self, *given: ReceivedView | str | None) -> None:
        self._given = list(given)

    def receive(self, timeout_ms: float) -> ReceivedView | None:
        item = self._given.pop(0)
        self.stale += item == "stale"
        self.ended = item == "end"
        return item if isinstance(item, ReceivedView) else None


def test_the_planner_drops_what_is_stale_late_of_another_epoch_or_another_life(tmp_path: Path) -> None:
    classes = (ClassRecord(id=0, name="road", colour=(0, 0, 0)), ClassRecord(id=1, name="car", colour=(0, 0, 255)))
    message = class_map(drawn=np.ones((14, 4, 6), np.uint8))
    quality = replace(message.header.quality, ood=())
    message = replace(message, header=replace(message.header, classes=classes, quality=quality))
    src = replace(message.header.src, epoch=message.header.src.epoch + 1)
    good, jumped = received(message), received(replace(message, header=replace(message.header, src=src)))
    late, anew = received(message, expired=True), received(message, restarted=True)
    defined = planner()
    awareness = defined["Awareness"](f"ipc://{tmp_path}/data", "main")
    assert awareness.poll() is None
    assert awareness.why_not == "nothing has come yet"
    awareness.close()
    for given, held, why_not in (
        (good, good, ""),
        (None, good, ""),  # nothing new, and not run out yet
        ("stale", None, "what comes is older than max_age_ms"),
        (good, good, ""),
        (jumped, jumped, "the camera's clock or format jumped"),
        (late, None, "it came too late"),
        (good, good, ""),
        ("end", None, "the stream has ended"),
        (anew, anew, "the node was started anew"),
    ):
        awareness._views = Scripted(given)
        assert awareness.poll() is held
        assert why_not in awareness.why_not
    assert defined["caution"](good) == 1.0
    defined["time"] = types.SimpleNamespace(monotonic=lambda: awareness._until_s + 0.001)
    awareness._views = Scripted(None)
    assert awareness.poll() is None
    assert awareness.why_not == "the last one has expired"


def seen_by(vis: np.ndarray, inverse: np.ndarray, **header: object) -> list[ReceivedView]:
    """Both maps of one window, whose camera stands 2 m ahead of the source camera."""
    pose = np.eye(4)
    pose[2, 3] = 2.0
    messages = visibility(seen=vis), depth(inverse=inverse.astype("<f2"))
    changes = {"source_from_view": (tuple(pose.ravel().tolist()),) * 2, "pose_units": "m"}
    changes["quality"] = replace(messages[0].header.quality, ood=())
    return [received(replace(each, header=replace(each.header, **changes | header))) for each in messages]


def test_obstacles_are_what_was_seen_now_where_it_was_and_never_of_two_windows(tmp_path: Path) -> None:
    defined = planner("obstacles")
    obstacles = defined["SeenObstacles"](f"ipc://{tmp_path}/data", "main")
    obstacles.maps.close()
    seen, far = seen_by(np.full((2, 4, 6), 2, np.uint8), np.full((2, 4, 6), 0.1))
    later = replace(far, message=replace(far.message, header=replace(far.header, window_id=1)))
    late = replace(far, expired=True)
    obstacles.maps = Scripted(far, seen, later, far, seen, None, late, seen, far)
    assert [obstacles.poll() is None for _ in range(9)] == [True] * 8 + [False]
    chance = np.random.default_rng(0)
    vis = chance.integers(0, 3, (2, 4, 6), np.uint8)
    inverse = np.where(chance.random((2, 4, 6)) < 0.2, 0.0, 1 / chance.uniform(1, 50, (2, 4, 6)))
    seen, far = seen_by(vis, inverse)
    points = defined["seen_points"](seen, far)
    shown = (vis[-1] == 2) & (inverse[-1] > 0)
    assert len(points) == shown.sum() > 0
    x, y, z = points.T - np.array([[0.0], [0.0], [2.0]])  # back in the view's axes
    fx, _, cx, _, fy, cy, *_ = far.header.intrinsics or ()
    assert np.allclose((fx * x / z + cx, fy * y / z + cy), np.nonzero(shown)[::-1])
    assert np.allclose(1 / z, inverse[-1][shown], rtol=5e-4)
    unusual = replace(far.header.quality, ood=("fps",))
    for change in ({"pose_units": "scene"}, {"intrinsics": None}, {"source_from_view": None}, {"quality": unusual}):
        assert len(defined["seen_points"](*seen_by(vis, inverse, **change))) == 0
    everywhere = np.full((2, 4, 6), 1 / 8.0)
    for state, metres in ((2, 10.0), (1, np.inf), (0, np.inf)):  # it brakes for nothing painted
        points = defined["seen_points"](*seen_by(np.full((2, 4, 6), state, np.uint8), everywhere))
        assert defined["nearest_ahead_m"](points) == metres
