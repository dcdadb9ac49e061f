"""The mix of warps and decoded picture: what a fresh one does, and what it can never do."""

import pytest
import torch
from small_models import draw, randomise
from torch import Tensor
from torch.testing import assert_close

from gcd_model.config import DRIVING_SMALL, PlaneMixConfig
from gcd_model.errors import OptionError
from gcd_model.networks import empty_networks
from gcd_model.plane_mix import PlaneMix

LAYERS, LATENT, CLASSES, ROWS = 3, 4, 5, 2
HEIGHT, WIDTH = 16, 24


def fresh(classes: int = CLASSES) -> PlaneMix:
    return PlaneMix(PlaneMixConfig(width=16, dilations=(1, 2)), LAYERS, LATENT, classes)


def mixed(
    mix: PlaneMix, decoded: Tensor, warped: Tensor, valid: Tensor, seed: int = 0
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Picture and logits, and the logits that went in."""
    latents = draw(len(decoded), LATENT, HEIGHT // 8, WIDTH // 8, seed=seed)
    logits = draw(len(decoded), CLASSES, HEIGHT // 2, WIDTH // 2, seed=seed + 1)
    picture, refined = mix(decoded, warped, valid, latents, logits)
    return picture, refined, logits


def everywhere(present: bool) -> Tensor:
    return torch.full((ROWS, LAYERS, HEIGHT, WIDTH), present)


def test_where_all_layers_agree_the_picture_is_what_they_agree_on() -> None:
    mix, decoded = fresh(), draw(ROWS, 3, HEIGHT, WIDTH)
    torch.nn.init.normal_(mix.choice.weight)  # whatever is chosen
    picture, _, _ = mixed(mix, decoded, decoded[:, None].expand(-1, LAYERS, -1, -1, -1), everywhere(True))
    assert_close(picture, decoded, rtol=0, atol=1e-5)


def test_a_fresh_mix_without_a_valid_warp_gives_the_decoded_picture_and_the_classes_as_they_came() -> None:
    decoded = draw(ROWS, 3, HEIGHT, WIDTH)
    picture, refined, logits = mixed(fresh(), decoded, torch.zeros(ROWS, LAYERS, 3, HEIGHT, WIDTH), everywhere(False))
    assert_close(picture, decoded, rtol=0, atol=1e-5)
    assert refined is not None
    assert torch.equal(refined, logits)


def test_a_fresh_mix_prefers_the_generated_layer_to_any_single_warp() -> None:
    warped = torch.ones(ROWS, LAYERS, 3, HEIGHT, WIDTH)
    picture, _, _ = mixed(fresh(), torch.zeros(ROWS, 3, HEIGHT, WIDTH), warped, everywhere(True))
    share = LAYERS / (LAYERS + torch.e)
    assert_close(picture, torch.full_like(picture, share), rtol=0, atol=1e-3)


def test_pixels_where_a_warp_is_not_valid_never_show_it() -> None:
    mix, valid = fresh(), everywhere(True)
    valid[..., WIDTH // 2 :] = False
    mix.choice.bias.data[0] = 20.0  # pyright: ignore[reportOptionalMemberAccess]
    warped = torch.ones(ROWS, LAYERS, 3, HEIGHT, WIDTH) * valid[:, :, None]
    picture, _, _ = mixed(mix, torch.full((ROWS, 3, HEIGHT, WIDTH), -0.5), warped, valid)
    assert_close(picture[..., WIDTH // 2 :], torch.full((ROWS, 3, HEIGHT, WIDTH // 2), -0.5), rtol=0, atol=1e-5)
    inside = picture[..., : WIDTH // 2 - 1]  # the last column shares its weights with the neighbour
    assert_close(inside, torch.ones_like(inside), rtol=0, atol=1e-3)


def test_a_chosen_warp_is_shown_as_sharp_as_it_is() -> None:
    mix, warped = fresh(), draw(ROWS, LAYERS, 3, HEIGHT, WIDTH)
    mix.choice.bias.data[1] = 20.0  # pyright: ignore[reportOptionalMemberAccess]
    picture, _, _ = mixed(mix, torch.zeros(ROWS, 3, HEIGHT, WIDTH), warped, everywhere(True))
    assert_close(picture, warped[:, 1], rtol=0, atol=2e-3)


def test_rows_do_not_look_at_each_other() -> None:
    mix = fresh()
    randomise(mix)
    decoded, warped, valid = draw(ROWS, 3, HEIGHT, WIDTH), draw(ROWS, LAYERS, 3, HEIGHT, WIDTH), everywhere(True)
    latents, logits = draw(ROWS, LATENT, 2, 3), draw(ROWS, CLASSES, 8, 12)
    picture, refined = mix(decoded, warped, valid, latents, logits)
    alone, alone_refined = mix(decoded[1:], warped[1:], valid[1:], latents[1:], logits[1:])
    assert_close(picture[1:], alone)
    assert_close(refined[1:], alone_refined)


def test_gradients_reach_every_parameter() -> None:
    mix, valid = fresh(), everywhere(True)
    randomise(mix)
    picture, refined, _ = mixed(mix, draw(ROWS, 3, HEIGHT, WIDTH), draw(ROWS, LAYERS, 3, HEIGHT, WIDTH), valid)
    assert refined is not None
    (picture.square().sum() + refined.square().sum()).backward()
    assert [name for name, p in mix.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_without_class_head_there_is_nothing_to_sharpen() -> None:
    mix, decoded = fresh(classes=0), draw(ROWS, 3, HEIGHT, WIDTH)
    warped = draw(ROWS, LAYERS, 3, HEIGHT, WIDTH)
    picture, refined = mix(decoded, warped, everywhere(True), draw(ROWS, LATENT, 2, 3), None)
    assert picture.shape == decoded.shape
    assert refined is None


def test_the_shipped_mix_is_small() -> None:
    mix = empty_networks(DRIVING_SMALL).plane_mix
    assert mix is not None
    assert 300_000 < sum(p.numel() for p in mix.parameters()) < 500_000


def test_a_width_that_norms_cannot_share_is_refused() -> None:
    with pytest.raises(OptionError, match="the plane mix is 24 wide"):
        PlaneMixConfig(width=24)
