"""Pictures of the same moments beside each other, with headings and a legend. Images are u8 RGB."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gcd_client.protocol import ClassRecord
from gcd_node.frame import Image
from gcd_node.pictures.files import side_by_side

_COLUMN_WIDTH = 320  # pixels; smaller pictures are enlarged by a whole factor to at least this
_FONT, _SCALE, _THICKNESS = cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1
_LINE, _SWATCH, _GAP = 22, 14, 6
_INK, _PAPER = (30, 30, 30), 255


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Moment:
    """One moment, each [H, W, 3]: the camera's picture, the view made of it, the same with what is painted hatched, and
    the view's class map in colours."""

    source: Image
    view: Image
    seen: Image
    classes: Image


def comparison(moments: Sequence[Moment], classes: Sequence[ClassRecord], headings: Sequence[str]) -> Image:
    """One row for each moment, a heading above each column, and under them what the colours mean.

    classes: the ontology. headings: one for each column.
    """
    rows = [side_by_side(*_enlarged(moment)) for moment in moments]
    width = rows[0].shape[1]
    line = np.full((4, width, 3), _PAPER, np.uint8)
    parts = [heading_line(headings, width)]
    for row in rows:
        parts += [row, line]
    return np.concatenate([*parts, legend(classes, width)], axis=0)


def heading_line(headings: Sequence[str], width: int) -> Image:
    """One line of `width` pixels with a heading above each of as many equal columns: [22, width, 3]."""
    picture = _paper(_LINE, width)
    for index, heading in enumerate(headings):
        _write(picture, heading, _GAP + index * width // len(headings), 0)
    return picture


def legend(classes: Sequence[ClassRecord], width: int) -> Image:
    """Each class's colour and name, in as many lines of `width` pixels as it takes: [lines * 22, width, 3]."""
    places = _places([_text_width(_shown(each)) + _SWATCH + 3 * _GAP for each in classes], width)
    picture = _paper((places[-1][0] + 1) * _LINE, width)
    for each, (line, left) in zip(classes, places, strict=True):
        top = line * _LINE + (_LINE - _SWATCH) // 2
        picture[top : top + _SWATCH, left : left + _SWATCH] = each.colour
        _write(picture, _shown(each), left + _SWATCH + _GAP, line)
    return picture


def _enlarged(moment: Moment) -> list[Image]:
    """Photographs smoothly, class maps without new colours."""
    factor = max(1, -(-_COLUMN_WIDTH // moment.source.shape[1]))
    size = (factor * moment.source.shape[1], factor * moment.source.shape[0])
    photographs = [cv2.resize(each, size, interpolation=cv2.INTER_CUBIC) for each in (moment.source, moment.view)]
    drawn = [cv2.resize(each, size, interpolation=cv2.INTER_NEAREST) for each in (moment.seen, moment.classes)]
    return [np.asarray(each, np.uint8) for each in (*photographs, *drawn)]


def _places(widths: Sequence[int], available: int) -> list[tuple[int, int]]:
    """Line and left edge of each entry, filled like text."""
    places: list[tuple[int, int]] = []
    line, left = 0, _GAP
    for width in widths:
        if left > _GAP and left + width > available:
            line, left = line + 1, _GAP
        places.append((line, left))
        left += width
    return places


def _shown(each: ClassRecord) -> str:
    return each.name.replace("_", " ")


def _paper(height: int, width: int) -> Image:
    return np.full((height, width, 3), _PAPER, np.uint8)


def _text_width(text: str) -> int:
    return cv2.getTextSize(text, _FONT, _SCALE, _THICKNESS)[0][0]


def _write(picture: Image, text: str, left: int, line: int) -> None:
    baseline = line * _LINE + _LINE - 7
    cv2.putText(picture, text, (left, baseline), _FONT, _SCALE, _INK, _THICKNESS, cv2.LINE_AA)
