"""Methods that run weights: a model that makes views, and video out of the first frame alone."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Self

import torch
from torch import Tensor

from gcd_model import Augmentation, Clip, RenderOptions, SourceFeatures, Trajectory, View, ViewSynthesizer
from gcd_model.clip import nearest_classes
from gcd_model.config import SemanticClass
from gcd_model.diffusion import Sampler, unit_noise
from gcd_model.geometry import pose_trajectory
from gcd_train.data.sample import to_network
from gcd_train.errors import DataError
from gcd_train.evaluation.anyview import EpisodeSet
from gcd_train.evaluation.clips import EvaluationSet, names_of
from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.predictors import (
    CameraPair,
    OpenedWeights,
    Prediction,
    SourceClip,
    fitted,
    middle,
    require_one_lens,
    resized,
    through_lens,
)
from gcd_train.evaluation.tables import counted

VANILLA_SVD = "vanilla_svd"
MOTION_BUCKET = 127.0
"""What Stable Video Diffusion is told of the motion: the middle of its range."""

_AS_SHIPPED = RenderOptions()
_SAME_PATH_M = 1e-3
"""Largest difference between the entries of two poses that count as one; more is another path."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SynthesizedViews:
    """A model with its own sampler settings, on its fixed view or on each clip's path.

    weights: give the model. options: instead of what it ships with. The noise of their seed is the same for every clip,
    as in a live node. painted: classes that its colours are read by, where it paints class maps and its file does not
    say which. classes: so many the clips have, None for any; what a model sees of others, as a robot on a street, is
    none of them. stretched: clips are brought to the size of the model, and its pictures to the size and the lens of
    the target; what the source's lens does not show stays black.
    """

    weights: OpenedWeights
    options: RenderOptions = _AS_SHIPPED
    painted: tuple[SemanticClass, ...] = ()
    classes: int | None = None
    stretched: bool = False
    privileged: bool = False

    @classmethod
    def of(cls, weights: OpenedWeights, clips: EvaluationSet, options: RenderOptions = _AS_SHIPPED) -> Self:
        """A model that is measured on these clips. Raises DataError where they do not fit together."""
        _require_fit(weights(), clips)
        free, traits, count = isinstance(clips, EpisodeSet), weights().traits, len(clips.classes) or None
        privileged = traits.splat == "given"
        made = cls(weights=weights, options=options, classes=count, stretched=free, privileged=privileged)
        if not made.paints_classes or traits.classes:
            return made
        if not clips.classes:
            raise DataError(
                f"{traits.name} paints class maps but names no classes, and the clips have none either; give clips "
                "with classes"
            )
        return replace(made, painted=clips.classes)

    @property
    def name(self) -> str:
        """The weights' name, with what is not as shipped of how they are sampled."""
        options = self.options
        told = [] if options.steps is None else [counted(options.steps, "step")]
        told += [] if options.solver is None else [options.solver]
        told += [] if options.guidance is None else ["guidance {:g} to {:g}".format(*options.guidance)]
        return self.weights().traits.name + (f" ({', '.join(told)})" if told else "")

    @property
    def details(self) -> dict[str, str]:
        traits, options = self.weights().traits, self.options
        used = Sampler.of(traits.config.sampling, options)
        return {
            "weights": traits.sha256_12,
            "family": "unknown" if traits.family is None else traits.family.name,
            "steps": str(used.steps),
            "solver": used.solver,
            "guidance": "{:g} to {:g}".format(*used.guidance),
            "samples": str(options.samples),
            "seed": str(options.seed),
            "precision": traits.precision,
            **({} if traits.splat == "none" else {"splat": f"{traits.splat} depth"}),
        }

    @property
    def paints_classes(self) -> bool:
        """Whether its picture is a class map in colours, which is compared as classes alone."""
        family = self.weights().traits.family
        return family is not None and family.output == "semantic"

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. Raises DataError where the clip's path is not one that the model was trained on."""
        view = self.drawer(clip)(self.options)
        if not self.stretched:
            return self.shown(view)
        source, target = clip.cameras.source, clip.cameras.target
        own = source.resized(view.samples.shape[-1], view.samples.shape[-2])
        first, *more = (Prediction(video=through_lens(each, own, target)) for each in view.samples)
        return replace(first, more=tuple(more))

    def drawer(self, clip: SourceClip) -> Callable[[RenderOptions], View]:
        """Draws the clip's view, encoded once, with any options. Raises DataError as `predict`."""
        synthesizer, cameras = self.weights(), clip.cameras
        path, config = self._path(cameras), synthesizer.traits.config
        video, lens, odometry = to_network(clip.source), cameras.source, None
        if self.stretched:
            require_one_lens(clip, self.name)
            video, lens = (
                resized(video, config.height, config.width, low=-1.0),
                lens.resized(config.width, config.height),
            )
            odometry = cameras.ground_from_source
        own = Clip(video=video, fps=clip.fps)
        if synthesizer.traits.live:
            own = replace(own, mount=cameras.mount, lens=lens, odometry=odometry)
        elif synthesizer.traits.splat != "none":
            own = replace(own, lens=cameras.source)
        if self.privileged:
            own = replace(own, depth=torch.from_numpy(clip.source_depth))
        features = synthesizer.encode(own)
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
        traits, asked = self.weights().traits, cameras.trajectory
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


def _require_fit(synthesizer: ViewSynthesizer, clips: EvaluationSet) -> None:
    traits = synthesizer.traits
    if isinstance(clips, EpisodeSet):  # opened for this model, whatever its size
        return
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


@dataclass(frozen=True, kw_only=True, slots=True)
class VanillaSVD:
    """A video out of the first frame, for each draw from noise of its own.

    The middle of the frame, of the shape the network was trained at, is resized to that size, as in the paper. What
    comes out is resized to the same part of the target and measured there, in the target's own pixels; the paper
    resized its targets to 576 x 1024 instead.

    weights: without camera control. size: height and width it works at, None for the weights' own (576 x 1024 of
        the published). steps: None as the weights say. samples: draws of each clip. seed: all noise comes from it and
        the clip's key, or, `shared_noise`, from it alone. details: see Predictor.
    Source: Blattmann et al. 2023 (SVD); Van Hoorick et al. 2024 (GCD), section 5, "Vanilla SVD".
    """

    weights: OpenedWeights
    size: tuple[int, int] | None = None
    steps: int | None = None
    samples: int = 1
    seed: int = 0
    shared_noise: bool = False
    name: str = VANILLA_SVD
    privileged: bool = False
    details: dict[str, str] = field(default_factory=dict[str, str])

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. No class map. Raises DataError for a clip that is longer than what the network makes."""
        traits, frames = self.weights().traits, len(clip.source)
        if frames > traits.config.frames:
            raise DataError(
                f"{traits.name} makes {traits.config.frames} frames, {clip.key or 'a clip'} has {frames}; evaluate on "
                "shorter clips (--frames 13 on AnyViewBench)"
            )
        height, width = self.size or (traits.config.height, traits.config.width)
        key = "" if self.shared_noise else clip.key
        features, lens = self._features(clip, key, height, width), clip.cameras.target
        crop = middle(lens, width / height)
        size = (lens.height, lens.width) if crop is None else (crop[3], crop[2])
        draws = [
            Prediction(video=resized(self._draw(features, key, number), *size)[:frames], crop=crop)
            for number in range(self.samples)
        ]
        return replace(draws[0], more=tuple(draws[1:]))

    def _features(self, clip: SourceClip, key: str, height: int, width: int) -> SourceFeatures:
        """Of the first frame at this size, encoded once, for all frames."""
        config = self.weights().traits.config
        first = fitted(to_network(clip.source[:1]), height, width)
        noise = Augmentation(noise=unit_noise(tuple(first.shape), self._seed(key)))
        made = self.weights().encode(Clip(video=first, fps=clip.fps), noise)
        tokens = None if made.tokens is None else made.tokens.repeat(config.frames, 1)
        return replace(made, tokens=tokens, latents=made.latents.repeat(config.frames, 1, 1, 1))

    def _draw(self, features: SourceFeatures, key: str, number: int) -> Tensor:
        """One video, [T, 3, H, W] in [0, 1]: draws go one by one, as full size leaves no room for two."""
        still = torch.eye(4, dtype=torch.float64).repeat(features.frames, 1, 1)
        seed = self._seed(f"{key}#{number}")
        options = RenderOptions(steps=self.steps, seed=seed, motion_bucket=MOTION_BUCKET)
        (view,) = self.weights().render(features, [pose_trajectory(still)], options)
        return view.video

    def _seed(self, name: str) -> int:
        return int.from_bytes(hashlib.sha256(f"{self.seed}:{name}".encode()).digest()[:6])
