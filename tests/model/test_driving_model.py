"""A small model with every switch that is ours: x0, shared noise, patches; and the class map of what it paints."""

import msgspec
import pytest
import torch
from small_models import (
    TINY_CLASSES,
    TINY_DRIVING,
    draw,
    random_clip,
    relative_error,
    tiny_driving,
    tiny_synthesizer,
)
from torch import Tensor
from torch.testing import assert_close

from gcd_model.clip import Augmentation, View, nearest_classes, palette
from gcd_model.config import DRIVING_CLASSES, ModelConfig, SemanticClass
from gcd_model.diffusion import RenderOptions
from gcd_model.errors import OptionError
from gcd_model.geometry import CameraMount
from gcd_model.networks import Networks
from gcd_model.synthesizer import Synthesizer

FRAMES, HEIGHT, WIDTH = TINY_DRIVING.frames, TINY_DRIVING.height, TINY_DRIVING.width
LATENTS = (FRAMES, 4, HEIGHT // 4, WIDTH // 4)


@pytest.fixture(scope="module")
def synthesizer() -> Synthesizer:
    return tiny_driving()


def rendered(synthesizer: Synthesizer, options: RenderOptions | None = None) -> View:
    features = synthesizer.encode(random_clip(TINY_DRIVING))
    return synthesizer.render(features, [synthesizer.traits.plan_view()], options)[0]


class Rows:
    """What the U-Net was called with."""

    def __init__(self, synthesizer: Synthesizer) -> None:
        self.noisy: list[Tensor] = []
        synthesizer.networks.unet.stem.register_forward_pre_hook(self._keep)

    def _keep(self, _: object, given: tuple[Tensor, ...]) -> None:
        self.noisy.append(given[0][:, :4])


def test_a_painted_view_comes_with_the_classes_of_its_colours(synthesizer: Synthesizer) -> None:
    view = rendered(synthesizer, options=RenderOptions(samples=2))
    assert synthesizer.traits.classes == TINY_CLASSES
    assert view.classes is not None
    assert view.classes.shape == (2, FRAMES, HEIGHT, WIDTH)
    away = (view.samples.unsqueeze(3) - palette(TINY_CLASSES).T[:, :, None, None] / 255).square().sum(dim=2)
    assert torch.equal(view.classes.long(), away.argmin(dim=2))


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


def test_the_checkpoint_names_its_augmentation(synthesizer: Synthesizer) -> None:
    clip = random_clip(TINY_DRIVING)
    assert synthesizer.encode(clip).augmentation == 0.0
    assert synthesizer.encode(clip, Augmentation(seed=3)).augmentation == 0.0
    assert synthesizer.encode(clip, Augmentation(strength=0.1)).augmentation == 0.1
    assert tiny_synthesizer().encode(random_clip()).augmentation == 0.02


def test_a_mount_is_refused_where_the_view_hangs_on_no_vehicle(synthesizer: Synthesizer) -> None:
    for traits in (synthesizer.traits, tiny_synthesizer().traits):
        with pytest.raises(OptionError):
            traits.plan_view(mount=CameraMount())


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
    config = networks.config.unet
    latents, condition = draw(rows, 4, 8, 12, seed=1), draw(rows, config.condition_channels, 8, 12, seed=2)
    plan = networks.unet.plan(torch.tensor([0.7]), draw(rows, config.vector_width, seed=3), None, None)
    if order is not None:
        plan = networks.unet.plan(torch.tensor([0.7]), draw(rows, config.vector_width, seed=3)[order], None, None)
        latents, condition = latents[order], condition[order]
    return networks.unet(latents, condition, *plan.step(0), image_mode=image_mode)


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
