"""A picture to judge pairs of clips by: one row a clip."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_train.data.pairs import PairedClip, PairedClips
from gcd_train.errors import DataError
from gcd_train.look.clip import instance_colour

Bytes = NDArray[np.uint8]

_FRAMES = (0, 7, 13)
_INSTANCE_COLOURS = np.array([instance_colour(number) for number in range(256)], np.uint8)
_BEST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 9]


def write_contact_sheet(folder: Path, out: Path, clips: int = 8) -> None:
    """Source, target on its way and at its end, depth and classes of the first clips, as PNG.

    Instances stand for the classes where the world has none.
    """
    data = PairedClips.open(folder, limit=clips)
    classes = np.array([kind.colour for kind in data.classes], np.uint8)
    rows = [_row(data[i], classes if data.classes else None) for i in range(len(data))]
    _write(out, np.concatenate(rows))


def _write(out: Path, picture: Bytes) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(out), picture[..., ::-1], _BEST_PNG):
        raise DataError(f"{out} cannot be written; give a path ending in .png in a folder that takes files")


def _row(clip: PairedClip, class_colours: Bytes | None) -> Bytes:
    last = len(clip.target) - 1
    nearness = np.where(clip.target_depth[last] > 0, 1 / np.maximum(clip.target_depth[last], 4.0), 0.0)
    depth = np.repeat((nearness * 4 * 255).astype(np.uint8)[..., None], 3, -1)
    views = [clip.target[min(i, last)] for i in _FRAMES]
    if class_colours is None:
        labels = _INSTANCE_COLOURS[clip.target_instances[last]]
    else:
        labels = class_colours[clip.target_classes[last]]
    return np.concatenate([clip.source[0], clip.source[last], *views, depth, labels], axis=1)
