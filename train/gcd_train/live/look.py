"""Sheets to look at while the live model learns."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from gcd_model.colours import palette
from gcd_model.config import SemanticClass


def picture(video: Tensor) -> Tensor:
    """[3, H, W] in [-1, 1] -> u8 [H, W, 3]."""
    return ((video.clamp(-1, 1) + 1) * 127.5).round().byte().permute(1, 2, 0)


def depth_picture(metres: Tensor) -> Tensor:
    """Near is bright: [H, W] metres -> u8 [H, W, 3]."""
    level = (1 - (metres.clamp(0.3, 200) / 0.3).log() / 6.5).clamp(0, 1) * 255
    return level.byte()[..., None].repeat(1, 1, 3)


def write_rows(rows: Sequence[Sequence[Tensor]], path: Path) -> None:
    """u8 [H, W, 3] tiles as a PNG."""
    sheet = torch.cat([torch.cat(list(row), dim=1) for row in rows]).numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.ascontiguousarray(sheet[..., ::-1]))


def depth_sheet(
    shown: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]], classes: Sequence[SemanticClass], path: Path
) -> None:
    """Picture, true depth, made depth, made classes, a row each."""
    colours = palette(tuple(classes))
    rows = [
        [picture(video), depth_picture(true), depth_picture(made), colours[labels.long()]]
        for video, true, made, labels in shown
    ]
    write_rows(rows, path)
