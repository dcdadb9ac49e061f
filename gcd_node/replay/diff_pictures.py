"""Pictures of where two runs differ: A, B and the difference made visible, beside each other."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import cv2
import msgspec
import numpy as np

from gcd_node.errors import OutputError
from gcd_node.frame import Image
from gcd_node.pictures.comparison import heading_line, legend
from gcd_node.pictures.files import make_folder, strip, write_png
from gcd_node.replay.diff_report import to_plain
from gcd_node.replay.manifest import Manifest
from gcd_node.replay.pixel_file import Pixels
from gcd_node.replay.run_diff import RunComparison, Tolerance, ViewComparison, paired_windows
from gcd_node.replay.run_folder import RunFolder, WindowPixels
from gcd_node.wire.class_colours import paint
from gcd_node.wire.header import ClassRecord

Classes: TypeAlias = tuple[ClassRecord, ...]
"""The ontology of a run's class maps."""

WORST = 4
"""As many pictures are made."""

REPORT = "diff.json"

_HIGHEST_GAIN = 64
_COLUMN_WIDTH = 320  # pixels; smaller pictures are enlarged by a whole factor to at least this
_PATTERN = "window-*-view-*.png"


def write_report(
    folder: Path, comparison: RunComparison, tolerance: Tolerance, runs: tuple[RunFolder, RunFolder]
) -> tuple[Path, ...]:
    """Write diff.json and a picture of each of the worst views; gives the paths of the pictures, worst first.

    Pictures of an earlier comparison in the same folder are removed.
    Raises:
        OutputError: `folder` cannot be written. DamagedRunError: see paired_windows().
    """
    make_folder(folder)
    try:
        for old in folder.glob(_PATTERN):
            old.unlink()
        (folder / REPORT).write_bytes(msgspec.json.encode(to_plain(comparison, tolerance)) + b"\n")
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror}; name another folder") from error
    worst = comparison.worst(WORST)
    found = _pictures(worst, runs) if worst else {}
    for path, picture in ((folder / _name(view), found[_name(view)]) for view in worst):
        write_png(path, picture)
    return tuple(folder / _name(view) for view in worst)


def side_by_side_picture(
    view: ViewComparison, a: WindowPixels, b: WindowPixels, classes: tuple[Classes, Classes]
) -> Image:
    """A, B and their difference at the first frame, the one that differs most and the last; class maps below, at the
    frame where most of their pixels differ.

    Levels of the difference are multiplied by the heading's number; class pixels that differ are white.
    classes: the ontologies of A and of B, empty without class maps.
    """
    pictures_a, pictures_b = a.pictures[view.view_id], b.pictures[view.view_id]
    distance = view.distance
    worst = 0 if distance is None else distance.worst_frame
    chosen = sorted({0, worst, len(pictures_a) - 1})
    gain = gain_for(0 if distance is None else distance.largest)
    rows = [_row(pictures_a[i], pictures_b[i], _amplified(pictures_a[i], pictures_b[i], gain)) for i in chosen]
    head = f"window {view.window_id}, frames {' '.join(map(str, chosen))}"
    maps = a.maps[view.view_id].get("cls"), b.maps[view.view_id].get("cls")
    if maps[0] is not None and maps[1] is not None:
        at = 0 if distance is None else distance.worst_class_frame
        rows.append(_class_row(maps[0][at], maps[1][at], classes))
        head += f", classes {at}"
    body = strip(rows)
    parts = [heading_line((f"A: {head}", "B", f"difference x {gain}"), body.shape[1]), body]
    return np.concatenate([*parts, legend(classes[0], body.shape[1])] if classes[0] else parts)


def gain_for(largest: int) -> int:
    """The power of two that makes a difference of so many levels as visible as it can be, at most 64."""
    gain = 1
    while gain < _HIGHEST_GAIN and 2 * gain * largest <= 255:
        gain *= 2
    return gain


def _pictures(worst: Sequence[ViewComparison], runs: tuple[RunFolder, RunFolder]) -> dict[str, Image]:
    """By file name. Both runs are read a second time, which is cheaper than to keep all their pixels."""
    wanted: dict[int, list[ViewComparison]] = {}
    for view in worst:
        wanted.setdefault(view.window_id, []).append(view)
    classes = _ontology(runs[0].manifest), _ontology(runs[1].manifest)
    found: dict[str, Image] = {}
    for a, b in paired_windows(*runs):
        if a is not None and b is not None:
            for view in wanted.get(a.entry.window_id, ()):
                found[_name(view)] = side_by_side_picture(view, a, b, classes)
    return found


def _name(view: ViewComparison) -> str:
    return f"window-{view.window_id:06d}-view-{view.view_id}.png"


def _ontology(manifest: Manifest) -> Classes:
    return tuple(ClassRecord(id=each.id, name=each.name, colour=each.colour) for each in manifest.classes)


def _amplified(a: Image, b: Image, gain: int) -> Image:
    return np.asarray(cv2.convertScaleAbs(cv2.absdiff(a, b), alpha=gain), np.uint8)


def _row(*pictures: Image) -> list[Image]:
    return [_enlarged(picture) for picture in pictures]


def _class_row(a: Pixels, b: Pixels, classes: tuple[Classes, Classes]) -> list[Image]:
    differs = np.where(a != b, np.uint8(255), np.uint8(0))
    return _row(paint(a, classes[0]), paint(b, classes[1]), np.repeat(differs[..., None], 3, axis=2))


def _enlarged(picture: Image) -> Image:
    """Without new levels: a difference is looked at pixel by pixel."""
    factor = max(1, -(-_COLUMN_WIDTH // picture.shape[1]))
    return np.repeat(np.repeat(picture, factor, axis=0), factor, axis=1)
