"""`gcd-train evaluate`: weights and what they have to beat, on held-out clips."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from rich.console import Console

from gcd_model import Synthesizer, load_synthesizer
from gcd_model.geometry import CameraMount
from gcd_train.baselines import Predictor, driving_baselines, fit_statistics
from gcd_train.cli.errors import errors_shown
from gcd_train.cli.progress_bar import progress_bar
from gcd_train.datasets.paired import PairedClips, require_apart
from gcd_train.errors import RecipeError
from gcd_train.evaluation import SynthesizedViews, class_grid, evaluate, require_same_kind
from gcd_train.report import Conditions, MountNumbers, Report, to_markdown, write_contact_sheet, write_report

_LOG = Console(stderr=True)

Made = TypeVar("Made")


def evaluate_command(
    data: Annotated[Path, typer.Option(help="Folder of held-out clips.")],
    out: Annotated[Path, typer.Option(help="Folder for evaluation.json, evaluation.md and contact_sheet.png.")],
    weights: Annotated[str | None, typer.Option(help="package:NAME or a path; without, baselines alone.")] = None,
    train: Annotated[Path | None, typer.Option(help="Folder of training clips: mean target, majority map.")] = None,
    baselines: Annotated[bool, typer.Option(help="Also measure what has to be beaten; needs --train.")] = True,
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first so many clips.")] = None,
    train_limit: Annotated[int, typer.Option(min=1, help="At most so many training clips for the means.")] = 1000,
    declared_height: Annotated[float, typer.Option(help="Mount declared: height, metres.")] = CameraMount().height_m,
    declared_tilt: Annotated[float, typer.Option(help="Mount declared: degrees down.")] = CameraMount().tilt_deg,
    sheet_clips: Annotated[int, typer.Option(min=1, help="Clips on the contact sheet.")] = 4,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    dtype: Annotated[str | None, typer.Option(help="float32, bfloat16 or float16.")] = None,
) -> None:
    """Measure weights and baselines on held-out clips, frames 2 to the last."""
    with errors_shown():
        mount = CameraMount(height_m=declared_height, tilt_deg=declared_tilt)
        out.mkdir(parents=True, exist_ok=True)  # to know at once
        clips = PairedClips.open(data, limit)
        model = None if weights is None else load_synthesizer(weights, device=device, dtype=dtype)
        training = _training_clips(train, train_limit) if baselines else None
        predictors = _predictors(model, training, clips, mount)
        evaluations = _watched(clips, "held-out clips", lambda tell: evaluate(predictors, clips, progress=tell))
        conditions = _conditions(data, train, clips, training, model, mount)
        names = tuple(each.name for each in clips.classes)
        report = Report(conditions=conditions, classes=names, evaluations=evaluations)
        write_report(report, out)
        shown = predictors[-1] if model is None else predictors[0]
        write_contact_sheet(out / "contact_sheet.png", shown, clips, range(min(sheet_clips, len(clips))))
    typer.echo(to_markdown(report))
    _LOG.print(f"wrote {out}/evaluation.json, evaluation.md and contact_sheet.png", highlight=False, markup=False)


def _training_clips(folder: Path | None, limit: int) -> PairedClips:
    if folder is None:
        raise RecipeError("baselines want training clips for their means: give --train FOLDER, or --no-baselines")
    return PairedClips.open(folder, limit)


def _predictors(
    model: Synthesizer | None, training: PairedClips | None, clips: PairedClips, mount: CameraMount
) -> tuple[Predictor, ...]:
    """The model first, then the baselines. Raises RecipeError for none, DataError where they cannot be compared."""
    if model is None and training is None:
        raise RecipeError("there is nothing to measure: give --weights, or leave out --no-baselines")
    found: list[Predictor] = []
    if model is not None:
        found.append(SynthesizedViews.of(model, clips, mount))
    if training is not None:
        require_same_kind(training, clips)
        require_apart(training, clips)
        statistics = _watched(training, "training clips", lambda tell: fit_statistics(training, progress=tell))
        found += driving_baselines(statistics, mount, len(clips.classes))
    return tuple(found)


def _conditions(
    data: Path,
    train: Path | None,
    clips: PairedClips,
    training: PairedClips | None,
    model: Synthesizer | None,
    mount: CameraMount,
) -> Conditions:
    true = clips.world.options
    return Conditions(
        data=str(data),
        weights=None if model is None else model.traits.name,
        sha256_12=None if model is None else model.traits.sha256_12,
        clips=len(clips),
        first_seed=clips.seed(0),
        last_seed=clips.seed(len(clips) - 1),
        frames=clips.frames,
        size=(clips.height, clips.width),
        grid=class_grid(clips),
        true_mount=MountNumbers(height_m=true.height_m, tilt_deg=true.tilt_deg),
        declared_mount=MountNumbers(height_m=mount.height_m, tilt_deg=mount.tilt_deg),
        train=None if training is None else str(train),
        train_clips=0 if training is None else len(training),
    )


def _watched(clips: PairedClips, name: str, work: Callable[[Callable[[int, int], None]], Made]) -> Made:
    """Do some work over clips behind a progress bar."""
    with progress_bar(name, len(clips)) as show:
        return work(lambda done, _: show(done))
