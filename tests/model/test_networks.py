"""Parts, autoencoders and image tower: against plain formulas, diffusers and transformers."""

import kornia
import pytest
import torch
import torch.nn.functional as F
from diffusers.models.autoencoders.autoencoder_kl_temporal_decoder import AutoencoderKLTemporalDecoder
from published import diffusers_state
from small_models import draw, randomise, relative_error
from torch import Tensor, nn
from torch.testing import assert_close
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from gcd_model.conditioning import ImageEncoder, clip_pixels
from gcd_model.config import ImageEncoderConfig, VAEConfig
from gcd_model.layers import Derived, TemporalShare, TokenAttention, Upsample, VideoResBlock, prepare
from gcd_model.unet import FramePositions
from gcd_model.vae import Encoder, Posterior, TemporalDecoder


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (4, 6)])
@pytest.mark.parametrize("prepared", [False, True])
def test_up_sampling_by_phases_equals_nearest_neighbour_then_convolution(
    height: int, width: int, prepared: bool
) -> None:
    up = Upsample(5).double()
    randomise(up)
    if prepared:
        prepare(up)
    x = draw(2, 5, height, width).double()
    plain = F.conv2d(F.interpolate(x, scale_factor=2.0, mode="nearest"), up.conv.weight, up.conv.bias, padding=1)
    assert relative_error(up(x), plain) < 1e-12


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_a_video_block_normalises_over_all_frames_of_a_clip_and_of_no_other(frames: int) -> None:
    share = TemporalShare(of_sigmoid="space", initial=0.3)
    block = VideoResBlock(8, 8, groups=2, embedding_width=None, eps=1e-5, share=share)
    randomise(block)
    clips = draw(2, frames, 8, 3, 4, seed=frames)
    together = block(clips.flatten(0, 1), frames)
    alone = torch.cat([block(clip, frames) for clip in clips])
    assert_close(together, alone)
    shifted = clips.clone()
    shifted[:, -1] *= 3
    changed = block(shifted.flatten(0, 1), frames).unflatten(0, (2, frames))[:, 0]
    assert not torch.allclose(changed, together.unflatten(0, (2, frames))[:, 0], atol=1e-3)


@pytest.mark.parametrize(
    "module",
    [Upsample(4), FramePositions(4, 3), TemporalShare(of_sigmoid="space", initial=0.5)],
    ids=lambda module: type(module).__name__,
)
def test_a_derived_value_carries_gradient_and_once_prepared_is_kept_until_weights_dtype_or_mode_change(
    module: Derived[Tensor],
) -> None:
    model = nn.Sequential(module).train()
    before = module.derived()
    assert before.requires_grad
    assert module.derived() is not before
    prepare(model)
    old = module.derived()
    assert not module.training
    assert module.derived() is old
    assert not old.requires_grad
    assert_close(old, before.detach())
    model.load_state_dict({name: value + 1 for name, value in model.state_dict().items()})
    assert not torch.allclose(module.derived(), old)
    prepare(model)
    model.double()
    assert module.derived().dtype == torch.float64
    prepare(model)
    kept = module.derived()
    model.train()
    assert module.derived() is not kept
    assert module.derived().requires_grad


def test_dormant_weights_survive_the_round_trip_but_are_never_moved_cast_or_trained() -> None:
    attention = TokenAttention(8, 6)
    attention.double().to("meta")
    assert attention.value.weight.device.type == "meta"
    for parameter in attention.dormant.parameters():
        assert parameter.device.type == "cpu"
        assert parameter.dtype == torch.float32
        assert not parameter.requires_grad
    assert {name for name in attention.state_dict() if name.startswith("dormant.")} == {
        "dormant.query",
        "dormant.key",
        "dormant.norm_weight",
        "dormant.norm_bias",
    }


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


def test_encoder_and_temporal_decoder_equal_diffusers(ours: _Vae, theirs: AutoencoderKLTemporalDecoder) -> None:
    frames, latents = draw(2, 3, 32, 48), draw(2 * FRAMES, 4, 4, 6)
    with torch.inference_mode():
        (posterior,) = theirs.encode(frames, return_dict=False)
        (pictures,) = theirs.decode(latents, num_frames=FRAMES, return_dict=False)
        result, decoded = ours.encoder(frames), ours.decoder(latents, FRAMES)
    assert (result.mean.shape, decoded.shape) == ((2, 4, 4, 6), (6, 3, 32, 48))
    assert relative_error(result.mean, posterior.mean) < 1e-5
    assert relative_error(result.log_variance, posterior.logvar) < 1e-5
    assert relative_error(decoded, pictures) < 1e-5


def test_a_fresh_decoder_has_temporal_branches_that_add_nothing_even_shares_and_the_published_epsilons() -> None:
    decoder = TemporalDecoder(VAE)
    blocks = [module for module in decoder.modules() if isinstance(module, VideoResBlock)]
    assert len(blocks) == 4 * 3 + 2
    for block in blocks:
        assert block.share.mix.item() == 0.0
        x = draw(FRAMES, block.spatial.norm1.num_channels, 2, 2)
        assert torch.equal(block(x, FRAMES), block.spatial(x))
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


def test_patches_make_an_autoencoder_coarser_and_unrelated_frames_are_decoded_apart() -> None:
    encoder, decoder = Encoder(PATCHED, quant=True), TemporalDecoder(PATCHED)
    randomise(decoder)
    latents = encoder(draw(5, 3, 16, 24)).mean
    assert (PATCHED.down_factor, latents.shape) == (4, (5, 6, 4, 6))
    apart = decoder(latents, None)
    assert apart.shape == (5, 3, 16, 24)
    assert_close(apart[3:4], decoder(latents[3:4], None))
    assert relative_error(decoder(latents, 5), apart) > 1e-3


TOWER = ImageEncoderConfig(image_size=28, patch=7, width=32, layers=3, heads=4, hidden_width=64, output_width=24)


def test_the_image_token_equals_transformers() -> None:
    ours = ImageEncoder(TOWER)
    randomise(ours)
    theirs = CLIPVisionModelWithProjection(
        CLIPVisionConfig(
            image_size=TOWER.image_size,
            patch_size=TOWER.patch,
            hidden_size=TOWER.width,
            intermediate_size=TOWER.hidden_width,
            num_hidden_layers=TOWER.layers,
            num_attention_heads=TOWER.heads,
            projection_dim=TOWER.output_width,
            hidden_act="gelu",
        )
    ).eval()
    theirs.load_state_dict(diffusers_state(ours, "image_encoder", "image_encoder/"))
    pixels = draw(3, 3, 28, 28)
    with torch.inference_mode():
        expected, result = theirs(pixels).image_embeds, ours(pixels)
    assert result.shape == (3, 24)
    assert relative_error(result, expected) < 1e-5


@pytest.mark.parametrize(("height", "width"), [(64, 96), (300, 200), (224, 224), (30, 400)])
def test_pixels_are_squeezed_by_kornias_antialiased_bicubic_before_the_range_changes(height: int, width: int) -> None:
    frames = draw(2, 3, height, width).clamp(-1, 1)
    squeezed = kornia.geometry.resize(frames, (224, 224), interpolation="bicubic", align_corners=True, antialias=True)
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073]).reshape(3, 1, 1)
    deviation = torch.tensor([0.26862954, 0.26130258, 0.27577711]).reshape(3, 1, 1)
    assert_close(clip_pixels(frames, 224), ((squeezed + 1) / 2 - mean) / deviation)
