"""`gcd-train evaluate`: weights and what they have to beat, on held-out clips."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from rich.console import Console

from gcd_model import Synthesizer, load_synthesizer
from gcd_model.geometry import CameraMount
from gcd_train.baselines import Predictor, all_baselines, fit_statistics
from gcd_train.cli.errors import errors_shown
from gcd_train.cli.progress_bar import progress_bar
from gcd_train.datasets.paired import PairedClips, require_apart
from gcd_train.errors import RecipeError
from gcd_train.evaluation import (
    Conditions,
    Figures,
    MountNumbers,
    Report,
    Shot,
    SynthesizedViews,
    best_of,
    class_grid,
    evaluate,
    require_same_kind,
    to_markdown,
    write_contact_sheet,
    write_report,
)

_LOG = Console(stderr=True)

Made = TypeVar("Made")


def evaluate_command(
    data: Annotated[list[Path], typer.Option(help="Folder of held-out clips; several may be given.")],
    out: Annotated[Path, typer.Option(help="Folder for evaluation.json, evaluation.md and contact_sheet.png.")],
    weights: Annotated[str | None, typer.Option(help="package:NAME or a path; without, baselines alone.")] = None,
    steps: Annotated[
        list[int] | None, typer.Option(min=1, help="Also with so many steps of the sampler; may be repeated.")
    ] = None,
    train: Annotated[
        list[Path] | None, typer.Option(help="Folder of training clips: mean target, majority map.")
    ] = None,
    baselines: Annotated[bool, typer.Option(help="Also measure what has to be beaten; needs --train.")] = True,
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first so many clips.")] = None,
    train_limit: Annotated[int, typer.Option(min=1, help="At most so many training clips for the means.")] = 1000,
    declared_height: Annotated[
        float | None, typer.Option(help="Driving: mount declared, height in metres; by default as trained.")
    ] = None,
    declared_tilt: Annotated[
        float | None, typer.Option(help="Driving: mount declared, degrees down; by default as trained.")
    ] = None,
    sheet_clips: Annotated[int, typer.Option(min=1, help="Clips on the contact sheet.")] = 4,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    dtype: Annotated[str | None, typer.Option(help="float32, bfloat16 or float16.")] = None,
) -> None:
    """Measure weights and baselines on held-out clips, frames 2 to the last, and say what is reached."""
    with errors_shown():
        mount = _mount(declared_height, declared_tilt)
        out.mkdir(parents=True, exist_ok=True)  # to know at once
        clips = PairedClips.open(data, limit)
        declared = _declared(mount, clips)
        model = None if weights is None else load_synthesizer(weights, device=device, dtype=dtype)
        views = () if model is None else _views(model, clips, steps or [])
        training = _training_clips(train, train_limit) if baselines else None
        rivals = () if training is None else _baselines(training, clips)
        if not (views or rivals):
            raise RecipeError("there is nothing to measure: give --weights, or leave out --no-baselines")
        measured = _watched(
            clips,
            "held-out clips",
            lambda tell: evaluate([*views, *rivals], clips, declared=declared, progress=tell),
        )
        report = Report(
            conditions=_conditions(data, train or [], clips, training, model, declared),
            classes=tuple(each.name for each in clips.classes),
            model=measured[: len(views)],
            baselines=measured[len(views) :],
        )
        text = to_markdown(report)
        write_report(report, text, out)
        shots = report.conditions.shots[:sheet_clips]
        write_contact_sheet(
            out / "contact_sheet.png",
            _shown([*views, *rivals], report),
            clips,
            range(len(shots)),
            labels=[str(shot) for shot in shots],
            declared=declared,
        )
    typer.echo(text)
    _LOG.print(f"wrote {out}/evaluation.json, evaluation.md and contact_sheet.png", highlight=False, markup=False)


def _mount(height_m: float | None, tilt_deg: float | None) -> CameraMount | None:
    """The mount that is declared; None where nobody says any."""
    if height_m is None and tilt_deg is None:
        return None
    usual = CameraMount()
    return CameraMount(
        height_m=usual.height_m if height_m is None else height_m,
        tilt_deg=usual.tilt_deg if tilt_deg is None else tilt_deg,
    )


def _declared(mount: CameraMount | None, clips: PairedClips) -> CameraMount | None:
    """What everybody is told of the source camera's mount; None where there is no vehicle."""
    if clips.camera == "none":
        return mount or CameraMount()
    if mount is not None:
        raise RecipeError("these clips have no vehicle to mount a camera on: leave out --declared-height and -tilt")
    return None


def _training_clips(folders: Sequence[Path] | None, limit: int) -> PairedClips:
    if not folders:
        raise RecipeError("baselines want training clips for their means: give --train FOLDER, or --no-baselines")
    return PairedClips.open(list(folders), limit)


def _views(model: Synthesizer, clips: PairedClips, steps: Sequence[int]) -> tuple[SynthesizedViews, ...]:
    """The model as it ships first, then with each other number of steps."""
    shipped = model.traits.config.sampling.steps
    others = [number for number in dict.fromkeys(steps) if number != shipped]
    return tuple(SynthesizedViews.of(model, clips, number) for number in (None, *others))


def _baselines(training: PairedClips, clips: PairedClips) -> tuple[Predictor, ...]:
    """What has to be beaten. Raises DataError where the training clips are no measure for the held-out ones."""
    require_same_kind(training, clips)
    require_apart(training, clips)
    statistics = _watched(training, "training clips", lambda tell: fit_statistics(training, progress=tell))
    return all_baselines(statistics, len(clips.classes))


def _shown(predictors: Sequence[Predictor], report: Report) -> list[Predictor]:
    """The model, and the best baselines with and without the exact depth, by its kinds of figure."""
    wanted = [each.name for each in report.model[:1]]
    for figure in _compared(report):
        for privileged in (False, True):
            best = best_of([each for each in report.baselines if each.privileged == privileged], figure)
            wanted += [] if best is None else [best.name]
    return [each for each in predictors if each.name in wanted]


def _compared(report: Report) -> list[Callable[[Figures], float]]:
    def psnr(of: Figures) -> float:
        return of.psnr_db

    def miou(of: Figures) -> float:
        return of.miou

    return [figure for figure in (psnr, miou) if not (report.model and math.isnan(figure(report.model[0].total)))]


def _conditions(
    data: Sequence[Path],
    train: Sequence[Path],
    clips: PairedClips,
    training: PairedClips | None,
    model: Synthesizer | None,
    declared: CameraMount | None,
) -> Conditions:
    return Conditions(
        data=tuple(map(str, data)),
        weights=None if model is None else model.traits.name,
        sha256_12=None if model is None else model.traits.sha256_12,
        steps=None if model is None else model.traits.config.sampling.steps,
        shots=tuple(_shot(clips, number) for number in range(len(clips))),
        frames=clips.frames,
        size=(clips.height, clips.width),
        grid=class_grid(clips),
        camera=clips.camera,
        true_mount=_numbers(clips.mount),
        declared_mount=_numbers(declared),
        train=() if training is None else tuple(map(str, train)),
        train_clips=0 if training is None else len(training),
    )


def _shot(clips: PairedClips, number: int) -> Shot:
    world, scene = clips.scene(number)
    goal = clips.trajectory(number).goal_delta
    change = None if goal is None else (goal.azimuth_deg, goal.elevation_deg, goal.radius_m)
    return Shot(world=world, scene=scene, clip=clips.places[number][1], change=change)


def _numbers(mount: CameraMount | None) -> MountNumbers | None:
    return None if mount is None else MountNumbers(height_m=mount.height_m, tilt_deg=mount.tilt_deg)


def _watched(clips: PairedClips, name: str, work: Callable[[Callable[[int, int], None]], Made]) -> Made:
    """Do some work over clips behind a progress bar."""
    with progress_bar(name, len(clips)) as show:
        return work(lambda done, _: show(done))
