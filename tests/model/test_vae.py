"""The autoencoders against diffusers, and what the published layout asks of them."""

import pytest
import torch
from diffusers.models.autoencoders.autoencoder_kl_temporal_decoder import AutoencoderKLTemporalDecoder
from naming import diffusers_state
from small_models import draw, randomise, relative_error
from torch import nn
from torch.testing import assert_close

from gcd_model.config import VAEConfig
from gcd_model.layers import VideoResBlock, prepare
from gcd_model.vae import Encoder, Posterior, TemporalDecoder

VAE = VAEConfig(width=32, multipliers=(1, 2, 4, 4), norm_groups=32)
FRAMES = 3


class _Vae(nn.Module):
    """What one diffusers autoencoder holds."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder(VAE, quant=True)
        self.decoder = TemporalDecoder(VAE)
        randomise(self)
        prepare(self)


@pytest.fixture(scope="module")
def ours() -> _Vae:
    return _Vae()


@pytest.fixture(scope="module")
def theirs(ours: _Vae) -> AutoencoderKLTemporalDecoder:
    model = AutoencoderKLTemporalDecoder(
        down_block_types=("DownEncoderBlock2D",) * 4,  # pyright: ignore[reportArgumentType]
        block_out_channels=VAE.widths,  # pyright: ignore[reportArgumentType]
        layers_per_block=VAE.blocks_per_level,
    ).eval()
    encoder = diffusers_state(ours.encoder, "target_encoder", "vae/")
    model.load_state_dict(encoder | diffusers_state(ours.decoder, "decoder", "vae/"))
    return model


def test_the_encoder_equals_diffusers(ours: _Vae, theirs: AutoencoderKLTemporalDecoder) -> None:
    frames = draw(2, 3, 32, 48)
    with torch.inference_mode():
        (expected,) = theirs.encode(frames, return_dict=False)
        result = ours.encoder(frames)
    assert result.mean.shape == (2, 4, 4, 6)
    assert relative_error(result.mean, expected.mean) < 1e-5
    assert relative_error(result.log_variance, expected.logvar) < 1e-5


def test_the_temporal_decoder_equals_diffusers(ours: _Vae, theirs: AutoencoderKLTemporalDecoder) -> None:
    latents = draw(2 * FRAMES, 4, 4, 6)
    with torch.inference_mode():
        (expected,) = theirs.decode(latents, num_frames=FRAMES, return_dict=False)
        result = ours.decoder(latents, FRAMES)
    assert result.shape == (6, 3, 32, 48)
    assert relative_error(result, expected) < 1e-5


def test_a_fresh_decoder_has_temporal_branches_that_add_nothing_and_even_shares() -> None:
    decoder = TemporalDecoder(VAE)
    blocks = [module for module in decoder.modules() if isinstance(module, VideoResBlock)]
    assert len(blocks) == 4 * 3 + 2
    for block in blocks:
        assert block.share.mix.item() == 0.0
        x = draw(FRAMES, block.spatial.norm1.num_channels, 2, 2)
        assert torch.equal(block(x, FRAMES), block.spatial(x))


def test_norms_have_the_published_epsilons() -> None:
    decoder = TemporalDecoder(VAE)
    for name, module in [*decoder.named_modules(), *Encoder(VAE, quant=True).named_modules()]:
        if isinstance(module, nn.GroupNorm):
            assert module.eps == (1e-5 if ".temporal." in name else 1e-6), name


def test_a_posterior_splits_its_moments_clamps_its_spread_and_samples() -> None:
    moments = torch.tensor([1.0, 2.0, -50.0, 50.0]).reshape(1, 4, 1, 1)
    posterior = Posterior.of_moments(moments)
    assert posterior.mean.flatten().tolist() == [1.0, 2.0]
    assert posterior.log_variance.flatten().tolist() == [-30.0, 20.0]
    noise = torch.ones(1, 2, 1, 1)
    expected = torch.tensor([1.0, 2.0]) + torch.exp(torch.tensor([-15.0, 10.0]))
    assert_close(posterior.sample(noise).flatten(), expected)


PATCHED = VAEConfig(latent_channels=6, width=8, multipliers=(1, 2), blocks_per_level=1, norm_groups=4, patch=2)


def test_patches_make_an_autoencoder_coarser_without_another_level() -> None:
    assert PATCHED.down_factor == 4
    encoder, decoder = Encoder(PATCHED, quant=True), TemporalDecoder(PATCHED)
    posterior = encoder(draw(FRAMES, 3, 16, 24))
    assert posterior.mean.shape == (FRAMES, 6, 4, 6)
    assert decoder(posterior.mean, FRAMES).shape == (FRAMES, 3, 16, 24)


def test_unrelated_frames_are_decoded_apart_and_any_number_of_them() -> None:
    decoder, latents = TemporalDecoder(PATCHED), draw(5, 6, 4, 6)
    randomise(decoder)
    together = decoder(latents, None)
    assert_close(together[3:4], decoder(latents[3:4], None))
    assert relative_error(decoder(latents, 5), together) > 1e-3
