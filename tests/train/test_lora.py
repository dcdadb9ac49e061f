"""Adapters on the U-Net: the same function at first, few weights, the same function merged, a file of their own."""

from pathlib import Path

import msgspec
import pytest
import torch
from test_start import SEED, given, published, random_batch, updated
from tiny_world import FRAMES, HEIGHT, WIDTH, TinyClips, saved, trainer
from torch import Tensor
from torch.testing import assert_close
from typer.testing import CliRunner

from gcd_model.config import SVD_14
from gcd_model.networks import Networks, empty_networks, random_networks
from gcd_model.weights.adapter import adapted, base_digest
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import load_adapted, load_weights, read_adapter, save_weights
from gcd_train.cli.main import app
from gcd_train.recipe import LoraRecipe, ModelRecipe, Recipe
from gcd_train.training.objective import Denoiser
from gcd_train.training.setup import copy_of, model_config
from gcd_train.training.trainable import adapter_of, halve_frozen, is_temporal, let_train, merge_lora, plain_weights

LORA = LoraRecipe(rank=2, alpha=4.0)
ADAPTED = ModelRecipe(base="small", family="kubric90", weights="given.safetensors", train="lora", lora=LORA)


def output(networks: Networks) -> Tensor:
    batch = random_batch(networks.config)
    denoiser = Denoiser(networks.unet, "v", networks.camera)
    with torch.no_grad():
        return denoiser(batch.target, torch.full((batch.frames,), 2.0), batch)[0]


def trained_networks() -> Networks:
    """After updates that moved both factors of every adapter."""
    networks = given()
    let_train(networks, ADAPTED, SEED)
    updated(networks)
    return networks


def test_adapters_change_nothing_at_first() -> None:
    networks = given()
    before = output(networks)
    let_train(networks, ADAPTED, SEED)
    assert_close(output(networks), before, rtol=0, atol=1e-6)


def test_only_adapters_and_what_steers_are_trained() -> None:
    networks = given()
    let_train(networks, ADAPTED, SEED)
    changed = updated(networks)
    assert all(name.endswith((".down", ".up")) or "camera" in name for name in changed)
    names = {name for name, p in networks.named_parameters() if p.requires_grad}
    assert changed == names
    assert not any(".dormant." in name for name in names)


def test_a_base_kept_in_bfloat16_computes_nearly_the_same_and_trains_the_same_adapters() -> None:
    networks = given()
    wanted = output(networks)
    let_train(networks, ADAPTED, SEED)
    halve_frozen(networks)
    frozen = [each for name, each in networks.named_parameters() if not each.requires_grad and "dormant" not in name]
    assert {each.dtype for each in frozen} == {torch.bfloat16}
    with torch.autocast("cpu", torch.bfloat16):
        assert (output(networks) - wanted).norm() < 0.02 * wanted.norm()
    assert updated(networks, half=True) == {name for name, each in networks.named_parameters() if each.requires_grad}
    assert {each.dtype for each in networks.parameters() if each.requires_grad} == {torch.float32}


def test_merged_weights_compute_the_same_and_are_plain() -> None:
    networks = trained_networks()
    wanted, names = output(networks), set(given().state_dict())
    assert not torch.allclose(wanted, output(given()), atol=1e-3)
    assert set(plain_weights(networks)) == names
    assert_close(output(copy_of(networks)), wanted, rtol=1e-5, atol=1e-5)
    merge_lora(networks)
    assert set(networks.state_dict()) == names
    assert_close(output(networks), wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("lora", [LORA, LoraRecipe(rank=2, alpha=4.0, stem=True, camera=False)])
def test_an_adapter_kept_apart_gives_the_same_on_its_base(lora: LoraRecipe) -> None:
    networks = given()
    let_train(networks, msgspec.structs.replace(ADAPTED, lora=lora), SEED)
    updated(networks)
    card = Card(name="adapted", config=published(), family=FAMILIES["kubric90"], move_time=1)
    apart = adapter_of(networks, lora, card, base_digest(given().state_dict()))
    assert ("unet.stem.weight" in apart.tensors, "camera.proj.weight" in apart.tensors) == (lora.stem, lora.camera)
    assert_close(output(adapted(given(), apart)), output(networks), rtol=1e-5, atol=1e-5)


def test_at_full_size_rank_32_is_under_two_percent_and_the_temporal_part_as_large_as_published() -> None:
    networks = empty_networks(SVD_14)
    assert sum(value.numel() for name, value in networks.named_parameters() if is_temporal(name)) == 656_076_838
    unet = sum(value.numel() for value in networks.unet.parameters())
    let_train(networks, ModelRecipe(base="svd-14", family="kubric90", weights="svd", train="lora"), SEED)
    factors = sum(value.numel() for name, value in networks.named_parameters() if name.endswith((".down", ".up")))
    assert factors == 26_607_616
    assert factors / unet < 0.02


def test_adapters_want_weights_to_stand_on() -> None:
    text = b'name = "x"\n[model]\ntrain = "lora"\n[vae]\nbudget = {updates = 1}\noptimiser = {rate = 1.0}\n'
    text += b"[unet]\nbudget = {updates = 1}\noptimiser = {rate = 1.0}\n[latents]\n"
    with pytest.raises(msgspec.ValidationError, match="adds to a trained U-Net: give model"):
        msgspec.toml.decode(text, type=Recipe)


# --- a whole run -----------------------------------------------------------------------------------------------------


def recipe(base: Path) -> Recipe:
    text = f"""
    name = "mine"
    model = {{ base = "small", family = "driving", weights = "{base}", train = "lora", lora = {{ rank = 2 }},
               frames = {FRAMES}, height = {HEIGHT}, width = {WIDTH} }}
    log = {{ valid_clips = 1 }}
    export = {{ dtype = "float32" }}
    [unet]
    budget = {{ updates = 2 }}
    source = "pixels"
    clip_batch = 1
    optimiser = {{ kind = "adam", rate = 0.01 }}
    """
    return msgspec.toml.decode("\n".join(text.splitlines()).replace(",\n  ", ", "), type=Recipe)


@pytest.mark.slow
def test_a_run_leaves_the_adapter_apart_and_merged_weights(tmp_path: Path) -> None:
    """Two updates, from a file to three files: state, adapter and merged weights agree, and the command joins them."""
    base, out = tmp_path / "base.safetensors", tmp_path / "run"
    model = ModelRecipe(base="small", family="driving", frames=FRAMES, height=HEIGHT, width=WIDTH)
    networks = random_networks(model_config(model), seed=1)
    save_weights(networks, base, Card(name="base", config=networks.config, family=None, move_time=3))
    trainer(out, recipe(base), TinyClips(1)).run()
    state = saved(out / "unet", "unet").module
    assert all(name.endswith((".down", ".up")) for name in state)
    joined = load_adapted(load_weights(base), read_adapter(out / "mine-adapter.safetensors"))
    merged = load_weights(out / "mine.safetensors")
    for name, value in merged.networks.state_dict().items():
        assert torch.equal(value, joined.networks.state_dict()[name]), name
    result = CliRunner().invoke(
        app, ["lora", "merge", str(base), str(out / "mine-adapter.safetensors"), str(tmp_path / "joined.safetensors")]
    )
    assert result.exit_code == 0, result.output
    again = load_weights(tmp_path / "joined.safetensors").networks.state_dict()
    assert all(torch.equal(value, again[name]) for name, value in merged.networks.state_dict().items())
