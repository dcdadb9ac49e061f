"""Transitions that take long: what may be asked meanwhile, and what becomes of a thread that does not end."""

import threading
from pathlib import Path

from cameras import Bench, until
from fakes import FakeSource, FakeSynthesizer, traits
from rig import Rig

from gcd_model import RenderOptions, ViewSynthesizer
from gcd_node.config import ModelSection
from gcd_node.control.message import Code

LOCKSTEP = 'kind = "synthetic"\npace = "lockstep"'
WAITING = "life = {autostart = false}"


class Deaf:
    """A model that hears no cancel: each rendering takes until it is let go."""

    def __init__(self) -> None:
        self.begun, self.go_on = threading.Event(), threading.Event()

    def __call__(self, options: RenderOptions) -> None:
        self.begun.set()
        assert self.go_on.wait(60)


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
        assert rig.try_out("shutdown").code is Code.OK
        assert rig.ask("shutdown").code is Code.ACCEPTED
        loaded.set()
        rig.await_state("finalized")
    assert rig.failure is None


def test_a_step_that_takes_long_is_waited_for_and_nothing_of_it_is_published(tmp_path: Path) -> None:
    deaf = Deaf()
    with Rig(tmp_path, lambda _: FakeSource(10_000), FakeSynthesizer(traits(), deaf), config=LOCKSTEP) as rig:
        assert deaf.begun.wait(30)
        assert rig.ask("deactivate").code is Code.ACCEPTED
        assert rig.ask("activate").code is Code.BUSY
        assert rig.node.state.label == "deactivating"
        deaf.go_on.set()
        rig.await_state("inactive")
        assert not rig.node.left_behind
        assert rig.views == []
        assert rig.ask("activate").code is Code.ACCEPTED
        rig.await_views(1)


def test_a_thread_left_behind_keeps_the_node_from_starting_only_until_it_ends(tmp_path: Path) -> None:
    deaf, more = Deaf(), "life = {hang_s = 0.3}"
    model = FakeSynthesizer(traits(), deaf)
    with Rig(tmp_path, lambda _: FakeSource(10_000), model, config=LOCKSTEP, more=more) as rig:
        assert deaf.begun.wait(30)
        assert rig.ask("deactivate").code is Code.ACCEPTED
        rig.await_state("inactive")
        assert rig.node.left_behind
        assert rig.ask("activate").code is Code.NOT_READY
        deaf.go_on.set()
        until(lambda: not rig.node.left_behind)
        assert rig.views == []  # nothing follows the end of a view
        assert rig.ask("activate").code is Code.ACCEPTED
        rig.await_views(1)
