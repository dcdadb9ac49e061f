from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from cameras import Bench, Camera
from fakes import Box, FakeSynthesizer, traits
from msgspec.structs import replace as struct_replace
from rig import Rig

from gcd_model import DeviceMemoryError
from gcd_model.config import PLAIN_SMALL
from gcd_node.errors import ModelFailedError
from gcd_node.fallback import FULL, FailureCounter, oom_levels
from gcd_node.health import Health
from gcd_node.model import IdleTimer
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
    assert [rung.name for rung in way[1:]] == ["views one by one", "bfloat16", "half the steps", "a single view"]
    for upper, lower in pairwise(way):
        assert lower.one_by_one >= upper.one_by_one
        assert lower.half >= upper.half
        assert lower.steps_divisor >= upper.steps_divisor
        assert lower.single >= upper.single


def test_rungs_that_would_change_nothing_are_left_out() -> None:
    assert oom_levels(views=1, samples=1, steps=1, can_halve=False) == (FULL,)
    assert [rung.name for rung in oom_levels(views=1, samples=1, steps=8, can_halve=False)] == [
        "as asked",
        "half the steps",
    ]


def test_only_three_failures_within_a_minute_at_the_bottom_are_the_end() -> None:
    clock, health = Hand(), Health()
    failures = FailureCounter(health, Announcer("n", "b", Box(), health), clock)
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


@pytest.mark.parametrize(
    ("device", "height", "size"), [("cpu", 128, (64, 96)), ("cpu", 96, (96, 192)), ("cuda:0", 128, (128, 192))]
)
def test_a_cpu_warms_up_with_less_where_it_can(device: str, height: int, size: tuple[int, int], tmp_path: Path) -> None:
    config = struct_replace(PLAIN_SMALL, height=height, width=192)
    model = FakeSynthesizer(replace(traits("driving"), config=config, device=device))
    camera = Camera(size=(192, 128))
    with Rig(tmp_path, Bench(camera), model, views="[view.main]") as rig:
        rig.await_state("active")
    assert tuple(model.clips[0].video.shape) == (1, 3, *size)
