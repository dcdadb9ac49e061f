"""Every baseline by name, and what it is built from."""

import difflib
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace

import torch

from gcd_model.config import SemanticClass
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.hexplane import Camera, HexPlaneSettings, SceneBounds, draw, learn
from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.predictors import (
    CopySource,
    Fixed,
    GroundHomography,
    Prediction,
    Predictor,
    SourceClip,
    TargetStatistics,
    to_pictures,
)
from gcd_train.evaluation.reprojection import (
    REPROJECT_RGBD,
    REPROJECT_SEMD,
    DepthReprojection,
    ReprojectRgbd,
    ReprojectSemd,
)
from gcd_train.evaluation.svd import VANILLA_SVD, VanillaSVD, weights_named

DEPTH_ON_MEAN = "depth_reprojection_on_mean"
"""Depth reprojection with holes as in the mean target and the majority map."""
HEXPLANE_VIEWS = (1, 2, 4, 8)
"""Numbers of input views that a HexPlane is usually given; any other number goes too."""
FROM_EXACT_CLASSES = ("copy_source", "ground_homography")
"""Baselines that are not privileged in their pictures, but make their class maps from the source's exact ones."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BaselineSettings:
    """What baselines are built from; may be sent to another process.

    frames, height, width: T, H and W of the clips. classes: of the clips, by id; empty for none. painted: the targets
    are painted in the colours of the classes, and all that counts is class maps.
    statistics: of training targets; None where there are none, and then holes are black.
    svd: the published weights, for vanilla SVD. device, dtype: see `gcd_model.load_synthesizer`. samples: draws of
    what draws. seed: of all noise. published: points are counted as released, see `SplatOptions`. hexplane: what is
    learnt of each clip.
    """

    frames: int
    height: int
    width: int
    classes: tuple[SemanticClass, ...] = ()
    painted: bool = False
    statistics: TargetStatistics | None = None
    svd: str | None = None
    device: str = "auto"
    dtype: str | None = None
    samples: int = 1
    seed: int = 0
    published: bool = False
    hexplane: HexPlaneSettings = field(default_factory=HexPlaneSettings)

    @property
    def fill(self) -> TargetStatistics:
        """What stands in holes: means over training targets, or black and no class."""
        if self.statistics is not None:
            return self.statistics
        black = torch.zeros(self.frames, 3, self.height, self.width)
        nothing = torch.full((self.frames, self.height, self.width), NO_CLASS, dtype=torch.uint8)
        return TargetStatistics(mean=black, majority=nothing if self.classes else None)


@dataclass(frozen=True, kw_only=True, slots=True)
class ClassesAlone:
    """A predictor whose pictures do not count, as the targets are class maps."""

    inner: Predictor

    @property
    def name(self) -> str:
        """See Predictor."""
        return self.inner.name

    @property
    def privileged(self) -> bool:
        """See Predictor."""
        return self.inner.privileged

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor."""
        made = self.inner.predict(clip)
        return replace(made, video=None, more=tuple(replace(each, video=None) for each in made.more))


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


def baseline_names(*, hexplane: Sequence[int] = HEXPLANE_VIEWS) -> tuple[str, ...]:
    """All there are, in the order of the tables. hexplane: numbers of views that are listed."""
    return (*_NAMES, *(f"hexplane_{views}" for views in hexplane))


def hexplane_views(name: str) -> int | None:
    """How many views the HexPlane of this name is given; None for another method."""
    found = re.fullmatch(r"hexplane_([1-9]\d*)", name)
    return None if found is None else int(found[1])


def build(name: str, settings: BaselineSettings) -> Predictor:
    """A baseline by its name.

    Raises:
        RecipeError: there is none of this name, or what it needs is not there.
        CheckpointError: vanilla SVD's weights cannot be used.
    """
    views = hexplane_views(name)
    if name not in _NAMES and not views:
        near = difflib.get_close_matches(name, baseline_names(), n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise RecipeError(f"no baseline is called {name!r}; {meant}there are {', '.join(baseline_names())}")
    if settings.painted and (views or name in _PICTURES_ALONE):
        raise RecipeError(f"{name} makes no class maps, and these targets are class maps; leave it out")
    if views:
        return HexPlane(views=views, settings=settings.hexplane, seed=settings.seed, device=settings.device)
    made = _made(name, settings)
    return ClassesAlone(inner=made) if settings.painted else made


def described(name: str, settings: BaselineSettings, trained_on: str = "nothing") -> dict[str, str]:
    """What a baseline is and works with, for the record of a run: it is the same method wherever this is the same.

    Args:
        trained_on: identity of the training clips, "nothing" without.
    Raises: CheckpointError for vanilla SVD's weights.
    """
    told, hexplane, svd = {"baseline": name}, hexplane_views(name), name == VANILLA_SVD
    told |= {"samples": str(settings.samples)} if svd else {}
    told |= {"seed": str(settings.seed)} if svd or hexplane else {}
    told |= {"means of": trained_on} if name in _OF_MEANS else {}
    told |= {"published rounding": "yes"} if settings.published and name in (REPROJECT_RGBD, REPROJECT_SEMD) else {}
    told |= {"weights": weights_named(settings.svd)} if svd and settings.svd is not None else {}
    told |= {key: str(value) for key, value in asdict(settings.hexplane).items()} if hexplane else {}
    filled = settings.statistics is not None and name != REPROJECT_SEMD
    return told | ({"holes": "of no class"} if settings.classes and name in _WITH_HOLES and not filled else {})


def usual_baselines(settings: BaselineSettings) -> tuple[str, ...]:
    """Names of those that need nothing but the clips and, for means, training targets."""
    means = () if settings.statistics is None else ("mean_target", "majority_map", DEPTH_ON_MEAN)
    always = ("copy_source", "ground_homography", "depth_reprojection", REPROJECT_RGBD, REPROJECT_SEMD)
    wanted = {*means, *always}
    if not settings.classes:
        wanted -= {"majority_map", REPROJECT_SEMD}
    if settings.painted:
        wanted -= set(_PICTURES_ALONE)
    return tuple(name for name in _NAMES if name in wanted)


def _made(name: str, settings: BaselineSettings) -> Predictor:
    """Raises RecipeError where what it needs is not there."""
    classes, trained = settings.classes, settings.statistics
    if trained is None and name in ("mean_target", "majority_map", DEPTH_ON_MEAN):
        raise RecipeError(f"{name} wants training clips for its means: give --train FOLDER, or leave it out")
    fill = settings.fill
    if name in ("majority_map", REPROJECT_SEMD) and not (classes and fill.majority is not None):
        raise RecipeError(f"{name} wants clips with class maps, got some without; leave it out")
    if name == "majority_map":
        return Fixed(name=name, prediction=Prediction(classes=fill.majority))
    if name == VANILLA_SVD:
        if settings.svd is None:
            raise RecipeError(f"{VANILLA_SVD} wants its weights: give the path of svd.safetensors")
        opened = VanillaSVD.open(settings.svd, device=settings.device, dtype=settings.dtype)
        return replace(opened, samples=settings.samples, seed=settings.seed)
    makers: dict[str, Callable[[], Predictor]] = {
        "copy_source": CopySource,
        "mean_target": lambda: Fixed(name=name, prediction=Prediction(video=fill.mean)),
        "ground_homography": lambda: GroundHomography(fill=fill),
        "depth_reprojection": lambda: DepthReprojection(fill=fill.constant, classes=len(classes)),
        DEPTH_ON_MEAN: lambda: DepthReprojection(fill=fill, classes=len(classes), name=DEPTH_ON_MEAN),
        REPROJECT_RGBD: lambda: ReprojectRgbd(published=settings.published),
        REPROJECT_SEMD: lambda: ReprojectSemd(classes=classes, published=settings.published),
    }
    return makers[name]()


_NAMES = (
    *("copy_source", "mean_target", "majority_map", "ground_homography", "depth_reprojection", DEPTH_ON_MEAN),
    *(REPROJECT_RGBD, REPROJECT_SEMD, VANILLA_SVD),
)
_OF_MEANS = ("mean_target", "majority_map", "ground_homography", "depth_reprojection", DEPTH_ON_MEAN)
_WITH_HOLES = ("ground_homography", "depth_reprojection", REPROJECT_SEMD)
_PICTURES_ALONE = ("mean_target", REPROJECT_RGBD, VANILLA_SVD)
