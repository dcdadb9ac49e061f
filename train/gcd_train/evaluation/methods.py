"""What is measured, and on what: from the options of a user to clips and methods, and what the run says of itself."""

import difflib
import math
import platform
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import torch
from typer import Option

from gcd_model import RenderOptions, inspect_weights, weights_path
from gcd_model.config import SemanticClass
from gcd_model.diffusion import SolverName
from gcd_model.weights.load import digest
from gcd_train.data.files import package_version
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.anyview import EpisodeSet
from gcd_train.evaluation.baselines import (
    REPROJECT_RGBD,
    REPROJECT_SEMD,
    CopySource,
    GroundHomography,
    ReprojectRgbd,
    ReprojectSemd,
)
from gcd_train.evaluation.clips import EvaluationSet, PairedSet
from gcd_train.evaluation.gaussians import GaussianSplatting
from gcd_train.evaluation.hexplane import HexPlane
from gcd_train.evaluation.metrics import Lpips
from gcd_train.evaluation.opening import SAMPLES, ClipOptions, open_clips, scene_layout
from gcd_train.evaluation.predictors import (
    Predictor,
    SavedFrames,
    open_weights,
)
from gcd_train.evaluation.store import LPIPS, RunNote
from gcd_train.evaluation.synthesized import VANILLA_SVD, SynthesizedViews, VanillaSVD
from gcd_train.evaluation.zeronvs import ETA, GUIDANCE, STEPS, ZERONVS, ZeroNVS, best_scale, open_zeronvs


@dataclass(frozen=True, kw_only=True, slots=True)
class EvaluateOptions(ClipOptions):
    """What is asked of `gcd-train evaluate`: one field for each of its options. None: left out."""

    weights: Annotated[list[str] | None, Option(help="package:NAME or a path; without, baselines alone.")] = None
    steps: Annotated[list[int] | None, Option(min=1, help="Also with so many steps; may be repeated.")] = None
    samples: Annotated[int | None, Option(min=1, help="Draws of each view; else the protocol's, 1 of pairs.")] = None
    guidance: Annotated[tuple[float, float] | None, Option(help="Of first and last frame; else as shipped.")] = None
    solver: Annotated[SolverName | None, Option(help="Euler steps as published, or of second order.")] = None
    baselines: Annotated[bool, Option(help="Also measure what has to be beaten.")] = True
    methods: Annotated[list[str] | None, Option(help="Baselines, commas between; by default the usual.")] = None
    svd: Annotated[str | None, Option(help="Weights for vanilla_svd: svd.safetensors.")] = None
    zeronvs: Annotated[str | None, Option(help="Weights for zeronvs: zeronvs.ckpt.")] = None
    zeronvs_scale: Annotated[
        str | None, Option(help="Metres that count as one in zeronvs; or RUN, on validation clips: its best scale.")
    ] = None
    predictions: Annotated[
        list[str] | None, Option(help="NAME=FOLDER with frames of another method; may be repeated.")
    ] = None
    privileged: Annotated[
        list[str] | None, Option(help="NAME of --predictions that was given depth or other views: *.")
    ] = None
    hexplane_updates: Annotated[int, Option(min=1, help="hexplane_K: steps of learning a clip.")] = 1000
    hexplane_rays: Annotated[int, Option(min=1, help="hexplane_K: rays in each of these steps.")] = 1024
    gaussian_updates: Annotated[int, Option(min=1, help="4dgs_K: steps of learning a clip, a picture each.")] = 1500
    gaussians: Annotated[int, Option(min=500, help="4dgs_K: to how many they grow.")] = 500
    lpips: Annotated[Path | None, Option(help="Folder with LPIPS weights; without, no such figure.")] = None
    device: Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")] = "auto"
    dtype: Annotated[str | None, Option(help="float32, bfloat16 or float16; by default as stored.")] = None


def planned(options: EvaluateOptions) -> tuple[EvaluationSet, tuple[Predictor, ...], tuple[str, ...]]:
    """Open the data and the weights, and choose the methods: all that is quick, so that faults are told at once.

    Returns: the clips, the methods with the weights first, and what is odd about the clips, line by line.
    Raises:
        DataError: data or frames are missing, or do not fit together. RecipeError: options contradict each other, or
            there is nothing to measure. CheckpointError: weights cannot be opened.
    """
    named = options.methods and [name.strip() for name in ",".join(options.methods).split(",") if name.strip()]
    if options.methods is not None and not options.baselines:
        raise RecipeError("--methods names baselines and --no-baselines wants none; leave one of the two out")
    for option, given, method in (
        ("--svd", options.svd, VANILLA_SVD),
        ("--zeronvs", options.zeronvs, ZERONVS),
        ("--zeronvs-scale", options.zeronvs_scale, ZERONVS),
    ):
        if given is not None and method not in (named or ()):
            raise RecipeError(
                f"{option} is for {method}, which --methods does not name; name it, or leave out {option}"
            )
    weights, given = None, options.weights or []
    if len(given) > 1:
        raise RecipeError(
            f"one --weights is measured at a time, got {' and '.join(given)}; give each its own line, to one --out"
        )
    if given:
        weights = partial(open_weights, _resolved(given[0]), options.device, options.dtype)
    clips, notes = open_clips(options, None if weights is None else weights().traits)
    samples = options.samples or (1 if scene_layout(options.data) is None else SAMPLES[options.protocol])
    options, methods = replace(options, samples=samples), list[Predictor]()
    if weights is not None:
        sampling = RenderOptions(
            solver=options.solver,
            guidance=options.guidance,
            samples=samples,
            seed=options.seed,
        )
        shipped = weights().traits.config.sampling.steps  # as it ships first, then with each other number of steps
        others = [number for number in dict.fromkeys(options.steps or ()) if number != shipped]
        methods += [SynthesizedViews.of(weights, clips, replace(sampling, steps=steps)) for steps in (None, *others)]
    if options.baselines:
        methods += baselines(named, clips, options)
    methods += _saved_frames(options, clips.classes if clips.painted else ())
    if not methods:
        raise RecipeError("there is nothing to measure: give --weights, or leave out --no-baselines")
    for first, second in pairwise(sorted(method.name for method in methods)):
        if first == second:
            raise RecipeError(
                f"each method needs a name of its own, got {first} twice; rename the frames of --predictions"
            )
    for each in methods:
        if isinstance(each, SavedFrames) and (names := each.beside(clips.keys)):
            notes += (f"{each.folder} holds frames that are of no clip of the set: {len(names)}, first {names[0]}",)
    return clips, tuple(methods), notes


def _resolved(weights: str) -> str:
    """A path that does not depend on where a process stands; names of weights as they are."""
    return str(Path(weights).resolve()) if Path(weights).exists() else weights


def _saved_frames(options: EvaluateOptions, painted: tuple[SemanticClass, ...]) -> list[Predictor]:
    """Methods whose frames lie in folders. painted: the classes in whose colours they are; empty for photographs."""
    found: list[Predictor] = []
    for named in options.predictions or ():
        name, _, folder = named.partition("=")
        if not (name and folder):
            raise RecipeError(f"frames of another method are given as NAME=FOLDER, got {named!r}")
        if not Path(folder).is_dir():
            raise DataError(f"the frames of {name} should lie in {folder}, which is no folder; give NAME=FOLDER")
        more = name in (options.privileged or ())
        found.append(SavedFrames(name=name, folder=Path(folder).resolve(), painted=painted, privileged=more))
    names = [method.name for method in found]
    for name in options.privileged or ():
        if name not in names:
            raise RecipeError(
                f"--privileged wants the name of a method of --predictions, got {name!r}; "
                f"there are {', '.join(names) or 'none'}"
            )
    return found


def run_note(clips: EvaluationSet, methods: Sequence[Predictor], options: EvaluateOptions, command: str) -> RunNote:
    """What the run says of itself. command: the line that began it. Raises DataError for LPIPS weights."""
    opened = None if options.lpips is None else Lpips.open(options.lpips)
    if opened is not None and opened.network != "vgg" and options.protocol == "anyviewbench":
        raise DataError(
            f"AnyViewBench's LPIPS is by VGG16, {options.lpips} holds {opened.network}; give VGG16's weights"
        )
    lpips = {} if opened is None else {LPIPS: opened.identity}
    return RunNote(
        command=command,
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        versions={
            "gcd-node": package_version(),
            "torch": str(torch.__version__),
            "python": platform.python_version(),
        },
        data=tuple(map(str, options.data)),
        data_identity=clips.identity,
        kind=clips.kind,
        modality="semantic" if clips.painted else "rgb",
        protocol="pairs" if isinstance(clips, PairedSet) else options.protocol,
        frames=clips.frames,
        height=clips.height,
        width=clips.width,
        seed=options.seed,
        clips=len(clips.keys),
        classes=tuple(each.name for each in clips.classes),
        groups=clips.groups if isinstance(clips, EpisodeSet) else {},
        splits=clips.splits if isinstance(clips, EpisodeSet) else {},
        methods={method.name: {**method.details, **lpips} for method in methods},
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodKind:
    """What `--methods NAME` measures, or NAME_K, K cameras of a scene.

    make: the method, from the clips, the options and K. makes: pictures, class maps or both. usual: it is measured
    where none are named. views: whether its name ends in K. geometry: it needs the source's depth, or the ground.
    """

    make: Callable[[EvaluationSet, EvaluateOptions, int], Predictor]
    makes: Literal["pictures", "classes", "both"] = "pictures"
    usual: bool = False
    views: bool = False
    geometry: bool = False


def baselines(names: Sequence[str] | None, clips: EvaluationSet, options: EvaluateOptions) -> tuple[Predictor, ...]:
    """Baselines by name; the usual ones that fit the clips where none are named.

    Raises:
        RecipeError: there is none of a name, it does not fit the clips, or it lacks what it needs.
        CheckpointError: vanilla SVD's weights cannot be opened.
    """
    unfit = {"pictures"} if clips.painted else set[str]() if clips.classes else {"classes"}
    if names is None:
        fitting = {name: kind for name, kind in METHODS.items() if clips.geometry or not kind.geometry}
        names = [name for name, kind in fitting.items() if kind.usual and kind.makes not in unfit]
    found: list[Predictor] = []
    for name in names:
        stem, _, number = name.rpartition("_")
        views = int(number) if re.fullmatch(r"[1-9]\d*", number) else 0
        kind = METHODS.get(stem if views else name)
        if kind is None or kind.views != bool(views):
            every = [f"{known}_{k}" for known, each in METHODS.items() for k in ((1, 2, 4, 8) if each.views else ())]
            every = [*(known for known, each in METHODS.items() if not each.views), *every]  # any other K goes, too
            near = difflib.get_close_matches(name, every, n=1)
            meant = f"did you mean {near[0]}? " if near else ""
            raise RecipeError(f"no baseline is called {name!r}; {meant}there are {', '.join(every)}")
        if kind.makes in unfit:
            targets = "class maps" if clips.painted else "pictures without class maps"
            raise RecipeError(f"{name} makes {kind.makes} alone, and these targets are {targets}; leave it out")
        if kind.geometry and not clips.geometry:
            raise RecipeError(f"{name} wants depth or the ground, which these clips do not tell; leave it out")
        if views > clips.cameras:
            there = f"{clips.cameras - 1} beside the source" if clips.cameras > 1 else "the source alone"
            more = ", or --exact, with which scenes of our own have more" if clips.kind == "kubric" else ""
            raise RecipeError(
                f"{name} wants {views} cameras, and these clips have {there}; give {stem}_{clips.cameras} or less"
                + more * (not options.exact)
            )
        found.append(kind.make(clips, options, views))
    return tuple(found)


def _reproject_rgbd(clips: EvaluationSet, options: EvaluateOptions, views: int) -> ReprojectRgbd:
    return ReprojectRgbd(published=options.protocol == "release")


def _reproject_semd(clips: EvaluationSet, options: EvaluateOptions, views: int) -> ReprojectSemd:
    return ReprojectSemd(classes=clips.classes, published=options.protocol == "release")


def _hexplane(clips: EvaluationSet, options: EvaluateOptions, views: int) -> HexPlane:
    return HexPlane(
        views=views,
        seed=options.seed,
        device=options.device,
        updates=options.hexplane_updates,
        rays=options.hexplane_rays,
    )


def _gaussians(clips: EvaluationSet, options: EvaluateOptions, views: int) -> GaussianSplatting:
    told = {"updates": options.gaussian_updates, "most": options.gaussians}
    return GaussianSplatting(views=views, seed=options.seed, device=options.device, **told)


def _vanilla_svd(clips: EvaluationSet, options: EvaluateOptions, views: int) -> VanillaSVD:
    """With weights that are opened where they are used: the published file `svd.safetensors`, its diffusers folder, or
    our own of the same task. A published file but GCD's is taken to be SVD, whatever it is called."""
    if options.svd is None:
        raise RecipeError(f"{VANILLA_SVD} wants its weights: give the path of svd.safetensors")
    kind, _, name = options.svd.partition(":")
    if kind == "random":
        family, weights_digest = name, options.svd
    else:
        found = inspect_weights(weights_path(options.svd))
        steered = found.layout == "gcd-ckpt" or getattr(found.config, "camera", "none") != "none"
        family = found.family.name if found.family else "GCD" if steered else None
        weights_digest = found.digest[:12]
    if family not in ("svd", None):
        raise RecipeError(
            f"{VANILLA_SVD} wants weights that make a video out of a picture, {options.svd} is of the family "
            f"{family}; give svd.safetensors"
        )
    samples, seed = options.samples or 1, options.seed
    details = {"baseline": VANILLA_SVD, "crop": "centre", "samples": str(samples), "seed": str(seed)}
    details["weights"] = weights_digest
    weights = partial(open_weights, _resolved(options.svd), options.device, options.dtype, None if family else "svd")
    one = isinstance(clips, EpisodeSet)  # AnyViewBench makes all clips from the same noise
    return VanillaSVD(weights=weights, samples=samples, seed=seed, shared_noise=one, details=details)


def _zeronvs(clips: EvaluationSet, options: EvaluateOptions, views: int) -> ZeroNVS:
    """Opened at once, so that a file of another method is refused before anything is measured."""
    if options.zeronvs is None or options.zeronvs_scale is None:
        raise RecipeError(
            f"{ZERONVS} wants its weights, --zeronvs zeronvs.ckpt, and --zeronvs-scale: metres that count as one, or a "
            "run on validation clips in which several were measured"
        )
    networks = partial(open_zeronvs, _resolved(options.zeronvs), options.device, options.dtype)
    networks()
    samples, weights_digest = options.samples or 1, digest((Path(options.zeronvs),))[:12]
    try:
        scale, chosen = float(options.zeronvs_scale), "as given"
    except ValueError:
        scale, chosen = best_scale(Path(options.zeronvs_scale), clips, weights_digest)
    if not (math.isfinite(scale) and scale > 0):
        raise RecipeError(f"--zeronvs-scale must be metres above 0, got {options.zeronvs_scale}")
    details = {"baseline": ZERONVS, "scale": f"{scale:g}", "scale chosen": chosen, "weights": weights_digest}
    details |= {"steps": str(STEPS), "guidance": f"{GUIDANCE:g}", "eta": f"{ETA:g}"}
    details |= {"samples": str(samples), "seed": str(options.seed)}
    return ZeroNVS(
        networks=networks,
        scale=scale,
        samples=samples,
        seed=options.seed,
        shared_noise=isinstance(clips, EpisodeSet),
        details=details,
    )


METHODS: dict[str, MethodKind] = {
    "copy_source": MethodKind(make=lambda clips, options, views: CopySource(), makes="both", usual=True),
    "ground_homography": MethodKind(
        make=lambda clips, options, views: GroundHomography(), makes="both", usual=True, geometry=True
    ),
    REPROJECT_RGBD: MethodKind(make=_reproject_rgbd, usual=True, geometry=True),
    REPROJECT_SEMD: MethodKind(make=_reproject_semd, makes="classes", usual=True, geometry=True),
    VANILLA_SVD: MethodKind(make=_vanilla_svd),
    ZERONVS: MethodKind(make=_zeronvs),
    "hexplane": MethodKind(make=_hexplane, views=True),
    "4dgs": MethodKind(make=_gaussians, views=True),
}
"""What can be measured beside weights and saved frames; a new method is one entry, and a `Predictor` of its own."""
