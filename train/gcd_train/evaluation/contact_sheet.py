"""Some clips as a picture: what came in, what the model made of it, what the best baselines did, what was there."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from textwrap import wrap

import cv2
import numpy as np

from gcd_model.config import SemanticClass
from gcd_train.baselines import Prediction, Predictor, to_labels
from gcd_train.datasets.clip_source import Bytes
from gcd_train.evaluation.clips import HeldOutClip
from gcd_train.evaluation.kept_frames import painted, png, to_bytes
from gcd_train.evaluation.report import write_file

SHEET_FRAMES = (1, 4, 7, 10, 12, 14)
"""Frames a contact sheet shows, counted from 1."""

_GAP, _LABEL_WIDTH, _INK = 4, 132, (40, 40, 40)
_LINE, _LETTERS = 14, 19  # pixels a line of a label, letters that fit in one


def write_contact_sheet(
    path: Path,
    predictors: Sequence[Predictor],
    clips: Iterable[tuple[str, HeldOutClip]],
    *,
    classes: Sequence[SemanticClass] = (),
) -> None:
    """PNG of some clips. Rows: source, each method's picture and class map, the true ones; columns: frames.

    Args:
        predictors: from top to bottom; what one does not make is left out. clips: from top to bottom, each with what it
            is called. classes: the ontology, empty for none.
    Raises:
        RunError: the file cannot be written. What a method raises.
    """
    blocks: list[Bytes] = []
    for label, clip in clips:
        strips: list[tuple[str, Bytes]] = [("source", clip.seen.source)]
        for each in predictors:
            strips += _made(each.name, each.predict(clip.seen), classes)
        strips += _true(clip, classes)
        blocks += [_labelled_row(label, kind, frames) for kind, frames in strips]
        blocks.append(np.zeros((_GAP, blocks[-1].shape[1], 3), np.uint8))
    write_file(path, png(np.concatenate(blocks[:-1])))


def _made(name: str, made: Prediction, classes: Sequence[SemanticClass]) -> list[tuple[str, Bytes]]:
    strips: list[tuple[str, Bytes]] = []
    if made.video is not None:
        strips.append((name, to_bytes(made.video)))
    if made.classes is not None and classes:
        strips.append((f"{name}: classes", painted(made.classes, classes)))
    return strips


def _true(clip: HeldOutClip, classes: Sequence[SemanticClass]) -> list[tuple[str, Bytes]]:
    labels = to_labels(clip.target_classes if classes else None)
    maps = [] if labels is None else [("true classes", painted(labels, classes))]
    return [*maps, ("target", clip.target)]


def _labelled_row(clip: str, kind: str, frames: Bytes) -> Bytes:
    shown = [frames[number - 1] for number in SHEET_FRAMES if number <= len(frames)]
    height = shown[0].shape[0]
    margin = np.full((height, _LABEL_WIDTH, 3), 255, np.uint8)
    for line, text in enumerate((*wrap(kind, _LETTERS), *wrap(clip, _LETTERS))):
        cv2.putText(margin, text, (4, _LINE * (1 + line)), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)
    gap = np.full((height, _GAP, 3), 255, np.uint8)
    return np.concatenate([margin, *(part for picture in shown for part in (picture, gap))], axis=1)
