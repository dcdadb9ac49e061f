"""Every baseline by name, and what it is built from."""

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TypeAlias

import torch

from gcd_model.config import SemanticClass
from gcd_train.errors import RecipeError
from gcd_train.evaluation.hexplane import HexPlaneSettings
from gcd_train.evaluation.hexplane_learning import HexPlane
from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.predictors import (
    CopySource,
    GroundHomography,
    MajorityMap,
    MeanTarget,
    Prediction,
    Predictor,
    SourceClip,
    TargetStatistics,
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

_HEXPLANE = re.compile(r"hexplane_([1-9]\d*)")


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


Builder: TypeAlias = Callable[[BaselineSettings], Predictor]


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


def baseline_names(*, hexplane: Sequence[int] = HEXPLANE_VIEWS) -> tuple[str, ...]:
    """All there are, in the order of the tables. hexplane: numbers of views that are listed."""
    return (*_BUILDERS, *(f"hexplane_{views}" for views in hexplane))


def build(name: str, settings: BaselineSettings) -> Predictor:
    """A baseline by its name.

    Raises:
        RecipeError: there is none of this name, or what it needs is not there.
        CheckpointError: vanilla SVD's weights cannot be used.
    """
    views = _HEXPLANE.fullmatch(name)
    if name not in _BUILDERS and not views:
        near = difflib.get_close_matches(name, baseline_names(), n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise RecipeError(f"no baseline is called {name!r}; {meant}there are {', '.join(baseline_names())}")
    if settings.painted and (views or name in _PICTURES_ALONE):
        raise RecipeError(f"{name} makes no class maps, and these targets are class maps; leave it out")
    made = _hexplane(int(views[1]), settings) if views else _BUILDERS[name](settings)
    return ClassesAlone(inner=made) if settings.painted else made


def described(name: str, settings: BaselineSettings) -> dict[str, str]:
    """What a baseline is beyond its name and the draws, for the record of a run.

    Vanilla SVD's weights, what a HexPlane learns, and what holes in class maps count as. Raises CheckpointError.
    """
    if name == VANILLA_SVD and settings.svd is not None:
        return {"weights": weights_named(settings.svd)}
    if _HEXPLANE.fullmatch(name):
        return {key: str(value) for key, value in asdict(settings.hexplane).items()}
    filled = settings.statistics is not None and name != REPROJECT_SEMD
    return {"holes": "of no class"} if settings.classes and name in _WITH_HOLES and not filled else {}


def usual_baselines(settings: BaselineSettings) -> tuple[str, ...]:
    """Names of those that need nothing but the clips and, for means, training targets."""
    means = () if settings.statistics is None else ("mean_target", "majority_map", DEPTH_ON_MEAN)
    always = ("copy_source", "ground_homography", "depth_reprojection", REPROJECT_RGBD, REPROJECT_SEMD)
    wanted = {*means, *always}
    if not settings.classes:
        wanted -= {"majority_map", REPROJECT_SEMD}
    if settings.painted:
        wanted -= set(_PICTURES_ALONE)
    return tuple(name for name in _BUILDERS if name in wanted)


def _mean_target(settings: BaselineSettings) -> Predictor:
    return MeanTarget(statistics=_trained(settings, "mean_target"))


def _majority_map(settings: BaselineSettings) -> Predictor:
    majority = _trained(settings, "majority_map").majority
    if majority is None:
        raise RecipeError("majority_map wants clips with class maps, got some without; leave it out")
    return MajorityMap(majority=majority)


def _depth_on_mean(settings: BaselineSettings) -> Predictor:
    statistics = _trained(settings, DEPTH_ON_MEAN)
    return DepthReprojection(fill=statistics, classes=len(settings.classes), name=DEPTH_ON_MEAN)


def _reproject_semd(settings: BaselineSettings) -> Predictor:
    if not settings.classes:
        raise RecipeError(f"{REPROJECT_SEMD} wants clips with class maps, got some without; leave it out")
    return ReprojectSemd(classes=settings.classes, published=settings.published)


def _vanilla_svd(settings: BaselineSettings) -> Predictor:
    if settings.svd is None:
        raise RecipeError(f"{VANILLA_SVD} wants its weights: give the path of svd.safetensors")
    opened = VanillaSVD.open(settings.svd, device=settings.device, dtype=settings.dtype)
    return replace(opened, samples=settings.samples, seed=settings.seed)


def _hexplane(views: int, settings: BaselineSettings) -> Predictor:
    return HexPlane(views=views, settings=settings.hexplane, seed=settings.seed, device=settings.device)


def _trained(settings: BaselineSettings, name: str) -> TargetStatistics:
    if settings.statistics is None:
        raise RecipeError(f"{name} wants training clips for its means: give --train FOLDER, or leave it out")
    return settings.statistics


_BUILDERS: Mapping[str, Builder] = {
    "copy_source": lambda _: CopySource(),
    "mean_target": _mean_target,
    "majority_map": _majority_map,
    "ground_homography": lambda settings: GroundHomography(fill=settings.fill),
    "depth_reprojection": lambda s: DepthReprojection(fill=s.fill.constant, classes=len(s.classes)),
    DEPTH_ON_MEAN: _depth_on_mean,
    REPROJECT_RGBD: lambda settings: ReprojectRgbd(published=settings.published),
    REPROJECT_SEMD: _reproject_semd,
    VANILLA_SVD: _vanilla_svd,
}
_WITH_HOLES = ("ground_homography", "depth_reprojection", REPROJECT_SEMD)
_PICTURES_ALONE = ("mean_target", REPROJECT_RGBD, VANILLA_SVD)
