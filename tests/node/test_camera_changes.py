"""A camera that goes on otherwise: another picture size, another rate, another device. Through a whole node."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cameras import FPS, Bench, Camera, until
from fakes import HEIGHT, WIDTH
from rig import Rig

from gcd_client.control import Code
from gcd_client.subscriber import ReceivedView
from gcd_node.errors import SourceLostError
from gcd_node.sources import OakSource, SourceConfig
from gcd_node.sources.live import LiveCamera

CALIBRATION = """
image_width: 384
image_height: 256
camera_matrix: {rows: 3, cols: 3, data: [200.0, 0, 191.5, 0, 200.0, 127.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0, 0, 0]}
"""
GUARD_S = 30.0
WHOLE, HALF, SQUARE, TINY = (384, 256), (192, 128), (256, 256), (48, 32)


class Steady(Camera):
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
    path = folder / "camera.yaml"
    path.write_text(CALIBRATION)
    return f'kind = "v4l2"\ncalibration = "{path}"'


def reasons(rig: Rig) -> list[str]:
    return list(rig.statuses()[-1]["reasons"])


def view_of(rig: Rig, camera: Steady, epoch: int, size: tuple[int, int] | None = None) -> ReceivedView:
    """Take pictures until there is a view of them, and give that; it is of this epoch.

    A machine too busy to fetch the pictures of a second sees a step of the clock, which begins an epoch of its own.
    """
    deadline_s = time.monotonic() + GUARD_S
    while not (seen := [view for view in rig.of() if view.header.src.epoch == epoch + len(rig.events("CLOCK_STEP"))]):
        camera.step(size)
        assert time.monotonic() < deadline_s, "no view came in time"
    return seen[0]


# Another size.


def test_a_calibration_of_another_shape_is_left_out_and_the_field_of_view_is_flagged_until_it_is_back(
    tmp_path: Path,
) -> None:
    camera = Steady(size=WHOLE)
    with Rig(tmp_path, Bench(camera), config=calibrated(tmp_path)) as rig:
        rig.await_state("active")
        view_of(rig, camera, 0)
        square = view_of(rig, camera, 1, SQUARE).header
        until(lambda: "hfov" in reasons(rig))
        again = view_of(rig, camera, 2, WHOLE).header
        until(lambda: "hfov" not in reasons(rig))
        assert rig.node.state.label == "active"
    assert square.src.resize == "released"
    assert "hfov" in square.quality.ood
    assert again.src.resize == "remap2x_area"
    assert "hfov" not in again.quality.ood
    assert rig.events("SRC_REFUSED") == []


@pytest.mark.parametrize(
    ("more", "size", "words"),
    [("", TINY, "allow_upscale"), ("strict = true", SQUARE, "strict: field of view")],
    ids=["too small", "strict"],
)
def test_pictures_the_model_cannot_be_given_are_refused_until_they_change_and_the_node_lives_on(
    more: str, size: tuple[int, int], words: str, tmp_path: Path
) -> None:
    camera = Steady(size=WHOLE)
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


# Another rate, and what is told meanwhile.


def lose(rig: Rig, camera: Camera, count: int = 1) -> None:
    camera.feed(SourceLostError("unplugged"))
    rig.await_event("SRC_LOST", count)


def test_a_camera_that_returns_at_another_rate_gets_windows_of_the_nearest_trained_rate(tmp_path: Path) -> None:
    camera, bench = Steady(), Bench()
    bench.plug(camera)
    with Rig(tmp_path, bench) as rig:
        rig.await_state("active")
        before = view_of(rig, camera, 0).header
        lose(rig, camera)
        slower = bench.plug(Steady(fps=12.5))
        after = view_of(rig, slower, 1).header
        until(lambda: rig.metas()[-1]["fps"] == 12.0)
        lose(rig, slower, 2)
        slowest = bench.plug(Steady(fps=4.0))
        flagged = view_of(rig, slowest, 2).header
        until(lambda: "fps" in reasons(rig))
        states = [status["state"] for status in rig.statuses()]
        assert not rig.ended  # nobody was told of an end
    assert (before.src.fps_in, before.src.fps_cond) == (24.0, 24.0)
    assert (after.src.fps_in, after.src.fps_cond) == (12.5, 12.0)
    assert after.valid_for_ms == round(2 * 14 / 12 * 1000)
    assert (flagged.src.fps_cond, flagged.quality.ood[0]) == (4.0, "fps")
    assert set(states[states.index("active") :]) == {"active"}


def test_a_camera_that_returns_too_slow_for_the_stated_rate_is_refused_and_the_next_one_is_taken(
    tmp_path: Path,
) -> None:
    camera, bench = Steady(), Bench()
    bench.plug(camera)
    with Rig(tmp_path, bench, more="window = {fps = 24.0}") as rig:
        rig.await_state("active")
        view_of(rig, camera, 0)
        lose(rig, camera)
        slow = bench.plug(Steady(fps=10.0))
        for _ in range(15):
            slow.step()
        assert "fps 24 is more than the 10 the source gives" in rig.await_event("SRC_REFUSED")["message"]
        lose(rig, slow, 2)
        right = bench.plug(Steady())
        view_of(rig, right, 2)
        assert rig.node.state.label == "active"
    assert len({view.header.src.epoch for view in rig.of()}) == 2  # none of what was refused


def test_a_node_can_be_stopped_and_started_while_its_camera_takes_for_ever_to_open(tmp_path: Path) -> None:
    first, late, answer = Steady(), Steady(), threading.Event()
    asked: list[SourceConfig] = []

    def open_source(config: SourceConfig) -> LiveCamera:
        asked.append(config)
        if len(asked) == 2:
            return LiveCamera("slow", lambda: answer.wait(60), open_timeout_s=60.0, hint="wait")
        return first if len(asked) == 1 else late

    with Rig(tmp_path, open_source) as rig:
        rig.await_state("active")
        view_of(rig, first, 0)
        lose(rig, first)
        until(lambda: len(asked) == 2)
        assert rig.ask("deactivate").code is Code.ACCEPTED
        rig.await_state("inactive")
        assert rig.ask("activate").code is Code.ACCEPTED
        rig.await_state("active")
        view_of(rig, late, 2)
        answer.set()
    assert not rig.node.left_behind


# The same device.


@pytest.mark.parametrize("stated", [None, "192.168.1.20"])
def test_an_oak_is_opened_again_by_its_own_id_unless_its_place_was_stated(stated: str | None, tmp_path: Path) -> None:
    wanted: list[str | None] = []

    def open_oak(config: OakSource) -> Steady:
        wanted.append(config.device)
        camera = Steady()
        camera.info = replace(camera.info, kind="oak", id="18443010A1B2")
        cameras.append(camera)
        return camera

    cameras: list[Steady] = []
    config = 'kind = "oak"' + ("" if stated is None else f'\ndevice = "{stated}"')
    with Rig(tmp_path, open_oak, config=config) as rig:
        rig.await_state("active")
        view_of(rig, cameras[0], 0)
        lose(rig, cameras[0])
        until(lambda: len(cameras) == 2)
        view_of(rig, cameras[1], 1)
    assert wanted == [stated, stated or "18443010A1B2"]
