"""An evaluation as files: JSON for programs, a Markdown table and a contact sheet for people."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.class_head import palette
from gcd_train.baselines import Prediction, Predictor
from gcd_train.datasets.paired import PairedClip
from gcd_train.errors import RunError
from gcd_train.evaluation import Evaluation, Figures, HeldOutClips

SHEET_FRAMES = (1, 4, 7, 10, 12, 14)
"""Frames a contact sheet shows, counted from 1."""

_RIVAL = "depth_reprojection"
_GAP, _LABEL_WIDTH, _INK = 4, 84, (40, 40, 40)


class MountNumbers(msgspec.Struct, frozen=True, kw_only=True):
    """The part of a CameraMount that studies vary: height in metres, degrees down."""

    height_m: float
    tilt_deg: float

    def __str__(self) -> str:
        return f"{self.height_m:g} m, {self.tilt_deg:g} deg down"


class Conditions(msgspec.Struct, frozen=True, kw_only=True):
    """What the figures hold for.

    clips: how many were measured. first_seed, last_seed: of their scenes.
    size, grid: height and width of pictures and of the class grid.
    true_mount: of the source camera in the data. declared_mount: what the model and the baselines were told of it.
    train_clips: clips the mean and the majority map were fitted on, 0 without baselines.
    """

    data: str
    weights: str | None
    sha256_12: str | None
    clips: int
    first_seed: int
    last_seed: int
    frames: int
    size: tuple[int, int]
    grid: tuple[int, int]
    true_mount: MountNumbers
    declared_mount: MountNumbers
    train: str | None
    train_clips: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Report:
    """Everything an evaluation found."""

    conditions: Conditions
    classes: tuple[str, ...]
    evaluations: tuple[Evaluation, ...]


def psnr_lead(first: Evaluation, other: Evaluation) -> tuple[float, float]:
    """How far `first` is ahead of `other` on the same clips, dB, and the standard error of that difference."""
    ahead = np.array([a.psnr_db - b.psnr_db for a, b in zip(first.clips, other.clips, strict=True)])
    error = ahead.std(ddof=1) / math.sqrt(len(ahead)) if len(ahead) > 1 else math.nan
    return float(ahead.mean()), float(error)


def against_bar(report: Report) -> list[str]:
    """One line for each thing that weights are meant to reach and do or do not; none without weights or baselines."""
    first, rivals = report.evaluations[0], {each.name: each for each in report.evaluations[1:]}
    if report.conditions.weights is None or _RIVAL not in rivals:
        return []
    iou = dict(zip(report.classes, first.total.class_iou, strict=True))
    reached = (
        (f"PSNR over {_RIVAL}, dB", psnr_lead(first, rivals[_RIVAL])[0], 2.5, math.inf),
        ("gradient energy", first.total.gradient_energy, 0.5, 1.4),
        ("mIoU", first.total.miou, 0.52, 1.0),
        ("IoU of car", iou.get("car", math.nan), 0.45, 1.0),
    )
    return [
        f"- {name}: {value:.3g}, wanted {low:g} or more{'' if high in (1.0, math.inf) else f', at most {high:g}'}: "
        + ("reached" if low <= value <= high else "**missed**")
        for name, value, low, high in reached
    ]


def write_report(report: Report, folder: Path) -> None:
    """`evaluation.json` (NaN as null) and `evaluation.md` in `folder`. Raises RunError if it cannot be written."""
    text = msgspec.json.format(msgspec.json.encode(report), indent=1)
    _write(folder / "evaluation.json", text)
    _write(folder / "evaluation.md", to_markdown(report).encode())


def to_markdown(report: Report) -> str:
    """Two tables, pictures and classes of every predictor with standard errors and the IoU of each class; the bar."""
    given = report.conditions
    height, width = given.grid
    lines = [
        f"{given.clips} clips of `{given.data}` (scenes {given.first_seed} to {given.last_seed}), "
        f"frames 2-{given.frames}; value ± standard error over clips.",
        f"Source camera at {given.true_mount}; declared: {given.declared_mount}.",
        f"Class figures at {width}x{height}, in brackets at picture size. * uses the exact source depth.",
        "",
        *_table(_HEADINGS, [_row(each, report.evaluations[0]) for each in report.evaluations]),
        "",
        "IoU of each class:",
        "",
        *_table(("class", *(each.name for each in report.evaluations)), _class_rows(report)),
        "",
        *against_bar(report),
    ]
    return "\n".join(lines)


_HEADINGS = (
    "",
    "PSNR dB",
    "last frame",
    "SSIM",
    "gradient energy",
    "flicker",
    "mIoU",
    "accuracy",
    "first row ahead, dB",
    "s/clip",
)
_PICTURE_COLUMNS: tuple[tuple[Callable[[Figures], float], int], ...] = (
    (lambda f: f.psnr_db, 2),
    (lambda f: f.last_psnr_db, 2),
    (lambda f: f.ssim, 3),
    (lambda f: f.gradient_energy, 2),
    (lambda f: f.flicker, 2),
)


def _row(each: Evaluation, first: Evaluation) -> list[str]:
    cells = [_with_error(column(each.total), column(each.error), digits) for column, digits in _PICTURE_COLUMNS]
    miou = _with_error(each.total.miou, each.error.miou, 3)
    if not math.isnan(each.total.miou_full):
        miou += f" ({each.total.miou_full:.3f})"
    accuracy = _with_error(each.total.accuracy, each.error.accuracy, 3)
    name = each.name + (" *" if each.privileged else "")
    lead = "-" if each is first else _with_error(*psnr_lead(first, each), 2)
    return [name, *cells, miou, accuracy, lead, f"{each.seconds_per_clip:.2f}"]


def _class_rows(report: Report) -> list[list[str]]:
    def cell(each: Evaluation, label: int) -> str:
        iou, full = each.total.class_iou[label], each.total.class_iou_full[label]
        return "-" if math.isnan(iou) and math.isnan(full) else f"{iou:.2f} ({full:.2f})"

    return [[name, *(cell(each, i) for each in report.evaluations)] for i, name in enumerate(report.classes)]


def _with_error(value: float, error: float, digits: int) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}f}" + ("" if math.isnan(error) else f" ± {error:.{digits}f}")


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---"] * len(headings)
    return [f"| {' | '.join(cells)} |" for cells in (headings, rule, *rows)]


def write_contact_sheet(path: Path, predictor: Predictor, clips: HeldOutClips, numbers: Sequence[int]) -> None:
    """PNG of some clips: rows input, prediction, its class map, the target's class map, target; columns frames.

    Args:
        numbers: of the clips, from top to bottom.
    Raises:
        RunError: the file cannot be written.
    """
    colours = palette(tuple(clips.classes))
    rows: list[NDArray[np.uint8]] = []
    for number in numbers:
        clip = clips[number]
        for label, frames in _strips(predictor.predict(clip), clip, colours):
            rows.append(_labelled_row(f"{number}", label, frames))
        rows.append(np.full((_GAP, rows[-1].shape[1], 3), 0, np.uint8))
    done, data = cv2.imencode(".png", cv2.cvtColor(np.concatenate(rows[:-1]), cv2.COLOR_RGB2BGR))
    assert done, "PNG takes any picture"
    _write(path, data.tobytes())


def _strips(made: Prediction, clip: PairedClip, colours: Tensor) -> list[tuple[str, NDArray[np.uint8]]]:
    """Row labels with frames uint8 [T, H, W, 3]; rows a predictor does not have are left out."""
    strips = [("input", clip.source)]
    if made.video is not None:
        strips.append(("view", _to_bytes(made.video)))
    if made.classes is not None:
        strips.append(("classes", colours[made.classes.long()].numpy()))
    true_classes = colours[torch.from_numpy(clip.target_classes.copy()).long()].numpy()
    return [*strips, ("true classes", true_classes), ("target", clip.target)]


def _labelled_row(clip: str, label: str, frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    shown = [frames[number - 1] for number in SHEET_FRAMES if number <= len(frames)]
    height = shown[0].shape[0]
    margin = np.full((height, _LABEL_WIDTH, 3), 255, np.uint8)
    for line, text in enumerate((label, f"clip {clip}")):
        cv2.putText(margin, text, (4, 16 + 16 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)
    gap = np.full((height, _GAP, 3), 255, np.uint8)
    return np.concatenate([margin, *(part for picture in shown for part in (picture, gap))], axis=1)


def _to_bytes(video: Tensor) -> NDArray[np.uint8]:
    return (video.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()


def _write(path: Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}; choose another --out") from error
