"""A picture to judge pairs of clips by: one row a clip."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_train.datasets.paired import PairedClip, PairedClips
from gcd_train.errors import DataError

_FRAMES = (0, 7, 13)
_BEST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 9]


def write_contact_sheet(folder: Path, out: Path, clips: int = 8) -> None:
    """Source, target on its way and at its end, depth and classes of the first clips, as PNG."""
    data = PairedClips.open(folder, limit=clips)
    palette = np.array([kind.colour for kind in data.classes], np.uint8)
    rows = [_row(data[i], palette) for i in range(len(data))]
    _write(out, np.concatenate(rows))


def _write(out: Path, picture: NDArray[np.uint8]) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(out), picture[..., ::-1], _BEST_PNG):
        raise DataError(f"{out} cannot be written; give a path ending in .png in a folder that takes files")


def _row(clip: PairedClip, palette: NDArray[np.uint8]) -> NDArray[np.uint8]:
    last = len(clip.target) - 1
    nearness = np.where(clip.target_depth[last] > 0, 1 / np.maximum(clip.target_depth[last], 4.0), 0.0)
    depth = np.repeat((nearness * 4 * 255).astype(np.uint8)[..., None], 3, -1)
    views = [clip.target[min(i, last)] for i in _FRAMES]
    return np.concatenate(
        [clip.source[0], clip.source[last], *views, depth, palette[clip.target_classes[last]]], axis=1
    )
