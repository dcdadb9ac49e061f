"""How [model] of a launch file becomes what the model is asked."""

from dataclasses import replace
from typing import get_args, get_type_hints

import msgspec
from fakes import traits

from gcd_model import RenderOptions, Sampler, sampler_of
from gcd_model.clip import QUALITIES, SOLVERS
from gcd_model.config import SamplingConfig
from gcd_node.config import ModelSection
from gcd_node.model import drawing_options, sampler_in_use

MANY_STEPS = replace(traits(), config=msgspec.structs.replace(traits().config, sampling=SamplingConfig()))


def test_everything_of_drawing_reaches_the_model() -> None:
    section = ModelSection(
        weights="w",
        quality="fastest",
        steps=3,
        solver="dpmpp_2m",
        guidance=(1.0, 2.0),
        guidance_interval=(0.5, 5.0),
        samples=2,
        motion_bucket=9.0,
    )
    assert drawing_options(section) == RenderOptions(
        quality="fastest",
        steps=3,
        solver="dpmpp_2m",
        guidance=(1.0, 2.0),
        guidance_interval=(0.5, 5.0),
        samples=2,
        motion_bucket=9.0,
    )


def test_what_is_left_out_is_as_quality_and_checkpoint_have_it() -> None:
    own = Sampler(steps=25, solver="euler", guidance=(1.0, 1.5))
    assert sampler_in_use(ModelSection(weights="w"), MANY_STEPS) == own
    fast = sampler_of(SamplingConfig(), RenderOptions(quality="fast"))
    assert sampler_in_use(ModelSection(weights="w", quality="fast"), MANY_STEPS) == fast != own


def test_launch_files_know_the_models_qualities_and_solvers() -> None:
    """The words stand in two places, as readers of launch files need no model."""
    hints = get_type_hints(ModelSection)
    assert get_args(hints["quality"]) == QUALITIES
    assert get_args(get_args(hints["solver"])[0]) == SOLVERS
