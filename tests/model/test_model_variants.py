"""One config scales every part of the model."""

from collections.abc import Callable

import msgspec
import pytest
import torch
from small_models import TINY, draw, random_clip, relative_error, synthesize, tiny_synthesizer

from gcd_model.config import ModelConfig, SamplingConfig
from gcd_model.diffusion import RenderOptions
from gcd_model.errors import OptionError, ShapeError
from gcd_model.geometry import SphericalDelta, Trajectory, pose_trajectory
from gcd_model.synthesizer import Synthesizer

LATENTS = (TINY.frames, 4, TINY.height // 4, TINY.width // 4)


@pytest.fixture(scope="module")
def synthesizer() -> Synthesizer:
    return tiny_synthesizer()


def path(synthesizer: Synthesizer) -> Trajectory:
    return synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=30.0))


def with_unet(**changes: object) -> ModelConfig:
    """TINY with other fields in its U-Net."""
    return msgspec.structs.replace(TINY, unet=msgspec.structs.replace(TINY.unet, **changes))


@pytest.mark.parametrize("channels", [0, 3])
def test_a_checkpoint_with_extra_condition_channels_wants_exactly_those(channels: int) -> None:
    synthesizer = tiny_synthesizer(with_unet(condition_channels=6))
    extra = draw(3, channels, *LATENTS[2:]) if channels else None
    with pytest.raises(ShapeError):
        synthesizer.encode(random_clip(), extra=extra)
    features = synthesizer.encode(random_clip(), extra=draw(3, 2, *LATENTS[2:]))
    assert synthesizer.render(features, [path(synthesizer)])[0].samples.isfinite().all()


def test_a_model_without_image_tower_has_no_tokens_and_still_renders() -> None:
    unet = msgspec.structs.replace(TINY.unet, context_width=None)
    synthesizer = tiny_synthesizer(msgspec.structs.replace(TINY, unet=unet, image_encoder=None))
    assert synthesizer.encode(random_clip()).tokens is None
    assert synthesize(synthesizer, random_clip(), path(synthesizer)).samples.isfinite().all()


@pytest.mark.parametrize("control", ["relative_pose", "none"])
def test_the_other_camera_controls_render_too(control: str) -> None:
    unet = msgspec.structs.replace(TINY.unet, camera_width=0 if control == "none" else TINY.unet.camera_width)
    synthesizer = tiny_synthesizer(msgspec.structs.replace(TINY, unet=unet, camera=control), family_known=False)
    options = RenderOptions(motion_bucket=127.0)
    angle = torch.tensor([0.0, 0.1, 0.2], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    features = synthesizer.encode(random_clip())
    still, moving = synthesizer.render(
        features, [pose_trajectory(poses[:1].repeat(3, 1, 1)), pose_trajectory(poses)], options
    )
    assert (relative_error(still.latents, moving.latents) > 1e-3) == (control == "relative_pose")


def test_networks_in_bfloat16_give_float32_views_near_those_of_float32(synthesizer: Synthesizer) -> None:
    half = tiny_synthesizer()
    for name, network in half.networks.named_children():
        if name != "decoder":
            network.bfloat16()
    exact = synthesize(synthesizer, random_clip(), path(synthesizer))
    rounded = synthesize(half, random_clip(), path(half))
    assert rounded.samples.dtype == rounded.latents.dtype == torch.float32
    assert 0 < relative_error(rounded.latents, exact.latents) < 0.05


def test_a_render_at_another_number_of_frames_levels_and_latent_channels_has_the_shapes_the_config_says() -> None:
    config = ModelConfig(
        frames=5,
        height=16,
        width=32,
        unet=msgspec.structs.replace(
            TINY.unet, latent_channels=8, condition_channels=8, multipliers=(1, 1, 2), attention=(True, False, True)
        ),
        vae=msgspec.structs.replace(TINY.vae, latent_channels=8, multipliers=(1, 2)),
        image_encoder=TINY.image_encoder,
        sampling=SamplingConfig(steps=2),
    )
    assert (config.vae.down_factor, config.unet.size_factor, config.size_factor) == (2, 4, 8)
    synthesizer = tiny_synthesizer(config)
    features = synthesizer.encode(random_clip(config))
    (view,) = synthesizer.render(features, [path(synthesizer)])
    assert view.video.shape == (5, 3, 16, 32)
    assert view.latents.shape == (1, 5, 8, 8, 16)


@pytest.mark.parametrize(
    "make",
    [
        lambda: msgspec.structs.replace(TINY, camera="none"),
        lambda: msgspec.structs.replace(TINY, image_encoder=None),
        lambda: msgspec.structs.replace(TINY, vae=msgspec.structs.replace(TINY.vae, latent_channels=8)),
        lambda: with_unet(attention=(True,)),
        lambda: with_unet(vector_width=25),
        lambda: with_unet(width=12),
        lambda: with_unet(head_width=24),
    ],
)
def test_parts_that_do_not_fit_together_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(OptionError):
        make()
