"""The side-by-side video: every kind of picture in its panel, with names, time and a depth bar."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError
from gcd_train.show.footage import Footage
from gcd_train.show.matplotlib_door import DPI, new_figure, to_pixels
from gcd_train.show.sheet import FAINT, INK, Row, depth_bar, rows_of

Bytes = NDArray[np.uint8]
_COLUMNS = 3
_GAP, _NAME, _TOP, _BAR = 10, 26, 44, 44  # pixels
_PLAYS = 2
_HOLD_S = 0.7  # at the end of each play


def write_video(footage: Footage, out: Path) -> None:
    """The clip at its own speed, twice over, as MP4 (MPEG-4 part 2).

    Raises: RenderError without matplotlib, DataError if the file cannot be written.
    """
    rows = rows_of(footage)
    height, width = footage.source.shape[1:3]
    places = [_place(number, width, height) for number in range(len(rows))]
    page = _page(footage, rows, places)
    hold = [footage.frames - 1] * round(_HOLD_S * footage.fps)
    out.parent.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(out), cv2.VideoWriter.fourcc(*"mp4v"), footage.fps, (page.shape[1], page.shape[0]))
    if not video.isOpened():
        raise DataError(f"{out} cannot be written; give a folder that takes files")
    for moment in [*range(footage.frames), *hold] * _PLAYS:
        video.write(_frame(footage, rows, places, page, moment)[..., ::-1])
    video.release()


def _place(number: int, width: int, height: int) -> tuple[int, int]:
    """Left upper corner of a panel, pixels."""
    row, column = divmod(number, _COLUMNS)
    return _GAP + column * (width + _GAP), _TOP + _NAME + row * (height + _NAME + _GAP)


def _page(footage: Footage, rows: Sequence[Row], places: Sequence[tuple[int, int]]) -> Bytes:
    """Everything that does not move, drawn once: u8 [H, W, 3], even sizes as codecs want them."""
    height, width = footage.source.shape[1:3]
    across = _COLUMNS * (width + _GAP) + _GAP + _BAR
    down = max(top for _, top in places) + height + _GAP
    across, down = across + across % 2, down + down % 2
    figure = new_figure(across / DPI, down / DPI)
    figure.text(_GAP / across, 1 - 13 / down, footage.title, fontsize=12, fontweight="bold", color=INK, va="top")
    for row, (left, top) in zip(rows, places, strict=True):
        at = (left / across, 1 - (top - 7) / down)
        figure.text(*at, row.name, fontsize=9.5, fontweight="bold", color=INK)
        told = row.told.replace("\n", " ")
        figure.text((left + 92) / across, at[1], told, fontsize=7.5, color=FAINT)
    left, top = places[-1]
    depth_bar(
        figure.add_axes(((left + width + 8) / across, 1 - (top + height) / down, 10 / across, (height - 14) / down)),
        footage,
    )
    return to_pixels(figure)


def _frame(footage: Footage, rows: Sequence[Row], places: Sequence[tuple[int, int]], page: Bytes, moment: int) -> Bytes:
    picture = page.copy()
    height, width = footage.source.shape[1:3]
    for row, (left, top) in zip(rows, places, strict=True):
        picture[top : top + height, left : left + width] = row.pictures[moment]
    seen = f"{100 * footage.seen_shares[moment]:.0f} % seen"
    told = f"t = {footage.seconds[moment]:.2f} s   frame {footage.frame_numbers[moment]:3d}   {seen}"
    at = (_GAP + _COLUMNS * (width + _GAP) - 340, 28)
    cv2.putText(picture, told, at, cv2.FONT_HERSHEY_SIMPLEX, 0.52, (60, 70, 82), 1, cv2.LINE_AA)
    return picture
