"""A model as it is shipped, as one of the methods that are measured."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

from torch import Tensor

from gcd_model import Clip, RenderOptions, Trajectory, ViewSynthesizer
from gcd_model.class_head import nearest_classes
from gcd_model.config import CameraControl, SemanticClass
from gcd_model.geometry import CameraMount
from gcd_train.baselines import CameraPair, Prediction, SourceClip
from gcd_train.datasets.clip_source import to_network
from gcd_train.errors import DataError
from gcd_train.evaluation.held_out import names_of

_SAME_PATH_M = 1e-3
"""Largest difference between the entries of two poses that count as one; more is another path."""


class ClipFacts(Protocol):
    """What a model has to fit: of an `EvaluationSet`, or of pairs."""

    @property
    def frames(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def width(self) -> int: ...
    @property
    def camera(self) -> CameraControl: ...
    @property
    def classes(self) -> Sequence[SemanticClass]: ...


@dataclass(frozen=True, kw_only=True, slots=True)
class SynthesizedViews:
    """A model with its own sampler settings, on its fixed view or on each clip's path.

    steps, guidance (of the first and the last frame): instead of those the weights ship with. samples: draws of each
    view. seed: of their noise, the same for every clip, as in a live node. painted: classes that its colours are read
    by, where it paints class maps and its file does not say which.
    """

    synthesizer: ViewSynthesizer
    steps: int | None = None
    guidance: tuple[float, float] | None = None
    samples: int = 1
    seed: int = 0
    painted: tuple[SemanticClass, ...] = ()
    privileged: bool = False

    @classmethod
    def of(cls, synthesizer: ViewSynthesizer, clips: ClipFacts, options: RenderOptions | None = None) -> Self:
        """A model that is measured on these clips.

        options: steps, guidance, samples and seed count. Raises DataError where model and clips do not fit together.
        """
        _require_fit(synthesizer, clips)
        options = RenderOptions() if options is None else options
        made = cls(
            synthesizer=synthesizer,
            steps=options.steps,
            guidance=options.guidance,
            samples=options.samples,
            seed=options.seed,
        )
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
        """The weights' name, with the steps and the guidance if they are not the shipped ones."""
        told = [] if self.steps is None else [f"{self.steps} step{'' if self.steps == 1 else 's'}"]
        told += [] if self.guidance is None else [f"guidance {self.guidance[0]:g} to {self.guidance[1]:g}"]
        return self.synthesizer.traits.name + (f" ({', '.join(told)})" if told else "")

    @property
    def paints_classes(self) -> bool:
        """Whether its picture is a class map in colours, which is compared as classes alone."""
        family = self.synthesizer.traits.family
        return family is not None and family.output == "semantic"

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. Raises DataError where the clip's path is not one that the model was trained on."""
        traits = self.synthesizer.traits
        mount = clip.cameras.mount
        declared = None if mount == (traits.mount or CameraMount()) else mount
        features = self.synthesizer.encode(Clip(video=to_network(clip.source), fps=clip.fps, mount=declared))
        (view,) = self.synthesizer.render(features, [self._path(clip.cameras, declared)], self._options())
        classes = [None] * self.samples if view.classes is None else list(view.classes)
        first, *more = (self._draw(*each) for each in zip(view.samples, classes, strict=True))
        return replace(first, more=tuple(more))

    def _draw(self, video: Tensor, classes: Tensor | None) -> Prediction:
        if self.painted:
            return Prediction(classes=nearest_classes(video, self.painted))
        return Prediction(video=None if self.paints_classes else video, classes=classes)

    def _options(self) -> RenderOptions:
        return RenderOptions(steps=self.steps, guidance=self.guidance, samples=self.samples, seed=self.seed)

    def _path(self, cameras: CameraPair, declared: CameraMount | None) -> Trajectory:
        traits, asked = self.synthesizer.traits, cameras.trajectory
        if traits.config.camera == "none":
            planned = traits.plan_view(mount=declared)
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


def _require_fit(synthesizer: ViewSynthesizer, clips: ClipFacts) -> None:
    traits = synthesizer.traits
    wanted = (traits.config.frames, traits.config.height, traits.config.width)
    given = (clips.frames, clips.height, clips.width)
    if wanted != given:
        raise DataError(f"{traits.name} was trained on clips of T, H, W = {wanted}, got {given}; generate such ones")
    if (traits.config.camera == "none") != (clips.camera == "none"):
        raise DataError(
            f"{traits.name} has camera control {traits.config.camera!r}, the clips {clips.camera!r}; evaluate "
            "driving models on `generate driving`, others on clips of an orbit"
        )
    if traits.classes and clips.classes and names_of(traits.classes) != names_of(clips.classes):
        raise DataError(f"{traits.name} has classes {names_of(traits.classes)}, the clips {names_of(clips.classes)}")
