"""Where training starts, which part of the networks it changes, and what it leaves as it was, bit for bit."""

import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
import torch
from safetensors.torch import save_file
from tiny_world import FRAMES, HEIGHT, WIDTH, TinyClips, noise_batch, ran, saved, trainer
from torch import Tensor
from torch.testing import assert_close

from gcd_model.config import SVD_14, ModelConfig
from gcd_model.networks import Networks, empty_networks, random_networks
from gcd_model.weights.adapter import adapted, base_digest
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import load_adapted, load_weights, read_adapter, save_weights
from gcd_model.weights.save import gcd_state, write_published
from gcd_train.errors import RecipeError
from gcd_train.recipe import LoraRecipe, LossRecipe, ModelRecipe, NoiseRecipe, Recipe
from gcd_train.recipe_files import load_recipe
from gcd_train.training.objective import Batch, Denoiser, diffusion_loss
from gcd_train.training.setup import Draws, Precision, copy_of, fresh_networks, model_config, start_networks
from gcd_train.training.trainable import (
    adapter_of,
    halve_frozen,
    is_temporal,
    keep_trained_alone,
    let_train,
    merge_lora,
    plain_weights,
)

CPU = torch.device("cpu")
SEED = 3


def published(camera: str = "spherical") -> ModelConfig:
    """The smallest networks that published names and shapes can tell."""
    small = model_config(ModelRecipe(base="small", family="driving" if camera == "none" else "kubric90"))
    unet = msgspec.structs.replace(
        small.unet, width=32, multipliers=(1, 2), attention=(False, True), head_width=64, norm_groups=32
    )
    vae = msgspec.structs.replace(small.vae, width=32, multipliers=(1, 1), norm_groups=32)
    tower = msgspec.structs.replace(small.image_encoder, heads=16)  # pyright: ignore[reportArgumentType]  it has one
    return msgspec.structs.replace(small, unet=unet, vae=vae, image_encoder=tower, frames=2, camera=camera)


def starting(path: Path, scratch: bool = False) -> ModelRecipe:
    return ModelRecipe(base="small", family="kubric90", weights=str(path), scratch=scratch)


def given(camera: str = "spherical") -> Networks:
    return random_networks(published(camera), seed=1)


def write(path: Path, networks: Networks) -> Path:
    """In the layout its suffix and name tell."""
    config, weights = networks.config, networks.state_dict()
    card = Card(name="given", config=config, family=None, move_time=1)
    if path.suffix == ".ckpt":
        write_published(path, weights, card, carried={})
    elif path.stem == "svd":
        save_file({name: value.clone() for name, value in gcd_state(weights, config, {}).items()}, path)
    else:
        save_weights(networks, path, card)
    return path


def assert_from(networks: Networks, source: Networks, anew: tuple[str, ...]) -> None:
    """Weights come from the source, but those that start anew, which are as fresh networks have them."""
    state, wanted = networks.state_dict(), source.state_dict()
    fresh = fresh_networks(networks.config, SEED).state_dict()
    for name, value in state.items():
        expected = fresh[name] if name.startswith(anew) else wanted[name]
        assert torch.equal(value, expected), name


@pytest.mark.parametrize(
    ("name", "camera", "scratch", "anew"),
    [
        ("gcd.ckpt", "spherical", False, ("nothing",)),
        ("own.safetensors", "spherical", False, ("nothing",)),
        ("svd.safetensors", "none", False, ("camera.", "unet.embed_camera.")),
        ("svd.safetensors", "none", True, ("unet.", "camera.")),
    ],
)
def test_a_file_gives_what_it_has_but_the_unet_from_scratch(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, camera: str, scratch: bool, anew: tuple[str, ...]
) -> None:
    source = given(camera)
    networks = start_networks(starting(write(tmp_path / name, source), scratch), published(), SEED)
    assert_from(networks, source, anew)
    assert torch.equal(networks.unet.stem.weight, source.unet.stem.weight) == (not scratch)
    assert caplog.text == ""  # a file that says no family is asked for none


def test_a_file_of_another_model_is_refused_by_its_first_weight(tmp_path: Path) -> None:
    path = write(tmp_path / "own.safetensors", given())
    wide = msgspec.structs.replace(published(), unet=msgspec.structs.replace(published().unet, embedding_width=64))
    with pytest.raises(RecipeError, match=r"own.safetensors holds another model .* misshapen, first: unet\."):
        start_networks(starting(path), wide, SEED)


# --- what is trained -------------------------------------------------------------------------------------------------


def random_batch(config: ModelConfig) -> Batch:
    return noise_batch(config, Draws(1, "batch", 0, CPU), config.frames, config.frames, (4, 4))


def updated(networks: Networks, *, half: bool = False) -> set[str]:
    """One update with a large rate; the names of all weights whose bits changed. half: arithmetic in bfloat16."""
    before = {name: value.clone() for name, value in networks.state_dict().items()}
    denoiser = Denoiser(networks.unet, "v", networks.camera)
    trained = [parameter for parameter in denoiser.parameters() if parameter.requires_grad]
    optimiser = torch.optim.Adam(trained, lr=0.01)
    for update in range(2):  # what stands behind a layer that starts at zero moves with the second
        loss = diffusion_loss(
            denoiser,
            random_batch(networks.config),
            Draws(1, "test", update, CPU),
            Precision(CPU, half=half, channels_last=False),
            noise=NoiseRecipe(),
            loss=LossRecipe(),
            channel_weights=None,
            step=0,
        )
        optimiser.zero_grad()
        loss.total.backward()
        optimiser.step()
    return {name for name, value in networks.state_dict().items() if not torch.equal(value, before[name])}


def test_as_published_all_of_the_unet_and_the_camera_change_and_nothing_else() -> None:
    networks = given()
    let_train(networks, ModelRecipe(base="small", family="kubric90"), SEED)
    changed = updated(networks)
    assert {name.partition(".")[0] for name in changed} == {"unet", "camera"}
    unet = {name for name, _ in networks.named_parameters() if name.startswith(("unet.", "camera."))}
    assert changed == {name for name in unet if ".dormant." not in name}
    frozen = [(name, p) for name, p in networks.named_parameters() if name not in unet]
    assert {name.partition(".")[0] for name, _ in frozen} == {
        "image_encoder",
        "target_encoder",
        "own_condition_encoder",
        "decoder",
    }
    assert all(p.grad is None and not p.requires_grad for _, p in frozen)


def test_training_what_is_temporal_leaves_the_spatial_layers_alone() -> None:
    networks = given()
    let_train(networks, ModelRecipe(base="small", family="kubric90", train="temporal"), SEED)
    changed = updated(networks)
    steering = {"camera.proj.weight", "camera.proj.bias"}
    steering |= {f"unet.embed_camera.{layer}.{leaf}" for layer in (0, 2) for leaf in ("weight", "bias")}
    assert steering < changed
    assert all(is_temporal(name) for name in changed - steering)
    assert len(changed - steering) > 30


def test_states_hold_only_what_is_trained_and_go_back_where_they_were() -> None:
    networks = given()
    let_train(networks, ModelRecipe(base="small", family="kubric90", train="temporal"), SEED)
    denoiser = Denoiser(networks.unet, "v", networks.camera)
    whole = set(denoiser.state_dict())
    keep_trained_alone(denoiser)
    state: dict[str, Tensor] = {name: torch.full_like(value, 0.5) for name, value in denoiser.state_dict().items()}
    assert set(state) == {name for name, p in networks.named_parameters() if p.requires_grad}
    assert len(state) < len(whole)
    spatial = networks.unet.stem.weight.clone()
    denoiser.load_state_dict(state)
    assert all(p.eq(0.5).all() for p in networks.parameters() if p.requires_grad)
    assert torch.equal(networks.unet.stem.weight, spatial)
    with pytest.raises(RuntimeError, match="Missing key"):
        denoiser.load_state_dict({name: value for name, value in state.items() if "camera" not in name})


# --- camera control --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("family", "camera", "features", "width"),
    [("kubric90", None, 13, 32), ("kubric90", "relative_pose", 12, 32), ("driving", None, 0, 0)],
)
def test_the_papers_networks_are_steered_as_the_recipe_says(
    family: str, camera: str | None, features: int, width: int
) -> None:
    recipe = msgspec.convert({"base": "small", "family": family, "camera": camera}, ModelRecipe)
    networks = empty_networks(model_config(recipe))
    shape = () if networks.camera is None else tuple(networks.camera.proj.weight.shape)
    assert shape == ((width, features) if width else ())
    assert (networks.unet.embed_camera is None) == (width == 0)


def test_a_family_with_another_kind_of_view_is_refused() -> None:
    with pytest.raises(RecipeError, match=r"camera = 'none', its family kubric90 by 'spherical'"):
        model_config(ModelRecipe(base="svd-14", family="kubric90", camera="none"))


def test_a_missing_weight_file_is_told_with_its_key_before_networks_are_made() -> None:
    recipe = load_recipe("package:kubric-gradual-max90").model
    with pytest.raises(RecipeError, match=r"svd\.safetensors, is not there; .*--set model\.weights=FILE"):
        start_networks(recipe, model_config(recipe), seed=0)


@pytest.mark.slow
def test_the_temporal_part_trains_on_a_cpu_with_channels_last() -> None:
    """In a process of its own, which torch's group norm would crash."""
    program = (
        "import torch; from test_start import *; from tiny_world import smaller\n"
        "from gcd_train.training.objective import denoiser_of\n"
        "networks = random_networks(smaller(4, 32, 64), seed=0); unet = networks.config.unet\n"
        "let_train(networks, ModelRecipe(weights='x', train='temporal'), SEED)\n"
        "denoiser = Precision(CPU, half=False, channels_last=True).placed(denoiser_of(networks))\n"
        "shapes = (unet.latent_channels, 4, 8), (unet.condition_channels, 4, 8), (unet.vector_width,)\n"
        "target, condition, vector = (torch.randn(4, *shape) for shape in shapes)\n"
        "batch = Batch(target=target, condition=condition, vector=vector, tokens=None, emphasis=None, frames=4)\n"
        "denoiser(batch.target, torch.ones(4), batch).square().mean().backward()"
    )
    subprocess.run([sys.executable, "-c", program], cwd=Path(__file__).parent, check=True)


# --- adapters: the same function at first, few weights, the same function merged, a file of their own -----------------

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


@pytest.mark.slow
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


def adapted_recipe(base: Path) -> Recipe:
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
    trainer(out, adapted_recipe(base), TinyClips(1)).run()
    state = saved(out / "unet", "unet").module
    assert all(name.endswith((".down", ".up")) for name in state)
    joined = load_adapted(load_weights(base), read_adapter(out / "mine-adapter.safetensors"))
    merged = load_weights(out / "mine.safetensors")
    for name, value in merged.networks.state_dict().items():
        assert torch.equal(value, joined.networks.state_dict()[name]), name
    adapter, merged_again = out / "mine-adapter.safetensors", tmp_path / "joined.safetensors"
    code, said = ran("lora", "merge", base, adapter, merged_again)
    assert code == 0, said
    again = load_weights(merged_again).networks.state_dict()
    assert all(torch.equal(value, again[name]) for name, value in merged.networks.state_dict().items())
