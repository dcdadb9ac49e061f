"""A camera that goes on otherwise: another picture size, another rate, another device. Through a whole node."""

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from cameras import FPS, Bench, Camera, calibration, until
from fakes import HEIGHT, LOCKSTEP, WIDTH, FakeSynthesizer, Steady, painting_traits, traits
from rig import Rig

from gcd_client.control import Code
from gcd_client.protocol import EndMessage, ViewMessage, decode
from gcd_client.subscriber import ReceivedView
from gcd_model import RenderOptions
from gcd_node.errors import SourceLostError
from gcd_node.sources import OakSource

GUARD_S = 30.0
WHOLE, HALF, SQUARE, TINY = (384, 256), (192, 128), (256, 256), (48, 32)


class Even(Camera):
    """Its stamps lie on an even grid, however fast it is asked."""

    def __init__(self, *, size: tuple[int, int] = (WIDTH, HEIGHT), fps: float = FPS) -> None:
        super().__init__(size=size, fps=fps)
        self._size, self._stamp_ns, self._level = size, time.monotonic_ns(), 0

    def step(self, size: tuple[int, int] | None = None) -> None:
        """A picture, of this size from here on."""
        width, height = self._size = size or self._size
        self._level = 40 + (self._level + 7) % 150
        self._stamp_ns += round(1e9 / self.info.fps_nominal)
        self.shoot(np.full((height, width, 3), self._level, np.uint8), stamp_ns=self._stamp_ns)
        time.sleep(0.02)  # faster than a real one: stamps are what counts


def calibrated(folder: Path) -> str:
    return f'kind = "v4l2"\ncalibration = "{calibration(folder, WHOLE, 200.0)}"'


def reasons(rig: Rig) -> list[str]:
    return list(rig.statuses()[-1]["reasons"])


def view_of(rig: Rig, camera: Even, epoch: int, size: tuple[int, int] | None = None) -> ReceivedView:
    """Take pictures until there is a view of them, and give that; it is of this epoch.

    A machine too busy to fetch the pictures of a second sees a step of the clock, which begins an epoch of its own.
    """
    deadline_s = time.monotonic() + GUARD_S
    while not (seen := [view for view in rig.of() if view.header.src.epoch == epoch + len(rig.events("CLOCK_STEP"))]):
        camera.step(size)
        assert time.monotonic() < deadline_s, "no view came in time"
    return seen[0]


@pytest.mark.parametrize(
    ("more", "size", "words"),
    [("", TINY, "allow_upscale"), ("strict = true", SQUARE, "strict: field of view")],
    ids=["too small", "strict"],
)
def test_pictures_the_model_cannot_take_are_refused(
    more: str, size: tuple[int, int], words: str, tmp_path: Path
) -> None:
    camera = Even(size=WHOLE)
    with Rig(tmp_path, Bench(camera), config=calibrated(tmp_path), more=more) as rig:
        rig.await_state("active")
        view_of(rig, camera, 0)
        for _ in range(15):
            camera.step(size)
        told = rig.await_event("SRC_REFUSED")
        status = rig.await_status(lambda status: "SRC_REFUSED" in status["reasons"])
        assert rig.ask("state").result["state"] == "active"
        view_of(rig, camera, 2, WHOLE)
        until(lambda: "SRC_REFUSED" not in reasons(rig))
    assert words in told["message"]
    assert (status["level"], status["source"]["state"]) == (2, "streaming")
    assert len({view.header.src.epoch for view in rig.of()}) == 2  # none of what was refused
    assert len(rig.events("SRC_REFUSED")) == 1
    assert rig.statuses()[-1]["drops"]["source"] >= 15


def lose(rig: Rig, camera: Camera, count: int = 1) -> None:
    camera.feed(SourceLostError("unplugged"))
    rig.await_event("SRC_LOST", count)


def test_a_camera_that_returns_at_another_rate_gets_windows_of_the_nearest_trained_rate(tmp_path: Path) -> None:
    with Rig(tmp_path, bench := Bench(camera := Even())) as rig:
        rig.await_state("active")
        before = view_of(rig, camera, 0).header
        lose(rig, camera)
        slower = bench.plug(Even(fps=12.5))
        after = view_of(rig, slower, 1).header
        until(lambda: rig.told("meta")[-1]["fps"] == 12.0)
        lose(rig, slower, 2)
        slowest = bench.plug(Even(fps=4.0))
        flagged = view_of(rig, slowest, 2).header
        until(lambda: "fps" in reasons(rig))
        lose(rig, slowest, 3)
        view_of(rig, bench.plug(Even()), 3)
        until(lambda: "fps" not in reasons(rig))
        states = [status["state"] for status in rig.statuses()]
        assert not rig.ended  # nobody was told of an end
    assert (before.src.fps_in, before.src.fps_cond) == (24.0, 24.0)
    assert (after.src.fps_in, after.src.fps_cond) == (12.5, 12.0)
    assert after.valid_for_ms == round(2 * 14 / 12 * 1000)
    assert (flagged.src.fps_cond, flagged.quality.ood[0]) == (4.0, "fps")
    assert set(states[states.index("active") :]) == {"active"}


def test_a_camera_that_returns_too_slow_is_refused_and_the_next_one_taken(tmp_path: Path) -> None:
    with Rig(tmp_path, bench := Bench(camera := Even()), more="window = {fps = 24.0}") as rig:
        rig.await_state("active")
        view_of(rig, camera, 0)
        lose(rig, camera)
        slow = bench.plug(Even(fps=10.0))
        for _ in range(15):
            slow.step()
        assert "fps 24 is more than the 10 the source gives" in rig.await_event("SRC_REFUSED")["message"]
        lose(rig, slow, 2)
        view_of(rig, bench.plug(Even()), 2)
    assert len({view.header.src.epoch for view in rig.of()}) == 2  # none of what was refused


@pytest.mark.parametrize("stated", [None, "192.168.1.20"])
def test_an_oak_is_opened_again_by_its_own_id_unless_its_place_was_stated(stated: str | None, tmp_path: Path) -> None:
    wanted: list[str | None] = []

    def open_oak(config: OakSource) -> Even:
        wanted.append(config.device)
        camera = Even()
        camera.info = replace(camera.info, kind="oak", id="18443010A1B2")
        cameras.append(camera)
        return camera

    cameras: list[Even] = []
    config = 'kind = "oak"' + ("" if stated is None else f'\ndevice = "{stated}"')
    with Rig(tmp_path, open_oak, config=config) as rig:
        rig.await_state("active")
        view_of(rig, cameras[0], 0)
        lose(rig, cameras[0])
        until(lambda: len(cameras) == 2)
        view_of(rig, cameras[1], 1)
    assert wanted == [stated, stated or "18443010A1B2"]


# Several views of one input while commands change them: on every topic, down to its end-of-stream.


TWO_VIEWS = '[view.top]\n[view.swing]\nkind = "orbit"\nrate_deg_s = 24.0\namplitude_deg = 60.0'


class Tape:
    """Every message of the data socket, in its order, from before the node's start to after its end."""

    def __init__(self, folder: Path) -> None:
        self.said: list[ViewMessage | EndMessage] = []
        self._there, self._done = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._hear, args=(f"ipc://{folder}/data",), daemon=True)

    def __enter__(self) -> "Tape":
        self._thread.start()
        assert self._there.wait(20)
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join(20)

    def _hear(self, endpoint: str) -> None:
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.set(zmq.SUBSCRIBE, b"view/")
            socket.set(zmq.LINGER, 0)
            socket.connect(endpoint)
            self._there.set()
            while not self._done.is_set() or socket.poll(200):
                if socket.poll(50):
                    message = decode(socket.recv())
                    if not (isinstance(message, EndMessage) and message in self.said[-20:]):  # ends are repeated
                        self.said.append(message)  # type: ignore[arg-type]

    def of(self, topic: str, kind: type[ViewMessage] | type[EndMessage] = ViewMessage) -> list[Any]:
        return [each for each in list(self.said) if isinstance(each, kind) and each.topic == topic]

    def ends(self, topic: str) -> int:
        return len(self.of(topic, EndMessage))

    def await_more(self, topic: str, count: int = 2) -> None:
        wanted = len(self.of(topic)) + count
        until(lambda: len(self.of(topic)) >= wanted)


@pytest.mark.slow
def test_a_topic_that_a_command_opens_and_closes_and_a_removed_view_begin_and_end_with_it(tmp_path: Path) -> None:
    model, views = FakeSynthesizer(painting_traits()), "[view.top]\n[view.second]"
    with Tape(tmp_path) as tape, Rig(tmp_path, lambda _: Steady(), model, config=LOCKSTEP, views=views) as rig:
        until(lambda: rig.publisher.stats.subscribers >= 2)  # the tape hears
        tape.await_more("view/top/win")
        assert rig.ask("set_param", samples=2).code is Code.OK
        tape.await_more("view/top/std")
        assert rig.ask("set_param", samples=1).code is Code.OK
        until(lambda: tape.ends("view/top/std") == tape.ends("view/second/std") == 1)
        assert tape.ends("view/top/win") == 0
        before = len(tape.of("view/top/std"))
        tape.await_more("view/top/win", 4)
        assert len(tape.of("view/top/std")) == before  # nothing follows its end
        assert rig.ask("set_param", samples=2).code is Code.OK
        tape.await_more("view/top/std")  # the sequence goes on where it was
        tape.await_more("view/second/std")
        tape.await_more("view/second/cls")
        assert rig.ask("remove_view", view="second").code is Code.OK
        topics = {"view/second/win": 1, "view/second/std": 2, "view/second/cls": 1}
        until(lambda: all(tape.ends(topic) == count for topic, count in topics.items()))
        tape.await_more("view/top/cls")
        assert rig.ask("set_view", view="second").code is Code.OK
        tape.await_more("view/second/cls")
    sequences = [each.sequence for each in tape.said if each.topic == "view/top/std"]
    assert sequences == list(range(len(sequences)))
    assert [tape.ends(f"view/top/{kind}") for kind in ("win", "std")] == [1, 2]
    assert [tape.ends(topic) for topic in topics] == [2, 3, 2]
    revisions = [each.header.view_rev for each in tape.said if each.topic == "view/second/cls"]
    assert revisions == sorted(revisions)
    assert set(revisions) == {1, 2}


def test_a_view_removed_in_the_last_window_still_ends(tmp_path: Path) -> None:
    begun = threading.Event()

    def slow(options: RenderOptions) -> None:
        begun.set()
        assert options.cancel is not None
        until(options.cancel.is_set)

    model = FakeSynthesizer(traits(), slow)
    with Tape(tmp_path) as tape, Rig(tmp_path, lambda _: Steady(), model, config=LOCKSTEP, views=TWO_VIEWS) as rig:
        until(lambda: rig.publisher.stats.subscribers >= 2)  # the tape hears
        assert begun.wait(30)
        assert rig.ask("remove_view", view="swing").code is Code.OK
        assert rig.ask("deactivate").code is Code.ACCEPTED
        rig.await_state("inactive")
        until(lambda: tape.ends("view/swing/win") == tape.ends("view/top/win") == 1)
    assert all(isinstance(each, EndMessage) for each in tape.said)  # what was in work when it was told to stop is lost
