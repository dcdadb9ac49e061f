"""Sample pictures of a run."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from gcd_train.files import write_whole

_GAP = 4  # pixels between the pictures of a sheet


def write_sheet(path: Path, rows: Sequence[Sequence[Tensor]]) -> None:
    """Write pictures [3, H, W] in [-1, 1], all of one size, row by row as one PNG. Raises RunError."""
    height, width = rows[0][0].shape[-2:]
    sheet = np.full((len(rows) * (height + _GAP), max(map(len, rows)) * (width + _GAP), 3), 255, np.uint8)
    for y, row in enumerate(rows):
        for x, picture in enumerate(row):
            top, left = y * (height + _GAP), x * (width + _GAP)
            sheet[top : top + height, left : left + width] = _to_bytes(picture)
    done, data = cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    assert done, "PNG takes any picture"
    write_whole(path, data.tobytes())


def _to_bytes(picture: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    scaled = (picture.detach().float().cpu().clamp(-1, 1) + 1) * 127.5
    return scaled.round().to(torch.uint8).permute(1, 2, 0).numpy()
