"""Every baseline by name, and what it is built from."""

import difflib
import hashlib
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model import (
    Augmentation,
    Clip,
    RenderOptions,
    SourceFeatures,
    ViewSynthesizer,
    inspect_weights,
    load_synthesizer,
    weights_path,
)
from gcd_model.diffusion import unit_noise
from gcd_model.geometry import pose_trajectory
from gcd_train.data.sample import to_network
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.clips import EvaluationSet
from gcd_train.evaluation.hexplane import Camera, HexPlaneSettings, SceneBounds, draw, learn
from gcd_train.evaluation.predictors import CopySource, Maker, Method, Prediction, SourceClip, to_pictures
from gcd_train.evaluation.reprojection import (
    REPROJECT_RGBD,
    REPROJECT_SEMD,
    GroundHomography,
    ReprojectRgbd,
    ReprojectSemd,
)

VANILLA_SVD = "vanilla_svd"
"""Stable Video Diffusion."""
MOTION_BUCKET = 127.0
"""What Stable Video Diffusion is told of the motion: the middle of its range."""
FROM_EXACT_CLASSES = ("copy_source", "ground_homography")
"""Baselines that are not privileged in their pictures, but make their class maps from the source's exact ones."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BaselineSettings:
    """What baselines are built from.

    svd: the published weights, for vanilla SVD. device, dtype: see `gcd_model.load_synthesizer`. samples: draws of
    what draws. seed: of all noise. published: points are counted as released, see `SplatOptions`. hexplane: what is
    learnt of each clip.
    """

    svd: str | None = None
    device: str = "auto"
    dtype: str | None = None
    samples: int = 1
    seed: int = 0
    published: bool = False
    hexplane: HexPlaneSettings = HexPlaneSettings()  # noqa: RUF009  it is frozen


@dataclass(frozen=True, kw_only=True, slots=True)
class HexPlane:
    """HexPlane with so many input views: the source clip, and further cameras of the scene from two on.

    views: K. settings: what is learnt of each clip, and how long. seed, device: of the learning, see `learn`.
    With two views or more it is given more than the others, so `privileged`. It makes no class maps.
    Source: Cao and Johnson 2023 (HexPlane); as a baseline, Van Hoorick et al. 2024 (GCD), section 5.
    """

    views: int = 1
    settings: HexPlaneSettings = HexPlaneSettings()  # noqa: RUF009  it is frozen
    seed: int = 0
    device: str = "auto"

    @property
    def name(self) -> str:
        """`hexplane_K`."""
        return f"hexplane_{self.views}"

    @property
    def privileged(self) -> bool:
        """True from two views on."""
        return self.views > 1

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. Raises DataError where the clip's scene has fewer cameras."""
        if self.views > 1 and clip.others is None:
            raise DataError(
                f"{self.name} wants {self.views} cameras of a scene, but clip {clip.key or 'without a key'} has one; "
                "give a 4D data set, or ask for hexplane_1"
            )
        own, frames = clip.cameras, len(clip.source)
        times = [2.0 * number / max(frames - 1, 1) - 1.0 for number in range(frames)]
        pictures = [
            (colours, Camera(lens=own.source, world_from_camera=own.ground_from_source, time=time))
            for colours, time in zip(to_pictures(clip.source), times, strict=True)
        ]
        for video in clip.others(self.views - 1) if clip.others is not None and self.views > 1 else ():
            pictures += [
                (
                    to_pictures(view.rgb[None])[0],
                    Camera(lens=view.lens, world_from_camera=torch.from_numpy(view.world_from_camera), time=time),
                )
                for view, time in zip(video, times, strict=True)
            ]
        wanted = own.ground_from_source @ own.source_from_target  # [T, 4, 4]
        known = torch.stack([camera.world_from_camera for _, camera in pictures])
        bounds = SceneBounds.around(torch.cat([known, wanted]))
        field = learn(pictures, bounds, self.settings, frames=frames, seed=self.seed, device=self.device)
        drawn = [
            draw(field, Camera(lens=own.target, world_from_camera=pose, time=time), self.settings)
            for pose, time in zip(wanted, times, strict=True)
        ]
        return Prediction(video=torch.stack(drawn))


@dataclass(frozen=True, kw_only=True, slots=True)
class VanillaSVD:
    """A video out of the first frame, for each draw from noise of its own.

    The frame is stretched to the size the network was trained at, and what comes out is stretched back: nothing is
    cropped, so that all of the target is measured.

    synthesizer: without camera control. size: height and width it works at, None for the weights' own (576 x 1024 of
        the published). steps: None as the weights say. samples: draws of each clip. seed: all noise comes from it and
        the clip's key.
    Source: Blattmann et al. 2023 (SVD); Van Hoorick et al. 2024 (GCD), section 5, "Vanilla SVD". Stretching is ours.
    """

    synthesizer: ViewSynthesizer
    size: tuple[int, int] | None = None
    steps: int | None = None
    samples: int = 1
    seed: int = 0
    name: str = VANILLA_SVD
    privileged: bool = False

    @classmethod
    def open(cls, weights: str | Path, settings: BaselineSettings | None = None) -> Self:
        """The published file `svd.safetensors`, its diffusers folder, or our own weights of the same task.

        Args:
            weights: see `gcd_model.load_synthesizer`; a published file is taken to be SVD, whatever it is called.
        Raises:
            CheckpointError: the file is missing, damaged or of another architecture.
            DataError: it is steered: that is another task.
        """
        settings = settings or BaselineSettings()
        of_ours = isinstance(weights, str) and weights.startswith(("package:", "random:"))
        family = None if of_ours or inspect_weights(weights).family else "svd"
        opened = load_synthesizer(weights, family=family, device=settings.device, dtype=settings.dtype)
        return cls(synthesizer=opened, samples=settings.samples, seed=settings.seed)

    def __post_init__(self) -> None:
        traits = self.synthesizer.traits
        if traits.config.camera != "none":
            raise DataError(
                f"{self.name} wants weights that make a video out of a picture, {traits.name} is told a camera path; "
                "give svd.safetensors"
            )

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. No class map. Raises DataError for a clip that is longer than what the network makes."""
        traits, frames = self.synthesizer.traits, len(clip.source)
        if frames > traits.config.frames:
            raise DataError(
                f"{traits.name} makes {traits.config.frames} frames, {clip.key or 'a clip'} has {frames}; evaluate on "
                "shorter clips"
            )
        height, width = clip.cameras.target.height, clip.cameras.target.width
        features = self._features(clip)
        draws = [
            Prediction(video=_stretched(self._draw(features, clip.key, number), height, width)[:frames])
            for number in range(self.samples)
        ]
        return replace(draws[0], more=tuple(draws[1:]))

    def _features(self, clip: SourceClip) -> SourceFeatures:
        """Of the first frame, encoded once, for all frames."""
        config = self.synthesizer.traits.config
        height, width = self.size or (config.height, config.width)
        first = _stretched(to_network(clip.source[:1]), height, width, low=-1.0)
        noise = Augmentation(noise=unit_noise(tuple(first.shape), self._seed(clip.key)))
        told = self.synthesizer.encode(Clip(video=first, fps=clip.fps), noise)
        tokens = None if told.tokens is None else told.tokens.repeat(config.frames, 1)
        return replace(told, tokens=tokens, latents=told.latents.repeat(config.frames, 1, 1, 1))

    def _draw(self, features: SourceFeatures, key: str, number: int) -> Tensor:
        """One video, [T, 3, H, W] in [0, 1]: draws go one by one, as full size leaves no room for two."""
        still = torch.eye(4, dtype=torch.float64).repeat(features.frames, 1, 1)
        seed = self._seed(f"{key}#{number}")
        options = RenderOptions(steps=self.steps, seed=seed, motion_bucket=MOTION_BUCKET)
        (view,) = self.synthesizer.render(features, [pose_trajectory(still)], options)
        return view.video

    def _seed(self, name: str) -> int:
        return int.from_bytes(hashlib.sha256(f"{self.seed}:{name}".encode()).digest()[:6])


def _stretched(pictures: Tensor, height: int, width: int, *, low: float = 0.0) -> Tensor:
    """[T, 3, ...] at another size, within low..1."""
    if pictures.shape[-2:] == (height, width):
        return pictures
    resized = F.interpolate(pictures, size=(height, width), mode="bicubic", align_corners=False, antialias=True)
    return resized.clamp(low, 1.0)


def hexplane_views(name: str) -> int | None:
    """How many views the HexPlane of this name is given; None for another method."""
    found = re.fullmatch(r"hexplane_([1-9]\d*)", name)
    return None if found is None else int(found[1])


def baselines(names: Sequence[str] | None, clips: EvaluationSet, settings: BaselineSettings) -> tuple[Method, ...]:
    """Baselines by name; those that need nothing but the clips where none are named.

    Raises:
        RecipeError: there is none of a name, or it lacks what it needs.
        CheckpointError: vanilla SVD's weights cannot be opened.
    """
    if names is None:
        left_out = {REPROJECT_RGBD} if clips.painted else set[str]() if clips.classes else {REPROJECT_SEMD}
        names = [name for name in _USUAL if name not in left_out]
    return tuple(_baseline(name, clips, settings) for name in names)


def _baseline(name: str, clips: EvaluationSet, settings: BaselineSettings) -> Method:
    views = hexplane_views(name)
    if clips.painted and (views or name in (REPROJECT_RGBD, VANILLA_SVD)):
        raise RecipeError(f"{name} makes no class maps, and these targets are class maps; leave it out")
    if views:
        return _hexplane(name, views, clips.cameras, settings)
    if name == VANILLA_SVD:
        return _vanilla_svd(settings)
    if name == REPROJECT_SEMD and not clips.classes:
        raise RecipeError(f"{name} wants clips with class maps, got some without; leave it out")
    makers: dict[str, Maker] = {
        "copy_source": CopySource,
        "ground_homography": GroundHomography,
        REPROJECT_RGBD: partial(ReprojectRgbd, published=settings.published),
        REPROJECT_SEMD: partial(ReprojectSemd, classes=clips.classes, published=settings.published),
    }
    if name not in makers:
        every = (*makers, VANILLA_SVD, *(f"hexplane_{views}" for views in (1, 2, 4, 8)))  # any other number goes too
        near = difflib.get_close_matches(name, every, n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise RecipeError(f"no baseline is called {name!r}; {meant}there are {', '.join(every)}")
    rounded = settings.published and name in (REPROJECT_RGBD, REPROJECT_SEMD)
    told = {"baseline": name} | ({"published rounding": "yes"} if rounded else {})
    return Method(name=name, make=makers[name], told=told)


def _hexplane(name: str, views: int, cameras: int, settings: BaselineSettings) -> Method:
    if views > cameras:
        there = f"{cameras - 1} beside the source" if cameras > 1 else "the source alone"
        raise RecipeError(
            f"{name} wants {views} cameras, and these clips have {there}; give hexplane_{cameras} or less"
        )
    learnt = {key: str(value) for key, value in asdict(settings.hexplane).items()}
    make = partial(HexPlane, views=views, settings=settings.hexplane, seed=settings.seed, device=settings.device)
    return Method(name=name, make=make, told={"baseline": name, "seed": str(settings.seed), **learnt})


def _vanilla_svd(settings: BaselineSettings) -> Method:
    """Its weights are opened where they are used; what they are is asked here."""
    if settings.svd is None:
        raise RecipeError(f"{VANILLA_SVD} wants its weights: give the path of svd.safetensors")
    kind, _, name = settings.svd.partition(":")
    if kind == "random":
        family, weights = name, settings.svd
    else:
        inspected = inspect_weights(weights_path(settings.svd))
        family, weights = inspected.family or "svd", inspected.digest[:12]
    if family != "svd":
        raise RecipeError(
            f"{VANILLA_SVD} wants weights that make a video out of a picture, {settings.svd} is of the family "
            f"{family}; give svd.safetensors"
        )
    told = {"baseline": VANILLA_SVD, "samples": str(settings.samples), "seed": str(settings.seed), "weights": weights}
    return Method(name=VANILLA_SVD, make=partial(VanillaSVD.open, settings.svd, settings), told=told)


_USUAL = ("copy_source", "ground_homography", REPROJECT_RGBD, REPROJECT_SEMD)
