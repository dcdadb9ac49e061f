"""What a user asks of an evaluation, worked out: the clips, the methods, what the run says of itself."""

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path

import torch

from gcd_model.diffusion import Quality, RenderOptions, SolverName
from gcd_train.data.files import package_version
from gcd_train.errors import RecipeError
from gcd_train.evaluation.baselines import VANILLA_SVD, BaselineSettings, baselines
from gcd_train.evaluation.clips import EvaluationSet, PairedSet
from gcd_train.evaluation.hexplane import HexPlaneSettings
from gcd_train.evaluation.methods import of_saved_frames, of_weights, open_weights
from gcd_train.evaluation.metrics import Lpips
from gcd_train.evaluation.opening import ClipOptions, data_kind, open_clips
from gcd_train.evaluation.predictors import Method
from gcd_train.evaluation.protocol import SAMPLES
from gcd_train.evaluation.store import LPIPS, RunNote


@dataclass(frozen=True, kw_only=True, slots=True)
class EvaluateOptions(ClipOptions):
    """What is asked of `gcd-train evaluate`: one field for each of its options, see there. None: left out."""

    weights: str | None = None
    steps: Sequence[int] | None = None
    samples: int | None = None
    guidance: tuple[float, float] | None = None
    quality: Quality = "exact"
    solver: SolverName | None = None
    guidance_interval: tuple[float, float] | None = None
    baselines: bool = True
    methods: Sequence[str] | None = None
    svd: str | None = None
    predictions: Sequence[str] | None = None
    privileged: Sequence[str] | None = None
    hexplane: HexPlaneSettings = HexPlaneSettings()  # noqa: RUF009  it is frozen
    lpips: Path | None = None
    device: str = "auto"
    dtype: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """What is to be done. notes: what is odd about the clips, line by line. methods: the weights first."""

    clips: EvaluationSet
    notes: tuple[str, ...]
    methods: tuple[Method, ...]


def planned(options: EvaluateOptions) -> Plan:
    """Open the data and the weights, and choose the methods: all that is quick, so that faults are told at once.

    Raises:
        DataError: data or frames are missing, or do not fit together. RecipeError: options contradict each other, or
            there is nothing to measure. CheckpointError: weights cannot be opened.
    """
    named = options.methods and [name.strip() for name in ",".join(options.methods).split(",") if name.strip()]
    if options.methods is not None and not options.baselines:
        raise RecipeError("--methods names baselines and --no-baselines wants none; leave one of the two out")
    if options.svd is not None and VANILLA_SVD not in (named or ()):
        raise RecipeError(f"--svd is for {VANILLA_SVD}, which --methods does not name; name it, or leave out --svd")
    weights = None
    if options.weights is not None:
        weights = partial(open_weights, _resolved(options.weights), options.device, options.dtype)
    clips, notes = open_clips(options, None if weights is None else weights().traits)
    samples = options.samples or (1 if data_kind(options.data) == "pairs" else SAMPLES[options.protocol])
    methods: list[Method] = []
    if weights is not None:
        sampling = RenderOptions(
            quality=options.quality,
            solver=options.solver,
            guidance=options.guidance,
            guidance_interval=options.guidance_interval,
            samples=samples,
            seed=options.seed,
        )
        methods += of_weights(weights, clips, sampling, options.steps or ())
    if options.baselines:
        settings = BaselineSettings(
            svd=None if options.svd is None else _resolved(options.svd),
            device=options.device,
            dtype=options.dtype,
            samples=samples,
            seed=options.seed,
            published=options.protocol == "release",
            hexplane=options.hexplane,
        )
        methods += baselines(named, clips, settings)
    painted = clips.classes if clips.painted else ()
    methods += of_saved_frames(options.predictions or (), painted, privileged=options.privileged or ())
    if not methods:
        raise RecipeError("there is nothing to measure: give --weights, or leave out --no-baselines")
    for first, second in pairwise(sorted(method.name for method in methods)):
        if first == second:
            raise RecipeError(
                f"each method needs a name of its own, got {first} twice; rename the frames of --predictions"
            )
    return Plan(clips=clips, notes=notes, methods=tuple(methods))


def _resolved(weights: str) -> str:
    """A path that does not depend on where a process stands; names of weights as they are."""
    return str(Path(weights).resolve()) if Path(weights).exists() else weights


def run_note(plan: Plan, options: EvaluateOptions, command: str) -> RunNote:
    """What the run says of itself. command: the line that began it. Raises DataError for LPIPS weights."""
    clips = plan.clips
    lpips = {} if options.lpips is None else {LPIPS: Lpips.open(options.lpips).identity}
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
        classes=tuple(each.name for each in clips.classes),
        methods={method.name: {**method.told, **lpips} for method in plan.methods},
    )
