"""The door: what `encode` and `render` promise, on the smallest networks with every part and on their variants."""

import math
from collections.abc import Callable
from dataclasses import replace

import msgspec
import pytest
import torch
from small_models import (
    TINY,
    TINY_CLASSES,
    TINY_DRIVING,
    draw,
    random_clip,
    relative_error,
    synthesize,
    tiny_driving,
    tiny_synthesizer,
)
from torch import Tensor, nn
from torch.testing import assert_close

from gcd_model.clip import Augmentation, Clip, View, nearest_classes, palette
from gcd_model.conditioning import (
    CameraEmbedder,
    SourceFeatures,
    relative_pose_features,
    spherical_features,
    with_unconditional,
)
from gcd_model.config import DRIVING_CLASSES, ModelConfig, SamplingConfig, SemanticClass
from gcd_model.diffusion import RenderOptions, unit_noise
from gcd_model.errors import ModelError, NonFiniteError, OptionError, ShapeError
from gcd_model.geometry import CameraMount, SphericalDelta, Trajectory, pose_trajectory
from gcd_model.networks import Networks
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


@pytest.mark.parametrize(("options", "evaluations"), [({}, 3), ({"steps": 1}, 1), ({"steps": 2, "solver": "heun"}, 3)])
def test_the_number_of_steps_is_the_checkpoints_unless_asked_and_progress_counts_evaluations(
    synthesizer: Synthesizer, options: dict[str, object], evaluations: int
) -> None:
    features, seen = synthesizer.encode(random_clip()), list[tuple[int, int]]()
    note = RenderOptions(progress=lambda done, total: seen.append((done, total)), **options)  # type: ignore[arg-type]
    synthesizer.render(features, [path(synthesizer)], note)
    assert seen == [(done, evaluations) for done in range(1, evaluations + 1)]


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


def still(frames: int) -> Trajectory:
    return pose_trajectory(torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1))


FEATURES = SourceFeatures(tokens=None, latents=torch.zeros(2, 4, 1, 1), fps=12.0, augmentation=0.02)


def render(synthesizer: Synthesizer, *paths: Trajectory, frames: int | None = None, **options: object) -> list[View]:
    features = synthesizer.encode(random_clip(frames=frames))
    return synthesizer.render(features, paths, RenderOptions(**options))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        *(
            (lambda synthesizer, shape=shape: render(synthesizer, still(3), initial_noise=draw(*shape)), OptionError)
            for shape in [(3, 4, 8, 8), (2, *LATENTS)]
        ),
        (lambda synthesizer: synthesizer.encode(random_clip(), Augmentation(noise=draw(3, 4, 8, 8))), ShapeError),
        *((lambda synthesizer, n=n: render(synthesizer, path(synthesizer), frames=n), ShapeError) for n in (2, 4)),
        *((lambda synthesizer, n=n: render(synthesizer, still(n)), ShapeError) for n in (2, 4)),
        (lambda synthesizer: render(synthesizer), ShapeError),
        (lambda _: RenderOptions(samples=0), OptionError),
        (lambda _: RenderOptions(steps=0), OptionError),
        (lambda _: FEATURES.followed_by(replace(FEATURES, tokens=torch.zeros(2, 5))), ShapeError),
        (lambda _: FEATURES.followed_by(replace(FEATURES, fps=6.0)), ShapeError),
        (lambda _: CameraEmbedder("spherical", 5)(still(3)), ShapeError),  # it is steered by angles
        (lambda synthesizer: synthesizer.traits.plan_view(mount=CameraMount()), OptionError),  # nor by a vehicle
    ],
)
def test_other_lengths_noises_numbers_and_features_are_refused(
    synthesizer: Synthesizer, wrong: Callable[[Synthesizer], object], error: type[ModelError]
) -> None:
    with pytest.raises(error):
        wrong(synthesizer)


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


def with_unet(**changes: object) -> ModelConfig:
    """TINY with other fields in its U-Net."""
    return msgspec.structs.replace(TINY, unet=msgspec.structs.replace(TINY.unet, **changes))


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


def test_other_frames_levels_and_channels_and_no_image_tower_give_the_shapes_the_config_says() -> None:
    config = ModelConfig(
        frames=5,
        height=16,
        width=32,
        unet=msgspec.structs.replace(
            TINY.unet,
            latent_channels=8,
            condition_channels=8,
            multipliers=(1, 1, 2),
            attention=(True, False, True),
            context_width=None,
        ),
        vae=msgspec.structs.replace(TINY.vae, latent_channels=8, multipliers=(1, 2)),
        image_encoder=None,
        sampling=SamplingConfig(steps=2),
    )
    assert (config.vae.down_factor, config.unet.size_factor, config.size_factor) == (2, 4, 8)
    synthesizer = tiny_synthesizer(config)
    features = synthesizer.encode(random_clip(config))
    assert features.tokens is None
    (view,) = synthesizer.render(features, [path(synthesizer)])
    assert (view.video.shape, view.latents.shape) == ((5, 3, 16, 32), (1, 5, 8, 8, 16))


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


@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize("rows", [draw(3, 5), draw(3, 4, 2, 3)], ids=["tokens", "latents"])
def test_the_unconditional_branch_comes_first_and_sees_zeros_in_both_image_streams(rows: Tensor, views: int) -> None:
    both = with_unconditional(rows, views, True).unflatten(0, (2, views, 3))
    assert not both[0].any()
    assert torch.equal(both[1], rows.expand_as(both[1]))
    assert torch.equal(with_unconditional(rows, views, False), both[1].flatten(0, 1))


def test_condition_latents_are_the_posterior_mean_of_the_noised_frames_not_scaled_and_the_tower_sees_them_clean(
    synthesizer: Synthesizer,
) -> None:
    clip = random_clip()
    noise = draw(*clip.video.shape, seed=7)
    features = synthesizer.encode(clip, Augmentation(strength=0.3, noise=noise))
    with torch.inference_mode():
        posterior = synthesizer.networks.condition_encoder(clip.video + 0.3 * noise)
    assert TINY.vae.scale == 0.18215
    assert_close(features.latents, posterior.mean)
    assert features.augmentation == 0.3
    clean = synthesizer.encode(clip, Augmentation(strength=0.0))
    assert clean.tokens is not None
    assert features.tokens is not None
    assert torch.equal(clean.tokens, features.tokens)
    assert not torch.allclose(clean.latents, features.latents)


# A small driving model with every switch that is ours: x0, shared noise, patches; and it paints its classes.

FRAMES, HEIGHT, WIDTH = TINY_DRIVING.frames, TINY_DRIVING.height, TINY_DRIVING.width


@pytest.fixture(scope="module")
def driving() -> Synthesizer:
    return tiny_driving()


def rendered(synthesizer: Synthesizer, options: RenderOptions | None = None) -> View:
    features = synthesizer.encode(random_clip(TINY_DRIVING))
    return synthesizer.render(features, [synthesizer.traits.plan_view()], options)[0]


def test_a_painted_view_comes_with_the_classes_of_its_colours(driving: Synthesizer) -> None:
    view = rendered(driving, options=RenderOptions(samples=2))
    assert driving.traits.classes == TINY_CLASSES
    assert view.classes is not None
    assert view.classes.shape == (2, FRAMES, HEIGHT, WIDTH)
    away = (view.samples.unsqueeze(3) - palette(TINY_CLASSES).T[:, :, None, None] / 255).square().sum(dim=2)
    assert torch.equal(view.classes.long(), away.argmin(dim=2))


def test_every_frame_starts_from_the_same_noise_and_one_step_gives_what_the_network_says() -> None:
    driving = tiny_driving()
    calls, said = _Calls(driving), list[Tensor]()
    driving.networks.unet.conv_out.register_forward_hook(lambda *given: said.append(given[2]))
    view = rendered(driving, options=RenderOptions(samples=2))
    first, second = calls.inputs[0][0].unflatten(0, (2, FRAMES))
    for each in (first, second):
        assert_close(each, each[:1].expand_as(each))
    assert not torch.allclose(first, second)
    assert_close(view.latents.flatten(0, 1), said[0])


def test_the_checkpoint_names_its_augmentation(driving: Synthesizer) -> None:
    clip = random_clip(TINY_DRIVING)
    assert [driving.encode(clip, each).augmentation for each in (None, Augmentation(seed=3))] == [0.0, 0.0]
    assert driving.encode(clip, Augmentation(strength=0.1)).augmentation == 0.1
    assert tiny_synthesizer().encode(random_clip()).augmentation == 0.02


def test_an_ontology_that_cannot_be_told_apart_is_refused() -> None:
    content = msgspec.to_builtins(TINY_DRIVING)
    for classes, words in (([0, 0], "a colour of its own"), ([0], "2 to 256 classes, got 1")):
        content["semantic_classes"] = [msgspec.to_builtins(TINY_CLASSES[i]) for i in classes]
        with pytest.raises(msgspec.ValidationError, match=words):
            msgspec.convert(content, ModelConfig)
    with pytest.raises(OptionError):
        SemanticClass(name="car", colour=(0, 300, 0))


@pytest.mark.parametrize("classes", [TINY_CLASSES, DRIVING_CLASSES])
def test_a_painted_map_is_read_back_even_a_little_off_colour(classes: tuple[SemanticClass, ...]) -> None:
    generator = torch.Generator().manual_seed(3)
    truth = torch.randint(len(classes), (2, 7, 9), generator=generator)
    painted = palette(classes)[truth].permute(0, 3, 1, 2) / 255
    noisy = (painted + 0.03 * (torch.rand(painted.shape, generator=generator) - 0.5)).clamp(0, 1)
    for pixels in (painted, noisy):
        found = nearest_classes(pixels, classes)
        assert found.dtype == torch.uint8
        assert torch.equal(found.long(), truth)


def unet_rows(networks: Networks, rows: int, *, image_mode: bool, order: Tensor | None = None) -> Tensor:
    config, order = networks.config.unet, torch.arange(rows) if order is None else order
    latents, condition = draw(rows, 4, 8, 12, seed=1), draw(rows, config.condition_channels, 8, 12, seed=2)
    plan = networks.unet.plan(torch.tensor([0.7]), draw(rows, config.vector_width, seed=3)[order], None, None)
    return networks.unet(latents[order], condition[order], *plan.step(0), image_mode=image_mode)


def test_in_image_mode_rows_are_unrelated_frames_in_any_order_and_number() -> None:
    networks = tiny_driving().networks
    order = torch.tensor([3, 0, 4, 1, 2])
    plain = unet_rows(networks, 5, image_mode=True)
    assert_close(unet_rows(networks, 5, image_mode=True, order=order), plain[order])
    clip, frames = unet_rows(networks, 3, image_mode=False), unet_rows(networks, 3, image_mode=True)
    assert relative_error(clip, frames) > 1e-3


def test_what_single_frames_taught_a_fresh_network_holds_for_clips_at_first() -> None:
    networks = Networks(TINY_DRIVING)
    learnt = [
        parameter
        for name, parameter in networks.named_parameters()
        if not any(part in name for part in (".temporal.", ".positions.", ".share.", "mix_frames"))
    ]
    with torch.no_grad():
        for i, parameter in enumerate(learnt):
            parameter.copy_(draw(*parameter.shape, seed=i) * 0.2)
    clip, frames = unet_rows(networks, 3, image_mode=False), unet_rows(networks, 3, image_mode=True)
    assert frames.abs().max() > 0.1
    assert_close(clip, frames, rtol=1e-4, atol=1e-5)
    latents = draw(FRAMES, 4, HEIGHT // 4, WIDTH // 4)
    assert_close(networks.decoder(latents, FRAMES), networks.decoder(latents, None), rtol=1e-4, atol=1e-5)
