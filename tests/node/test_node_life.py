"""A node's life through real sockets: transitions, also slow ones, views and parameters that commands change."""

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from cameras import Bench, Camera, until
from fakes import LOCKSTEP, FakeSource, FakeSynthesizer, Steady, traits
from rig import Rig
from torch import nn
from torch.nn.modules import module

from gcd_client.control import Code
from gcd_model import (
    Augmentation,
    Cancelled,
    Clip,
    RenderOptions,
    SourceFeatures,
    SphericalDelta,
    Trajectory,
    View,
    ViewSynthesizer,
)
from gcd_node.config import ModelSection
from gcd_node.lifecycle import PATHS, Lifecycle, State, Verb
from gcd_node.model import interruptible

WILD: list[dict[str, object]] = [
    *({"azimuth_deg": 1e308}, {"radius": 1e308}, {"radius": -1e308}),
    {"kind": "orbit", "rate_deg_s": 1e308, "amplitude_deg": 60.0},
    {"kind": "orbit", "rate_deg_s": 1.0, "amplitude_deg": 1e308},
    {"kind": "orbit", "rate_deg_s": 1.0, "amplitude_deg": 1e-308},
    {"T_src_dst": [1e308] * 16},
    {"T_src_dst": [1, 0, 0, 1e308, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
]
WAITING = "life = {autostart = false}"
TWO_VIEWS = '[view.main]\nazimuth_deg = 10.0\n[view.swing]\nkind = "orbit"\nrate_deg_s = 24.0\namplitude_deg = 30.0'


class Gate:
    """A model that renders one window each time it is let."""

    def __init__(self) -> None:
        self.waits = threading.Semaphore(0)
        self.begun = 0

    def __call__(self, options: RenderOptions) -> None:
        if options.steps == 1:  # the warm-up
            return
        self.begun += 1
        deadline_s = time.monotonic() + 30
        while not self.waits.acquire(timeout=0.01):
            if options.cancel is not None and options.cancel.is_set():
                return
            assert time.monotonic() < deadline_s


def test_a_node_goes_through_its_life_as_it_is_asked(tmp_path: Path) -> None:
    with Rig(tmp_path, lambda _: FakeSource(14), config=LOCKSTEP, more=WAITING) as rig:
        assert rig.ask("state").state == "unconfigured"
        assert rig.ask("activate").code is Code.WRONG_STATE
        for verb, state in (("configure", "inactive"), ("activate", "active")):
            assert rig.ask(verb).code is Code.ACCEPTED
            until(lambda state=state: any(event["state"] == state for event in rig.events("STATE")))
        rig.await_event("SRC_ENDED")
        rig.await_state("inactive")
        assert len(rig.await_views(1)) == 1
        rig.ask("activate")
        rig.await_event("SRC_ENDED", 2)
        rig.await_state("inactive")
        assert [view.header.window_id for view in rig.await_views(2)] == [0, 1]
        assert [view.header.src.epoch for view in rig.of()] == [0, 1]
        assert rig.ask("cleanup").code is Code.ACCEPTED
        rig.await_state("unconfigured")
        assert rig.ask("configure").code is Code.ACCEPTED
        rig.await_state("inactive")
        assert rig.ask("shutdown").code is Code.ACCEPTED
        rig.await_state("finalized")
    assert rig.failure is None
    assert len({view.header.boot_id for view in rig.views}) == 1
    assert [view.message.sequence for view in rig.of()] == [0, 2]  # 1 was the end of the first stream


def asked(rig: Rig, verb: str) -> Any:
    return rig.ask(verb).result


def test_f15_a_window_in_work_keeps_its_views_which_come_from_one_batch_and_change_alone(tmp_path: Path) -> None:
    gate = Gate()
    model = FakeSynthesizer(traits(), gate)
    with Rig(tmp_path, lambda _: Steady(), model, config=LOCKSTEP, views=TWO_VIEWS, more="") as rig:
        gate.waits.release()
        rig.await_views(1, "swing")
        until(lambda: gate.begun == 2)
        reply = rig.ask("set_view", view="main", azimuth_deg=-20.0)
        assert (reply.code, reply.result and reply.result["view_rev"]) == (Code.OK, 2)
        gate.waits.release(3)
        rig.await_views(3)
        rig.await_views(3, "swing")
    assert [view.header.view_rev for view in rig.of()[:3]] == [1, 1, 2]
    assert [view.header.view_rev for view in rig.of("swing")[:3]] == [1, 1, 1]
    goals = [view.header.pose[-1].az_deg for view in rig.of() if view.header.pose][:3]
    assert goals == [10.0, 10.0, -20.0]
    swings = [view.header.pose[-1].az_deg for view in rig.of("swing") if view.header.pose][:3]
    assert swings == pytest.approx([0.0, 14.0, 28.0])  # a change of its neighbour does not make it begin again
    assert {len(paths) for paths, _ in model.asked} == {2}
    assert len({view.header.cfg_digest for view in rig.of()[:3]}) == 2
    assert [meta["view_revs"]["main"] for meta in rig.told("meta")] == [1, 2]


def test_a_view_is_set_by_angles_by_a_rigid_pose_or_as_an_orbit(tmp_path: Path) -> None:
    planned = traits().plan_view(SphericalDelta(azimuth_deg=25.0, elevation_deg=5.0, radius_m=1.0))
    pose = planned.source_from_target[-1].flatten().tolist()
    with Rig(tmp_path, Bench(), more=WAITING, views="[view.main]\nazimuth_deg = 10.0\n[view.other]") as rig:
        assert rig.ask("set_view", view="main", azimuth_deg=1.0).code is Code.NOT_READY
        rig.ask("configure")
        rig.await_state("inactive")
        told = rig.ask("set_view", view="main", T_src_dst=pose).result
        goal = told["goal"]
        assert (goal["azimuth_deg"], goal["elevation_deg"], goal["radius"]) == pytest.approx((25.0, 5.0, 1.0), abs=1e-6)
        assert told["rotation_error_deg"] == pytest.approx(0.0, abs=1e-3)
        orbit = {"kind": "orbit", "rate_deg_s": 9.0, "amplitude_deg": 20.0}
        goal = {**orbit, "azimuth_deg": 0.0, "elevation_deg": 0.0, "radius": 0.0}
        assert rig.ask("set_view", orbit, view="main").result == {"view": "main", "goal": goal, "view_rev": 3}
        turned = [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]  # looks at the scene, rolled by 90 degrees
        assert rig.ask("set_view", view="main", T_src_dst=turned).code is Code.OUT_OF_RANGE
        assert rig.ask("set_view", view="main", T_src_dst=[2.0] * 16).code is Code.BAD_ARG
        views = rig.ask("views").result
        assert views["main"] == {**goal, "view_rev": 3}
        # a change meant for another revision
        angle = {"view": "main", "azimuth_deg": 1.0}
        assert rig.client.request("set_view", angle, if_view_rev=3).code is Code.OK
        refused = rig.client.request("set_view", angle, if_view_rev=3)
        assert (refused.code, refused.result) == (Code.WRONG_STATE, {"view_rev": 4})
        assert rig.client.request("remove_view", {"view": "main"}, if_view_rev=3).code is Code.WRONG_STATE
        assert rig.client.request("remove_view", {"view": "main"}, if_view_rev=4).code is Code.OK


def test_a_node_tells_who_it_is_and_parameters_change_from_the_next_window_on(tmp_path: Path) -> None:
    with Rig(tmp_path, lambda _: Steady(), config=LOCKSTEP) as rig:
        rig.await_views(1)
        hello, described = asked(rig, "hello"), asked(rig, "describe")
        assert (hello["boot_id"], hello["node_id"], hello["role"]) == (rig.views[0].header.boot_id, "gcd", "operator")
        assert described["limits"] == {"azimuth_deg": [-90, 90], "elevation_deg": [-30, 30], "radius": [-3, 3]}
        assert described["fps"] == [6.0, 8.0, 12.0, 24.0]
        assert asked(rig, "get_calib")["K"] == pytest.approx(list(rig.views[0].header.intrinsics or ()))
        assert (asked(rig, "state")["state"], asked(rig, "state")["source"]) == ("active", "streaming")
        assert "heartbeat_seq" not in asked(rig, "stats")
        assert rig.ask("record_start").code is Code.NOT_READY
        reply = rig.ask("set_param", steps=3, guidance=[1.0, 2.0], publish="jpeg", jpeg_quality=60)
        assert reply.code is Code.OK
        until(lambda: rig.of()[-1].header.encoding == "jpeg")
        assert rig.of()[-1].header.quality.steps == 3
        assert rig.of()[-1].images.shape == (14, 64, 96, 3)
        assert rig.model.asked[-1][1].guidance == (1.0, 2.0)
        config = asked(rig, "get_config")["config"]
        assert (config["model"]["steps"], config["publish"]["encoding"]) == (3, "jpeg")
        assert rig.ask("set_param", samples=2).code is Code.OK
        until(lambda: rig.model.asked[-1][1].samples == 2)
        for wanted in WILD:  # no number in a view can end the stream
            reply = rig.ask("set_view", wanted, view="main")
            assert reply.code in (Code.OK, Code.OUT_OF_RANGE, Code.BAD_ARG)
            rig.await_views(len(rig.of()) + 3)
        assert rig.events("MODEL_FAILED") == []


def test_an_operator_who_deactivates_keeps_a_node_that_would_end_with_its_source(tmp_path: Path) -> None:
    with Rig(tmp_path, lambda _: Steady(), config=LOCKSTEP, once=True) as rig:
        rig.await_views(1)
        assert rig.ask("deactivate").code is Code.ACCEPTED
        rig.await_event("STATE")
        assert [event["code"] for event in rig.events()][-2:] == ["STOPPED", "STATE"]
        assert rig.node.state.label == "inactive"
        rig.ask("activate")
        rig.await_state("active")
        until(lambda: rig.of()[-1].header.src.epoch == 1)
    ids = [view.header.window_id for view in rig.of()]
    assert ids == sorted(set(ids))


def test_live_stamps_are_utc_with_one_offset_for_all_views_of_a_window(tmp_path: Path) -> None:
    camera = Camera()
    with Rig(tmp_path, Bench(camera), views=TWO_VIEWS) as rig:
        rig.await_state("active")
        began_ns = time.time_ns()
        camera.run(30)
        rig.await_views(1)
        rig.await_views(1, "swing")
    header, other = rig.of()[0].header, rig.of("swing")[0].header
    assert header.clock == "realtime"
    assert header.t_capture_ns == other.t_capture_ns
    assert began_ns - 50_000_000 <= header.t_capture_ns[0] <= header.t_capture_ns[-1] <= header.t_infer_start_ns
    since_ms = (header.t_publish_ns - header.t_capture_ns[-1]) / 1e6
    assert header.age_ms == pytest.approx(since_ms, abs=20)


# Transitions that take long: what may be asked meanwhile, and what becomes of a thread that does not end.


class Pause(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        time.sleep(0.01)
        return x


class SlowSynthesizer(FakeSynthesizer):
    """Slow in its encoder, in a denoising step or in its decoder; one step, so nobody asks between two."""

    def __init__(self, part: str) -> None:
        super().__init__(traits())
        self.begun, self._part = threading.Event(), part
        self._layers = nn.Sequential(*(Pause() for _ in range(4000)))  # 40 s, and none asks whether to go on

    def _work(self, x: torch.Tensor) -> None:
        self.begun.set()
        self._layers(x)

    def encode(self, clip: Clip, augmentation: Augmentation | None = None) -> SourceFeatures:
        if self._part == "encoder":
            self._work(clip.video)
        return super().encode(clip, augmentation)

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        if self._part == "decoder" and options is not None and options.progress is not None:
            options.progress(1, 1)
        if self._part != "encoder":
            self._work(features.latents)
        return super().render(features, trajectories, options)


@pytest.mark.parametrize("part", ["encoder", "step", "decoder"])
def test_f23_any_part_of_the_model_is_abandoned(tmp_path: Path, part: str, caplog: pytest.LogCaptureFixture) -> None:
    model = SlowSynthesizer(part)
    with Rig(tmp_path, lambda _: FakeSource(10_000), model, config=LOCKSTEP) as rig:
        assert model.begun.wait(30)
        rig.node.stop()
        rig.await_state("finalized")
    assert not rig.node.left_behind
    assert rig.failure is None
    assert rig.views == []
    assert "does not end" not in caplog.text


def test_while_a_transition_is_under_way_the_node_is_busy_and_can_still_be_ended(tmp_path: Path) -> None:
    loaded = threading.Event()

    def load(_: ModelSection) -> ViewSynthesizer:
        assert loaded.wait(60)
        return FakeSynthesizer(traits())

    with Rig(tmp_path, Bench(), load, more=WAITING) as rig:
        assert rig.ask("configure").code is Code.ACCEPTED
        for verb in ("configure", "activate", "cleanup"):
            refused = rig.ask(verb)
            assert refused.code is Code.BUSY
            assert "configuring" in refused.message
        assert rig.client.request("shutdown", dry_run=True).code is Code.OK
        assert rig.ask("shutdown").code is Code.ACCEPTED
        loaded.set()
        rig.await_state("finalized")
    assert rig.failure is None


def test_what_breaks_in_a_transition_is_internal_and_the_node_can_begin_anew(tmp_path: Path) -> None:
    broken = [ZeroDivisionError("ours")]

    def load(_: ModelSection) -> ViewSynthesizer:
        if broken:
            raise broken.pop()
        return FakeSynthesizer(traits())

    with Rig(tmp_path, Bench(), load, more=WAITING) as rig:
        for event, state in (("INTERNAL", "unconfigured"), ("STATE", "inactive")):
            assert rig.ask("configure").code is Code.ACCEPTED
            assert rig.await_event(event)["verb"] == "configure"
            rig.await_state(state)


def test_a_thread_left_behind_keeps_the_node_from_starting_only_until_it_ends(tmp_path: Path) -> None:
    begun, go_on, more = threading.Event(), threading.Event(), "life = {hang_s = 0.3}"

    def deaf(_: RenderOptions) -> None:
        begun.set()
        assert go_on.wait(60)

    model = FakeSynthesizer(traits(), deaf)
    with Rig(tmp_path, lambda _: FakeSource(10_000), model, config=LOCKSTEP, more=more) as rig:
        assert begun.wait(30)
        rig.await_state("active")
        assert rig.ask("deactivate").code is Code.ACCEPTED
        rig.await_state("inactive")
        assert rig.node.left_behind
        assert rig.ask("activate").code is Code.NOT_READY
        go_on.set()
        until(lambda: not rig.node.left_behind)
        assert rig.views == []  # nothing follows the end of a view
        assert rig.ask("activate").code is Code.ACCEPTED
        rig.await_views(1)


def test_a_node_that_is_told_to_stop_interrupts_nobody_elses_network() -> None:
    cancel, x = threading.Event(), torch.zeros(1)
    cancel.set()
    with interruptible(cancel, {threading.get_ident()}):
        with pytest.raises(Cancelled, match="Pause"):
            Pause()(x)
        other = threading.Thread(target=lambda: done.append(Pause()(x)))
        done: list[torch.Tensor] = []
        other.start()
        other.join(30)
    assert len(done) == 1
    Pause()(x)  # and not here any more


@pytest.mark.parametrize(("device", "watched"), [("cpu", 1), ("cuda:0", 0)])
def test_compiled_work_of_a_gpu_meets_no_hook(tmp_path: Path, device: str, watched: int) -> None:
    hooks: list[int] = []
    told = replace(traits(), device=device)
    model = FakeSynthesizer(told, lambda _: hooks.append(len(module._global_forward_pre_hooks)))
    with Rig(tmp_path, lambda _: FakeSource(10_000), model, config=LOCKSTEP) as rig:
        rig.await_views(1)
    assert set(hooks) == {watched}


def test_a_transition_begins_where_it_may_and_alone_or_changes_nothing() -> None:
    verbs, settled = get_args(Verb), [state for state in State if state.settled]
    assert Lifecycle().state is State.UNCONFIGURED
    for verb, state in product(verbs, settled):
        life = Lifecycle()
        life.state = state
        allowed, passing, goal = PATHS[verb]
        assert goal in settled
        assert passing not in settled
        assert (life.begin(verb) is None) == (state in allowed)
        assert life.state is (passing if state in allowed else state)
        assert state not in allowed or all(life.begin(each) for each in verbs)
