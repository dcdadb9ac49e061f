"""From the records of a run to what `evaluate` prints and writes: tables and JSON."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from gcd_model.config import CameraControl
from gcd_model.geometry import CameraMount
from gcd_train.errors import DataError
from gcd_train.evaluation.baselines import FROM_EXACT_CLASSES
from gcd_train.evaluation.clips import EvaluationSet, PairedSet
from gcd_train.evaluation.statistics import (
    FIGURE_NAMES,
    Array,
    Bootstrap,
    FigureName,
    Selection,
    Sums,
    class_iou,
    clip_sums,
    deviation,
    lead,
    unbiased,
    weighted,
)
from gcd_train.evaluation.store import ClipRecord, RunKeeper
from gcd_train.evaluation.tables import counted, markdown_rows
from gcd_train.files import write_whole


@dataclass(frozen=True, kw_only=True, slots=True)
class Evaluation:
    """One method on a set of clips. clips: sums of each. of_all: of all. seconds_per_clip: of the method alone."""

    name: str
    privileged: bool
    clips: Sums
    of_all: Bootstrap
    seconds_per_clip: float

    def value(self, name: FigureName) -> float:
        """One figure of all clips."""
        return self.of_all.value(name)

    def class_iou(self, *, full: bool = False) -> Array:
        """Of each class, [K]: at the class grid, or at picture size."""
        return class_iou((self.clips.full if full else self.clips.grid).sum(axis=0))

    def told(self) -> dict[str, object]:
        """For `evaluation.json`: figures of each clip, of all, and the standard errors of those over scenes."""
        names, grid, full = FIGURE_NAMES, self.clips.grid, self.clips.full
        by_clip = {name: self.clips.figure(name).tolist() for name in names}
        by_clip |= {"class_iou": class_iou(grid).tolist(), "class_iou_full": class_iou(full).tolist()}
        total: dict[str, object] = {name: self.value(name) for name in names}
        error: dict[str, object] = {name: self.of_all.error(name) for name in names}
        weights, scenes = self.of_all.weights, self.of_all.scenes
        for key, of_clips, of_scenes in (("class_iou", grid, scenes.grid), ("class_iou_full", full, scenes.full)):
            total[key] = class_iou(of_clips.sum(axis=0)).tolist()
            error[key] = np.full(of_clips.shape[-1], np.nan).tolist()
            if weights is not None:
                spread = deviation(class_iou(weighted(of_scenes, weights)))
                error[key] = (spread * unbiased(class_iou(of_scenes))).tolist()
        return {
            "name": self.name,
            "privileged": self.privileged,
            "clips": [dict(zip(by_clip, row, strict=True)) for row in zip(*by_clip.values(), strict=True)],
            "total": total,
            "error": error,
            "seconds_per_clip": self.seconds_per_clip,
        }


def evaluation(records: Sequence[ClipRecord], selection: Selection | None = None, *, classes: int = 0) -> Evaluation:
    """Figures of one method. Raises DataError where there is no record, or they are of several methods."""
    if len({record.method for record in records}) != 1:
        raise DataError("figures want records of one method; evaluate it first")
    clips = clip_sums(records, selection or Selection(), classes=classes)
    return Evaluation(
        name=records[0].method,
        privileged=records[0].privileged,
        clips=clips,
        of_all=Bootstrap(scenes=clips.grouped([record.scene for record in records])),
        seconds_per_clip=sum(record.seconds for record in records) / len(records),
    )


class MountNumbers(msgspec.Struct, frozen=True, kw_only=True):
    """The part of a CameraMount that studies vary: height in metres, degrees down."""

    height_m: float
    tilt_deg: float

    @classmethod
    def of(cls, mount: CameraMount | None) -> "MountNumbers | None":
        """None where there is no vehicle."""
        return None if mount is None else cls(height_m=mount.height_m, tilt_deg=mount.tilt_deg)

    def __str__(self) -> str:
        return f"{self.height_m:g} m, {self.tilt_deg:g} deg down"


class Shot(msgspec.Struct, frozen=True, kw_only=True):
    """One measured clip.

    world, scene: the world and the seed of its scene. clip: its name in the shard, a number; of whole scenes its name
        in the control list.
    change: where its target camera goes, azimuth and elevation in degrees and radius in metres, target minus source;
        None on the one path of driving.
    """

    world: str
    scene: int
    clip: str
    change: tuple[float, float, float] | None = None

    @classmethod
    def of(cls, clips: EvaluationSet, record: ClipRecord) -> "Shot":
        """The clip of a record."""
        if isinstance(clips, PairedSet):
            number = clips.number(record.key)
            world, scene = clips.clips.scene(number)
            return cls(world=world, scene=scene, clip=clips.clips.name(number), change=record.change)
        world = record.scene.rstrip("0123456789")
        number = int(record.scene[len(world) :] or 0)
        return cls(world=world.strip("_"), scene=number, clip=record.key.rpartition(".")[2], change=record.change)

    def __str__(self) -> str:
        alike = self.clip.isdecimal() and int(self.clip) == self.scene
        name = f"{self.world} {self.scene}" + ("" if alike else f" ({self.clip})")
        if self.change is None:
            return name
        azimuth_deg, elevation_deg, radius_m = self.change
        return f"{name} az {azimuth_deg:+.0f} el {elevation_deg:+.0f} r {radius_m:+.1f}"


class Conditions(msgspec.Struct, frozen=True, kw_only=True):
    """What the figures hold for.

    data, train: folders. weights: name of the model, None for baselines alone. steps: of its sampler, as shipped.
    samples: draws of each view. first_frame: that is measured, counted from 1. shots: the clips, in order.
    size, grid: height and width of pictures and of the class grid. true_mount: of the source camera in the data.
    declared_mount: what methods are given of it; both None where there is no vehicle. train_clips: that means are of.
    failed: see `Account.failed`.
    """

    data: tuple[str, ...]
    weights: str | None
    sha256_12: str | None
    steps: int | None
    shots: tuple[Shot, ...]
    frames: int
    size: tuple[int, int]
    grid: tuple[int, int]
    camera: CameraControl
    true_mount: MountNumbers | None
    declared_mount: MountNumbers | None
    train: tuple[str, ...]
    train_clips: int
    samples: int = 1
    first_frame: int = 2
    failed: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Summary:
    """Everything an evaluation found. model: the weights as they ship, then with other steps. classes: names by id."""

    conditions: Conditions
    classes: tuple[str, ...]
    model: tuple[Evaluation, ...]
    baselines: tuple[Evaluation, ...]

    @property
    def evaluations(self) -> tuple[Evaluation, ...]:
        """All rows, the model's first."""
        return self.model + self.baselines


def best_of(evaluations: Sequence[Evaluation], name: FigureName) -> Evaluation | None:
    """The one with the highest figure; None where there is none."""
    found = [each for each in evaluations if not math.isnan(each.value(name))]
    return max(found, key=lambda each: each.value(name), default=None)


def complete_rows(
    keeper: RunKeeper, methods: Sequence[str], keys: Sequence[str], fresh: Mapping[tuple[str, str], ClipRecord]
) -> dict[str, tuple[ClipRecord, ...]]:
    """By method, the records of clips that every method has; methods without any record are left out.

    Args:
        fresh: records that this process knows already, by method and key.
    Raises: DataError where no clip is left. RunError: a record is damaged.
    """
    found = {name: {key for key in keys if (name, key) in fresh or keeper.has(name, key)} for name in methods}
    there = {name: some for name, some in found.items() if some}
    shared = [key for key in keys if there and all(key in some for some in there.values())]
    if not shared:
        raise DataError("no clip could be measured with every method; see the failures above")
    return {name: tuple(fresh.get((name, key)) or keeper.read(name, key) for key in shared) for name in there}


def write_summary(summary: Summary, text: str, folder: Path) -> None:
    """`evaluation.json` (NaN as null) and `evaluation.md` with the text. Raises RunError if they cannot be written."""
    every = {
        "conditions": summary.conditions,
        "classes": summary.classes,
        "model": [each.told() for each in summary.model],
        "baselines": [each.told() for each in summary.baselines],
    }
    write_whole(folder / "evaluation.json", msgspec.json.format(msgspec.json.encode(every), indent=1))
    write_whole(folder / "evaluation.md", text.encode())


@dataclass(frozen=True, kw_only=True, slots=True)
class _Column:
    """One figure as a column. full: the same at picture size, shown in brackets. of_classes: of class maps."""

    heading: str
    figure: FigureName
    digits: int
    full: FigureName | None = None
    of_classes: bool = False

    def cell(self, each: Evaluation) -> str:
        text = _with_error(each.value(self.figure), each.of_all.error(self.figure), self.digits)
        full = math.nan if self.full is None else each.value(self.full)
        text = text if math.isnan(full) else f"{text} ({full:.{self.digits}f})"
        return f"{text} *" if self.of_classes and text != "-" and each.name in FROM_EXACT_CLASSES else text


_PSNR = _Column(heading="PSNR dB", figure="psnr_db", digits=2)
_SSIM = _Column(heading="SSIM", figure="ssim", digits=3)
_MIOU = _Column(heading="mIoU", figure="miou", digits=3, full="miou_full", of_classes=True)
_COLUMNS = (
    _PSNR,
    _Column(heading="last frame", figure="last_psnr_db", digits=2),
    _SSIM,
    _Column(heading="LPIPS", figure="lpips", digits=3),
    _Column(heading="diversity", figure="diversity", digits=3),
    _Column(heading="gradient energy", figure="gradient_energy", digits=2),
    _Column(heading="flicker", figure="flicker", digits=2),
    _MIOU,
    _Column(heading="accuracy", figure="accuracy", digits=3, of_classes=True),
)


def to_markdown(summary: Summary) -> str:
    """All tables; what no method has is left out."""
    parts = [_conditions(summary), _methods(summary.evaluations)]
    if len(summary.model) > 1:
        parts.append(_steps(*summary.model))
    if any(not math.isnan(each.value("miou")) for each in summary.evaluations):
        parts.append(_classes(summary))
    if summary.model:
        parts.append(_clips(summary))
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _conditions(summary: Summary) -> list[str]:
    given, shots = summary.conditions, summary.conditions.shots
    scenes = len({(shot.world, shot.scene) for shot in shots})
    folders = ", ".join(f"`{folder}`" for folder in given.data)
    lines = [
        f"{len(shots)} clips of {scenes} scenes in {folders}, frames {given.first_frame}-{given.frames}; value ± "
        "standard error over scenes. * is given more than the source video."
    ]
    if given.weights is not None:
        steps, samples = counted(given.steps or 0, "step"), counted(given.samples, "sample")
        lines.append(f"`{given.weights}` as it ships: {steps} of its sampler, {samples}.")
    if given.true_mount is not None:
        lines.append(f"Source camera at {given.true_mount}; declared: {given.declared_mount}.")
    if summary.classes:
        height, width = given.grid
        lines.append(f"Class figures at {width}x{height}, in brackets at picture size.")
    if given.failed:
        lines.append(f"**Failed, and in no row: {'; '.join(given.failed)}.**")
    has = {name: any(not math.isnan(each.value(name)) for each in summary.evaluations) for name in FIGURE_NAMES}
    if has["psnr_db"] and not has["lpips"]:
        lines.append("LPIPS: no weights given (`--lpips`).")
    return lines


def _methods(evaluations: Sequence[Evaluation]) -> list[str]:
    first = evaluations[0]
    columns = [each for each in _COLUMNS if not all(math.isnan(row.value(each.figure)) for row in evaluations)]
    ahead = [each for each in (_PSNR, _MIOU) if not math.isnan(first.value(each.figure))]
    rows = [
        [
            each.name + (" *" if each.privileged else ""),
            *(column.cell(each) for column in columns),
            *("-" if first is each else _ahead(first, each, column) for column in ahead),
            f"{each.seconds_per_clip:.2f}",
        ]
        for each in evaluations
    ]
    headings = [*(each.heading for each in columns), *(f"first row ahead, {each.heading}" for each in ahead), "s/clip"]
    return markdown_rows(["", *headings], rows)


def _ahead(first: Evaluation, other: Evaluation, column: _Column, sign: str = "") -> str:
    return _with_error(*lead(first.of_all, other.of_all, column.figure), column.digits, sign)


def _steps(shipped: Evaluation, *others: Evaluation) -> list[str]:
    columns = [column for column in (_PSNR, _SSIM, _MIOU) if not math.isnan(shipped.value(column.figure))]
    return [
        "The steps that ship against others, on the same clips:",
        "",
        *(
            f"- over {other.name}: " + ", ".join(f"{c.heading} {_ahead(shipped, other, c, sign='+')}" for c in columns)
            for other in others
        ),
    ]


def _classes(summary: Summary) -> list[str]:
    shown = [each for each in summary.evaluations if not math.isnan(each.value("miou"))]
    columns = [list(map(_with_full, each.class_iou(), each.class_iou(full=True))) for each in shown]
    every = [[name, *cells] for name, *cells in zip(summary.classes, *columns, strict=False)]
    rows = [row for row in every if set(row[1:]) != {"-"}]  # a class that is neither true nor said, as void
    return ["IoU of each class:", "", *markdown_rows(["class", *(each.name for each in shown)], rows)]


def _with_full(iou: float, full: float) -> str:
    both = ("-" if math.isnan(value) else f"{value:.2f}" for value in (iou, full))
    return "-" if math.isnan(iou) and math.isnan(full) else "{} ({})".format(*both)


def _clips(summary: Summary) -> list[str]:
    """Every clip by name, and where the model is ahead of the best baseline and where not."""
    columns = [["clip", *map(str, summary.conditions.shots)]]
    for column in (_PSNR, _MIOU):
        if math.isnan(summary.model[0].value(column.figure)):
            continue
        own, best = summary.model[0].clips.figure(column.figure), best_of(summary.baselines, column.figure)
        columns.append([column.heading, *(_with_error(value, math.nan, column.digits) for value in own)])
        if best is not None:
            apart = own - best.clips.figure(column.figure)
            cells = (_with_error(value, math.nan, column.digits, "+") for value in apart)
            columns.append([f"over {best.name}", *cells])
    headings, *rows = zip(*columns, strict=True)
    return ["Clips:", "", *markdown_rows(headings, rows)]


def _with_error(value: float, error: float, digits: int, sign: str = "") -> str:
    if math.isnan(value):
        return "-"
    return f"{value:{sign}.{digits}f}" + ("" if math.isnan(error) else f" ± {error:.{digits}f}")
