"""`gcd-train evaluate`: weights and what they have to beat, on held-out clips."""

from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal

import torch
import typer
from typer import Option

from gcd_model.diffusion import Quality, SolverName
from gcd_train.cli.common import command_line, errors_shown, progress_bar, say, stop_as_by_ctrl_c
from gcd_train.errors import RecipeError, TrainError
from gcd_train.evaluation.galleries import KeptViews
from gcd_train.evaluation.hexplane import HexPlaneSettings
from gcd_train.evaluation.measure import Account, ClipWork, assign_gpus, measure_all
from gcd_train.evaluation.methods import EvaluateOptions, planned, run_note
from gcd_train.evaluation.report import make_report
from gcd_train.evaluation.store import RunKeeper

_FIELD = HexPlaneSettings()

Folders = Annotated[list[Path], Option(help="Folder of pairs (several may be given), or one of whole scenes.")]
Out = Annotated[Path, Option(help="Folder of the run: run.json, records, tables; one that is there is gone on with.")]
WeightsPath = Annotated[list[str] | None, Option(help="package:NAME or a path; without, baselines alone.")]
Steps = Annotated[list[int] | None, Option(min=1, help="Also with so many steps of the sampler; may be repeated.")]
Samples = Annotated[int | None, Option(min=1, help="Draws of each view; by default 1 of pairs, else by the protocol.")]
Guidance = Annotated[tuple[float, float] | None, Option(help="Of the first and the last frame; by default as shipped.")]
QualityChoice = Annotated[Quality, Option(help="As the weights ship, or in fewer steps where they take many.")]
Solver = Annotated[SolverName | None, Option(help="Euler steps as published, or of second order.")]
Interval = Annotated[tuple[float, float] | None, Option(help="Noise levels guidance applies at; by default all.")]
Baselines = Annotated[bool, Option(help="Also measure what has to be beaten.")]
Methods = Annotated[list[str] | None, Option(help="These baselines, with commas between; by default the usual ones.")]
Svd = Annotated[str | None, Option(help="Weights for vanilla_svd: svd.safetensors.")]
Predictions = Annotated[list[str] | None, Option(help="NAME=FOLDER with frames of another method; may be repeated.")]
Privileged = Annotated[list[str] | None, Option(help="NAME of --predictions that was given depth or other views: *.")]
HexPlaneUpdates = Annotated[int, Option("--hexplane-updates", min=1, help="hexplane_K: steps of learning a clip.")]
HexPlaneRays = Annotated[int, Option("--hexplane-rays", min=1, help="hexplane_K: rays in each of these steps.")]
LpipsWeights = Annotated[Path | None, Option("--lpips", help="Folder with LPIPS weights; without, no such figure.")]
ProtocolName = Annotated[Literal["paper", "release"], Option(help="How clips are cut from whole scenes.")]
Controls = Annotated[Path | None, Option(help="Scenes: control list, JSON.")]
Split = Annotated[str | None, Option(help="Only scenes of a split: a name as driving-test, or FILE:test.")]
Listed = Annotated[Path | None, Option("--list", help="Scenes: only those of a list, one a line.")]
Trajectories = Annotated[int | None, Option(min=1, help="Scenes: clips of each; by default 4 (paper, Kubric-4D) or 1.")]
FrameStart = Annotated[int | None, Option(min=0, help="Scenes: first frame of every clip.")]
FrameSkip = Annotated[int | None, Option(min=1, help="Scenes: frames from one of the clip to the next.")]
Angles = Annotated[Literal["max90", "max180"] | None, Option(help="Scenes: how far goals are drawn; by default max90.")]
PathKind = Annotated[Literal["gradual", "direct"] | None, Option(help="Scenes: as the weights by default.")]
Modality = Annotated[Literal["rgb", "semantic"] | None, Option(help="Scenes: targets; as the weights by default.")]
Exact = Annotated[bool, Option("--exact", help="Our scenes: targets from their geometry instead of from points.")]
Camera = Annotated[list[str] | None, Option(help="Scenes: a camera to read; may be repeated. By default all.")]
Limit = Annotated[int | None, Option(min=1, help="Only the first so many scenes.")]
Views = Annotated[KeptViews, Option(help="Frames to keep as PNG, for the gallery: few are all of four clips.")]
Workers = Annotated[int, Option(min=1, help="Processes; where there are several GPUs they take them in turn.")]
Ray = Annotated[str | None, Option("--ray", help="Run on this Ray cluster (auto, HOST:PORT; extra `cluster`).")]
Seed = Annotated[int, Option(min=0, help="Of drawn clips and of all noise.")]
Device = Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")]
Dtype = Annotated[str | None, Option(help="float32, bfloat16 or float16.")]


def evaluate_command(
    data: Folders,
    out: Out,
    weights: WeightsPath = None,
    steps: Steps = None,
    samples: Samples = None,
    guidance: Guidance = None,
    quality: QualityChoice = "exact",
    solver: Solver = None,
    guidance_interval: Interval = None,
    baselines: Baselines = True,
    methods: Methods = None,
    svd: Svd = None,
    predictions: Predictions = None,
    privileged: Privileged = None,
    updates: HexPlaneUpdates = _FIELD.updates,
    rays: HexPlaneRays = _FIELD.rays,
    lpips: LpipsWeights = None,
    protocol: ProtocolName = "paper",
    controls: Controls = None,
    split: Split = None,
    listed: Listed = None,
    trajectories: Trajectories = None,
    frame_start: FrameStart = None,
    frame_skip: FrameSkip = None,
    angles: Angles = None,
    path: PathKind = None,
    modality: Modality = None,
    exact: Exact = False,
    camera: Camera = None,
    limit: Limit = None,
    views: Views = "few",
    workers: Workers = 1,
    ray: Ray = None,
    seed: Seed = 0,
    device: Device = "auto",
    dtype: Dtype = None,
) -> None:
    """Measure weights, baselines and others' frames on held-out clips, and say what is reached."""
    given = dict(locals())
    with errors_shown():
        given |= {"weights": _one(weights), "hexplane": HexPlaneSettings(updates=updates, rays=rays)}
        options = EvaluateOptions(**{field.name: given[field.name] for field in fields(EvaluateOptions)})
        _evaluate(options, out, views=views, workers=workers, ray=ray)


def _one(weights: list[str] | None) -> str | None:
    if weights and len(weights) > 1:
        raise RecipeError(
            f"one --weights is measured at a time, got {' and '.join(weights)}; give each its own line, to one --out"
        )
    return weights[0] if weights else None


def _evaluate(options: EvaluateOptions, out: Path, *, views: KeptViews, workers: int, ray: str | None) -> None:
    out.mkdir(parents=True, exist_ok=True)  # to know at once
    clips, methods, notes = planned(options)
    for line in notes:
        say(line)
    with RunKeeper(out).in_use(run_note(clips, methods, options, command_line())):
        work = ClipWork(
            folder=out.resolve(),
            clips=clips,
            methods={method.name: method for method in methods},
            lpips=None if options.lpips is None else options.lpips.resolve(),
            views=views,
        )
        account = _measured(work, workers, ray, options.device)
    for line in account.lines():
        say(line)
    typer.echo(make_report([out], out, drawn=False).read_text())
    say(f"wrote {out}/run.json, records, report.md, tables" + " and gallery" * (views != "none"))
    if account.failures:
        raise typer.Exit(TrainError.exit_code)


def _measured(work: ClipWork, workers: int, ray: str | None, device: str) -> Account:
    if workers > 1 or ray is not None:
        stop_as_by_ctrl_c()
    account, gpus = Account(clips=len(work.clips.keys)), assign_gpus(device, torch.cuda.device_count())
    with progress_bar("clips", len(work.clips.keys)) as show:
        for account in measure_all(
            work, workers=workers, ray_address=ray, gpus=float(device != "cpu"), environments=gpus
        ):
            show(account.done)
    return account
