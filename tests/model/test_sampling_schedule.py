"""What a window is sampled with: solver, guidance and the noise levels it applies at."""

from dataclasses import replace

import pytest
import torch
from small_models import TINY, random_clip, tiny_synthesizer
from torch import Tensor

from gcd_model.clip import RenderOptions
from gcd_model.diffusion import Schedule
from gcd_model.errors import OptionError
from gcd_model.geometry import SphericalDelta
from gcd_model.synthesizer import Synthesizer, synthesize
from gcd_model.unet import StageInputs

STEPS = 4


@pytest.fixture(scope="module")
def synthesizer() -> Synthesizer:
    return tiny_synthesizer()


def latents(synthesizer: Synthesizer, options: RenderOptions) -> Tensor:
    path = synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=30.0))
    return synthesize(synthesizer, random_clip(), path, replace(options, steps=STEPS)).latents


def test_guidance_applies_within_its_interval_alone() -> None:
    levels = Schedule.of(TINY, RenderOptions(steps=STEPS)).sigmas.tolist()
    schedule = Schedule.of(TINY, RenderOptions(steps=STEPS, guidance_interval=(levels[2], levels[1])))
    assert schedule.guided == (False, True, True, False)
    assert (schedule.branches, schedule.evaluations) == (2, STEPS + 2)


@pytest.mark.parametrize("guidance", [None, (1.0, 3.0)])
def test_an_interval_over_all_noise_levels_changes_no_bit(
    synthesizer: Synthesizer, guidance: tuple[float, float] | None
) -> None:
    everywhere = RenderOptions(guidance=guidance)
    bounded = replace(everywhere, guidance_interval=(0.0, 1e9))
    assert torch.equal(latents(synthesizer, everywhere), latents(synthesizer, bounded))


def test_outside_the_interval_the_network_sees_the_conditional_rows_alone(
    synthesizer: Synthesizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    unet, seen = synthesizer.networks.unet, list[int]()
    forward = unet.forward

    def counted(rows: Tensor, condition: Tensor, inputs: StageInputs) -> Tensor:
        seen.append(len(rows))
        return forward(rows, condition, inputs)

    monkeypatch.setattr(unet, "forward", counted)
    levels = Schedule.of(TINY, RenderOptions(steps=STEPS)).sigmas.tolist()
    latents(synthesizer, RenderOptions(guidance_interval=(levels[1], levels[0])))
    assert seen == [2 * TINY.frames, 2 * TINY.frames, TINY.frames, TINY.frames]


@pytest.mark.parametrize("interval", [(2.0, 1.0), (-1.0, 1.0), (float("nan"), 1.0)])
def test_an_interval_that_is_none_is_refused(interval: tuple[float, float]) -> None:
    with pytest.raises(OptionError):
        RenderOptions(guidance_interval=interval)
