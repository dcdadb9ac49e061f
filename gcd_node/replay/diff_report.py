"""A comparison of two runs in words, as tables, as JSON, and in pictures of where they differ most."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from rich.table import Table

from gcd_client.images import paint
from gcd_node.errors import OutputError
from gcd_node.frame import Image
from gcd_node.pictures.comparison import heading_line, legend
from gcd_node.pictures.files import make_folder, strip, write_png
from gcd_node.replay.compare import (
    MAP_NAMES,
    Distance,
    Missing,
    RunComparison,
    Tolerance,
    ViewComparison,
    paired_windows,
)
from gcd_node.replay.run import RunFolder, WindowPixels

WORST = 4
"""As many pictures are made."""
REPORT = "diff.json"

_ROWS, _LINES = 40, 10
_HIGHEST_GAIN = 64
_COLUMN_WIDTH = 320  # pixels; smaller pictures are enlarged by a whole factor to at least this
_PATTERN = "window-*-view-*.png"


def verdict(comparison: RunComparison, tolerance: Tolerance) -> str:
    """How the comparison ends, in one line."""
    total = len(comparison.views) + len(comparison.missing)
    same = sum(view.identical for view in comparison.views)
    if same == total:
        return f"identical: all {total} views"
    far = len(comparison.failures(tolerance))
    if not far:
        return f"near enough: {same} of {total} views are identical, the others {_bounds(tolerance)}"
    return f"DIFFERENT: {far} of {total} views are not {_bounds(tolerance)}"


def divergence(comparison: RunComparison) -> str | None:
    """Where the runs first differ and what that says, in one line; None if they are identical."""
    first = comparison.first_divergence
    if first is None:
        return None
    cause = _cause(first) if isinstance(first, ViewComparison) else ""
    return f"first divergence: window {first.window_id}, view {first.view_id}: {describe(first)}{cause}"


def describe(each: ViewComparison | Missing) -> str:
    """One view of one window in words."""
    if isinstance(each, Missing):
        return f"only in {each.only_in}"
    if each.identical:
        return "identical"
    parts = [] if each.distance is None else _apart(each.distance)
    return "; ".join(parts + [f"other {fact}" for fact in each.facts])


def report_text(comparison: RunComparison, tolerance: Tolerance) -> str:
    """The whole comparison for an assertion or a log: verdict, causes, first divergence, the worst views."""
    lines = [verdict(comparison, tolerance)]
    if comparison.facts:
        lines += ["what A and B were made from differs (A, B):"]
        lines += [f"  {fact.name}: {fact.a}, {fact.b}" for fact in comparison.facts]
    first, failures = divergence(comparison), comparison.failures(tolerance)
    lines += [] if first is None else [first]
    lines += [f"  window {each.window_id}, view {each.view_id}: {describe(each)}" for each in failures[:_LINES]]
    lines += [f"  and {len(failures) - _LINES} more"] if len(failures) > _LINES else []
    return "\n".join(lines)


def tables(comparison: RunComparison, tolerance: Tolerance) -> list[Table]:
    """What the runs were made from, if that differs, and every view of every window; of many, those that differ."""
    facts = Table("differs", "A", "B", title="What the runs were made from", title_style="dim")
    for fact in comparison.facts:
        facts.add_row(fact.name, fact.a, fact.b)
    rows = sorted((*comparison.views, *comparison.missing), key=lambda each: (each.window_id, each.view_id))
    if len(rows) > _ROWS:
        rows = [each for each in rows if isinstance(each, Missing) or not each.identical]
    views = Table("window", "view", "difference", title="Views of windows", title_style="dim")
    failures = comparison.failures(tolerance)
    for each in rows[:_ROWS]:
        views.add_row(str(each.window_id), each.view_id, describe(each), style="red" if each in failures else None)
    if len(rows) > _ROWS:
        views.caption = f"and {len(rows) - _ROWS} more that differ; --json has them all"
    return [facts, views] if comparison.facts else [views]


def to_plain(comparison: RunComparison, tolerance: Tolerance) -> dict[str, Any]:
    """Everything as plain values for JSON, which has null for the PSNR of identical pictures, infinite here."""
    first = comparison.first_divergence
    return {
        "a": str(comparison.a),
        "b": str(comparison.b),
        "passed": not comparison.failures(tolerance),
        "identical": first is None,
        **asdict(tolerance),
        "facts": [asdict(fact) for fact in comparison.facts],
        "first_divergence": None if first is None else {"window_id": first.window_id, "view_id": first.view_id},
        "views": [
            {**asdict(view), "identical": view.identical, "passed": view.within(tolerance)} for view in comparison.views
        ],
        "missing": [asdict(each) for each in comparison.missing],
    }


def _cause(first: ViewComparison) -> str:
    if not first.same_input:
        return "; the model was given other pictures already: look at the recording and its decoder"
    if not first.same_seed:
        return "; the model was given the same pictures and another seed, as any other setting brings one"
    return "; the model was given the same pictures"


def _bounds(tolerance: Tolerance) -> str:
    least_db, share = tolerance.min_psnr_db, tolerance.max_class_share
    pictures = "identical" if least_db is None else f"within {least_db:g} dB in every frame"
    return pictures if share == 0 else f"{pictures} and {share:.2%} of the class pixels"


def _apart(distance: Distance) -> list[str]:
    parts: list[str] = []
    if distance.largest:
        parts.append(
            f"{distance.psnr_db:.2f} dB, frame {distance.worst_frame} {distance.worst_psnr_db:.2f} dB, "
            f"up to {distance.largest} levels"
        )
    return parts + [f"{share:.3%} of the {MAP_NAMES[kind]}" for kind, share in distance.shares.items() if share]


# Pictures.


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
    paths = {
        (view.window_id, view.view_id): folder / f"window-{view.window_id:06d}-view-{view.view_id}.png"
        for view in comparison.worst(WORST)
    }
    views = {(view.window_id, view.view_id): view for view in comparison.views}
    for a, b in paired_windows(*runs) if paths else ():  # read again, which is cheaper than to keep all pixels
        for key, path in paths.items():
            if a is not None and b is not None and key[0] == a.entry.window_id:
                write_png(path, side_by_side_picture(views[key], a, b, runs))
    return tuple(paths.values())


def side_by_side_picture(
    view: ViewComparison, a: WindowPixels, b: WindowPixels, runs: tuple[RunFolder, RunFolder]
) -> Image:
    """A, B and their difference at the first frame, the one that differs most and the last; class maps below, at the
    frame where most of their pixels differ.

    Levels of the difference are multiplied by the heading's number; class pixels that differ are white.
    """
    distance = view.distance
    assert distance is not None, "only views with pictures of one size have a place among the worst"
    all_a, all_b = a.views[view.view_id], b.views[view.view_id]
    chosen = sorted({0, distance.worst_frame, len(all_a["win"]) - 1})
    gain = gain_for(distance.largest)
    pairs = [(all_a["win"][i], all_b["win"][i]) for i in chosen]
    rows = [(one, other, cv2.convertScaleAbs(cv2.absdiff(one, other), alpha=gain)) for one, other in pairs]
    head = f"window {view.window_id}, frames {' '.join(map(str, chosen))}"
    classes = [run.manifest.classes for run in runs]
    if "cls" in all_a and "cls" in all_b:
        at = distance.worst_class_frame
        one, other = all_a["cls"][at], all_b["cls"][at]
        differs = np.where(one != other, np.uint8(255), np.uint8(0))
        rows.append((paint(one, classes[0]), paint(other, classes[1]), np.repeat(differs[..., None], 3, axis=2)))
        head += f", classes {at}"
    body = strip([[_enlarged(np.asarray(picture, np.uint8)) for picture in row] for row in rows])
    parts = [heading_line((f"A: {head}", "B", f"difference x {gain}"), body.shape[1]), body]
    return np.concatenate([*parts, legend(classes[0], body.shape[1])] if classes[0] else parts)


def gain_for(largest: int) -> int:
    """The power of two that makes a difference of so many levels as visible as it can be, at most 64."""
    gain = 1
    while gain < _HIGHEST_GAIN and 2 * gain * largest <= 255:
        gain *= 2
    return gain


def _enlarged(picture: Image) -> Image:
    """Without new levels: a difference is looked at pixel by pixel."""
    factor = max(1, -(-_COLUMN_WIDTH // picture.shape[1]))
    return np.repeat(np.repeat(picture, factor, axis=0), factor, axis=1)
