"""Classes of records counted frame by frame, once for every choice of frames and pixels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_train.evaluation.record import REGIONS, ClipRecord, Counted, Region
from gcd_train.metrics import NO_CLASS, commonest_classes

COMMON_CLASSES = 10
"""Classes that the paper's mIoU is a mean over: the commonest of the evaluated targets."""

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class ClassCounts:
    """Pixels that are right, predicted and true by class, of n clips with T frames and K classes.

    regions: [n, T, 3, K] at picture size, of regions that any clip has. grid: [n, T, 3, K] at the class grid.
    common: ids of the commonest classes.
    """

    grid: Array
    regions: Mapping[Region, Array] = field(default_factory=dict[Region, Array])
    common: tuple[int, ...] = ()

    def of(self, region: Region) -> Array:
        """At picture size; zeros for a region that nobody has."""
        return self.regions.get(region, np.zeros_like(self.grid))


def class_counts(records: Sequence[ClipRecord], classes: int = 0) -> ClassCounts:
    """Counts of one method's clips. classes: how many there are at least; ids beyond make it more."""
    count = max([classes, *(1 + _highest(record) for record in records)])
    names: list[Region] = [name for name in REGIONS if any(name in record.regions for record in records)]
    regions: dict[Region, Array] = {
        name: _stacked([_confusion(record, name) for record in records], records, count) for name in names
    }
    grid = _stacked([record.grid_confusion for record in records], records, count)
    return ClassCounts(grid=grid, regions=regions, common=_commonest(regions.get("all", grid)))


def _commonest(counts: Array) -> tuple[int, ...]:
    """Ids of the classes with most pixels in the targets of all frames, rising; ties go to the lower id."""
    true = torch.from_numpy(counts[:, :, 2].sum(axis=(0, 1)))
    return tuple(sorted(commonest_classes(true, COMMON_CLASSES)))


def _confusion(record: ClipRecord, name: Region) -> Sequence[Counted] | None:
    region = record.regions.get(name)
    return None if region is None else region.confusion


def _stacked(confusions: Sequence[Sequence[Counted] | None], records: Sequence[ClipRecord], classes: int) -> Array:
    """[n, T, 3, K]; zeros where nothing was counted."""
    frames = records[0].frames if records else 0
    counts = np.zeros((len(records), frames, 3, classes))
    for clip, confusion in zip(counts, confusions, strict=True):
        for frame, counted in zip(clip, confusion or (), strict=False):
            _count(frame, counted)
    return counts


def _count(frame: Array, counted: Counted) -> None:
    """Fill one frame's counts [3, K]."""
    if not counted:
        return
    true, predicted, pixels = np.array(counted).T
    known = predicted < frame.shape[1]  # the others are of no class: wrong, and nobody's
    np.add.at(frame[0], true, pixels * (true == predicted))
    np.add.at(frame[1], predicted[known], pixels[known])
    np.add.at(frame[2], true, pixels)


def _highest(record: ClipRecord) -> int:
    """The highest class id that a record names; -1 for none."""
    every = [record.grid_confusion or (), *(region.confusion or () for region in record.regions.values())]
    ids = (label for frames in every for frame in frames for entry in frame for label in entry[:2])
    return max((label for label in ids if label != NO_CLASS), default=-1)
