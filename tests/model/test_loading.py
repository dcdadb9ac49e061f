"""A checkpoint's name becomes a synthesizer on a device, in a precision."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from published import HEADS, SMALL_GCD, filled, write_diffusers, write_gcd
from torch import Tensor

from gcd_model import Clip, loading
from gcd_model.config import SMALL
from gcd_model.errors import CheckpointError, OptionError, ViewFixedError
from gcd_model.geometry import SphericalDelta
from gcd_model.live.config import LIVE_TINY
from gcd_model.loading import load_synthesizer
from gcd_model.synthesizer import Synthesizer
from gcd_model.weights import load
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import PACKAGED, inspect_weights, save_weights


def dtypes(synthesizer: Synthesizer) -> dict[str, set[torch.dtype]]:
    """Precisions of each network; what never leaves the host keeps its own."""
    return {
        name: {p.dtype for key, p in module.named_parameters() if ".dormant." not in key}
        for name, module in synthesizer.networks.named_children()
    }


def test_float32_on_the_cpu_stays_in_the_mapped_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: dict[str, int] = {}

    def remembered(*arguments: object, **options: object) -> object:
        loaded = real(*arguments, **options)
        kept.update({name: tensor.data_ptr() for name, tensor in loaded.networks.state_dict().items()})
        return loaded

    real = loading.load_weights
    monkeypatch.setattr(loading, "load_weights", remembered)
    synthesizer = load_synthesizer(write_gcd(tmp_path), device="cpu", **HEADS)
    assert {name: tensor.data_ptr() for name, tensor in synthesizer.networks.state_dict().items()} == kept


def test_a_precision_is_for_all_but_the_decoder_and_a_float16_folder_computes_in_float32_on_the_cpu(
    tmp_path: Path,
) -> None:
    found = dtypes(load_synthesizer("random:kubric90", device="cpu", dtype="bfloat16"))
    assert found.pop("decoder") == {torch.float32}
    assert set(map(tuple, found.values())) == {(torch.bfloat16,)}
    synthesizer = load_synthesizer(write_diffusers(tmp_path / "m", half=True), device="cpu", family="driving")
    assert set(map(tuple, dtypes(synthesizer).values())) == {(torch.float32,)}
    assert synthesizer.traits.family == FAMILIES["driving"]


@pytest.mark.parametrize("family", list(FAMILIES))
def test_random_networks_have_their_familys_control(family: str) -> None:
    traits = load_synthesizer(f"random:{family}", device="cpu").traits
    direct = family == "live"
    assert (traits.name, traits.trained, traits.move_time) == (f"random-{family}", False, 0 if direct else 13)
    assert traits.config.camera == FAMILIES[family].camera
    size = (LIVE_TINY.height, LIVE_TINY.width) if traits.live else (SMALL.height, SMALL.width)
    assert (traits.config.height, traits.config.width) == size
    if traits.config.camera == "none":
        with pytest.raises(ViewFixedError):
            traits.plan_view(SphericalDelta(azimuth_deg=10.0))


def test_random_networks_are_the_same_every_time_and_of_another_family_others() -> None:
    first, second, other = (
        load_synthesizer(f"random:{name}", device="cpu") for name in ("kubric90", "kubric90", "svd")
    )
    assert first.traits.sha256_12 == second.traits.sha256_12 != other.traits.sha256_12
    state: dict[str, Tensor] = second.networks.state_dict()
    assert all(torch.equal(tensor, state[name]) for name, tensor in first.networks.state_dict().items())


def test_packaged_weights_are_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "PACKAGED", tmp_path)
    with pytest.raises(CheckpointError):
        load_synthesizer("package:small")
    card = Card(name="small", config=SMALL_GCD, family=FAMILIES["kubric90"], move_time=13)
    save_weights(filled(), tmp_path / "small.safetensors", card)
    assert load_synthesizer("package:small", device="cpu").traits.name == "small"
    with pytest.raises(CheckpointError):
        load_synthesizer("package:large")
    with pytest.raises(CheckpointError):
        load_synthesizer(f"package:../{tmp_path.name}/small")


@pytest.mark.parametrize(
    "options",
    [
        {"device": "gpu"},
        {"device": "cpu:1"},
        {"device": "cuda:99"},
        {"dtype": "int8"},
        {"dtype": "float8"},  # of the engine cuda alone
        {"family": "driving"},
        {"frames": 1},
    ],
)
def test_impossible_options_are_refused(options: dict[str, str]) -> None:
    with pytest.raises(OptionError):
        load_synthesizer("random:kubric90", **options)


WEIGHTS = PACKAGED / "live-small.safetensors"
MEGABYTES = 16


def test_one_model_ships_it_is_small_and_the_card_is_of_these_weights() -> None:
    assert list(PACKAGED.glob("*.safetensors")) == [WEIGHTS]
    assert WEIGHTS.stat().st_size <= MEGABYTES * 1e6
    assert inspect_weights(WEIGHTS).sha256_12 in WEIGHTS.with_suffix(".md").read_text()


@pytest.mark.slow
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


@pytest.mark.slow
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
