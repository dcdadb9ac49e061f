"""The weights that ship with the package: their size, their card, and that they run."""

import subprocess
import sys

import torch

from gcd_model import Clip, load_synthesizer
from gcd_model.loading import PACKAGED
from gcd_model.weights.load import inspect_weights

WEIGHTS = PACKAGED / "live-small.safetensors"
MEGABYTES = 16


def test_one_model_ships_and_it_is_small() -> None:
    assert list(PACKAGED.glob("*.safetensors")) == [WEIGHTS]
    assert WEIGHTS.stat().st_size <= MEGABYTES * 1e6


def test_the_card_is_of_these_weights() -> None:
    card = WEIGHTS.with_suffix(".md").read_text()
    assert inspect_weights(WEIGHTS).sha256_12 in card
    assert "TODO-FIGURE" not in card


def test_a_view_is_finite_trained_and_the_same_twice() -> None:
    synthesizer = load_synthesizer("package:live-small", device="cpu")
    config = synthesizer.traits.config
    shape = (config.frames, 3, config.height, config.width)
    video = torch.rand(shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
    features = synthesizer.encode(Clip(video=video, fps=synthesizer.traits.fps))
    first, second = (synthesizer.render(features, [synthesizer.traits.plan_view()])[0] for _ in range(2))
    assert synthesizer.traits.trained
    assert first.video.shape == shape
    assert first.video.isfinite().all()
    assert torch.equal(first.video, second.video)


def test_the_first_view_does_without_a_compiler() -> None:
    """torch's compiler takes two seconds to import, and comes in by functions of tensors on the device "meta"."""
    code = """
import sys, torch
from gcd_model import Clip, load_synthesizer
live = load_synthesizer("package:live-small", device="cpu")
video = torch.zeros(1, 3, live.traits.config.height, live.traits.config.width)
live.streaming().render(live.encode(Clip(video=video, fps=10.0)), [live.streaming().traits.plan_view()])
print(sorted({"torch._dynamo", "torch._inductor", "sympy", "diffusers"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"
