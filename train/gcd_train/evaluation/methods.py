"""What is measured beside baselines: weights, and the frames that other methods saved."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Self, TypeAlias

import torch
from torch import Tensor

from gcd_model import Clip, RenderOptions, Sampler, Trajectory, View, ViewSynthesizer, load_synthesizer
from gcd_model.clip import nearest_classes
from gcd_model.config import SemanticClass
from gcd_train.data.sample import to_network
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.clips import EvaluationSet, names_of
from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.predictors import CameraPair, Method, Prediction, Predictor, SavedFrames, SourceClip
from gcd_train.evaluation.store import FRAMES_IN

_SAME_PATH_M = 1e-3
"""Largest difference between the entries of two poses that count as one; more is another path."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SynthesizedViews:
    """A model with its own sampler settings, on its fixed view or on each clip's path.

    options: instead of what the weights ship with. The noise of their seed is the same for every clip, as in a live
    node. painted: classes that its colours are read by, where it paints class maps and its file does not say which.
    classes: so many the clips have, None for any; what a model sees of others, as a robot on a street, is none of them.
    """

    synthesizer: ViewSynthesizer
    options: RenderOptions = RenderOptions()  # noqa: RUF009  it is frozen
    painted: tuple[SemanticClass, ...] = ()
    classes: int | None = None
    privileged: bool = False

    @classmethod
    def of(cls, synthesizer: ViewSynthesizer, clips: EvaluationSet, options: RenderOptions | None = None) -> Self:
        """A model that is measured on these clips.

        Raises DataError where model and clips do not fit together.
        """
        _require_fit(synthesizer, clips)
        options = RenderOptions() if options is None else options
        made = cls(synthesizer=synthesizer, options=options, classes=len(clips.classes) or None)
        if not made.paints_classes or synthesizer.traits.classes:
            return made
        if not clips.classes:
            raise DataError(
                f"{synthesizer.traits.name} paints class maps but names no classes, and the clips have none either; "
                "give clips with classes"
            )
        return replace(made, painted=tuple(clips.classes))

    @property
    def name(self) -> str:
        """The weights' name, with what is not as shipped of how they are sampled."""
        told = told_of(self.options)
        return self.synthesizer.traits.name + (f" ({told})" if told else "")

    @property
    def paints_classes(self) -> bool:
        """Whether its picture is a class map in colours, which is compared as classes alone."""
        family = self.synthesizer.traits.family
        return family is not None and family.output == "semantic"

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. Raises DataError where the clip's path is not one that the model was trained on."""
        return self.shown(self.drawer(clip)(self.options))

    def drawer(self, clip: SourceClip) -> Callable[[RenderOptions], View]:
        """Draws the clip's view, encoded once, with any options. Raises DataError as `predict`."""
        synthesizer, mount = self.synthesizer, clip.cameras.mount
        live, video = synthesizer.traits.live, to_network(clip.source)
        declared = mount if live else None
        path = self._path(clip.cameras)
        lens = clip.cameras.source if live else None
        features = synthesizer.encode(Clip(video=video, fps=clip.fps, mount=declared, lens=lens))
        return lambda options: synthesizer.render(features, [path], options)[0]

    def shown(self, view: View) -> Prediction:
        """A view as it is measured, all its draws."""
        classes = [None] * len(view.samples) if view.classes is None else list(view.classes)
        first, *more = (self._draw(*each) for each in zip(view.samples, classes, strict=True))
        return replace(first, more=tuple(more))

    def _draw(self, video: Tensor, classes: Tensor | None) -> Prediction:
        if self.painted:
            return Prediction(classes=nearest_classes(video, self.painted))
        if classes is not None and self.classes is not None:
            classes = torch.where(classes < self.classes, classes, NO_CLASS)
        return Prediction(video=None if self.paints_classes else video, classes=classes)

    def _path(self, cameras: CameraPair) -> Trajectory:
        traits, asked = self.synthesizer.traits, cameras.trajectory
        if traits.live:
            return asked
        if traits.config.camera == "none":
            planned = traits.plan_view()
            same = planned.at_goal == asked.at_goal
        else:
            planned = traits.plan_view(asked.goal_delta, source=asked.source)  # with the limits of the family
            apart = (planned.source_from_target - asked.source_from_target).abs().max()
            same = float(apart) <= _SAME_PATH_M
        if not same:
            raise DataError(
                f"{traits.name} reaches its goal in frame {traits.move_time}, the clips go another way there (they "
                f"arrive in frame {asked.at_goal.index(True)}); evaluate it on clips like those of its training"
            )
        return planned


def told_of(options: RenderOptions) -> str:
    """What options say of sampling, in few words; empty where all is as shipped."""
    told = [] if options.quality == "exact" else [options.quality]
    told += [] if options.steps is None else [f"{options.steps} step{'' if options.steps == 1 else 's'}"]
    told += [] if options.solver is None else [options.solver]
    told += [] if options.guidance is None else ["guidance {:g} to {:g}".format(*options.guidance)]
    told += [] if options.guidance_interval is None else ["guided from {:g} to {:g}".format(*options.guidance_interval)]
    return ", ".join(told)


def _require_fit(synthesizer: ViewSynthesizer, clips: EvaluationSet) -> None:
    traits = synthesizer.traits
    wanted = (traits.config.frames, traits.config.height, traits.config.width)
    given = (clips.frames, clips.height, clips.width)
    if wanted != given:
        raise DataError(f"{traits.name} was trained on clips of T, H, W = {wanted}, got {given}; generate such ones")
    if not traits.live and (traits.config.camera == "none") != (clips.camera == "none"):
        raise DataError(
            f"{traits.name} has camera control {traits.config.camera!r}, the clips {clips.camera!r}; evaluate "
            "driving models on `generate driving`, others on clips of an orbit"
        )
    known = traits.classes[: len(clips.classes)] if traits.live else traits.classes  # its first ones are the streets'
    if known and clips.classes and names_of(known) != names_of(clips.classes):
        raise DataError(f"{traits.name} has classes {names_of(traits.classes)}, the clips {names_of(clips.classes)}")


OpenedWeights: TypeAlias = Callable[[], ViewSynthesizer]
"""Gives a model, opened once in each process: `partial` of `open_weights`. Raises CheckpointError."""


@lru_cache(maxsize=1)
def open_weights(path: str, device: str, dtype: str | None) -> ViewSynthesizer:
    """Weights by name or path; see `load_synthesizer`."""
    return load_synthesizer(path, device=device, dtype=dtype)


def of_weights(
    weights: OpenedWeights, clips: EvaluationSet, options: RenderOptions, steps: Sequence[int]
) -> tuple[Method, ...]:
    """The weights as they ship, then with each other number of steps.

    Args:
        options: all but the steps. steps: the shipped number is passed over.
    Raises:
        DataError: the weights do not fit the clips. CheckpointError: they cannot be opened.
    """
    shipped = weights().traits.config.sampling.steps
    others = [number for number in dict.fromkeys(steps) if number != shipped]
    return tuple(_of_weights(weights, clips, replace(options, steps=number)) for number in (None, *others))


def of_saved_frames(
    named: Sequence[str], painted: Sequence[SemanticClass], *, privileged: Sequence[str] = ()
) -> tuple[Method, ...]:
    """Methods whose frames lie in folders.

    Args:
        named: `NAME=FOLDER` each. painted: the classes in whose colours they are; empty for photographs. privileged:
            names of those that were given more than the source video.
    Raises:
        RecipeError: one has no name or no folder, or a privileged one is none of them. DataError: there is no such
            folder.
    """
    methods = tuple(_of_saved_frames(each, tuple(painted), privileged) for each in named)
    names = [method.name for method in methods]
    unknown = [name for name in privileged if name not in names]
    if unknown:
        raise RecipeError(
            f"--privileged wants the name of a method of --predictions, got {unknown[0]!r}; "
            f"there are {', '.join(names) or 'none'}"
        )
    return methods


def _of_weights(weights: OpenedWeights, clips: EvaluationSet, options: RenderOptions) -> Method:
    made = SynthesizedViews.of(weights(), clips, options)
    traits = made.synthesizer.traits
    used = Sampler.of(traits.config.sampling, options)
    told = {
        "weights": traits.sha256_12,
        "family": "unknown" if traits.family is None else traits.family.name,
        "steps": str(used.steps),
        "solver": used.solver,
        "guidance": "{:g} to {:g}".format(*used.guidance),
        "samples": str(options.samples),
        "seed": str(options.seed),
        "precision": traits.precision,
    }
    if used.guidance_interval is not None:
        told["guided from"] = "{:g} to {:g}".format(*used.guidance_interval)
    return Method(name=made.name, make=partial(_synthesized, weights, options, made.painted, made.classes), told=told)


def _synthesized(
    weights: OpenedWeights, options: RenderOptions, painted: tuple[SemanticClass, ...], classes: int | None
) -> Predictor:
    return SynthesizedViews(synthesizer=weights(), options=options, painted=painted, classes=classes)


def _of_saved_frames(named: str, painted: tuple[SemanticClass, ...], privileged: Sequence[str]) -> Method:
    name, separator, folder = named.partition("=")
    if not (name and separator and folder):
        raise RecipeError(f"frames of another method are given as NAME=FOLDER, got {named!r}")
    place = Path(folder).resolve()
    SavedFrames.open(name, place)  # to refuse at once
    more = name in privileged
    told = {FRAMES_IN: str(place), "digest": _listing(place)} | ({"privileged": "yes"} if more else {})
    return Method(name=name, make=partial(SavedFrames.open, name, place, painted=painted, privileged=more), told=told)


def _listing(folder: Path) -> str:
    """Digest of the names and contents of all files below: frames that are made anew are another method."""
    digest = hashlib.sha256()
    try:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                with path.open("rb") as file:
                    content = hashlib.file_digest(file, "sha256").hexdigest()
                digest.update(f"{path.relative_to(folder)} {content}\n".encode())
    except OSError as error:
        raise DataError(f"{folder} cannot be read ({error}); give NAME=FOLDER") from error
    return digest.hexdigest()[:12]
