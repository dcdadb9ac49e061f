"""How [model] of a launch file becomes what the model is asked."""

from typing import get_args, get_type_hints

from gcd_model import RenderOptions
from gcd_model.clip import QUALITIES, SOLVERS
from gcd_node.config import ModelSection
from gcd_node.stream_context import drawing_options


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


def test_launch_files_know_the_models_qualities_and_solvers() -> None:
    """The words stand in two places, as readers of launch files need no model."""
    hints = get_type_hints(ModelSection)
    assert get_args(hints["quality"]) == QUALITIES
    assert get_args(get_args(hints["solver"])[0]) == SOLVERS
