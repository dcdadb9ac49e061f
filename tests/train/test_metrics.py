import math

import pytest
import torch
from scipy.ndimage import binary_erosion
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch.testing import assert_close

from gcd_train.evaluation.metrics import (
    NO_CLASS,
    class_iou,
    confusion_matrix,
    frame_confusions,
    gradient_map,
    masked_mean,
    masked_psnr,
    mean_iou,
    pixel_deviation,
    psnr,
    ssim_map,
    void_ids,
    window_mask,
)


def grey(*levels: float, size: int = 16) -> torch.Tensor:
    return torch.tensor(levels).view(-1, 1, 1, 1).expand(-1, 3, size, size).contiguous()


def noise(seed: int = 0) -> torch.Tensor:
    return torch.rand(2, 3, 24, 20, generator=torch.Generator().manual_seed(seed))


def test_psnr_of_a_constant_error_is_minus_20_log_of_it() -> None:
    assert_close(psnr(grey(0.5, 0.6), grey(0.6, 0.6)), torch.tensor([20.0, 100.0]), rtol=0, atol=1e-4)


def test_ssim_and_psnr_are_those_of_scikit_image() -> None:
    first = noise(0)
    second = (0.8 * first + 0.2 * noise(1)).clamp(0, 1)
    pairs = [(first[t].double().numpy(), second[t].double().numpy()) for t in range(2)]
    for found, (a, b) in zip(ssim_map(first, second), pairs, strict=True):
        _, theirs = structural_similarity(a, b, channel_axis=0, data_range=1.0, full=True)
        assert_close(found, torch.from_numpy(theirs).mean(dim=0)[3:-3, 3:-3], rtol=0, atol=1e-12)
    noises = [peak_signal_noise_ratio(a, b, data_range=1.0) for a, b in pairs]
    assert psnr(first, second).tolist() == pytest.approx(noises, abs=1e-4)


def test_ssim_of_bright_flat_pictures_does_not_drown_in_rounding() -> None:
    flat = grey(1.0, size=32) - 1e-4 * torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    assert ssim_map(flat, flat.clone()).mean().item() == pytest.approx(1.0, abs=1e-9)


def halves() -> torch.Tensor:
    """The left 8 of 20 columns of the first frame, nothing of the second."""
    mask = torch.zeros(2, 24, 20, dtype=torch.bool)
    mask[0, :, :8] = True
    return mask


def test_what_lies_outside_a_mask_is_not_looked_at() -> None:
    first, second, mask = noise(0), noise(1), halves()
    changed = torch.where(mask[:, None], second, 1 - second)
    changed[0, :, :, 19] = torch.nan
    assert_close(masked_psnr(first, second, mask)[0], masked_psnr(first, changed, mask)[0])
    spread = [masked_mean(pixel_deviation(torch.stack([first, each])), mask)[0] for each in (changed, second)]
    assert_close(*spread)
    cut = psnr(first[:1, :, :, :8], second[:1, :, :, :8])
    assert_close(masked_psnr(first, second, mask)[:1], cut)


def test_ssim_masks_are_eroded_three_times_by_a_cross() -> None:
    mask = torch.rand(2, 24, 20, generator=torch.Generator().manual_seed(0)) > 0.03
    theirs = [binary_erosion(each.numpy(), iterations=3)[3:-3, 3:-3] for each in mask]
    assert 20 < sum(int(each.sum()) for each in theirs) < 400
    assert window_mask(mask).tolist() == [each.tolist() for each in theirs]


def test_diversity_is_the_spread_over_all_draws() -> None:
    draws = torch.stack([grey(0.1), grey(0.3), grey(0.3), grey(0.5)])
    assert pixel_deviation(draws).mean().item() == pytest.approx(math.sqrt((0.2**2 + 0.2**2) / 4), rel=1e-5)
    assert pixel_deviation(torch.stack([noise(0)] * 3)).amax() < 1e-6


def test_gradient_of_a_ramp_is_its_slope() -> None:
    ramp = (torch.arange(32.0) / 100).expand(1, 3, 32, 32)
    # replicated edges halve the slope in the two outer columns
    assert gradient_map(ramp).mean().item() == pytest.approx(0.01 * (30 + 2 * 0.5) / 32, rel=1e-5)
    assert gradient_map(ramp.mT).mean().item() == pytest.approx(0.01 * 31 / 32, rel=1e-5)
    assert gradient_map(grey(0.4)).mean().item() == pytest.approx(0.0, abs=1e-6)


def labels(seed: int) -> torch.Tensor:
    """Three frames of four classes."""
    return torch.randint(0, 4, (3, 6, 8), generator=torch.Generator().manual_seed(seed)).to(torch.uint8)


def test_confusions_of_frames_and_of_regions_add_up_to_the_whole() -> None:
    said, true, mask = labels(0), labels(1), labels(2) < 2
    whole = frame_confusions(said, true, 4)
    assert whole[:, :, :4].sum(dim=0).equal(confusion_matrix(said, true, 4))
    assert not whole[:, :, 4].any()
    assert (frame_confusions(said, true, 4, mask) + frame_confusions(said, true, 4, ~mask)).equal(whole)
    assert whole[1, :, :4].equal(confusion_matrix(said[1], true[1], 4))


def test_iou_by_hand_with_an_absent_class() -> None:
    target = torch.tensor([[0, 0, 1, 2]], dtype=torch.uint8)
    confusion = confusion_matrix(torch.tensor([[0, 1, 1, 1]], dtype=torch.uint8), target, 4)
    assert confusion.tolist() == [[1, 1, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]
    iou = class_iou(confusion)
    assert iou[:3].tolist() == pytest.approx([1 / 2, 1 / 3, 0.0])
    assert math.isnan(float(iou[3]))
    assert mean_iou(confusion) == pytest.approx((1 / 2 + 1 / 3 + 0) / 3)


def test_predictions_of_no_class_are_wrong_and_nobodys() -> None:
    true = torch.tensor([[[0, 0, 1, 1]]], dtype=torch.uint8)
    said = torch.tensor([[[0, NO_CLASS, 1, NO_CLASS]]], dtype=torch.uint8)
    found = frame_confusions(said, true, 2)
    assert found.tolist() == [[[1, 0, 1], [0, 1, 1]]]
    assert class_iou(found[0]).tolist() == [0.5, 0.5]


def test_void_is_known_by_its_name_whatever_the_case() -> None:
    assert void_ids(["Road", "Void", "Car", "unlabelled", "UNLABELED "]) == (1, 3, 4)
    assert void_ids(["Road", "Avoided"]) == ()
    assert void_ids(["Void"] * 256) == ()
