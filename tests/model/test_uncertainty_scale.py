"""The scale of the deviation over samples: stored with weights, carried by views."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from small_models import TINY, random_clip, tiny_synthesizer, tiny_traits

from gcd_model import RenderOptions, SphericalDelta, convert_weights, inspect_weights, load_synthesizer
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.networks import random_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.weights.card import Card
from gcd_model.weights.families import FAMILIES
from gcd_model.weights.load import load_weights, save_weights

CARD = Card(name="small", config=TINY, family=FAMILIES["kubric90"], move_time=2, uncertainty_scale=1.75)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    save_weights(random_networks(TINY, seed=0), path, CARD)
    return path


def test_the_scale_comes_with_the_weights(file: Path) -> None:
    assert load_weights(file).card.uncertainty_scale == 1.75
    assert inspect_weights(file).uncertainty_scale == 1.75
    assert load_synthesizer(file, device="cpu").traits.uncertainty_scale == 1.75
    assert tiny_traits().uncertainty_scale is None


def test_converting_keeps_the_scale_or_takes_a_new_one(file: Path, tmp_path: Path) -> None:
    kept = convert_weights(file, tmp_path / "kept.safetensors", dtype="float16")
    given = convert_weights(file, tmp_path / "given.safetensors", uncertainty_scale=3.0)
    assert (kept.uncertainty_scale, given.uncertainty_scale) == (1.75, 3.0)
    with safe_open(file, framework="pt") as before, safe_open(tmp_path / "given.safetensors", framework="pt") as after:
        names = list(before.keys())
        assert names == list(after.keys())
        assert all(torch.equal(before.get_tensor(name), after.get_tensor(name)) for name in names)


@pytest.mark.parametrize("scale", [0.0, float("nan")])
def test_what_is_no_scale_is_refused(file: Path, tmp_path: Path, scale: float) -> None:
    with pytest.raises(OptionError):
        convert_weights(file, tmp_path / "bad.safetensors", uncertainty_scale=scale)
    assert not (tmp_path / "bad.safetensors").exists()


@pytest.mark.parametrize("text", ["much", "0", "nan"])
def test_a_damaged_scale_is_refused_by_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "damaged.safetensors"
    save_file({"a": torch.zeros(1)}, path, metadata={**CARD.to_metadata(), "gcd.uncertainty_scale": text})
    with pytest.raises(CheckpointError):
        inspect_weights(path)


def test_views_carry_the_scale_of_their_weights() -> None:
    plain = tiny_synthesizer()
    measured = Synthesizer(plain.networks, replace(tiny_traits(), uncertainty_scale=2.5))
    trajectory, options = plain.traits.plan_view(SphericalDelta(azimuth_deg=20.0)), RenderOptions(samples=2, steps=1)
    (view,) = measured.render(measured.encode(random_clip()), [trajectory], options)
    (other,) = plain.render(plain.encode(random_clip()), [trajectory], options)
    assert view.std is not None
    assert view.uncertainty is not None
    assert torch.equal(view.samples, other.samples)
    assert torch.equal(view.uncertainty, 2.5 * view.std)
    assert other.uncertainty is None
    assert replace(view, samples=view.samples[:1]).uncertainty is None
