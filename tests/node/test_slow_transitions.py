"""Transitions that take long: what may be asked meanwhile, and what becomes of a thread that does not end."""

import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from cameras import Bench, until
from fakes import LOCKSTEP, FakeSource, FakeSynthesizer, traits
from rig import Rig
from torch import nn

from gcd_client.control import Code
from gcd_model import Augmentation, Cancelled, Clip, RenderOptions, SourceFeatures, Trajectory, View, ViewSynthesizer
from gcd_node.config import ModelSection
from gcd_node.model import interruptible

WAITING = "life = {autostart = false}"


class Deaf:
    """A model that hears no cancel and has no layers: each rendering takes until it is let go."""

    def __init__(self) -> None:
        self.begun, self.go_on = threading.Event(), threading.Event()

    def __call__(self, options: RenderOptions) -> None:
        self.begun.set()
        assert self.go_on.wait(60)


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

    def encode(
        self, clip: Clip, augmentation: Augmentation | None = None, extra: torch.Tensor | None = None
    ) -> SourceFeatures:
        if self._part == "encoder":
            self._work(clip.video)
        return super().encode(clip, augmentation, extra)

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        if self._part == "decoder" and options is not None and options.progress is not None:
            options.progress(1, 1)
        if self._part != "encoder":
            self._work(features.latents)
        return super().render(features, trajectories, options)


@pytest.mark.parametrize("part", ["encoder", "step", "decoder"])
def test_f23_whatever_part_of_the_model_is_at_work_it_is_abandoned(
    tmp_path: Path, part: str, caplog: pytest.LogCaptureFixture
) -> None:
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
    deaf, more = Deaf(), "life = {hang_s = 0.3}"
    model = FakeSynthesizer(traits(), deaf)
    with Rig(tmp_path, lambda _: FakeSource(10_000), model, config=LOCKSTEP, more=more) as rig:
        assert deaf.begun.wait(30)
        rig.await_state("active")
        assert rig.ask("deactivate").code is Code.ACCEPTED
        rig.await_state("inactive")
        assert rig.node.left_behind
        assert rig.ask("activate").code is Code.NOT_READY
        deaf.go_on.set()
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
