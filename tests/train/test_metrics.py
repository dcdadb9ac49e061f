import math

import pytest
import torch
from torch.testing import assert_close

from gcd_model.errors import ShapeError
from gcd_train.metrics import (
    class_iou,
    confusion_matrix,
    frame_change,
    gradient_magnitude,
    majority_classes,
    mean_iou,
    pixel_accuracy,
    psnr,
    ssim,
)


def grey(*levels: float, size: int = 16) -> torch.Tensor:
    return torch.tensor(levels).view(-1, 1, 1, 1).expand(-1, 3, size, size).contiguous()


def noise(seed: int = 0) -> torch.Tensor:
    return torch.rand(2, 3, 24, 20, generator=torch.Generator().manual_seed(seed))


def test_psnr_of_a_constant_error_is_minus_20_log_of_it() -> None:
    assert_close(psnr(grey(0.5, 0.6), grey(0.6, 0.6)), torch.tensor([20.0, 100.0]), rtol=0, atol=1e-4)


def test_psnr_is_by_frame_not_over_the_clip() -> None:
    both = psnr(grey(0.5, 0.51), grey(0.6, 0.61))
    assert_close(both, torch.tensor([20.0, 20.0]), rtol=0, atol=1e-3)
    assert psnr(grey(0.5), grey(0.51)).item() == pytest.approx(40.0, abs=1e-3)


def test_ssim_of_a_picture_with_itself_is_one_and_symmetric_otherwise() -> None:
    first, second = noise(0), noise(1)
    assert_close(ssim(first, first), torch.ones(2))
    assert_close(ssim(first, second), ssim(second, first))
    assert ssim(first, second).max() < 0.5


def test_ssim_of_two_flat_pictures_is_the_luminance_term() -> None:
    a, b, c1 = 0.3, 0.6, 0.01**2
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    assert ssim(grey(a), grey(b)).item() == pytest.approx(expected, abs=1e-4)


def test_ssim_weighs_by_a_gaussian_of_eleven_pixels() -> None:
    first, second = noise(0)[:1, :1, :11, :11].double(), noise(1)[:1, :1, :11, :11].double()
    ramp = torch.exp(-((torch.arange(11.0, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    weight = torch.outer(ramp, ramp) / ramp.sum() ** 2
    mean_a, mean_b = (weight * first).sum(), (weight * second).sum()
    var_a, var_b = (weight * first**2).sum() - mean_a**2, (weight * second**2).sum() - mean_b**2
    covariance = (weight * first * second).sum() - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    top = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    expected = top / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    assert_close(ssim(first, second)[0], expected, rtol=1e-5, atol=1e-5)


def test_ssim_refuses_pictures_below_its_window() -> None:
    with pytest.raises(ShapeError, match="11"):
        ssim(grey(0.1, size=8), grey(0.1, size=8))


def test_gradient_of_a_ramp_is_its_slope() -> None:
    ramp = (torch.arange(32.0) / 100).expand(1, 3, 32, 32)
    # replicated edges halve the slope in the two outer columns
    assert gradient_magnitude(ramp).item() == pytest.approx(0.01 * (30 + 2 * 0.5) / 32, rel=1e-5)
    assert gradient_magnitude(ramp.mT).item() == pytest.approx(0.01 * 31 / 32, rel=1e-5)
    assert gradient_magnitude(grey(0.4)).item() == pytest.approx(0.0, abs=1e-6)


def test_frame_change_is_the_mean_absolute_step() -> None:
    assert_close(frame_change(grey(0.1, 0.4, 0.2)), torch.tensor([0.3, 0.2]))


def test_confusion_counts_targets_in_rows() -> None:
    target = torch.tensor([[0, 0, 1, 2]], dtype=torch.uint8)
    predicted = torch.tensor([[0, 1, 1, 1]], dtype=torch.uint8)
    assert confusion_matrix(predicted, target, 4).tolist() == [[1, 1, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]


def test_iou_by_hand_with_an_absent_class() -> None:
    confusion = torch.tensor([[1, 1, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]])
    iou = class_iou(confusion)
    assert iou[:3].tolist() == pytest.approx([1 / 2, 1 / 3, 0.0])
    assert math.isnan(float(iou[3]))
    assert mean_iou(confusion) == pytest.approx((1 / 2 + 1 / 3 + 0) / 3)
    assert pixel_accuracy(confusion) == pytest.approx(0.5)


def test_a_perfect_map_has_iou_one_for_all_that_is_there() -> None:
    labels = torch.tensor([[0, 3], [3, 1]], dtype=torch.uint8)
    assert mean_iou(confusion_matrix(labels, labels, 5)) == 1.0


def test_ids_beyond_the_ontology_are_refused() -> None:
    labels = torch.tensor([4], dtype=torch.uint8)
    with pytest.raises(ShapeError, match="below 4"):
        confusion_matrix(labels, labels, 4)


def test_the_majority_of_each_cell_wins_and_ties_go_to_the_lowest_id() -> None:
    labels = torch.tensor([[2, 2, 0, 1], [2, 1, 1, 1], [0, 3, 2, 2], [3, 0, 3, 3]], dtype=torch.uint8)
    assert majority_classes(labels[None], 2, 2, 4).tolist() == [[[2, 1], [0, 2]]]


def test_a_grid_that_does_not_divide_the_map_is_refused() -> None:
    with pytest.raises(ShapeError, match="divide"):
        majority_classes(torch.zeros(4, 6, dtype=torch.uint8), 2, 4, 2)
