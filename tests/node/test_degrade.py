import gc
import weakref
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from fakes import LOCKSTEP, Box, FakeSource, FakeSynthesizer, traits
from rig import Rig

from gcd_model import DeviceMemoryError, RenderOptions, SourceFeatures, Trajectory, View, ViewSynthesizer
from gcd_node.config import ModelSection
from gcd_node.errors import ModelFailedError
from gcd_node.health import Health
from gcd_node.model import FailureCounter, oom_levels
from gcd_node.status import Announcer


def test_only_three_failures_within_a_minute_at_the_bottom_are_the_end() -> None:
    clock = iter((0.0, 31.0, 62.0, 90.0))  # asked for where nothing is left to give up
    failures = FailureCounter(Announcer("n", "b", Box(), Health()), clock.__next__)
    levels = oom_levels(views=2, samples=1, steps=1, can_halve=False)
    assert failures.given_up == []
    for _ in range(5):
        failures.out_of_memory(1, DeviceMemoryError("full"), levels)
    assert failures.given_up == ["views one by one", "a single view"]
    with pytest.raises(ModelFailedError):
        failures.out_of_memory(1, DeviceMemoryError("full"), levels)


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
