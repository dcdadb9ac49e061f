"""The weights that ship with the package: their size, their card, and that they run."""

from pathlib import Path

import pytest
import torch

from gcd_model import Clip, load_synthesizer
from gcd_model.checkpoints import inspect_weights
from gcd_model.loading import PACKAGED

SHIPPED = sorted(PACKAGED.glob("*.safetensors"))
MEGABYTES = 25


def test_models_for_the_road_for_its_classes_and_for_orbits_ship() -> None:
    assert {"driving-small", "driving-semantic-small", "objects-small"} == {path.stem for path in SHIPPED}


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_weights_are_small_and_in_half_precision_or_eight_bits(path: Path) -> None:
    assert path.stat().st_size <= MEGABYTES * 1e6
    stored = {each.name: set(each.dtypes) for each in inspect_weights(path).networks}
    assert set().union(*stored.values()) <= {"float16", "int8"}
    assert stored["decoder"] == {"float16"}


def test_all_weights_together_keep_the_package_small() -> None:
    assert sum(path.stat().st_size for path in SHIPPED) <= 60e6


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_card_is_of_these_weights(path: Path) -> None:
    card = path.with_suffix(".md").read_text()
    assert inspect_weights(path).sha256_12 in card
    for heading in ("## Data", "## Training", "## Figures", "## What is wrong with it", "## Licence"):
        assert heading in card


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_view_is_finite_trained_and_the_same_twice(path: Path) -> None:
    synthesizer = load_synthesizer(f"package:{path.stem}", device="cpu")
    config = synthesizer.traits.config
    shape = (config.frames, 3, config.height, config.width)
    video = torch.rand(shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
    features = synthesizer.encode(Clip(video=video, fps=synthesizer.traits.fps))
    first, second = (synthesizer.render(features, [synthesizer.traits.plan_view()])[0] for _ in range(2))
    assert synthesizer.traits.trained
    assert first.video.shape == shape
    assert torch.equal(first.video, second.video)
    if first.classes is None:
        assert synthesizer.traits.classes == ()
    else:
        assert int(first.classes.max()) < len(synthesizer.traits.classes)
