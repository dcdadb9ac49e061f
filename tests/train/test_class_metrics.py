import math

import pytest
import torch

from gcd_train.evaluation.metrics import (
    NO_CLASS,
    class_iou,
    confusion_matrix,
    frame_confusions,
    majority_classes,
    mean_iou,
    void_ids,
    without_classes,
)


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


def test_the_majority_of_each_cell_wins_and_ties_go_to_the_lowest_id() -> None:
    labels = torch.tensor([[2, 2, 0, 1], [2, 1, 1, 1], [0, 3, 2, 2], [3, 0, 3, 3]], dtype=torch.uint8)
    assert majority_classes(labels[None], 2, 2, 4).tolist() == [[[2, 1], [0, 2]]]


def test_pixels_without_a_class_are_not_counted() -> None:
    true, said = labels(0), labels(1)
    true[0] = NO_CLASS
    found = frame_confusions(said, true, 4)
    assert found.sum(dim=(1, 2)).tolist() == [0, 48, 48]


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


def test_a_map_without_void_has_no_class_there_and_the_others_stay() -> None:
    assert without_classes(labels(0), ()).equal(labels(0))
    made = without_classes(labels(0), (1, 3))
    assert made.dtype == torch.uint8
    assert ((made == NO_CLASS) == (labels(0) % 2 == 1)).all()
    assert made[labels(0) % 2 == 0].equal(labels(0)[labels(0) % 2 == 0])


def test_of_256_classes_the_last_is_one_too() -> None:
    true = torch.full((1, 2, 2), 255, dtype=torch.uint8)
    assert frame_confusions(true, true, 256)[0, 255, 255] == 4
