"""Each row of the failure table as a test named after it, through real sockets: `pytest tests/node -k f9_`.

F5, F9, F23 and F25 are in test_fault_processes.py, F6 in test_source_conformance.py, F7 in test_camera_changes.py, F15
in test_node_life.py, F16 to F19 with control and security, F20 in test_publisher.py, F22 in test_recorder.py.
"""

import gc
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from cameras import FPS, Bench, Camera, until
from fakes import LOCKSTEP, Box, FakeSource, FakeSynthesizer, Steady, fake_config, run, traits
from rig import Rig, service_manager

from gcd_client.control import Code
from gcd_client.subscriber import ViewSubscriber
from gcd_model import (
    DeviceMemoryError,
    NonFiniteError,
    ViewSynthesizer,
)
from gcd_node.config import ModelSection
from gcd_node.errors import ConfigError, ModelFailedError, SourceLostError
from gcd_node.health import Health, Level
from gcd_node.model import FailureCounter, oom_levels
from gcd_node.service import ServiceManager
from gcd_node.sources import open_source
from gcd_node.status import Announcer

WAITING = "life = {autostart = false}"
REALTIME = 'kind = "synthetic"\npace = "realtime"'
TWO_VIEWS = "[view.main]\nazimuth_deg = 10.0\n[view.other]\nazimuth_deg = -10.0"
SLACK_S = 3.0  # what a machine that does other things may add


def test_f1_a_camera_that_falls_silent_stalls_is_lost_and_comes_back_in_a_new_epoch(tmp_path: Path) -> None:
    first = Camera()
    with Rig(tmp_path, bench := Bench(first)) as rig:
        rig.await_state("active")
        first.run(20)
        rig.await_views(1)
        rig.await_event("SRC_STALLED")
        stalled_s = time.monotonic() - first.last_s
        warned = rig.await_status(lambda status: "SRC_STALLED" in status["reasons"])
        rig.await_event("SRC_LOST")
        lost_s = time.monotonic() - first.last_s
        failed = rig.await_status(lambda status: "SRC_LOST" in status["reasons"])
        shown = len(rig.of())
        assert rig.node.state.label == "active"
        second = bench.plug(Camera())
        until(lambda: second in bench.opened)
        assert len(rig.of()) == shown  # nothing is ever repeated
        second.run(30)
        rig.await_event("SRC_BACK")
        source = rig.await_views(shown + 1)[shown].header.src
    assert 0.2 <= stalled_s <= 0.2 + SLACK_S
    assert stalled_s < lost_s <= 2.0 + SLACK_S
    assert (warned["level"], warned["source"]["state"]) == (1, "stalled")
    assert (failed["level"], failed["source"]["state"]) == (2, "lost")
    assert source.epoch == 1
    assert source.seq == tuple(range(14))  # of the second camera alone: the six frames left over are gone
    assert rig.statuses()[-1]["source"]["reconnects"] == 1


def test_f1_a_camera_that_does_not_come_back_is_given_up_with_exit_75(tmp_path: Path) -> None:
    camera = Camera()
    with Rig(tmp_path, Bench(camera), config='kind = "v4l2"\nmax_reconnects = 1') as rig:
        rig.await_state("active")
        camera.run(15)
        rig.await_views(1)
        camera.feed(SourceLostError("unplugged"))
        rig.await_state("finalized")
        until(lambda: rig.ended)
    assert isinstance(rig.failure, SourceLostError)
    assert rig.failure.exit_code == 75


def test_f2_without_a_camera_the_node_stays_inactive_and_says_which_there_are(tmp_path: Path) -> None:
    with Rig(tmp_path, bench := Bench(), more=WAITING) as rig:
        rig.ask("configure")
        rig.await_state("inactive")
        asked_s = time.monotonic()
        assert rig.ask("activate").code is Code.ACCEPTED
        told = rig.await_event("NOT_READY")
        assert time.monotonic() - asked_s < 3.0 + SLACK_S
        rig.await_state("inactive")
        assert (told["verb"], "there are: none" in told["message"]) == ("activate", True)
        bench.plug(Camera())
        rig.ask("activate")
        rig.await_state("active")


def test_f3_damaged_frames_are_counted_and_a_gap_rejects_its_window(tmp_path: Path) -> None:
    camera = Camera()
    with Rig(tmp_path, Bench(camera)) as rig:
        rig.await_state("active")
        period_ns, start_ns = round(1e9 / FPS), time.monotonic_ns()
        for i in range(36):
            if i in (5, 6, 7):
                camera.corrupt += 1  # three arrive damaged and are not yielded
            else:
                camera.shoot(stamp_ns=start_ns + i * period_ns)
            time.sleep(1 / FPS)
        told = rig.await_event("WIN_GAP")
        view = rig.await_views(1)[0]
        until(lambda: rig.statuses()[-1]["source"]["corrupt"] == 3)
    assert told["level"] == 1
    assert view.header.src.seq == tuple(range(5, 19))  # the camera's own numbers: none for what never came
    assert all(status["level"] < 2 for status in rig.statuses())


def test_f4_frames_that_do_not_rise_are_dropped_and_a_step_begins_a_new_epoch(tmp_path: Path) -> None:
    camera = Camera()
    with Rig(tmp_path, Bench(camera)) as rig:
        rig.await_state("active")
        period_ns, start_ns = round(1e9 / FPS), time.monotonic_ns()
        stamps = [start_ns + i * period_ns for i in range(14)]
        stamps[5:5] = [stamps[4], stamps[3]]  # one again, and one that steps back
        stamps += [start_ns - 5_000_000_000 + i * period_ns for i in range(15)]
        for stamp_ns in stamps:
            camera.shoot(stamp_ns=stamp_ns)
            time.sleep(0.5 / FPS)
        before, after = rig.await_views(2)[:2]
        rig.await_event("CLOCK_STEP")
    assert before.header.src.seq == (*range(5), *range(7, 16))
    assert (before.header.src.dropped, before.header.src.epoch) == (2, 0)
    assert after.header.src.epoch == 1


def test_f4_a_recording_that_begins_again_as_it_is_told_to_is_no_trouble(tmp_path: Path) -> None:
    config = 'kind = "synthetic"\nfps = 24.0\nframes = 15\nloop = true\nallow_upscale = true'
    with Rig(tmp_path, open_source, config=config) as rig:
        assert rig.await_event("CLOCK_STEP")["level"] == Level.OK


@pytest.mark.parametrize("strict", ["true", "false"])
def test_f8_a_rate_below_the_trained_ones_is_flagged_and_refused_when_strict(strict: str, tmp_path: Path) -> None:
    source, more = FakeSource(14, fps=4.0), f"strict = {strict}"
    with Rig(tmp_path, lambda _: source, config=LOCKSTEP, more=more, once=True) as rig:
        rig.await_state("finalized")
    if strict == "true":
        assert isinstance(rig.failure, ConfigError)
        assert rig.views == []
    else:
        assert "fps" in rig.views[0].header.quality.ood
        assert "fps" in [reason for status in rig.statuses() for reason in status["reasons"]]
        assert max(status["level"] for status in rig.statuses()) == 1


def test_f10_without_a_reader_nothing_is_rendered_until_one_comes(tmp_path: Path) -> None:
    with Rig(tmp_path, lambda _: Steady(), config=REALTIME, more="life = {idle_s = 0.2}", watched=False) as rig:
        rig.await_status(lambda status: "IDLE" in status["reasons"])
        model = rig.model
        asked, built = len(model.asked), rig.statuses()[-1]["window"]["built"]
        rig.await_status(lambda status: status["window"]["built"] > built + 5)
        assert len(model.asked) == asked
        assert rig.statuses()[-1]["level"] == 0
        with ViewSubscriber(f"ipc://{tmp_path}/data", "main") as views:
            assert views.receive(20_000) is not None
        until(lambda: "IDLE" not in rig.statuses()[-1]["reasons"])


def full() -> None:
    raise DeviceMemoryError("out of memory")


def test_f11_a_full_device_is_asked_for_less_and_goes_on(tmp_path: Path) -> None:
    model = FakeSynthesizer(traits(), lambda _: full() if len(model.asked[-1][0]) > 1 else None)
    with Rig(tmp_path, lambda _: Steady(), model, config=LOCKSTEP, views=TWO_VIEWS) as rig:
        rig.await_views(2, "other")
        told = rig.await_event("GPU_OOM")
        status = rig.await_status(lambda status: status["model"]["state"] == "degraded")
        assert len(rig.await_views(2)) >= 2
    assert told["rung"] == "views one by one"
    assert len(rig.events("GPU_OOM")) == 1
    assert (status["level"], status["model"]["oom_count"]) == (1, 1)


def test_f11_a_model_that_never_finds_memory_fails_and_the_node_stays(tmp_path: Path) -> None:
    model = FakeSynthesizer(traits(), Mock(side_effect=DeviceMemoryError("out of memory")))
    with Rig(tmp_path, lambda _: Steady(), model, config=LOCKSTEP) as rig:
        rig.await_event("MODEL_FAILED")
        rig.await_state("inactive")
        status = rig.await_status(lambda status: "MODEL_FAILED" in status["reasons"] and status["state"] == "inactive")
        assert rig.ask("state").code is Code.OK
        assert rig.ask("activate").code is Code.NOT_READY
        assert rig.ask("cleanup").code is Code.ACCEPTED
        rig.await_state("unconfigured")
    assert (status["level"], status["model"]["state"]) == (2, "failed")
    assert rig.views == []
    assert rig.failure is None


def test_f11_only_three_failures_within_a_minute_at_the_bottom_are_the_end() -> None:
    clock = iter((0.0, 31.0, 62.0, 90.0))  # asked for where nothing is left to give up
    failures = FailureCounter(Announcer("n", "b", Box(), Health()), clock.__next__)
    levels = oom_levels(views=2, samples=1, steps=1, can_halve=False)
    assert failures.given_up == []
    for _ in range(5):
        failures.out_of_memory(1, DeviceMemoryError("full"), levels)
    assert failures.given_up == ["views one by one", "a single view"]
    with pytest.raises(ModelFailedError):
        failures.out_of_memory(1, DeviceMemoryError("full"), levels)


def test_f11_a_full_gpu_gets_the_same_model_in_bfloat16(tmp_path: Path) -> None:
    loaded, still_there = list["weakref.ref[ViewSynthesizer]"](), list[int]()  # when the next one is loaded

    def load(section: ModelSection) -> ViewSynthesizer:
        still_there.append(sum(model() is not None for model in loaded))
        told = replace(traits(), device="cuda:0", precision=section.dtype or "float32")
        made = FakeSynthesizer(told, lambda _: full() if section.dtype is None else None)
        loaded.append(weakref.ref(made))
        return made

    gc.disable()  # what only a collection would free is still on the device when the next model is loaded
    try:
        with Rig(tmp_path, lambda _: FakeSource(10_000), load, config=LOCKSTEP) as rig:
            told = rig.await_event("GPU_OOM")
            views = rig.await_views(2)
            status = rig.await_status(lambda status: status["model"]["state"] == "degraded")
    finally:
        gc.enable()
    assert told["rung"] == "bfloat16"
    assert len(rig.events("GPU_OOM")) == 1
    assert [view.header.model.precision for view in views[:2]] == ["bfloat16", "bfloat16"]
    assert views[0].header.window_id == 0  # nothing was lost: the same window again
    assert status["reasons"] == ["MODEL_DEGRADED"]
    assert still_there == [0, 0]


def test_f12_pictures_that_are_no_numbers_are_never_published(tmp_path: Path) -> None:
    model = FakeSynthesizer(traits(), Mock(side_effect=NonFiniteError("NaN")))
    with Rig(tmp_path, lambda _: Steady(), model, config=LOCKSTEP) as rig:
        rig.await_event("MODEL_FAILED")
        rig.await_state("inactive")
        told = rig.events("MODEL_NAN")
    seeds = [options.seed for _, options in model.asked][-6:]
    assert [event["window_id"] for event in told] == [0, 1, 2]
    assert [seed for event in told for seed in event["seeds"]] == seeds
    assert len(set(seeds)) == 6  # one retry each, with another seed
    assert told[0]["seq"] == [0, 13]
    assert rig.views == []


def test_f13_an_input_without_a_picture_is_published_and_flagged() -> None:
    for levels, flags in (
        ((0, 0), {"exposure", "static"}),  # black
        ((255, 255), {"exposure", "static"}),  # saturated
        ((120, 120), {"static"}),  # frozen
        ((0, 4), {"exposure"}),  # dark
        ((120, 124), set()),
    ):
        drawn = [np.full((64, 96, 3), level, np.uint8) for level in levels]
        covered = FakeSource(14, edit=lambda frame, drawn=drawn: replace(frame, image=drawn[frame.seq % 2]))
        box = run(fake_config(), source=covered)
        assert set(box.of("win")[0].header.quality.ood) == flags


def test_f14_an_impossible_view_is_refused_with_what_is_allowed_and_nothing_changes(tmp_path: Path) -> None:
    with Rig(tmp_path, Bench(), more=WAITING) as rig:
        rig.ask("configure")
        rig.await_state("inactive")
        before = rig.ask("views").result
        beyond = rig.ask("set_view", view="main", azimuth_deg=95.0)
        assert beyond.code is Code.OUT_OF_RANGE
        allowed = beyond.result["allowed"]
        assert allowed["azimuth_deg"] == [-90.0, 90.0]
        swing = {"kind": "orbit", "rate_deg_s": 5.0, "amplitude_deg": 120.0}
        assert rig.ask("set_view", swing, view="main").code is Code.OUT_OF_RANGE
        assert rig.ask("set_view", view="mian", azimuth_deg=5.0).code is Code.UNKNOWN_VIEW
        assert rig.ask("set_view", view="main", azimut_deg=5.0).code is Code.BAD_ARG
        assert rig.ask("views").result == before


@pytest.fixture
def watchdog(tmp_path: Path) -> Iterator[tuple[ServiceManager, Callable[[], list[str]]]]:
    """A service manager that wants to hear of the node, and what it has heard since it was asked last."""
    address = str(tmp_path / "notify")
    with service_manager(address) as heard:
        yield ServiceManager({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "200000"}), heard


def assert_not_fed(rig: Rig, heard: Callable[[], list[str]], status: Mapping[str, Any]) -> None:
    """In two heartbeats after this status."""
    heard()
    rig.await_status(lambda later: later["heartbeat_seq"] >= status["heartbeat_seq"] + 2)
    assert "WATCHDOG=1" not in heard()


def test_f21_a_model_that_hangs_is_an_error_and_the_watchdog_is_not_fed(tmp_path: Path, watchdog: Any) -> None:
    stuck, (service, heard) = threading.Event(), watchdog
    model, more = FakeSynthesizer(traits(), lambda _: stuck.wait(60) and None), "life = {hang_s = 0.5}"
    with Rig(tmp_path, lambda _: Steady(), model, config=LOCKSTEP, more=more, service=service) as rig:
        rig.await_event("MODEL_HUNG")
        status = rig.await_status(lambda status: "MODEL_HUNG" in status["reasons"])
        assert_not_fed(rig, heard, status)
        assert rig.ask("state").code is Code.OK
        stuck.set()
        until(lambda: "MODEL_HUNG" not in rig.statuses()[-1]["reasons"])
        until(lambda: "WATCHDOG=1" in heard())
    assert status["level"] == 2


def test_a_dead_control_thread_is_an_error_and_starves_the_watchdog(
    tmp_path: Path, watchdog: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    service, heard = watchdog
    with Rig(tmp_path, lambda _: Steady(), config=LOCKSTEP, service=service) as rig:
        rig.await_status(lambda status: status["ready"])
        monkeypatch.setattr(rig.control.guard, "wait", lambda: 1 / 0)
        rig.control.guard.wake()
        assert rig.await_event("THREAD_DIED")["thread"] == "control"
        status = rig.await_status(lambda status: "THREAD_DIED" in status["reasons"])
        assert_not_fed(rig, heard, status)
    assert (status["level"], status["ready"], status["not_ready"]) == (2, False, ["THREAD_DIED"])
    assert len(rig.events("THREAD_DIED")) == 1


def test_f24_ages_do_not_notice_that_somebody_set_the_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera, true_ns = Camera(), time.time_ns
    with Rig(tmp_path, Bench(camera)) as rig:
        rig.await_state("active")
        camera.run(15)
        before = rig.await_views(1)[0].header
        monkeypatch.setattr(time, "time_ns", lambda: true_ns() + 3600 * 10**9)
        told = rig.await_event("CLOCK_STEP")
        camera.run(30)
        after = rig.await_views(2)[-1].header
        monkeypatch.undo()
    assert told["clock"] == "utc"
    assert told["step_ms"] == pytest.approx(3_600_000, abs=1000)
    assert 0 <= after.age_ms < 1000 * SLACK_S
    assert 0 <= before.age_ms < 1000 * SLACK_S
    assert after.t_capture_ns[0] - before.t_capture_ns[-1] > 3000 * 10**9  # UTC is what the clock says
    assert after.src.epoch == 0
