"""What `encode` and `render` refuse, and that the message says what to do."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from small_models import TINY, draw, random_clip, tiny_synthesizer
from torch import nn

from gcd_model.clip import Augmentation, Clip, RenderOptions
from gcd_model.conditioning import SourceFeatures
from gcd_model.errors import NonFiniteError, OptionError, ShapeError
from gcd_model.geometry import SphericalDelta, Trajectory, pose_trajectory
from gcd_model.synthesizer import Synthesizer, synthesize

LATENTS = (TINY.frames, 4, TINY.height // 4, TINY.width // 4)


@pytest.fixture(scope="module")
def synthesizer() -> Synthesizer:
    return tiny_synthesizer()


def path(synthesizer: Synthesizer) -> Trajectory:
    return synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=30.0))


@pytest.mark.parametrize("shape", [(3, 4, 8, 8), (2, *LATENTS)])
def test_initial_noise_of_another_shape_is_refused(synthesizer: Synthesizer, shape: tuple[int, ...]) -> None:
    features = synthesizer.encode(random_clip())
    with pytest.raises(OptionError):
        synthesizer.render(features, [path(synthesizer)], RenderOptions(initial_noise=draw(*shape)))


def test_augmentation_noise_of_another_shape_is_refused(synthesizer: Synthesizer) -> None:
    with pytest.raises(ShapeError):
        synthesizer.encode(random_clip(), Augmentation(noise=draw(3, 3, 8, 8)))


@pytest.mark.parametrize(("height", "width"), [(30, 64), (0, 64)])
def test_a_size_the_network_cannot_take_is_refused_with_the_size_it_was_trained_on(
    synthesizer: Synthesizer, height: int, width: int
) -> None:
    with pytest.raises(OptionError):
        synthesizer.encode(Clip(video=torch.zeros(3, 3, height, width), fps=12.0))


@pytest.mark.parametrize("shape", [(3, 32, 64), (3, 1, 32, 64), (1, 3, 3, 32, 64)])
def test_a_clip_that_is_no_list_of_colour_pictures_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError):
        Clip(video=torch.zeros(shape), fps=12.0)


def test_a_clip_in_another_type_or_without_frame_rate_is_refused() -> None:
    with pytest.raises(ShapeError):
        Clip(video=torch.zeros(3, 3, 8, 8, dtype=torch.uint8), fps=12.0)
    for fps in (0.0, -1.0, float("nan")):
        with pytest.raises(OptionError):
            Clip(video=torch.zeros(3, 3, 8, 8), fps=fps)


@pytest.mark.parametrize("frames", [2, 4])
def test_clip_and_trajectory_must_have_the_trained_length(synthesizer: Synthesizer, frames: int) -> None:
    features = synthesizer.encode(random_clip())
    with pytest.raises(ShapeError):
        synthesizer.render(synthesizer.encode(random_clip(frames=frames)), [path(synthesizer)])
    still = pose_trajectory(torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1))
    with pytest.raises(ShapeError):
        synthesizer.render(features, [still])


def test_at_least_one_trajectory_sample_and_step_are_wanted(synthesizer: Synthesizer) -> None:
    with pytest.raises(ShapeError):
        synthesizer.render(synthesizer.encode(random_clip()), [])
    with pytest.raises(OptionError):
        RenderOptions(samples=0)
    with pytest.raises(OptionError):
        RenderOptions(steps=0)


def _unet_end(synthesizer: Synthesizer) -> nn.Conv2d:
    return synthesizer.networks.unet.conv_out


def _decoder_end(synthesizer: Synthesizer) -> nn.Conv2d:
    return synthesizer.networks.decoder.conv_out


@pytest.mark.parametrize("part", [_unet_end, _decoder_end])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_network_that_gives_nan_or_infinity_raises(part: Callable[[Synthesizer], nn.Conv2d], value: float) -> None:
    broken = tiny_synthesizer()
    with torch.no_grad():
        part(broken).weight.fill_(value)
    with pytest.raises(NonFiniteError):
        synthesize(broken, random_clip(), path(broken))


def test_without_a_family_the_motion_number_must_be_given() -> None:
    unknown = tiny_synthesizer(family_known=False)
    features = unknown.encode(random_clip())
    with pytest.raises(OptionError):
        unknown.render(features, [path(unknown)])
    (view,) = unknown.render(features, [path(unknown)], RenderOptions(motion_bucket=127.0))
    assert view.motion_bucket == 127.0


def test_features_of_another_kind_are_not_joined() -> None:
    latents = torch.zeros(2, 4, 1, 1)
    plain = SourceFeatures(tokens=None, latents=latents, extra=None, fps=12.0, augmentation=0.02)
    for other in (replace(plain, tokens=torch.zeros(2, 5)), replace(plain, extra=latents), replace(plain, fps=6.0)):
        with pytest.raises(ShapeError):
            plain.followed_by(other)
