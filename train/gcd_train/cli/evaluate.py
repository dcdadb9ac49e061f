"""`gcd-train evaluate`, `report` and `calibrate`: weights and what they have to beat, on held-out clips."""

from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from typer import Option

from gcd_model import RenderOptions, convert_weights, load_synthesizer, weights_path
from gcd_train.cli import common
from gcd_train.cli.common import (
    Device,
    Dtype,
    Limit,
    Ray,
    command_line,
    errors_shown,
    progress_bar,
    say,
    with_fields_of,
)
from gcd_train.data.splits import write_controls
from gcd_train.errors import DataError, RecipeError, TrainError
from gcd_train.evaluation.calibration import CalibrationNote, Distances, calibrate, distances, write_calibration
from gcd_train.evaluation.clips import EvaluationSet, SceneSet
from gcd_train.evaluation.figures import FigureKind, make_figure
from gcd_train.evaluation.galleries import KeptViews
from gcd_train.evaluation.measure import Account, ClipWork, assign_gpus, measure_all
from gcd_train.evaluation.methods import EvaluateOptions, planned, run_note
from gcd_train.evaluation.opening import ClipOptions, open_clips
from gcd_train.evaluation.predictors import Predictor
from gcd_train.evaluation.report import make_report
from gcd_train.evaluation.store import RunKeeper
from gcd_train.evaluation.synthesized import SynthesizedViews
from gcd_train.pictures import require_matplotlib

Views = Annotated[KeptViews, Option(help="Frames to keep as PNG, for the gallery: few are all of four clips.")]
Workers = Annotated[int, Option(min=1, help="Processes; where there are several GPUs they take them in turn.")]


@with_fields_of(EvaluateOptions)
def evaluate_command(
    out: Annotated[Path, Option(help="Folder of the run; one that is there is gone on with.")],
    views: Views = "few",
    workers: Workers = 1,
    ray: Ray = None,
    **options: Any,
) -> None:
    """Measure weights, baselines and others' frames on held-out clips, and say what is reached."""
    asked = EvaluateOptions(**options)
    with errors_shown():
        out.mkdir(parents=True, exist_ok=True)  # to know at once
        clips, methods, notes = planned(asked)
        for line in notes:
            say(line)
        with RunKeeper(out).in_use(run_note(clips, methods, asked, command_line())):
            if isinstance(clips, SceneSet) and asked.controls is None:
                write_controls(out / "controls.json", clips.listed())
            work = ClipWork(
                folder=out.resolve(),
                clips=clips,
                methods={method.name: method for method in methods},
                lpips=None if asked.lpips is None else asked.lpips.resolve(),
                views=views,
            )
            account = _measured(work, workers, ray, asked.device)
        for line in account.lines():
            say(line)
        if any(out.glob("records/*/*.json")):
            typer.echo(make_report([out], out, drawn=False).read_text())
            say(f"wrote {out}/run.json, records, report.md, tables" + " and gallery" * (views != "none"))
    if account.failures:
        raise typer.Exit(TrainError.exit_code)


def _measured(work: ClipWork, workers: int, ray: str | None, device: str) -> Account:
    if workers > 1 or ray is not None:
        common.stop_as_by_ctrl_c()
    account, gpus = Account(clips=len(work.clips.keys)), assign_gpus(device, torch.cuda.device_count())
    with progress_bar("clips", len(work.clips.keys)) as show:
        for account in measure_all(
            work, workers=workers, ray_address=ray, gpus=float(device != "cpu"), environments=gpus
        ):
            show(account.done)
    return account


def report_command(
    runs: Annotated[list[Path], typer.Argument(help="Folders that `gcd-train evaluate` wrote.", metavar="RUN...")],
    out: Annotated[Path, typer.Option(help="Folder for report.md, tables/, plots/ and gallery/.")],
    lead: Annotated[
        list[str] | None, typer.Option(help="Method to compare with all others; by default models, or saved frames.")
    ] = None,
    clips: Annotated[int, typer.Option(min=0, help="Clips in the gallery.")] = 4,
    plots: Annotated[bool, typer.Option(help="Draw plots; needs matplotlib.")] = True,
) -> None:
    """Write the paper's tables, or the same for our own clips, from what was measured; nothing is measured again."""
    with errors_shown():
        path = make_report(runs, out, leads=lead or (), clips=clips, drawn=plots, command=command_line())
    typer.echo(f"wrote {path}")


def figure_command(
    kind: Annotated[FigureKind, typer.Argument(help="Over angles, over views given, variants beside, worst clips.")],
    runs: Annotated[list[Path], typer.Argument(help="Folders that `gcd-train evaluate` wrote.", metavar="RUN...")],
    out: Annotated[Path, typer.Option(help="The picture, PNG.")],
    method: Annotated[list[str] | None, typer.Option(help="Only this one; may be repeated.")] = None,
    clips: Annotated[int, typer.Option(min=1, help="Clips of an ablation or of failures.")] = 6,
) -> None:
    """Draw one figure of the paper from what was measured; nothing is measured again."""
    with errors_shown():
        make_figure(kind, runs, out, methods=method or (), clips=clips)
    say(f"wrote {out}")


def calibrate_command(
    data: Annotated[list[Path], Option(help="Held-out clips: folders of pairs, or a folder in a published layout.")],
    weights: Annotated[str, Option(help="package:NAME or a path.")],
    out: Annotated[Path, Option(help="Folder for calibration.json, calibration.md and reliability.png.")],
    store: Annotated[
        Path | None, Option(help="Also write the weights with the scale here, a new .safetensors file.")
    ] = None,
    samples: Annotated[int, Option(min=2, help="Draws of each view; the scale is for as many.")] = 4,
    steps: Annotated[int | None, Option(min=1, help="Steps of the sampler instead of the shipped number.")] = None,
    seed: Annotated[int, Option(min=0, help="Of the noise samples begin with.")] = 0,
    split: Annotated[str | None, Option(help="Only scenes of a split, by its name such as driving-test.")] = None,
    limit: Limit = None,
    device: Device = "auto",
    dtype: Dtype = None,
) -> None:
    """Measure how often the truth lies within the intervals of the samples, and the scale that makes it as meant."""
    with errors_shown():
        require_matplotlib()  # now, not after an hour
        path = None if store is None else _weights_file(weights, store, steps)
        model = load_synthesizer(weights, device=device, dtype=dtype)
        if model.traits.live:
            raise RecipeError(
                f"{model.traits.name} states its own spread; tools/live_measure.py says how well it holds"
            )
        clips, notes = open_clips(ClipOptions(data=data, split=split, limit=limit, seed=seed), model.traits)
        for line in notes:
            say(line)
        views = SynthesizedViews.of(lambda: model, clips, RenderOptions(steps=steps, samples=samples, seed=seed))
        if views.paints_classes:
            raise RecipeError(f"{model.traits.name} paints classes, which have no intervals; calibrate one of colours")
        measured, unreadable = _distances(clips, views)
        note = CalibrationNote(
            weights=model.traits.name,
            sha256_12=model.traits.sha256_12,
            data=tuple(map(str, data)),
            data_identity=clips.identity,
            clips=len(measured),
            unreadable=unreadable,
            samples=samples,
            steps=steps or model.traits.config.sampling.steps,
            seed=seed,
            found=calibrate(measured),
        )
        text = write_calibration(note, out)
        if path is not None and store is not None:
            convert_weights(path, store, uncertainty_scale=note.found.scale)
            say(
                f"{store} holds the scale {note.found.scale:.3g}: for {samples} samples in {note.steps} steps, and "
                "scenes like these; with other --samples it is wrong"
            )
    typer.echo(text)
    if note.warning:
        say(f"warning: {note.warning}")
    say(f"wrote {out}/calibration.json, calibration.md and reliability.png")


def _weights_file(weights: str, store: Path, steps: int | None) -> Path:
    """The file whose copy gets the scale; what is wrong with --store is said before anything is measured."""
    if steps is not None:
        raise RecipeError("a stored scale is for the steps that ship: leave out --steps, or --store")
    if store.exists() or store.suffix != ".safetensors" or not store.parent.is_dir():
        raise RecipeError(f"--store wants the name of a new .safetensors file in a folder that exists, got {store}")
    if weights.startswith("random:"):
        raise RecipeError(f"{weights} is no file that a scale could be stored with; leave out --store")
    return weights_path(weights)


def _distances(clips: EvaluationSet, views: Predictor) -> tuple[list[tuple[str, Distances]], tuple[str, ...]]:
    """Of every clip that can be read; of the others the reason. Raises DataError where none can."""
    measured: list[tuple[str, Distances]] = []
    unreadable: list[str] = []
    with progress_bar("held-out clips", len(clips.keys)) as show:
        for number, key in enumerate(clips.keys, 1):
            try:
                clip = clips.clip(key)
            except DataError as error:
                unreadable.append(f"{key}: {error}")
                say(f"left out {key}: {error}")
            else:
                measured.append((clip.scene, distances(clip, views.predict(clip.seen))))
            show(number)
    if not measured:
        raise DataError(f"none of the {len(clips.keys)} clips can be read: {unreadable[0]}")
    return measured, tuple(unreadable)
