"""The objective against formulas written out here, and the laws of its random draws."""

from dataclasses import replace

import msgspec
import pytest
import torch
from tiny_world import FRAMES, TinyClips, noise_batch, tiny_recipe
from torch import Tensor
from torch.testing import assert_close

from gcd_model.networks import Networks, random_networks
from gcd_model.weights.card import FAMILIES
from gcd_train.data.batches import SampleBatches
from gcd_train.data.sample import to_network
from gcd_train.recipe import LossRecipe, NoiseRecipe, UNetRecipe
from gcd_train.training.objective import Batch, Denoiser, diffusion_loss, draw_noise, draw_sigma, drop_streams
from gcd_train.training.setup import Draws, Precision, model_config

CPU = torch.device("cpu")
PRECISION = Precision(CPU, half=False, channels_last=False)
PAPER = LossRecipe()


def draws(update: int = 0) -> Draws:
    return Draws(1, "test", update, CPU)


def tiny_networks(prediction: str) -> Networks:
    config = msgspec.structs.replace(model_config(tiny_recipe().model), prediction=prediction)
    return random_networks(config, seed=2)


def batch_of(networks: Networks, clips: int) -> Batch:
    return noise_batch(networks.config, draws(99), clips * FRAMES, FRAMES)


def network_output(networks: Networks, noisy: Tensor, sigma: Tensor, batch: Batch) -> Tensor:
    plan = networks.unet.plan(0.25 * sigma.log()[None], batch.vector, None, None)
    scaled = noisy / (sigma**2 + 1).sqrt()[:, None, None, None]
    return networks.unet(scaled, batch.condition, *plan.step(0))


@pytest.mark.parametrize("step", [0, 2500, 5000])
def test_loss_and_gradient_equal_the_papers_formula_on_fixed_noise(step: int) -> None:
    networks = tiny_networks("v")
    batch, noise = batch_of(networks, 2), NoiseRecipe()
    denoiser = Denoiser(networks.unet, "v")
    loss = diffusion_loss(denoiser, batch, draws(), PRECISION, noise=noise, loss=PAPER, channel_weights=None, step=step)
    probe = networks.unet.conv_out.weight
    (gradient,) = torch.autograd.grad(loss.total, probe)

    again = draws()
    sigma = draw_sigma(again, 2, noise).repeat_interleave(FRAMES)
    unit = draw_noise(again, batch.target.shape, FRAMES, 0.0)
    wide = sigma[:, None, None, None]
    v = (unit - wide * batch.target) / (1 + wide**2).sqrt()
    raw = network_output(networks, batch.target + wide * unit, sigma, batch)
    errors = ((raw - v) ** 2).flatten(1)  # unit weight on v
    kept = {0: 1.0, 2500: 0.55, 5000: 0.1}[step]
    top = errors.sort(dim=1, descending=True).values[:, : int(errors.shape[1] * kept)].mean(1)
    expected = (0.9 * top + 0.1 * errors.mean(1)).mean()
    (expected_gradient,) = torch.autograd.grad(expected, probe)
    assert_close(loss.total, expected, rtol=1e-4, atol=1e-5)
    assert_close(gradient, expected_gradient, rtol=1e-3, atol=1e-4)


def test_an_x0_network_is_asked_for_the_clean_latents() -> None:
    networks = tiny_networks("x0")
    batch = batch_of(networks, 1)
    noise, recipe = NoiseRecipe(fixed_share=1.0), LossRecipe(focal=False, weight_limit=5.0)
    loss = diffusion_loss(
        Denoiser(networks.unet, "x0"), batch, draws(), PRECISION,
        noise=noise, loss=recipe, channel_weights=None, step=0,
    )  # fmt: skip
    again = draws()
    sigma = draw_sigma(again, 1, noise).repeat_interleave(FRAMES)
    unit = draw_noise(again, batch.target.shape, FRAMES, 0.0)
    raw = network_output(networks, batch.target + 80 * unit, sigma, batch)
    assert_close(loss.total, ((raw - batch.target) ** 2).mean() * (1 + 1 / 6400), rtol=1e-4, atol=1e-5)


def test_noise_levels_are_log_normal_and_a_share_of_the_clips_gets_the_fixed_one() -> None:
    logs = draw_sigma(draws(), 20000, NoiseRecipe()).log()
    assert (logs.mean().item(), logs.std().item()) == (pytest.approx(1.0, abs=0.05), pytest.approx(1.6, abs=0.05))
    fixed = draw_sigma(draws(), 20000, NoiseRecipe(fixed_share=0.6)) == 80.0
    assert fixed.double().mean().item() == pytest.approx(0.6, abs=0.02)


@pytest.mark.parametrize(("shared", "correlation"), [(0.0, 0.0), (0.9, 0.9), (1.0, 1.0)])
def test_frames_of_a_clip_share_as_much_noise_as_the_recipe_says(shared: float, correlation: float) -> None:
    noise = draw_noise(draws(), torch.Size((4, 4, 50, 50)), 2, shared).unflatten(0, (2, 2))
    assert noise.std().item() == pytest.approx(1.0, abs=0.03)
    assert (noise[:, 0] * noise[:, 1]).mean().item() == pytest.approx(correlation, abs=0.05)
    assert (noise[0] * noise[1]).mean().item() == pytest.approx(0.0, abs=0.05)


def pixel_batch(augmentation: float, dropout: float = 0.0) -> tuple[Batch, Networks, Tensor]:
    networks = tiny_networks("v")
    recipe = tiny_recipe().unet
    changed: UNetRecipe = msgspec.structs.replace(
        recipe, image_share=0.0, loss=LossRecipe(), augmentation=augmentation, dropout=dropout
    )
    source = to_network(TinyClips(1).sample(0).source)
    batches = SampleBatches(TinyClips(1), networks, changed, FAMILIES["driving"], PRECISION)
    return batches.batch(draws(), 1), networks, source


@pytest.mark.parametrize("strength", [0.02, 0.0])
def test_augmentation_noise_is_added_to_the_pixels_the_encoder_sees(strength: float) -> None:
    batch, networks, source = pixel_batch(strength)
    noisy = source + (strength * draws().normal(*source.shape) if strength else 0)
    channels = networks.config.vae.latent_channels
    assert_close(batch.condition[:, :channels], networks.condition_encoder(noisy).mean)


def test_draws_follow_from_seed_stage_and_update_alone() -> None:
    assert torch.equal(draws(5).normal(3), draws(5).normal(3))
    assert not torch.equal(draws(5).normal(3), draws(6).normal(3))
    assert not torch.equal(draws(5).normal(3), Draws(2, "test", 5, CPU).normal(3))


def dropped(frames: int = 4, **options: object) -> tuple[Tensor, Tensor]:
    """Which of 400 clips' frames keep latents and token, bool [400, T] each."""
    recipe = msgspec.structs.replace(tiny_recipe().unet, dropout=0.3, **options)
    rows = 400 * frames
    condition, tokens = drop_streams(torch.ones(rows, 2, 3, 3), torch.ones(rows, 5), frames, draws(), recipe)
    assert tokens is not None
    kept = condition.flatten(1).bool(), tokens.bool()
    assert all(bool((rows == rows[:, :1]).all()) for rows in kept)  # a frame goes as a whole
    latents, images = (rows[:, 0].unflatten(0, (400, frames)) for rows in kept)
    for stream in (latents, images):
        assert 0.62 < float(stream.float().mean()) < 0.78
    return latents, images


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("per", ["frame", "clip"])  # "frame" and not joint: as released
def test_frames_or_clips_are_dropped_and_both_streams_together_or_each_by_itself(per: str, joint: bool) -> None:
    latents, images = dropped(dropout_per=per, dropout_joint=joint)
    for stream in (latents, images):
        assert bool((stream == stream[:, :1]).all()) == (per == "clip")
    assert bool((latents == images).all()) == joint
    if not joint and per == "frame":
        both, alone = float((~latents & ~images).float().mean()), float((~latents & images).float().mean())
        assert 0.06 < both < 0.12  # 0.3 * 0.3
        assert 0.17 < alone < 0.25  # 0.3 * 0.7


def test_without_dropout_nothing_is_drawn() -> None:
    recipe = msgspec.structs.replace(tiny_recipe().unet, dropout=0.0)
    rows, later = torch.ones(8, 2, 3, 3), draws()
    condition, tokens = drop_streams(rows, None, 4, later, recipe)
    assert condition is rows
    assert tokens is None
    assert torch.equal(later.normal(3), draws().normal(3))


def test_the_recipe_chooses_the_blend_and_how_long_the_data_took_is_told_beside_the_loss() -> None:
    networks = tiny_networks("v")
    batch, denoiser = replace(batch_of(networks, 1), wait_s=0.25, ids=("a",)), Denoiser(networks.unet, "v")
    released, plain = (
        diffusion_loss(
            denoiser, batch, draws(), PRECISION,
            noise=NoiseRecipe(), loss=LossRecipe(focal_blend=blend), channel_weights=None, step=5000,
        )
        for blend in ("released", "plain")
    )  # fmt: skip
    assert plain.total.item() > released.total.item()  # the hardest alone, without a tenth of the mean of all
    assert (float(plain.parts["wait_s"]), plain.ids) == (0.25, ("a",))
