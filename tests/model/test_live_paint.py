"""What was never seen: the mean of what could be there, and the same made crisp."""

import torch

from gcd_model.live.paint_net import crisp

ROAD, GRASS = (-0.6, -0.6, -0.5), (-0.5, 0.4, -0.7)


def test_a_soft_edge_between_two_classes_becomes_a_step_and_their_colours_stay() -> None:
    share = ((torch.arange(96) - 40.0) / 24).clamp(0, 1).expand(64, 96)  # of grass, from left to right
    colours = torch.tensor([ROAD, GRASS])
    mean = (colours[0, :, None, None] * (1 - share) + colours[1, :, None, None] * share)[None]
    logits = torch.logit(share.clamp(1e-4, 1 - 1e-4))
    made = crisp(mean, torch.stack([-logits / 2, logits / 2, torch.full_like(logits, -20.0)])[None])[0]
    assert (made[:, :, :51] - colours[0, :, None, None]).abs().max() < 0.1
    assert (made[:, :, 53:] - colours[1, :, None, None]).abs().max() < 0.1


def test_a_class_that_is_sure_everywhere_is_a_smoothed_mean() -> None:
    mean = torch.linspace(-1, 1, 128).expand(1, 3, 64, 128)
    classes = torch.zeros(1, 4, 64, 128)
    classes[:, 2] = 30.0
    made = crisp(mean, classes)
    assert (made - mean)[..., 30:-30].abs().max() < 0.02


def test_a_class_of_a_single_pixel_has_a_finite_colour() -> None:
    classes = torch.zeros(1, 3, 32, 32)
    classes[:, 0] = 50.0
    classes[0, 1, 7, 9] = 80.0
    assert bool(crisp(torch.rand(1, 3, 32, 32), classes).isfinite().all())
