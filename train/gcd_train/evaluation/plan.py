"""What a user asks of an evaluation, worked out: the clips, the methods, what the run says of itself, what it found."""

import platform
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import product
from math import isnan
from pathlib import Path
from typing import Literal, TypeAlias

import torch

from gcd_model import Quality, RenderOptions, SolverName, Traits
from gcd_model.geometry import CameraMount
from gcd_train.data.pairs import PairedClips
from gcd_train.data.splits import require_apart
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.baselines import VANILLA_SVD, BaselineSettings, build
from gcd_train.evaluation.clips import EvaluationSet, PairedSet, SceneSet, identity_of, names_of
from gcd_train.evaluation.galleries import contact_rows, write_sheet
from gcd_train.evaluation.hexplane import HexPlaneSettings
from gcd_train.evaluation.methods import (
    Method,
    of_baselines,
    of_saved_frames,
    of_weights,
    open_weights,
    require_names_apart,
)
from gcd_train.evaluation.metrics import Lpips
from gcd_train.evaluation.opening import Choice, SceneCuts, data_kind, open_pairs, open_scenes, usual_samples
from gcd_train.evaluation.predictors import fit_statistics
from gcd_train.evaluation.protocol import FrameBounds, ProtocolName
from gcd_train.evaluation.runs import Measured, Run, gather
from gcd_train.evaluation.statistics import FigureName, Selection
from gcd_train.evaluation.store import LPIPS, RunKeeper, RunNote
from gcd_train.layouts.manifest import package_version

ProgressBar: TypeAlias = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Shows how far some work is: its name and its steps; gives what is called with the steps done."""


@dataclass(frozen=True, kw_only=True, slots=True)
class EvaluateOptions:
    """What is asked of `gcd-train evaluate`: one field for each of its options, see there. None: left out."""

    data: Sequence[Path]
    weights: str | None = None
    steps: Sequence[int] | None = None
    samples: int | None = None
    guidance: tuple[float, float] | None = None
    quality: Quality = "exact"
    solver: SolverName | None = None
    guidance_interval: tuple[float, float] | None = None
    train: Sequence[Path] | None = None
    train_limit: int = 1000
    baselines: bool = True
    methods: Sequence[str] | None = None
    svd: str | None = None
    predictions: Sequence[str] | None = None
    privileged: Sequence[str] | None = None
    hexplane: HexPlaneSettings = HexPlaneSettings()  # noqa: RUF009  it is frozen
    lpips: Path | None = None
    protocol: ProtocolName = "paper"
    controls: Path | None = None
    split: str | None = None
    listed: Path | None = None
    limit: int | None = None
    trajectories: int | None = None
    frame_start: int | None = None
    frame_skip: int | None = None
    angles: Literal["max90", "max180"] | None = None
    path: Literal["gradual", "direct"] | None = None
    modality: Literal["rgb", "semantic"] | None = None
    exact: bool = False
    camera: Sequence[str] | None = None
    declared_height: float | None = None
    declared_tilt: float | None = None
    seed: int = 0
    device: str = "auto"
    dtype: str | None = None

    @property
    def names(self) -> list[str] | None:
        """The baselines that are asked for by name; None for the usual ones."""
        if self.methods is None:
            return None
        return [name.strip() for name in ",".join(self.methods).split(",") if name.strip()]

    @property
    def mount(self) -> CameraMount | None:
        """The mount that is declared; None for none. Raises OptionError for one that no camera has."""
        given = {"height_m": self.declared_height, "tilt_deg": self.declared_tilt}
        given = {name: value for name, value in given.items() if value is not None}
        return CameraMount(**given) if given else None

    @property
    def sampling(self) -> RenderOptions:
        """All but the steps."""
        return RenderOptions(
            quality=self.quality,
            solver=self.solver,
            guidance=self.guidance,
            guidance_interval=self.guidance_interval,
            samples=self.samples or usual_samples(self.data, self.protocol),
            seed=self.seed,
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """What is to be done.

    notes: what is odd about the clips, line by line. models, baselines, saved: methods, in the order of the table;
    baselines that want means cannot be used before `with_means`. model: what is known of the weights, None without.
    settings: of the baselines. training: pairs for means. painted: targets are class maps in colours. lpips: digest of
    its weights, None without.
    """

    options: EvaluateOptions
    clips: EvaluationSet
    notes: tuple[str, ...]
    models: tuple[Method, ...]
    baselines: tuple[Method, ...]
    saved: tuple[Method, ...]
    model: Traits | None
    settings: BaselineSettings
    training: PairedClips | None
    painted: bool
    lpips: str | None

    @property
    def methods(self) -> tuple[Method, ...]:
        """All, the weights first."""
        return self.models + self.baselines + self.saved

    def with_means(self, bar: ProgressBar) -> "Plan":
        """With the means of the training clips, all of which are read for it; the same plan where there are none.

        Raises: DataError if one cannot be read.
        """
        if self.training is None:
            return self
        with bar("training clips", len(self.training)) as show:
            statistics = fit_statistics(self.training, progress=lambda done, _: show(done))
        settings = replace(self.settings, statistics=statistics)
        made = tuple(replace(each, make=partial(build, each.name, settings)) for each in self.baselines)
        return replace(self, baselines=made, settings=settings)

    def note(self, command: str) -> RunNote:
        """What the run says of itself. command: the line that began it."""
        clips, options = self.clips, self.options
        lpips = {} if self.lpips is None else {LPIPS: self.lpips}
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
            modality="semantic" if self.painted else "rgb",
            protocol="pairs" if isinstance(clips, PairedSet) else options.protocol,
            frames=clips.frames,
            height=clips.height,
            width=clips.width,
            fps=clips.rates[0],
            rates=tuple(clips.rates) if len(clips.rates) > 1 else (),
            seed=options.seed,
            classes=tuple(each.name for each in clips.classes),
            methods={method.name: {**method.told, **lpips} for method in self.methods},
        )

    def write_sheet(self, path: Path, keys: Sequence[str], keeper: RunKeeper) -> bool:
        """The contact sheet of clips; whether any of them was measured. Raises RunError."""
        shown, classes = self._on_the_sheet(keeper), self.clips.classes
        path.unlink(missing_ok=True)
        rows = [
            (key, contact_rows(self.clips.clip(key), [(name, keeper.sheet_rows(name, key)) for name in shown], classes))
            for key in keys
            if any(keeper.has(name, key) for name in shown)
        ]
        if rows:
            write_sheet(rows, path)
        return bool(rows)

    def _on_the_sheet(self, keeper: RunKeeper) -> list[str]:
        """The weights, and the best others with and without more than the source, by PSNR and by mIoU."""
        (of,) = gather([Run.read(keeper.folder)])
        measured, chosen = Measured(of=of), [method.name for method in self.models[:1]]
        others = {method.name for method in self.baselines + self.saved}
        figures: tuple[FigureName, ...] = ("psnr_db", "miou_full")
        for figure, privileged in product(figures, (False, True)):
            found = [
                (measured.sums(method, Selection()).value(figure), method.name)
                for method in of.methods
                if method.name in others and method.privileged == privileged
            ]
            chosen += [name for _, name in sorted(each for each in found if not isnan(each[0]))[-1:]]
        return [method.name for method in of.methods if method.name in chosen]


def planned(options: EvaluateOptions) -> Plan:
    """Open the data and the weights, and choose the methods: all that is quick, so that faults are told at once.

    Raises:
        DataError: data or frames are missing, or do not fit together. RecipeError: options contradict each other, or
            there is nothing to measure. CheckpointError: weights cannot be opened.
    """
    _require_used(options)
    lpips = None if options.lpips is None else Lpips.open(options.lpips).identity
    choice = Choice(split=options.split, listed=options.listed, limit=options.limit)
    weights, model, painted = None, None, False
    if options.weights is not None:
        weights = partial(open_weights, _resolved(options.weights), options.device, options.dtype)
        model = weights().traits
    if data_kind(options.data) == "pairs":
        _require_pairs_options(options)
        clips, notes = open_pairs(options.data, choice, options.mount)
    else:
        cuts = _cuts(options, model)
        clips, notes = open_scenes(options.data[0], choice, cuts)
        painted = cuts.semantic
    training = _training(options, clips)
    models = () if weights is None else of_weights(weights, clips, options.sampling, options.steps or ())
    settings = _settings(options, clips, training, painted=painted)
    trained_on = "nothing" if training is None else identity_of(training)
    further = len(clips.dataset.cameras) - 1 if isinstance(clips, SceneSet) else 0  # pairs have one camera
    baselines = (
        of_baselines(options.names, settings, trained_on=trained_on, others=further) if options.baselines else ()
    )
    saved = of_saved_frames(
        options.predictions or (), clips.classes if painted else (), privileged=options.privileged or ()
    )
    if not (models or baselines or saved):
        raise RecipeError("there is nothing to measure: give --weights, or leave out --no-baselines")
    require_names_apart([*models, *baselines, *saved])
    return Plan(
        options=options,
        clips=clips,
        notes=notes,
        models=models,
        baselines=baselines,
        saved=saved,
        model=model,
        settings=settings,
        training=training,
        painted=painted,
        lpips=lpips,
    )


def _resolved(weights: str) -> str:
    """A path that does not depend on where a process stands; names of weights as they are."""
    return str(Path(weights).resolve()) if Path(weights).exists() else weights


def _require_used(options: EvaluateOptions) -> None:
    """Raises RecipeError for what would be left aside without a word."""
    if options.methods is not None and not options.baselines:
        raise RecipeError("--methods names baselines and --no-baselines wants none; leave one of the two out")
    if options.svd is not None and VANILLA_SVD not in (options.names or ()):
        raise RecipeError(f"--svd is for {VANILLA_SVD}, which --methods does not name; name it, or leave out --svd")


def _require_pairs_options(options: EvaluateOptions) -> None:
    """Pairs were cut when they were made."""
    of_scenes = ("controls", "trajectories", "frame_start", "frame_skip", "angles", "path", "modality")
    given = any(getattr(options, name) is not None for name in of_scenes)
    if given or options.exact or options.camera or options.protocol != "paper":
        raise RecipeError(
            "these are pairs, cut when they were made: leave out --protocol, --controls, --trajectories, "
            "--frame-start, --frame-skip, --angles, --path, --modality, --exact and --camera"
        )


def _cuts(options: EvaluateOptions, model: Traits | None) -> SceneCuts:
    """What was asked for, and what suits the weights where nothing was."""
    if options.mount is not None:
        raise RecipeError("scenes tell where their cameras are: leave out --declared-height and --declared-tilt")
    suiting = SceneCuts.suiting(model)
    return replace(
        suiting,
        protocol=options.protocol,
        controls=options.controls,
        clips=options.trajectories,
        seed=options.seed,
        bounds=FrameBounds(start=options.frame_start, skip=options.frame_skip),
        far=options.angles == "max180",
        gradual=suiting.gradual if options.path is None else options.path == "gradual",
        semantic=suiting.semantic if options.modality is None else options.modality == "semantic",
        exact=options.exact,
        cameras=tuple(options.camera) if options.camera else None,
    )


def _training(options: EvaluateOptions, clips: EvaluationSet) -> PairedClips | None:
    """Raises DataError where the training clips are no measure for the held-out ones."""
    if not options.baselines or not options.train:
        return None
    if not isinstance(clips, PairedSet):
        raise RecipeError("means are taken over pairs, and these are scenes: leave out --train")
    training = PairedClips.open(list(options.train), options.train_limit)
    kinds = [
        f"T, H, W = {(each.frames, each.height, each.width)}, classes {names_of(each.classes)}, camera control "
        f"{each.camera!r}"
        for each in (training, clips.clips)
    ]
    if kinds[0] != kinds[1]:
        raise DataError(
            f"training and held-out clips must be of one kind, got {kinds[0]} and {kinds[1]}; generate both alike"
        )
    require_apart(training.scenes, clips.clips.scenes)
    return training


def _settings(
    options: EvaluateOptions, clips: EvaluationSet, training: PairedClips | None, *, painted: bool
) -> BaselineSettings:
    """With nothing in the places of means that are not known yet. Raises RecipeError where some want training clips."""
    if options.baselines and options.methods is None and training is None and isinstance(clips, PairedSet):
        raise RecipeError(
            "baselines want training clips for their means: give --train FOLDER, name some that need none with "
            "--methods, or --no-baselines"
        )
    settings = BaselineSettings(
        frames=clips.frames,
        height=clips.height,
        width=clips.width,
        classes=tuple(clips.classes),
        painted=painted,
        svd=None if options.svd is None else _resolved(options.svd),
        device=options.device,
        dtype=options.dtype,
        samples=options.sampling.samples,
        seed=options.seed,
        published=options.protocol == "release",
        hexplane=options.hexplane,
    )
    return settings if training is None else replace(settings, statistics=settings.fill)
