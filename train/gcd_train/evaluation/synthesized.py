"""A model as it is shipped, as one of the predictors that are measured."""

from dataclasses import dataclass
from typing import Self

from gcd_model import Clip, RenderOptions, Trajectory, ViewSynthesizer
from gcd_model.geometry import CameraMount
from gcd_train.baselines import CameraPair, Prediction, SourceClip
from gcd_train.datasets.clip_source import to_network
from gcd_train.errors import DataError
from gcd_train.evaluation.held_out import HeldOutClips, names_of

_SAME_PATH_M = 1e-3
"""Largest difference between the entries of two poses that count as one; more is another path."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SynthesizedViews:
    """A model with its own sampler settings, on its fixed view or on each clip's path.

    steps: of the sampler, instead of the shipped number.
    """

    synthesizer: ViewSynthesizer
    steps: int | None = None
    privileged: bool = False

    @classmethod
    def of(cls, synthesizer: ViewSynthesizer, clips: HeldOutClips, steps: int | None = None) -> Self:
        """A model that is measured on these clips. Raises DataError where the two do not fit together."""
        traits = synthesizer.traits
        wanted = (traits.config.frames, traits.config.height, traits.config.width)
        given = (clips.frames, clips.height, clips.width)
        if wanted != given:
            raise DataError(
                f"{traits.name} was trained on clips of T, H, W = {wanted}, got {given}; generate such ones"
            )
        if (traits.config.camera == "none") != (clips.camera == "none"):
            raise DataError(
                f"{traits.name} has camera control {traits.config.camera!r}, the clips {clips.camera!r}; evaluate "
                "driving models on `generate driving`, others on clips of an orbit"
            )
        if traits.classes and names_of(traits.classes) != names_of(clips.classes):
            raise DataError(
                f"{traits.name} has classes {names_of(traits.classes)}, the clips {names_of(clips.classes)}"
            )
        made = cls(synthesizer=synthesizer, steps=steps)
        if made.paints_classes and not traits.classes:
            raise DataError(f"{traits.name} paints class maps but names no classes; its file must say which colours")
        return made

    @property
    def name(self) -> str:
        """The weights' name, with the steps if they are not the shipped ones."""
        name = self.synthesizer.traits.name
        return name if self.steps is None else f"{name} ({self.steps} step{'' if self.steps == 1 else 's'})"

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
        options = None if self.steps is None else RenderOptions(steps=self.steps)
        features = self.synthesizer.encode(Clip(video=to_network(clip.source), fps=clip.fps, mount=declared))
        (view,) = self.synthesizer.render(features, [self._path(clip.cameras, declared)], options)
        return Prediction(
            video=None if self.paints_classes else view.video,
            classes=None if view.classes is None else view.classes[0],
        )

    def _path(self, cameras: CameraPair, declared: CameraMount | None) -> Trajectory:
        traits, asked = self.synthesizer.traits, cameras.trajectory
        if traits.config.camera == "none":
            return traits.plan_view(mount=declared)
        planned = traits.plan_view(asked.goal_delta, source=asked.source)  # with the limits of the family
        apart = float((planned.source_from_target - asked.source_from_target).abs().max())
        if apart > _SAME_PATH_M:
            raise DataError(
                f"{traits.name} reaches its goal in frame {traits.move_time}, the clips go another way there (poses "
                f"differ by up to {apart:.3g}); evaluate it on clips like those of its training"
            )
        return planned
