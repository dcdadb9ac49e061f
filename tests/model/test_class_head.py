"""The class map beside the picture."""

import pytest
import torch
from small_models import TINY_CLASSES, draw, randomise
from torch.testing import assert_close

from gcd_model.class_head import ClassHead, class_map, palette
from gcd_model.config import DRIVING_CLASSES, ClassHeadConfig, SemanticClass
from gcd_model.errors import OptionError

CONFIG = ClassHeadConfig(classes=TINY_CLASSES, width=16, upscale=4)


def test_logits_stand_on_a_finer_grid_than_the_features() -> None:
    head = ClassHead(CONFIG, 8)
    assert head(draw(5, 8, 4, 6)).shape == (5, 3, 16, 24)


def test_a_head_reads_each_frame_alone() -> None:
    head, features = ClassHead(CONFIG, 8), draw(5, 8, 4, 6)
    assert_close(head(features)[2:3], head(features[2:3]))


def test_gradients_reach_every_parameter_and_the_features() -> None:
    head, features = ClassHead(CONFIG, 8), draw(2, 8, 4, 6).requires_grad_()
    randomise(head)
    head(features).square().sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in head.parameters())
    assert features.grad is not None
    assert features.grad.any()


def test_a_map_names_the_likeliest_class_of_every_pixel() -> None:
    wanted = torch.tensor([[0, 1, 2], [2, 2, 0]], dtype=torch.uint8)
    logits = torch.nn.functional.one_hot(wanted.long(), 3).permute(2, 0, 1)[None].float()
    same = class_map(logits, 2, 3)
    assert same.dtype == torch.uint8
    assert torch.equal(same[0], wanted)
    doubled = class_map(logits, 4, 6)
    assert doubled.shape == (1, 4, 6)
    assert doubled[0, ::3, ::5].tolist() == [[0, 2], [2, 0]]  # the corners


def test_a_palette_paints_a_map() -> None:
    painted = palette(TINY_CLASSES)[torch.tensor([[1, 0]])]
    assert painted.dtype == torch.uint8
    assert painted.tolist() == [[[0, 0, 200], [90, 90, 90]]]


def test_the_driving_classes_are_told_apart_by_name_and_colour() -> None:
    assert len(DRIVING_CLASSES) == 13
    assert [entry.name for entry in DRIVING_CLASSES[:2]] == ["sky", "road"]
    assert len({entry.name for entry in DRIVING_CLASSES}) == 13
    colours = palette(DRIVING_CLASSES).float()
    apart = torch.cdist(colours, colours) + 1000 * torch.eye(13)
    assert apart.min() > 45


def test_an_ontology_that_does_not_fit_a_byte_or_a_colour_out_of_range_is_refused() -> None:
    with pytest.raises(OptionError, match="2 to 256 classes"):
        ClassHeadConfig(classes=TINY_CLASSES[:1])
    with pytest.raises(OptionError, match="within 0-255"):
        SemanticClass(name="car", colour=(0, 300, 0))
