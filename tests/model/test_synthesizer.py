"""The door: what `encode` and `render` promise, on the smallest network that has every part, and on its variants."""

import math
import threading
from collections.abc import Callable
from dataclasses import replace

import msgspec
import pytest
import torch
from small_models import TINY, draw, random_clip, relative_error, synthesize, tiny_synthesizer
from torch import Tensor, nn
from torch.testing import assert_close

from gcd_model.clip import Augmentation, Clip
from gcd_model.conditioning import (
    CameraEmbedder,
    SourceFeatures,
    relative_pose_features,
    spherical_features,
    with_unconditional,
)
from gcd_model.config import ModelConfig, SamplingConfig
from gcd_model.diffusion import RenderOptions, unit_noise
from gcd_model.errors import Cancelled, ModelError, NonFiniteError, OptionError, ShapeError
from gcd_model.geometry import SphericalDelta, Trajectory, pose_trajectory
from gcd_model.synthesizer import Synthesizer

LATENTS = (TINY.frames, 4, TINY.height // 4, TINY.width // 4)


@pytest.fixture(scope="module")
def synthesizer() -> Synthesizer:
    return tiny_synthesizer()


def paths(synthesizer: Synthesizer) -> list[Trajectory]:
    goals = [(30.0, 10.0, 1.0), (-80.0, 0.0, 0.0), (0.0, 20.0, -2.0)]
    return [
        synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=azimuth, elevation_deg=elevation, radius_m=radius))
        for azimuth, elevation, radius in goals
    ]


def path(synthesizer: Synthesizer) -> Trajectory:
    return paths(synthesizer)[0]


def test_a_view_has_one_picture_per_frame_in_zero_to_one_and_the_latents_they_were_decoded_from(
    synthesizer: Synthesizer,
) -> None:
    view = synthesize(synthesizer, random_clip(), path(synthesizer))
    assert view.video.shape == (TINY.frames, 3, TINY.height, TINY.width)
    assert view.video.dtype == view.latents.dtype == torch.float32
    assert view.video.min() >= 0.0
    assert view.video.max() <= 1.0
    assert view.latents.shape == (1, *LATENTS)
    with torch.inference_mode():
        decoded = synthesizer.networks.decoder(view.latents[0] / 0.18215, TINY.frames)
    assert_close(view.video, torch.clamp((decoded + 1) / 2, 0, 1))


def test_several_views_and_samples_in_one_batch_equal_each_alone(synthesizer: Synthesizer) -> None:
    features = synthesizer.encode(random_clip())
    together = synthesizer.render(features, paths(synthesizer), RenderOptions(samples=2, seed=5))
    for one, view in zip(paths(synthesizer), together, strict=True):
        (alone,) = synthesizer.render(features, [one], RenderOptions(seed=5))
        assert relative_error(view.latents[:1], alone.latents) < 1e-5
        assert relative_error(view.samples[:1], alone.samples) < 1e-5
        assert view.motion_bucket == alone.motion_bucket
        second = RenderOptions(initial_noise=unit_noise(LATENTS, 5, stream=2))
        (alone,) = synthesizer.render(features, [one], second)
        assert relative_error(view.latents[1:], alone.latents) < 1e-5
    assert len({view.motion_bucket for view in together}) == 3


def test_the_uncertainty_is_the_population_deviation_over_samples_averaged_over_colours(
    synthesizer: Synthesizer,
) -> None:
    features = synthesizer.encode(random_clip())
    (view,) = synthesizer.render(features, [path(synthesizer)], RenderOptions(samples=3))
    mean = view.samples.mean(dim=0)
    expected = ((view.samples - mean) ** 2).mean(dim=0).sqrt().mean(dim=1)
    assert view.std is not None
    assert view.std.shape == (TINY.frames, TINY.height, TINY.width)
    assert_close(view.std, expected)
    assert view.std.max() > 0
    assert synthesize(synthesizer, random_clip(), path(synthesizer)).std is None


def test_injected_noise_reproduces_the_draws_it_stands_for(synthesizer: Synthesizer) -> None:
    clip = random_clip()
    drawn = synthesizer.encode(clip, Augmentation(seed=8))
    given = synthesizer.encode(clip, Augmentation(noise=unit_noise(tuple(clip.video.shape), 8)))
    assert torch.equal(drawn.latents, given.latents)
    (by_seed,) = synthesizer.render(drawn, [path(synthesizer)], RenderOptions(seed=8, samples=2))
    noise = torch.stack([unit_noise(LATENTS, 8, stream=1 + sample) for sample in range(2)])
    (by_noise,) = synthesizer.render(drawn, [path(synthesizer)], RenderOptions(initial_noise=noise, samples=2))
    assert torch.equal(by_seed.samples, by_noise.samples)


def test_the_number_of_steps_is_the_checkpoints_unless_asked_and_progress_counts_them(synthesizer: Synthesizer) -> None:
    features, seen = synthesizer.encode(random_clip()), list[tuple[int, int]]()

    def note(done: int, total: int) -> None:
        seen.append((done, total))

    synthesizer.render(features, [path(synthesizer)], RenderOptions(progress=note))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    seen.clear()
    synthesizer.render(features, [path(synthesizer)], RenderOptions(progress=note, steps=1))
    assert seen == [(1, 1)]
    seen.clear()
    synthesizer.render(features, [path(synthesizer)], RenderOptions(progress=note, steps=2, solver="heun"))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_cancelling_between_two_steps_raises_and_leaves_the_synthesizer_usable(synthesizer: Synthesizer) -> None:
    features, stop = synthesizer.encode(random_clip()), threading.Event()

    def note(done: int, _total: int) -> None:
        if done == 2:
            stop.set()

    with pytest.raises(Cancelled):
        synthesizer.render(features, [path(synthesizer)], RenderOptions(progress=note, cancel=stop))
    stop.clear()
    (view,) = synthesizer.render(features, [path(synthesizer)], RenderOptions(cancel=stop))
    assert view.samples.isfinite().all()


def test_features_of_parts_joined_equal_features_of_the_whole_clip(synthesizer: Synthesizer) -> None:
    clip = random_clip(frames=5)
    noise = draw(*clip.video.shape, seed=2)
    whole = synthesizer.encode(clip, Augmentation(noise=noise))

    def part(start: int, stop: int) -> tuple[Clip, Augmentation]:
        return Clip(video=clip.video[start:stop], fps=clip.fps), Augmentation(noise=noise[start:stop])

    joined = synthesizer.encode(*part(0, 3)).followed_by(synthesizer.encode(*part(3, 5))).rows(1, 4)
    assert joined.tokens is not None
    assert whole.tokens is not None
    assert relative_error(joined.tokens, whole.tokens[1:4]) < 1e-5
    assert relative_error(joined.latents, whole.latents[1:4]) < 1e-5


def test_off_the_cpu_all_frames_are_encoded_at_once(synthesizer: Synthesizer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU has the memory, and each call costs it as much as another frame."""
    seen = list[tuple[str, int]]()

    class Elsewhere:
        like = torch.empty(0, device="meta")

        def tokens(self, frames: Tensor) -> Tensor:
            seen.append((frames.device.type, len(frames)))
            return frames

        condition_mean = tokens

    monkeypatch.setattr(synthesizer, "_engine", Elsewhere())
    synthesizer.encode(random_clip(), Augmentation(strength=0.0))
    assert seen == [("meta", TINY.frames)] * 2


def test_the_motion_number_comes_from_the_formula_unless_it_is_given(synthesizer: Synthesizer) -> None:
    features = synthesizer.encode(random_clip())
    (view,) = synthesizer.render(features, [path(synthesizer)])
    assert view.motion_bucket == round(255 * (30**2 + 10**2) ** 0.5 / (90**2 + 30**2) ** 0.5)
    (other,) = synthesizer.render(features, [path(synthesizer)], RenderOptions(motion_bucket=200.0))
    assert other.motion_bucket == 200.0
    assert not torch.allclose(view.latents, other.latents, atol=1e-4)


class _Calls:
    """What the U-Net was called with."""

    def __init__(self, synthesizer: Synthesizer) -> None:
        self.inputs: list[tuple[Tensor, Tensor]] = []
        synthesizer.networks.unet.register_forward_pre_hook(lambda _, given: self.inputs.append(given[:2]))


def test_guidance_of_one_throughout_runs_the_conditional_branch_alone_and_gives_its_result() -> None:
    synthesizer = tiny_synthesizer()
    calls, features = _Calls(synthesizer), synthesizer.encode(random_clip())
    (alone,) = synthesizer.render(features, [path(synthesizer)], RenderOptions(guidance=(1.0, 1.0)))
    assert all(noisy.shape[0] == TINY.frames for noisy, _ in calls.inputs)
    calls.inputs.clear()
    (both,) = synthesizer.render(features, [path(synthesizer)], RenderOptions(guidance=(1.0, 1.0 + 1e-12)))
    assert all(noisy.shape[0] == 2 * TINY.frames for noisy, _ in calls.inputs)
    assert relative_error(alone.latents, both.latents) < 1e-5


@pytest.mark.parametrize("shape", [(3, 4, 8, 8), (2, *LATENTS)])
def test_noise_of_another_shape_is_refused(synthesizer: Synthesizer, shape: tuple[int, ...]) -> None:
    features = synthesizer.encode(random_clip())
    with pytest.raises(OptionError):
        synthesizer.render(features, [path(synthesizer)], RenderOptions(initial_noise=draw(*shape)))
    with pytest.raises(ShapeError):
        synthesizer.encode(random_clip(), Augmentation(noise=draw(*shape)))


@pytest.mark.parametrize(
    ("video", "fps", "error"),
    [
        (torch.zeros(3, 32, 64), 12.0, ShapeError),
        (torch.zeros(3, 1, 32, 64), 12.0, ShapeError),
        (torch.zeros(1, 3, 3, 32, 64), 12.0, ShapeError),
        (torch.zeros(3, 3, 8, 8, dtype=torch.uint8), 12.0, ShapeError),
        (torch.zeros(3, 3, 32, 64), 0.0, OptionError),
        (torch.zeros(3, 3, 32, 64), -1.0, OptionError),
        (torch.zeros(3, 3, 32, 64), float("nan"), OptionError),
        (torch.zeros(3, 3, 30, 64), 12.0, OptionError),
        (torch.zeros(3, 3, 0, 64), 12.0, OptionError),
    ],
)
def test_a_clip_that_is_none_or_of_a_size_the_network_cannot_take_is_refused(
    synthesizer: Synthesizer, video: Tensor, fps: float, error: type[ModelError]
) -> None:
    with pytest.raises(error):
        synthesizer.encode(Clip(video=video, fps=fps))


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
    plain = SourceFeatures(tokens=None, latents=latents, fps=12.0, augmentation=0.02)
    for other in (replace(plain, tokens=torch.zeros(2, 5)), replace(plain, fps=6.0)):
        with pytest.raises(ShapeError):
            plain.followed_by(other)


def with_unet(**changes: object) -> ModelConfig:
    """TINY with other fields in its U-Net."""
    return msgspec.structs.replace(TINY, unet=msgspec.structs.replace(TINY.unet, **changes))


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


def test_angles_become_cosines_and_sines_of_one_two_and_four_times_in_radians_and_the_radius_stays() -> None:
    azimuth, elevation = math.radians(30.0), math.radians(-10.0)
    expected = [
        function(multiple * angle)
        for angle in (azimuth, elevation)
        for multiple in (1, 2, 4)
        for function in (math.cos, math.sin)
    ]
    features = spherical_features(torch.tensor([[30.0, -10.0, 1.5]], dtype=torch.float64))
    assert_close(features, torch.tensor([[*expected, 1.5]]))
    recorded = [0.866025, 0.5, 0.5, 0.866025, -0.5, 0.866025]  # worked out by hand for 30 degrees
    assert_close(features[0, :6], torch.tensor(recorded), atol=1e-6, rtol=0)


def test_relative_poses_become_their_top_three_rows_row_by_row() -> None:
    poses = torch.arange(32, dtype=torch.float64).reshape(2, 4, 4)
    expected = [list(range(12)), list(range(16, 28))]
    assert relative_pose_features(poses).tolist() == expected
    assert relative_pose_features(poses).dtype == torch.float32


def test_a_free_path_is_refused_by_spherical_control_with_the_way_out() -> None:
    free = pose_trajectory(torch.eye(4, dtype=torch.float64).repeat(3, 1, 1))
    with pytest.raises(ShapeError):
        CameraEmbedder("spherical", 5)(free)


@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize("rows", [draw(3, 5), draw(3, 4, 2, 3)], ids=["tokens", "latents"])
def test_the_unconditional_branch_comes_first_and_sees_zeros_in_both_image_streams(rows: Tensor, views: int) -> None:
    both = with_unconditional(rows, views, True).unflatten(0, (2, views, 3))
    assert not both[0].any()
    assert torch.equal(both[1], rows.expand_as(both[1]))
    assert torch.equal(with_unconditional(rows, views, False), both[1].flatten(0, 1))


def test_condition_latents_are_the_posterior_mean_of_the_noised_frames_and_not_scaled() -> None:
    synthesizer, clip = tiny_synthesizer(), random_clip()
    noise = draw(*clip.video.shape, seed=7)
    features = synthesizer.encode(clip, Augmentation(strength=0.3, noise=noise))
    with torch.inference_mode():
        posterior = synthesizer.networks.condition_encoder(clip.video + 0.3 * noise)
    assert TINY.vae.scale == 0.18215
    assert_close(features.latents, posterior.mean)
    assert features.augmentation == 0.3


def test_the_image_tower_sees_the_frames_clean() -> None:
    synthesizer, clip = tiny_synthesizer(), random_clip()
    clean = synthesizer.encode(clip, Augmentation(strength=0.0))
    noisy = synthesizer.encode(clip, Augmentation(strength=0.5))
    assert clean.tokens is not None
    assert noisy.tokens is not None
    assert torch.equal(clean.tokens, noisy.tokens)
    assert not torch.allclose(clean.latents, noisy.latents)
