"""Configs and files of a model with switches that are ours, and what the published one keeps clear of."""

from pathlib import Path

import msgspec
import pytest
import torch
from small_models import TINY, TINY_DRIVING, random_clip, randomise

from gcd_model.checkpoints import inspect_weights, save_weights
from gcd_model.clip import Clip, View
from gcd_model.config import DRIVING_SMALL, SMALL, SVD_14, ModelConfig, PlaneMixConfig, warp_channels
from gcd_model.errors import OptionError
from gcd_model.geometry import CameraMount
from gcd_model.loading import load_synthesizer
from gcd_model.networks import Networks, empty_networks
from gcd_model.own_format import Card
from gcd_model.synthesizer import Synthesizer, synthesize

FRAMES = TINY_DRIVING.frames


def rendered(synthesizer: Synthesizer) -> View:
    return synthesize(synthesizer, random_clip(TINY_DRIVING), synthesizer.traits.plan_view())


def test_a_model_stored_in_half_precision_comes_back_and_computes_in_float32(tmp_path: Path) -> None:
    networks = Networks(TINY_DRIVING)
    randomise(networks)
    networks.half()
    card = Card(name="tiny-driving", config=TINY_DRIVING, family="driving", move_time=FRAMES - 1)
    save_weights(networks, tmp_path / "tiny.safetensors", card)
    loaded = load_synthesizer(tmp_path / "tiny.safetensors", device="cpu")
    assert {parameter.dtype for parameter in loaded.networks.parameters()} == {torch.float32}
    assert loaded.traits.config == TINY_DRIVING
    assert {report.name for report in inspect_weights(tmp_path / "tiny.safetensors").networks} == {
        "unet", "target_encoder", "decoder", "class_head", "plane_mix",
    }  # fmt: skip
    expected = rendered(Synthesizer(networks.float(), loaded.traits))
    view = rendered(loaded)
    assert torch.equal(view.samples, expected.samples)
    assert view.classes is not None
    assert expected.classes is not None
    assert torch.equal(view.classes, expected.classes)


@pytest.mark.parametrize("config", [SVD_14, SMALL, TINY])
def test_the_published_model_has_nothing_of_ours(config: ModelConfig) -> None:
    networks = empty_networks(config)
    assert networks.class_head is None
    assert networks.plane_mix is None
    assert {name.partition(".")[0] for name in networks.state_dict()} == {
        "unet", "camera", "image_encoder", "target_encoder", "own_condition_encoder", "decoder",
    }  # fmt: skip
    assert not config.is_ours
    assert (config.vae.patch, config.prediction, config.sampling.shared_noise) == (1, "v", False)


def test_a_config_written_before_these_switches_existed_reads_as_the_published_model() -> None:
    content = msgspec.json.decode(msgspec.json.encode(SVD_14))
    for name in ("prediction", "plane_warp", "plane_mix", "class_head"):
        del content[name]
    del content["vae"]["patch"], content["sampling"]["shared_noise"], content["sampling"]["augmentation"]
    assert msgspec.convert(content, ModelConfig) == SVD_14


def test_the_shipped_model_fits_its_file() -> None:
    assert msgspec.json.decode(msgspec.json.encode(DRIVING_SMALL), type=ModelConfig) == DRIVING_SMALL
    assert (DRIVING_SMALL.vae.down_factor, DRIVING_SMALL.size_factor) == (8, 32)
    parameters = sum(parameter.numel() for parameter in empty_networks(DRIVING_SMALL).parameters())
    assert 2 * parameters < 25_000_000  # bytes in half precision


def test_switches_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(OptionError, match="needs plane_warp"):
        msgspec.structs.replace(TINY, plane_mix=PlaneMixConfig())
    wanted = 4 + warp_channels(TINY_DRIVING.plane_warp, 4)
    with pytest.raises(OptionError, match=f"condition_channels must be {wanted}, got 4"):
        msgspec.structs.replace(TINY_DRIVING, unet=msgspec.structs.replace(TINY_DRIVING.unet, condition_channels=4))
    with pytest.raises(OptionError, match="pixels per latent, the VAE has 2"):
        msgspec.structs.replace(TINY_DRIVING, vae=msgspec.structs.replace(TINY_DRIVING.vae, patch=1))


def test_a_clip_carries_its_mount() -> None:
    mount = CameraMount(height_m=1.2)
    assert Clip(video=torch.zeros(1, 3, 32, 48), fps=10.0, mount=mount).mount == mount
    assert Clip(video=torch.zeros(1, 3, 32, 48), fps=10.0).mount is None
