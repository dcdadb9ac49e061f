"""What turns a drawn sample into pictures, by points or exactly: the types both share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics, center_crop_box
from gcd_train.datasets.trajectories import Draw

Bytes = NDArray[np.uint8]
Number = TypeVar("Number", bound=np.generic)
Modality = Literal["rgb", "classes"]


@dataclass(frozen=True, kw_only=True, slots=True)
class PairPictures:
    """A sample's pictures, as in `PairSample`. world_from_source: f64 [4, 4], where the source camera really stood."""

    source: Bytes
    target: Bytes
    target_classes: Bytes | None
    visible: NDArray[np.bool_] | None
    world_from_source: NDArray[np.float64]


class Pictures(Protocol):
    """Makes the pictures of samples."""

    def make(self, scene: str, draw: Draw) -> PairPictures:
        """Raises DataError, FileFault: a file is missing, damaged or does not fit."""
        ...


def trained_picture(rgb: Bytes, width: int, height: int) -> Bytes:
    """A camera's picture at the trained size: centre crop to its shape, then bilinear resize, as published."""
    left, top, across, along = center_crop_box(rgb.shape[1], rgb.shape[0], width / height)
    cropped = rgb[top : top + along, left : left + across]
    if (across, along) == (width, height):
        return np.ascontiguousarray(cropped)
    return cv2.resize(cropped, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False)


def trained_lens(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """The lens of `trained_picture`'s result, for a picture of this lens."""
    return lens.cropped(*center_crop_box(lens.width, lens.height, width / height)).resized(width, height)


def stacked(rows: Sequence[NDArray[Number] | None]) -> NDArray[Number] | None:
    """Frames as one clip, None if any of them is."""
    there = [row for row in rows if row is not None]
    return np.stack(there) if len(there) == len(rows) else None
