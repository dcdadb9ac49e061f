"""Class maps compared: what was taken for what, and how much of each class is right."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.errors import ShapeError
from gcd_train.metrics.shapes import require_mask, require_same_shape

NO_CLASS = 255
"""Id of pixels that belong to no class, unless an ontology has 256: not counted in targets, wrong in predictions."""

_VOID_NAMES = frozenset({"void", "unlabelled", "unlabeled"})


def void_ids(names: Sequence[str]) -> tuple[int, ...]:
    """Ids of the entries of an ontology that stand for no class: "Void", "unlabelled", whatever the case.

    None of an ontology with 256 entries, which leaves no id for what has no class.
    """
    if len(names) > NO_CLASS:
        return ()
    return tuple(label for label, name in enumerate(names) if name.strip().lower() in _VOID_NAMES)


def without_classes(labels: Tensor, void: Sequence[int]) -> Tensor:
    """A class map, uint8 of any shape, with `NO_CLASS` where an id of `void` stood."""
    if not void:
        return labels
    return labels.masked_fill(torch.isin(labels, torch.tensor(void, dtype=labels.dtype)), NO_CLASS)


def majority_classes(classes: Tensor, height: int, width: int, count: int) -> Tensor:
    """Class maps at a coarser grid: the commonest class of each cell, the lowest id where two are as common.

    Args:
        classes: uint8 [..., H, W], ids below `count`. height, width: of the grid; they divide H and W.
    Returns:
        uint8 [..., height, width]; 0 where none of the classes is in a cell.
    """
    *leading, rows, columns = classes.shape
    if rows % height or columns % width:
        raise ShapeError(f"a grid must divide the class map: wanted {height}x{width} from {rows}x{columns}")
    flat = classes.reshape(-1, rows, columns)
    cell = (rows // height, columns // width)
    there = torch.bincount(flat.flatten(), minlength=count)[:count] > 0
    there[0] = True  # what a cell becomes that none of the classes is in
    labels = there.nonzero()[:, 0]
    shares = torch.stack([F.avg_pool2d((flat == label).float(), cell) for label in labels.tolist()])
    return labels[shares.argmax(dim=0)].to(torch.uint8).reshape(*leading, height, width)


def confusion_matrix(predicted: Tensor, target: Tensor, count: int) -> Tensor:
    """Pixels of each target class (rows) by predicted class (columns): int64 [count, count].

    Matrices of several pictures add up. Raises ShapeError where shapes differ or an id is `count` or more.
    """
    require_same_shape(predicted, target)
    _require_known(predicted, target, count)
    pairs = target.long().flatten() * count + predicted.long().flatten()
    return torch.bincount(pairs, minlength=count * count).view(count, count)


def frame_confusions(predicted: Tensor, target: Tensor, count: int, mask: Tensor | None = None) -> Tensor:
    """`confusion_matrix` of each frame, without pixels whose target has no class: int64 [T, count, count + 1].

    The last column holds pixels whose prediction has no class: they are wrong, and taken for none of the others.

    Args:
        predicted, target: uint8 [T, H, W]. mask: bool [T, H, W], the pixels that count; None for all.
    Raises:
        ShapeError: shapes differ, or an id other than `NO_CLASS` is `count` or more.
    """
    require_same_shape(predicted, target)
    counted = _of_a_class(target, count)
    if mask is not None:
        require_mask(mask, *target.shape)
        counted = counted & mask
    said, true = predicted[counted], target[counted]
    known = _of_a_class(said, count)
    _require_known(said[known], true, count)
    frames, columns = len(target), count + 1
    frame = torch.arange(frames).view(-1, 1, 1).expand(target.shape)[counted]
    cells = (frame * count + true.long()) * columns + torch.where(known, said.long(), count)
    return torch.bincount(cells, minlength=frames * count * columns).view(frames, count, columns)


def named_confusion(predicted: Tensor, target: Tensor, names: Sequence[str]) -> Tensor:
    """`frame_confusions` of all frames together, int64 [K, K + 1], for the K classes of these names: those that stand
    for no class do not count where they are true."""
    void = void_ids(names)
    said, true = (without_classes(labels.cpu(), void) for labels in (predicted, target))
    return frame_confusions(said, true, len(names)).sum(dim=0)


def class_iou(confusion: Tensor) -> Tensor:
    """Intersection over union of each class, float64 [K]; NaN for one that is neither predicted nor there.

    confusion: [K, K], or [K, K + 1] with a last column for predictions of no class.
    """
    both = confusion.diagonal().double()
    return both / (confusion.sum(dim=0)[: len(confusion)] + confusion.sum(dim=1) - both)


def commonest_classes(pixels: Tensor, count: int) -> tuple[int, ...]:
    """Ids of the classes with most target pixels, most first, the lower id of two as common; absent ones never.

    Args:
        pixels: [K], of all evaluated targets together. count: how many at most.
    """
    order = pixels.argsort(descending=True, stable=True)[:count]
    return tuple(label for label in order.tolist() if pixels[label] > 0)


def mean_iou(confusion: Tensor, classes: Sequence[int] | None = None) -> float:
    """Mean over the classes that are predicted or there; NaN if none is.

    Args:
        confusion: of a whole set, for the paper's figure. classes: ids to average over, as the ten `commonest_classes`
            of the paper; None for all.
    """
    iou = class_iou(confusion)
    return float((iou if classes is None else iou[list(classes)]).nanmean())


def pixel_accuracy(confusion: Tensor) -> float:
    """Share of pixels whose class is right; NaN for no pixels."""
    return float(confusion.diagonal().sum().double() / confusion.sum())


def _of_a_class(labels: Tensor, count: int) -> Tensor:
    """Where ids are those of a class, or of none that is known."""
    return labels != NO_CLASS if count <= NO_CLASS else torch.ones_like(labels, dtype=torch.bool)


def _require_known(predicted: Tensor, target: Tensor, count: int) -> None:
    if any(labels.numel() and int(labels.max()) >= count for labels in (predicted, target)):
        raise ShapeError(f"class ids must be below {count}; are the two ontologies the same?")
