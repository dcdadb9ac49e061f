"""What a user asks of an evaluation, worked out: the clips, the methods, and what the run says of itself."""

import platform
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeAlias

import torch

from gcd_model import Traits
from gcd_train.baselines import VANILLA_SVD, BaselineSettings, TargetStatistics, fit_statistics
from gcd_train.datasets.paired import PairedClips, require_apart
from gcd_train.errors import RecipeError
from gcd_train.evaluation.asked import Asked, SceneWishes
from gcd_train.evaluation.clips import EvaluationSet
from gcd_train.evaluation.held_out import require_same_kind
from gcd_train.evaluation.methods import (
    Method,
    Weights,
    of_baselines,
    of_saved_frames,
    of_weights,
    require_names_apart,
    require_views,
)
from gcd_train.evaluation.opening import Opened, SceneCuts, data_kind, open_pairs, open_scenes
from gcd_train.evaluation.paired_set import PairedSet, identity_of
from gcd_train.evaluation.record import LPIPS, RunNote
from gcd_train.evaluation.scene_set import SceneSet
from gcd_train.layouts.manifest import package_version
from gcd_train.metrics import Lpips

ProgressBar: TypeAlias = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Shows how far some work is: its name and its steps; gives what is called with the steps done."""

_NEAR_DEG = 90.0
"""Families that were trained up to this azimuth have goals drawn up to it, others up to 180 degrees."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Training:
    """Pairs whose means stand in for what nobody saw. identity: of the clips."""

    clips: PairedClips
    identity: str

    @property
    def count(self) -> int:
        """How many clips."""
        return len(self.clips)


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """What is to be done.

    models, baselines, saved: methods, in the order of the table; baselines that want means cannot be used before
    `with_means`. model: what is known of the weights, None without. painted: targets are class maps in colours. lpips:
    digest of its weights, None without.
    """

    asked: Asked
    opened: Opened
    models: tuple[Method, ...]
    baselines: tuple[Method, ...]
    saved: tuple[Method, ...]
    model: Traits | None
    training: Training | None
    painted: bool
    lpips: str | None

    @property
    def clips(self) -> EvaluationSet:
        """To be measured on."""
        return self.opened.clips

    @property
    def rivals(self) -> tuple[Method, ...]:
        """What the weights are measured against."""
        return self.baselines + self.saved

    @property
    def methods(self) -> tuple[Method, ...]:
        """All, the weights first."""
        return self.models + self.rivals

    def with_means(self, bar: ProgressBar) -> "Plan":
        """With the means of the training clips, all of which are read for it; the same plan where there are none.

        Raises: DataError if one cannot be read.
        """
        if self.training is None:
            return self
        clips = self.training.clips
        with bar("training clips", len(clips)) as show:
            statistics = fit_statistics(clips, progress=lambda done, _: show(done))
        made = _baselines(self.asked, self.clips, self.training, statistics, painted=self.painted)
        return replace(self, baselines=made)


def planned(asked: Asked) -> Plan:
    """Open the data and the weights, and choose the methods: all that is quick, so that faults are told at once.

    Raises:
        DataError: data or frames are missing, or do not fit together. RecipeError: options contradict each other, or
            there is nothing to measure. CheckpointError: weights cannot be opened.
    """
    _require_used(asked)
    lpips = None if asked.lpips is None else Lpips.open(asked.lpips).identity
    if data_kind(asked.data) == "pairs":
        _require_pairs_options(asked)
        opened, model = open_pairs(asked.data, asked.choice, asked.mount), _model(asked)
        painted = False
    else:
        model = _model(asked)
        cuts = _cuts(asked, model)
        opened, painted = open_scenes(asked.data[0], asked.choice, cuts), cuts.semantic
    training = _training(asked, opened.clips)
    models = (
        ()
        if model is None
        else of_weights(_weights(asked), opened.clips, asked.tested.sampling, asked.tested.steps or ())
    )
    standing_in = None if training is None else _nothing_yet(opened.clips)
    baselines = _baselines(asked, opened.clips, training, standing_in, painted=painted)
    saved = of_saved_frames(
        asked.rivals.predictions or (),
        opened.clips.classes if painted else (),
        privileged=asked.rivals.privileged or (),
    )
    if not (models or baselines or saved):
        raise RecipeError("there is nothing to measure: give --weights, or leave out --no-baselines")
    require_names_apart([*models, *baselines, *saved])
    return Plan(
        asked=asked,
        opened=opened,
        models=models,
        baselines=baselines,
        saved=saved,
        model=model,
        training=training,
        painted=painted,
        lpips=lpips,
    )


def note_of(plan: Plan, command: str) -> RunNote:
    """What the run says of itself. command: the line that began it."""
    clips, asked = plan.clips, plan.asked
    lpips = {} if plan.lpips is None else {LPIPS: plan.lpips}
    return RunNote(
        command=command,
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        versions={
            "gcd-node": package_version(),
            "torch": str(torch.__version__),
            "python": platform.python_version(),
        },
        data=tuple(map(str, asked.data)),
        data_identity=clips.identity,
        kind=clips.kind,
        modality="semantic" if plan.painted else "rgb",
        protocol="pairs" if isinstance(clips, PairedSet) else asked.protocol,
        frames=clips.frames,
        height=clips.height,
        width=clips.width,
        fps=clips.fps,
        rates=tuple(clips.rates) if len(clips.rates) > 1 else (),
        seed=asked.tested.sampling.seed,
        classes=tuple(each.name for each in clips.classes),
        methods={method.name: {**method.told, **lpips} for method in plan.methods},
    )


def _weights(asked: Asked) -> Weights:
    path = _resolved(asked.tested.weights or "")
    return Weights(path=path, device=asked.tested.device, dtype=asked.tested.dtype)


def _resolved(weights: str) -> str:
    """A path that does not depend on where a process stands; names of weights as they are."""
    return str(Path(weights).resolve()) if weights and Path(weights).exists() else weights


def _names(asked: Asked) -> list[str] | None:
    """The baselines that are asked for by name; None for the usual ones."""
    told = asked.rivals.names
    return None if told is None else [name.strip() for name in ",".join(told).split(",") if name.strip()]


def _require_used(asked: Asked) -> None:
    """Raises RecipeError for what would be left aside without a word."""
    told = asked.rivals
    if told.names is not None and not told.usual:
        raise RecipeError("--methods names baselines and --no-baselines wants none; leave one of the two out")
    if told.svd is not None and VANILLA_SVD not in (_names(asked) or ()):
        raise RecipeError(f"--svd is for {VANILLA_SVD}, which --methods does not name; name it, or leave out --svd")


def _model(asked: Asked) -> Traits | None:
    return None if asked.tested.weights is None else _weights(asked).open().traits


def _require_pairs_options(asked: Asked) -> None:
    """Pairs were cut when they were made."""
    if asked.cut != SceneWishes() or asked.protocol != "paper":
        raise RecipeError(
            "these are pairs, cut when they were made: leave out --protocol, --controls, --trajectories, "
            "--frame-start, --frame-skip, --angles, --path, --modality, --exact and --camera"
        )


def _cuts(asked: Asked, model: Traits | None) -> SceneCuts:
    """What was asked for, and what suits the weights where nothing was."""
    if asked.mount is not None:
        raise RecipeError("scenes tell where their cameras are: leave out --declared-height and --declared-tilt")
    wishes, looks, form = asked.cut, asked.cut.looks, SceneCuts()
    limits = None if model is None or model.family is None else model.family.limits
    far = limits is not None and limits.azimuth_deg > _NEAR_DEG
    semantic = model is not None and model.family is not None and model.family.output == "semantic"
    config = form if model is None else model.config
    return SceneCuts(
        protocol=asked.protocol,
        controls=wishes.controls,
        clips=wishes.clips,
        seed=asked.tested.sampling.seed,
        bounds=wishes.bounds,
        far=far if looks.angles is None else looks.angles == "max180",
        gradual=(model is None or model.move_time > 0) if looks.path is None else looks.path == "gradual",
        semantic=semantic if looks.modality is None else looks.modality == "semantic",
        exact=wishes.exact,
        cameras=tuple(wishes.cameras) if wishes.cameras else None,
        frames=config.frames,
        height=config.height,
        width=config.width,
    )


def _training(asked: Asked, clips: EvaluationSet) -> Training | None:
    """Raises DataError where the training clips are no measure for the held-out ones."""
    told = asked.rivals
    if not told.usual or not told.train:
        return None
    if not isinstance(clips, PairedSet):
        raise RecipeError("means are taken over pairs, and these are scenes: leave out --train")
    training = PairedClips.open(list(told.train), told.train_limit)
    require_same_kind(training, clips.clips)
    if isinstance(clips.clips, PairedClips):
        require_apart(training, clips.clips)
    return Training(clips=training, identity=identity_of(training))


def _nothing_yet(clips: EvaluationSet) -> TargetStatistics:
    """What stands where means will be, in their shapes."""
    frame = (clips.height, clips.width)
    majority = torch.zeros(clips.frames, *frame, dtype=torch.uint8) if clips.classes else None
    return TargetStatistics(mean=torch.zeros(clips.frames, 3, *frame), majority=majority)


def _further_cameras(clips: EvaluationSet) -> int:
    """How many cameras a scene has beside the source's; pairs have none."""
    return len(clips.dataset.cameras) - 1 if isinstance(clips, SceneSet) else 0


def _baselines(
    asked: Asked,
    clips: EvaluationSet,
    training: Training | None,
    statistics: TargetStatistics | None,
    *,
    painted: bool,
) -> tuple[Method, ...]:
    """Those that are wanted. statistics: of the training clips. Raises RecipeError as `of_baselines`."""
    told = asked.rivals
    if not told.usual:
        return ()
    settings = BaselineSettings(
        frames=clips.frames,
        height=clips.height,
        width=clips.width,
        classes=tuple(clips.classes),
        painted=painted,
        statistics=statistics,
        svd=None if told.svd is None else _resolved(told.svd),
        device=asked.tested.device,
        dtype=asked.tested.dtype,
        samples=asked.tested.sampling.samples,
        seed=asked.tested.sampling.seed,
        published=asked.protocol == "released",
        hexplane=told.hexplane,
    )
    names = _names(asked)
    if names is None and training is None and isinstance(clips, PairedSet):
        raise RecipeError(
            "baselines want training clips for their means: give --train FOLDER, name some that need none with "
            "--methods, or --no-baselines"
        )
    require_views(names or (), _further_cameras(clips))
    return of_baselines(names, settings, "nothing" if training is None else training.identity)
