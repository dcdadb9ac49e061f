"""Some clips as a picture: what came in, what the model made of it, what the best baselines did, what was there."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.class_head import palette
from gcd_model.geometry import CameraMount
from gcd_train.baselines import Predictor
from gcd_train.baselines.predictor import to_labels
from gcd_train.datasets.paired import PairedClip
from gcd_train.evaluation.held_out import HeldOutClips, source_side
from gcd_train.evaluation.report import write_file

SHEET_FRAMES = (1, 4, 7, 10, 12, 14)
"""Frames a contact sheet shows, counted from 1."""

Pictures = NDArray[np.uint8]
_GAP, _LABEL_WIDTH, _INK = 4, 132, (40, 40, 40)
_LINE, _LETTERS = 14, 19  # pixels a line of a label, letters that fit in one


def write_contact_sheet(
    path: Path,
    predictors: Sequence[Predictor],
    clips: HeldOutClips,
    numbers: Sequence[int],
    *,
    labels: Sequence[str],
    declared: CameraMount | None = None,
) -> None:
    """PNG of some clips. Rows: source, each predictor's picture and class map, the true ones; columns: frames.

    Args:
        predictors: from top to bottom; what one does not make is left out.
        numbers: of the clips, from top to bottom. labels: what each of these is called.
        declared: see `evaluate`.
    Raises:
        RunError: the file cannot be written.
    """
    colours = palette(tuple(clips.classes)) if clips.classes else torch.zeros(1, 3, dtype=torch.uint8)
    blocks: list[Pictures] = []
    for number, label in zip(numbers, labels, strict=True):
        clip = clips[number]
        strips: list[tuple[str, Pictures]] = [("source", clip.source)]
        for each in predictors:
            strips += _made(each, clips, number, clip, declared, colours)
        strips += _true(clip, colours, classes=bool(clips.classes))
        blocks += [_labelled_row(label, kind, frames) for kind, frames in strips]
        blocks.append(np.zeros((_GAP, blocks[-1].shape[1], 3), np.uint8))
    done, data = cv2.imencode(".png", cv2.cvtColor(np.concatenate(blocks[:-1]), cv2.COLOR_RGB2BGR))
    assert done, "PNG takes any picture"
    write_file(path, data.tobytes())


def _made(
    predictor: Predictor,
    clips: HeldOutClips,
    number: int,
    clip: PairedClip,
    declared: CameraMount | None,
    colours: Tensor,
) -> list[tuple[str, Pictures]]:
    made = predictor.predict(source_side(clips, number, clip, declared))
    strips: list[tuple[str, Pictures]] = []
    if made.video is not None:
        strips.append((predictor.name, _to_bytes(made.video)))
    if made.classes is not None:
        strips.append((f"{predictor.name}: classes", _painted(made.classes, colours)))
    return strips


def _true(clip: PairedClip, colours: Tensor, *, classes: bool) -> list[tuple[str, Pictures]]:
    labels = to_labels(clip.target_classes if classes else None)
    maps = [] if labels is None else [("true classes", _painted(labels, colours))]
    return [*maps, ("target", clip.target)]


def _painted(labels: Tensor, colours: Tensor) -> Pictures:
    return colours[labels.long()].numpy()


def _labelled_row(clip: str, kind: str, frames: Pictures) -> Pictures:
    shown = [frames[number - 1] for number in SHEET_FRAMES if number <= len(frames)]
    height = shown[0].shape[0]
    margin = np.full((height, _LABEL_WIDTH, 3), 255, np.uint8)
    for line, text in enumerate((*wrap(kind, _LETTERS), *wrap(clip, _LETTERS))):
        cv2.putText(margin, text, (4, _LINE * (1 + line)), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)
    gap = np.full((height, _GAP, 3), 255, np.uint8)
    return np.concatenate([margin, *(part for picture in shown for part in (picture, gap))], axis=1)


def _to_bytes(video: Tensor) -> Pictures:
    return (video.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()
