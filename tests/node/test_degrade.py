import gc
import weakref
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from fakes import Box, FakeSource, FakeSynthesizer, traits
from rig import Rig

from gcd_model import DeviceMemoryError, RenderOptions, SourceFeatures, Trajectory, View, ViewSynthesizer
from gcd_node.config import ModelSection
from gcd_node.errors import ModelFailedError
from gcd_node.health import Health
from gcd_node.model import FULL, FailureCounter, IdleTimer, oom_levels
from gcd_node.service import ClockWatch
from gcd_node.status import Announcer


class Hand:
    """A clock that a test sets; seconds when called."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def nanoseconds(self) -> int:
        return round(self.now * 1e9)


def test_each_rung_keeps_what_the_ones_before_it_gave_up() -> None:
    way = oom_levels(views=2, samples=2, steps=10, can_halve=True)
    assert way[0] is FULL
    assert oom_levels(views=1, samples=1, steps=1, can_halve=False) == (FULL,)
    assert [rung.name for rung in way[1:]] == ["views one by one", "bfloat16", "half the steps", "a single view"]
    for upper, lower in pairwise(way):
        assert lower.one_by_one >= upper.one_by_one
        assert lower.half >= upper.half
        assert lower.steps_divisor >= upper.steps_divisor
        assert lower.single >= upper.single


def test_only_three_failures_within_a_minute_at_the_bottom_are_the_end() -> None:
    clock = Hand()
    failures = FailureCounter(Announcer("n", "b", Box(), Health()), clock)
    levels = oom_levels(views=2, samples=1, steps=1, can_halve=False)
    assert failures.level is FULL
    for clock.now in (0.0, 0.0, 0.0, 31.0, 62.0):
        failures.out_of_memory(1, DeviceMemoryError("full"), levels)
    assert failures.level.single
    clock.now = 90.0
    with pytest.raises(ModelFailedError):
        failures.out_of_memory(1, DeviceMemoryError("full"), levels)


def test_a_node_rests_only_after_nobody_has_watched_for_long_enough() -> None:
    clock = Hand()
    rule = IdleTimer(2.0, clock)
    told = []
    for clock.now, subscribers in ((0.0, 0), (1.9, 0), (2.1, 0), (2.2, 1), (4.1, 0), (4.3, 0)):
        told.append(rule.is_idle(subscribers))
    assert told == [False, False, True, False, False, True]


@pytest.mark.parametrize(("step_s", "seen"), [(0.05, None), (-0.05, None), (3600.0, 3_600_000.0), (-2.0, -2000.0)])
def test_a_clock_that_was_set_is_noticed_once(step_s: float, seen: float | None) -> None:
    utc, monotonic = Hand(), Hand()
    wall = ClockWatch(utc.nanoseconds, monotonic.nanoseconds)
    utc.now = monotonic.now = 5.0
    assert wall.step_ms() is None
    utc.now += step_s
    assert wall.step_ms() == seen
    assert wall.step_ms() is None


LOCKSTEP = 'kind = "synthetic"\npace = "lockstep"'


class OnGpu(FakeSynthesizer):
    """Says that it is on a GPU, and fits there in bfloat16 alone; holds itself in a cycle, as modules may."""

    def __init__(self, section: ModelSection) -> None:
        precision = section.dtype or "float32"
        super().__init__(replace(traits(), device="cuda:0", precision=precision))

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        if self.traits.precision == "float32":
            raise DeviceMemoryError("out of memory")
        return super().render(features, trajectories, options)


class Loader:
    """Loads models, and says how many of those it loaded before were still there when it was asked again."""

    def __init__(self) -> None:
        self.loaded: list[weakref.ref[OnGpu]] = []
        self.still_there: list[int] = []

    def __call__(self, section: ModelSection) -> ViewSynthesizer:
        self.still_there.append(sum(model() is not None for model in self.loaded))
        made = OnGpu(section)
        self.loaded.append(weakref.ref(made))
        return made


def test_f11_a_full_gpu_gets_the_same_model_in_bfloat16(tmp_path: Path) -> None:
    load = Loader()
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
    assert load.still_there == [0, 0]
