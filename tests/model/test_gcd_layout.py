"""What is written for the released code: its names and shapes, its containers, and the same bits when read again."""

import re
from pathlib import Path

import msgspec
import pytest
import torch
from published import (
    SMALL_GCD,
    assert_same_weights,
    convert,
    filled,
    fixed_view,
    inspect,
    load,
    manifest,
    write_diffusers,
    write_gcd,
    write_svd,
)
from small_models import TINY_DRIVING, draw
from torch import Tensor

from gcd_model.config import SMALL, SVD_14, ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.networks import Networks, empty_networks
from gcd_model.weights.adapter import CAMERA
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.infer import LEFTOVERS
from gcd_model.weights.load import load_weights
from gcd_model.weights.save import gcd_state, write_published

NARROW_HEADS = msgspec.structs.replace(SMALL_GCD, unet=msgspec.structs.replace(SMALL_GCD.unet, head_width=32))


def card(config: ModelConfig, family: str = "kubric90") -> Card:
    return Card(name="mine", config=config, family=FAMILIES[family], move_time=min(7, config.frames - 1))


def written(path: Path, networks: Networks, family: str = "kubric90", overwrite: bool = False) -> Path:
    weights = networks.state_dict()
    write_published(path, weights, card(networks.config, family), carried={}, updates=10, overwrite=overwrite)
    return path


def root_of(path: Path) -> dict[str, object]:
    """As whoever does not know us reads it: tensors and plain containers alone."""
    root = torch.load(path, map_location="cpu", weights_only=True)
    assert isinstance(root, dict)
    return root


def published_shapes(state: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in state.items()}


def test_names_and_shapes_at_full_size_are_those_of_the_released_file_and_of_the_base_model() -> None:
    weights = empty_networks(SVD_14).state_dict()
    fixed = {name: value for name, value in weights.items() if not name.startswith(CAMERA)}
    for kind, given, config in (("gcd_ckpt", weights, SVD_14), ("svd_safetensors", fixed, fixed_view(SVD_14))):
        released = manifest(kind)
        ours = published_shapes(gcd_state(given, config, {}))
        leftovers = {name: torch.empty(shape, device="meta") for name, shape in released.items() if name not in ours}
        assert all(any(re.fullmatch(each, name) for each in LEFTOVERS.values()) for name in leftovers)
        assert published_shapes(gcd_state(given, config, leftovers)) == released


@pytest.mark.parametrize("config", [SMALL_GCD, fixed_view(SMALL_GCD)], ids=["steered", "fixed view"])
def test_what_is_written_and_read_again_is_the_same_bit_for_bit(tmp_path: Path, config: ModelConfig) -> None:
    family = "driving" if config.camera == "none" else "kubric90"
    loaded = load(written(tmp_path / "mine.ckpt", filled(config), family))
    assert_same_weights(loaded.networks, filled(config))
    assert loaded.networks.config == config
    assert loaded.family is not None
    assert (loaded.name, loaded.family.name, loaded.card.move_time, loaded.layout) == ("mine", family, 7, "gcd-ckpt")


def test_it_is_a_lightning_checkpoint_of_plain_containers(tmp_path: Path) -> None:
    root = root_of(written(tmp_path / "mine.ckpt", filled()))
    wanted = {"epoch", "global_step", "pytorch-lightning_version", "state_dict", "optimizer_states", "hyper_parameters"}
    assert wanted <= set(root)
    assert root["global_step"] == 10
    assert root["optimizer_states"] == []
    assert inspect(tmp_path / "mine.ckpt").optimizer_size == 0


def test_leftovers_of_the_file_it_came_from_are_carried_over(tmp_path: Path) -> None:
    source = write_gcd(tmp_path)
    loaded = load(source)
    assert "lpips.lin0.model.1.weight" in loaded.carried
    assert not any(name.startswith("model_ema.") for name in loaded.carried)
    convert(source, tmp_path / "again.ckpt", layout="gcd-ckpt")
    state = root_of(tmp_path / "again.ckpt")["state_dict"]
    assert isinstance(state, dict)
    for name, tensor in loaded.carried.items():
        assert torch.equal(state[name], tensor), name
    assert_same_weights(load(tmp_path / "again.ckpt").networks, filled())


def test_the_base_model_converts_too_and_half_precision_spares_the_decoder(tmp_path: Path) -> None:
    report = convert(write_svd(tmp_path), tmp_path / "half.ckpt", layout="gcd-ckpt", dtype="float16")
    assert (report.layout, report.family) == ("gcd-ckpt", FAMILIES["svd"])
    precisions = {network.name: network.dtypes for network in report.networks}
    assert precisions["unet"] == ("float16",)
    assert precisions["decoder"] == ("float32",)


def test_one_encoder_for_all_frames_becomes_two_that_compute_the_same(tmp_path: Path) -> None:
    folder = write_diffusers(tmp_path / "model")
    convert(folder, tmp_path / "two.ckpt", layout="gcd-ckpt")
    one, two = load(folder).networks, load(tmp_path / "two.ckpt").networks
    assert two.config == fixed_view(SMALL_GCD)
    frames = draw(2, 3, 32, 32)
    with torch.no_grad():
        wanted = one.condition_encoder(frames)
        for encoder in (two.target_encoder, two.condition_encoder):
            torch.testing.assert_close(encoder(frames).mean, wanted.mean, rtol=1e-5, atol=1e-5)
            torch.testing.assert_close(encoder(frames).log_variance, wanted.log_variance, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("config", [TINY_DRIVING, SMALL, NARROW_HEADS], ids=["driving", "small", "narrow heads"])
def test_networks_the_released_code_could_not_build_are_refused(tmp_path: Path, config: ModelConfig) -> None:
    with pytest.raises(OptionError):
        written(tmp_path / "mine.ckpt", Networks(config))
    assert list(tmp_path.iterdir()) == []


def test_a_note_that_lies_about_the_networks_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "mine.ckpt", filled())
    root = torch.load(path, weights_only=True)
    root["hyper_parameters"]["gcd_node"] |= {
        "gcd.config": msgspec.json.encode(TINY_DRIVING).decode(),
        "gcd.family": "",
        "gcd.move_time": "2",
    }
    torch.save(root, path)
    with pytest.raises(CheckpointError):
        load_weights(path)


def test_tensors_that_share_storage_are_written_alone(tmp_path: Path) -> None:
    networks = Networks(SMALL_GCD)
    joined = torch.zeros(1_000_000)
    bias = networks.unet.conv_out.bias
    assert isinstance(bias, Tensor)
    weights = networks.state_dict() | {"unet.conv_out.bias": joined[: bias.numel()]}
    write_published(tmp_path / "mine.ckpt", weights, card(SMALL_GCD), carried={})
    state = root_of(tmp_path / "mine.ckpt")["state_dict"]
    assert isinstance(state, dict)
    assert state["model.diffusion_model.out.2.bias"].untyped_storage().nbytes() == bias.nbytes
