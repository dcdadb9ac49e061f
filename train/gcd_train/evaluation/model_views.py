"""Weights as they ship, as one of the methods that are measured."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

from torch import Tensor

from gcd_model import Clip, RenderOptions, Trajectory, View, ViewSynthesizer
from gcd_model.colours import nearest_classes
from gcd_model.config import SemanticClass
from gcd_train.datasets.clip_source import to_network
from gcd_train.errors import DataError
from gcd_train.evaluation.clips import ClipFacts, names_of
from gcd_train.evaluation.predictors import CameraPair, Prediction, SourceClip

_SAME_PATH_M = 1e-3
"""Largest difference between the entries of two poses that count as one; more is another path."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SynthesizedViews:
    """A model with its own sampler settings, on its fixed view or on each clip's path.

    options: instead of what the weights ship with. The noise of their seed is the same for every clip, as in a live
    node. painted: classes that its colours are read by, where it paints class maps and its file does not say which.
    """

    synthesizer: ViewSynthesizer
    options: RenderOptions = RenderOptions()  # noqa: RUF009  it is frozen
    painted: tuple[SemanticClass, ...] = ()
    privileged: bool = False

    @classmethod
    def of(cls, synthesizer: ViewSynthesizer, clips: ClipFacts, options: RenderOptions | None = None) -> Self:
        """A model that is measured on these clips.

        Raises DataError where model and clips do not fit together.
        """
        _require_fit(synthesizer, clips)
        made = cls(synthesizer=synthesizer, options=RenderOptions() if options is None else options)
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


def _require_fit(synthesizer: ViewSynthesizer, clips: ClipFacts) -> None:
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
