"""A model with every switch that is ours: warps, x0, shared noise, class map, plane mix, patches."""

from dataclasses import replace

import pytest
import torch
from small_models import (
    TINY_CLASSES,
    TINY_DRIVING,
    draw,
    random_clip,
    randomise,
    relative_error,
    tiny_driving,
    tiny_synthesizer,
)
from torch import Tensor
from torch.testing import assert_close

from gcd_model.clip import Augmentation, RenderOptions, View
from gcd_model.conditioning import SourceFeatures
from gcd_model.errors import OptionError, ShapeError
from gcd_model.geometry import CameraMount
from gcd_model.networks import Networks
from gcd_model.own_format import FULL_PRECISION
from gcd_model.plane_warp import PathWarps
from gcd_model.synthesizer import Synthesizer

FRAMES, HEIGHT, WIDTH = TINY_DRIVING.frames, TINY_DRIVING.height, TINY_DRIVING.width
LATENTS = (FRAMES, 4, HEIGHT // 4, WIDTH // 4)


@pytest.fixture(scope="module")
def synthesizer() -> Synthesizer:
    return tiny_driving()


def features_of(synthesizer: Synthesizer, mount: CameraMount | None = None) -> SourceFeatures:
    return synthesizer.encode(replace(random_clip(TINY_DRIVING), mount=mount))


def rendered(synthesizer: Synthesizer, mount: CameraMount | None = None, options: RenderOptions | None = None) -> View:
    path = synthesizer.traits.plan_view(mount=mount)
    return synthesizer.render(features_of(synthesizer, mount), [path], options)[0]


class Rows:
    """What the U-Net was called with."""

    def __init__(self, synthesizer: Synthesizer) -> None:
        self.noisy: list[Tensor] = []
        self.condition: list[Tensor] = []
        synthesizer.networks.unet.stem.register_forward_pre_hook(self._keep)

    def _keep(self, _: object, given: tuple[Tensor, ...]) -> None:
        self.noisy.append(given[0][:, :4])
        self.condition.append(given[0][:, 4:])


# --- rendering -------------------------------------------------------------------------------------------------------


def test_a_view_comes_with_a_class_map(synthesizer: Synthesizer) -> None:
    view = rendered(synthesizer, options=RenderOptions(samples=2))
    assert view.samples.shape == (2, FRAMES, 3, HEIGHT, WIDTH)
    assert view.classes is not None
    assert view.classes.dtype == torch.uint8
    assert view.classes.shape == (2, FRAMES, HEIGHT, WIDTH)
    assert set(view.classes.unique().tolist()) <= set(range(len(TINY_CLASSES)))
    assert len(view.classes.unique()) > 1
    assert synthesizer.traits.classes == TINY_CLASSES


def test_the_u_net_sees_source_latents_and_then_the_warps_of_the_clean_source() -> None:
    synthesizer = tiny_driving()
    rows, clip = Rows(synthesizer), random_clip(TINY_DRIVING)
    features = synthesizer.encode(clip, Augmentation(strength=0.5))
    path = synthesizer.traits.plan_view()
    synthesizer.render(features, [path])
    assert TINY_DRIVING.plane_warp is not None
    warps = PathWarps(TINY_DRIVING.plane_warp, CameraMount(), path, HEIGHT, WIDTH, down_factor=4)
    expected = torch.cat([features.latents, warps.channels(clip.video, torch.arange(FRAMES))], dim=1)
    assert_close(rows.condition[0], expected)


def test_every_frame_starts_from_the_same_noise() -> None:
    synthesizer = tiny_driving()
    rows = Rows(synthesizer)
    rendered(synthesizer, options=RenderOptions(samples=2))
    first, second = rows.noisy[0].unflatten(0, (2, FRAMES))
    assert_close(first, first[:1].expand_as(first))
    assert_close(second, second[:1].expand_as(second))
    assert not torch.allclose(first, second)


def test_one_step_gives_what_the_network_says_the_clean_latents_are() -> None:
    synthesizer = tiny_driving()
    said: list[Tensor] = []
    synthesizer.networks.unet.conv_out.register_forward_hook(lambda *given: said.append(given[2]))
    view = rendered(synthesizer)
    assert len(said) == 1
    assert_close(view.latents[0], said[0])


def test_class_maps_are_read_at_the_last_step(synthesizer: Synthesizer) -> None:
    calls: list[Tensor] = []
    head = synthesizer.networks.class_head
    assert head is not None
    handle = head.register_forward_pre_hook(lambda _, given: calls.append(given[0]))
    rendered(synthesizer, options=RenderOptions(steps=3, guidance=(1.0, 1.5)))
    handle.remove()
    assert [len(rows) for rows in calls] == [FRAMES]  # once, and of the conditional branch alone


def test_views_and_samples_in_one_batch_equal_those_made_alone(synthesizer: Synthesizer) -> None:
    features, traits = features_of(synthesizer), synthesizer.traits
    gradual, direct = traits.plan_view(), traits.plan_view(move_time=0)
    options = RenderOptions(samples=2, steps=2)
    together = synthesizer.render(features, [gradual, direct], options)
    for path, view in zip((gradual, direct), together, strict=True):
        (alone,) = synthesizer.render(features, [path], options)
        assert relative_error(view.latents, alone.latents) < 1e-4
        assert relative_error(view.samples, alone.samples) < 1e-4
        assert view.classes is not None
        assert alone.classes is not None
        assert (view.classes == alone.classes).float().mean() > 0.99
    assert relative_error(together[0].latents, together[1].latents) > 1e-3


def test_the_mount_of_the_camera_changes_the_view(synthesizer: Synthesizer) -> None:
    trained, same = rendered(synthesizer), rendered(synthesizer, CameraMount())
    assert torch.equal(trained.samples, same.samples)
    higher = rendered(synthesizer, CameraMount(height_m=1.9, tilt_deg=5.0))
    assert relative_error(higher.latents, trained.latents) > 1e-4


def test_networks_in_bfloat16_give_float32_views_near_those_of_float32(synthesizer: Synthesizer) -> None:
    half = tiny_driving()
    for name, network in half.networks.named_children():
        if name not in FULL_PRECISION:
            network.bfloat16()
    exact, rounded = rendered(synthesizer), rendered(half)
    assert rounded.samples.dtype == rounded.latents.dtype == torch.float32
    assert 0 < relative_error(rounded.latents, exact.latents) < 0.05
    assert rounded.classes is not None
    assert exact.classes is not None
    assert (rounded.classes == exact.classes).float().mean() > 0.9


def test_the_checkpoint_names_its_augmentation(synthesizer: Synthesizer) -> None:
    clip = random_clip(TINY_DRIVING)
    assert synthesizer.encode(clip).augmentation == 0.0
    assert synthesizer.encode(clip, Augmentation(seed=3)).augmentation == 0.0
    assert synthesizer.encode(clip, Augmentation(strength=0.1)).augmentation == 0.1
    assert tiny_synthesizer().encode(random_clip()).augmentation == 0.02


# --- features --------------------------------------------------------------------------------------------------------


def test_only_a_model_that_warps_keeps_the_video(synthesizer: Synthesizer) -> None:
    features = features_of(synthesizer)
    assert features.mount == CameraMount() == synthesizer.traits.mount
    assert features.video is not None
    plain = tiny_synthesizer().encode(replace(random_clip(), mount=CameraMount()))
    assert plain.video is None
    assert plain.mount is None
    assert tiny_synthesizer().traits.mount is None


def test_features_are_cut_and_joined_with_their_video(synthesizer: Synthesizer) -> None:
    features = features_of(synthesizer)
    rejoined = features.rows(0, 1).followed_by(features.rows(1, FRAMES))
    assert rejoined.video is not None
    assert features.video is not None
    assert torch.equal(rejoined.video, features.video)
    with pytest.raises(ShapeError, match="mount"):
        features.followed_by(features_of(synthesizer, CameraMount(height_m=2.0)))


def test_features_without_video_are_refused(synthesizer: Synthesizer) -> None:
    bare = replace(features_of(synthesizer), video=None)
    with pytest.raises(ShapeError, match="warps the source video"):
        synthesizer.render(bare, [synthesizer.traits.plan_view()])


def test_extra_channels_are_refused_where_the_warps_fill_them(synthesizer: Synthesizer) -> None:
    with pytest.raises(ShapeError, match="wants 0 extra condition channels, got 2"):
        synthesizer.encode(random_clip(TINY_DRIVING), extra=draw(FRAMES, 2, *LATENTS[2:]))


def test_a_mount_is_refused_where_no_vehicle_carries_the_view() -> None:
    with pytest.raises(OptionError, match="leave the mount out"):
        tiny_synthesizer().traits.plan_view(mount=CameraMount())


# --- single frames first, then clips ---------------------------------------------------------------------------------


def unet_rows(networks: Networks, rows: int, *, image_mode: bool, order: Tensor | None = None) -> Tensor:
    config = networks.config.unet
    latents, condition = draw(rows, 4, 8, 12, seed=1), draw(rows, config.condition_channels, 8, 12, seed=2)
    plan = networks.unet.plan(torch.tensor([0.7]), draw(rows, config.vector_width, seed=3), None, None)
    if order is not None:
        plan = networks.unet.plan(torch.tensor([0.7]), draw(rows, config.vector_width, seed=3)[order], None, None)
        latents, condition = latents[order], condition[order]
    return networks.unet(latents, condition, plan.step(0), image_mode=image_mode)


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
    latents = draw(*LATENTS)
    assert_close(networks.decoder(latents, FRAMES), networks.decoder(latents, None), rtol=1e-4, atol=1e-5)


def test_gradients_reach_every_part_across_frames_of_a_fresh_network_after_one_step() -> None:
    networks = Networks(TINY_DRIVING)
    randomise(networks.unet)
    networks.unet.start_apart()
    unet_rows(networks, 3, image_mode=False).square().sum().backward()
    for name in ("positions.mlp.2.weight", "temporal.attention.out.weight", "temporal.feed.contract.weight"):
        gradient = networks.unet.middle[0].attention.get_parameter(name).grad
        assert gradient is not None
        assert gradient.any()
