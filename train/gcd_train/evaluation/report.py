"""An evaluation as files: JSON for programs, Markdown tables for people."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from gcd_model.config import CameraControl
from gcd_train.errors import RunError
from gcd_train.evaluation.figures import Evaluation, Figures


class MountNumbers(msgspec.Struct, frozen=True, kw_only=True):
    """The part of a CameraMount that studies vary: height in metres, degrees down."""

    height_m: float
    tilt_deg: float

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
    samples: draws of each view, of what draws. first_frame: that is measured, counted from 1.
    shots: the clips that were measured, in order. size, grid: height and width of pictures and of the class grid.
    true_mount: of the source camera in the data. declared_mount: what the model and the baselines were told of it. Both
    None where there is no vehicle.
    train_clips: clips the mean and the majority map were fitted on, 0 without baselines.
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


@dataclass(frozen=True, kw_only=True, slots=True)
class Report:
    """Everything an evaluation found.

    model: the weights with the settings that ship, then with other steps; empty for baselines alone.
    classes: names of the ontology, by id.
    """

    conditions: Conditions
    classes: tuple[str, ...]
    model: tuple[Evaluation, ...]
    baselines: tuple[Evaluation, ...]

    @property
    def evaluations(self) -> tuple[Evaluation, ...]:
        """All rows, the model's first."""
        return self.model + self.baselines


def best_of(evaluations: Sequence[Evaluation], figure: Callable[[Figures], float]) -> Evaluation | None:
    """The one with the highest figure; None where nobody has it."""
    measured = [each for each in evaluations if not math.isnan(figure(each.total))]
    return max(measured, key=lambda each: figure(each.total), default=None)


def write_report(report: Report, text: str, folder: Path) -> None:
    """`evaluation.json` (NaN as null) and `evaluation.md` with the text. Raises RunError if they cannot be written."""
    every = {
        "conditions": report.conditions,
        "classes": report.classes,
        "model": report.model,
        "baselines": report.baselines,
    }
    write_file(folder / "evaluation.json", msgspec.json.format(msgspec.json.encode(every), indent=1))
    write_file(folder / "evaluation.md", text.encode())


def write_file(path: Path, data: bytes) -> None:
    """Write a file and the folders above it. Raises RunError if it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}; choose another --out") from error
