"""A model that is shown the source's points: its first update, its rows in stores and batches, and its figures."""

from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from cached_sets import CLIP, PLAN, FakePictures, cached, tiny_encoders
from driving_plane import PlaneClips
from test_objective import PRECISION, draws
from test_start import SEED, given, published, random_batch, starting, write
from tiny_world import TinyClips, ran, tiny_recipe, trainer
from torch import Tensor
from torch.testing import assert_close

from gcd_model import load_synthesizer
from gcd_model.conditioning import splat_channels
from gcd_model.config import ModelConfig, with_splat
from gcd_model.networks import Networks, random_networks
from gcd_model.weights.adapter import adapted, base_digest
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import save_weights
from gcd_train.data.batches import SampleBatches
from gcd_train.data.cache import CachedLatents, ClipPlace
from gcd_train.data.latents import LatentClips
from gcd_train.data.sample import splat_of, to_network
from gcd_train.evaluation.store import Run
from gcd_train.recipe import LoraRecipe, LossRecipe, NoiseRecipe, Recipe
from gcd_train.recipe_files import load_recipe
from gcd_train.training.objective import Denoiser, diffusion_loss
from gcd_train.training.setup import model_config, start_networks
from gcd_train.training.trainable import adapter_of, let_train

STEM = "unet.stem.weight"


@pytest.mark.parametrize(
    ("name", "camera"), [("gcd.ckpt", "spherical"), pytest.param("svd.safetensors", "none", marks=pytest.mark.slow)]
)
def test_the_first_update_computes_what_the_published_weights_compute(tmp_path: Path, name: str, camera: str) -> None:
    """Loss and gradient, from GCD's weights and from SVD's; what is new is zero, and has a gradient of its own."""
    path = write(tmp_path / name, given(camera))

    def first_update(config: ModelConfig) -> tuple[Tensor, Tensor, Tensor | None]:
        recipe = msgspec.structs.replace(starting(path), splat=config.splat)
        networks, batch = start_networks(recipe, config, SEED), random_batch(with_splat(config, "given"))
        loss = diffusion_loss(
            Denoiser(networks.unet, "v", networks.camera),
            replace(batch, condition=batch.condition[:, : config.unet.condition_channels]),
            draws(), PRECISION, noise=NoiseRecipe(), loss=LossRecipe(), channel_weights=None, step=0,
        )  # fmt: skip
        loss.total.backward()
        return loss.total.detach(), networks.unet.stem.weight.detach(), networks.unet.stem.weight.grad

    (loss, stem, gradient), (wanted, old, expected) = map(first_update, (with_splat(published(), "given"), published()))
    assert_close(loss, wanted, rtol=1e-6, atol=0)
    assert torch.equal(stem[:, :8], old)
    assert not bool(stem[:, 8:].any())
    assert_close(gradient[:, :8], expected, rtol=1e-4, atol=1e-6)
    assert bool(gradient[:, 8:].any())


def test_an_adapter_stands_on_the_base_without_it(tmp_path: Path) -> None:
    lora, base, config = LoraRecipe(rank=2, stem=True), given(), with_splat(published(), "given")
    recipe = msgspec.structs.replace(
        starting(write(tmp_path / "own.safetensors", base)), splat="given", train="lora", lora=lora
    )
    networks = start_networks(recipe, config, SEED)
    digest = base_digest(networks.state_dict())
    let_train(networks, recipe, SEED)
    torch.nn.init.normal_(networks.unet.stem.weight)
    card = Card(name="mine", config=config, family=FAMILIES["kubric90"], move_time=1)
    joined = adapted(base, adapter_of(networks, lora, card, digest))
    assert torch.equal(joined.unet.stem.weight, networks.unet.stem.weight)


@pytest.mark.parametrize(
    "changes",
    [
        {"train": "temporal"},
        {"train": "lora", "weights": "svd.safetensors"},
        {"data": {"task": "image-to-video"}},
    ],
)
def test_a_training_that_could_not_use_it_is_refused(changes: dict[str, object]) -> None:
    plain = msgspec.to_builtins(tiny_recipe())
    data = {**plain["data"], **changes.pop("data", {})}  # pyright: ignore
    with pytest.raises(msgspec.ValidationError, match="splat"):
        msgspec.convert({**plain, "data": data, "model": {**plain["model"], "splat": "given", **changes}}, Recipe)


def tiny(splat: str = "given") -> Recipe:
    recipe = tiny_recipe()
    return msgspec.structs.replace(recipe, model=msgspec.structs.replace(recipe.model, splat=splat))


@pytest.mark.parametrize(("dropout", "splat"), [(0.0, "given"), (0.0, "estimated"), (1.0, "given")])
def test_a_batch_has_it_behind_the_latents_and_drops_both(dropout: float, splat: str) -> None:
    networks, clips = random_networks(model_config(tiny(splat).model), seed=2), TinyClips(1)
    unet = msgspec.structs.replace(tiny().unet, image_share=0.0, loss=LossRecipe(), dropout=dropout)
    condition = SampleBatches(clips, networks, unet, FAMILIES["driving"], PRECISION).batch(draws(), 1).condition
    channels, sample = networks.config.vae.latent_channels, clips.sample(0)
    assert condition.shape[1] == networks.config.unet.condition_channels == 2 * channels + 1
    if dropout:
        assert not bool(condition.any())
    else:
        assert_close(condition[:, channels:], expected(networks, splat_of(sample, to_network(sample.source), splat)))


def expected(networks: Networks, splats: Tensor | None) -> Tensor:
    assert splats is not None
    with torch.no_grad():
        return splat_channels(splats, lambda frames: networks.condition_encoder(frames).mean)


def written(path: Path, networks: Networks) -> Path:
    card = Card(name=path.stem, config=networks.config, family=None, move_time=3)
    save_weights(networks, path, card)
    return path


def test_a_store_of_latents_holds_it_for_a_clip_and_its_mirror_image(tmp_path: Path) -> None:
    recipe = tiny()
    networks = random_networks(model_config(recipe.model), seed=2)
    model = msgspec.structs.replace(recipe.model, weights=str(written(tmp_path / "start.safetensors", networks)))
    trainer(tmp_path, msgspec.structs.replace(recipe, vae=None, model=model)).run("latents")
    sample, frames = TinyClips(2).sample(1), torch.arange(4)
    splats = splat_of(sample, to_network(sample.source), "given")
    assert splats is not None
    clips = LatentClips.open(tmp_path / "latents")
    for mirrored, shown in ((False, splats), (True, splats.flip(-1))):
        rows = clips.rows(torch.full((4,), 1), frames, torch.full((4,), mirrored), torch.device("cpu"))
        assert_close(rows.splat, expected(networks, shown), atol=2e-3, rtol=2e-3)  # float16


def test_a_cache_holds_it_for_every_place_on_the_path(tmp_path: Path) -> None:
    cached(tmp_path, FakePictures(scenes=("a",)), splat="given")
    place, encoders = ClipPlace(1, 2), tiny_encoders()
    clip = CachedLatents.open(tmp_path).clip("a", place, "gradual")
    moments = [FakePictures(scenes=("a",)).moment("a", time, (i,)) for i, time in enumerate(PLAN.times(place))]
    with torch.no_grad():
        shown = [encoders.splat(splat_of(each, to_network(each.source), "given")) for each in moments]
    assert len(shown) == CLIP
    assert_close(clip.splat, torch.cat([each for each in shown if each is not None]), atol=1e-3, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("splat", ["given", "estimated"])
def test_from_a_recipe_to_figures_which_are_marked_where_depth_is_given(tmp_path: Path, splat: str) -> None:
    """The study's recipe, on clips of a plane."""
    data, valid = (PlaneClips.make(1, width=64).write(tmp_path / f"from-{seed}", seed) for seed in (0, 9))
    start = load_recipe("package:study", small=True)
    base = written(tmp_path / "start.safetensors", random_networks(model_config(start.model), seed=0))

    changes = (f"--set=model.weights={base}", f"--set=model.splat={splat}")
    where = (f"--data={data}", f"--valid={valid}", f"--out={tmp_path / 'run'}")
    code, said = ran("train", "package:study", "--small", *where, *changes)
    assert code == 0, said
    weights = tmp_path / "run" / "study-small.safetensors"
    assert load_synthesizer(weights, device="cpu").traits.splat == splat
    out = f"--out={tmp_path / 'report'}"
    code, said = ran("evaluate", f"--weights={weights}", "--no-baselines", f"--data={valid}", out)
    assert code == 0, said
    (record,) = Run.read(tmp_path / "report").records
    assert record.privileged == (splat == "given")
