"""The paper's own baselines: the points of the source camera alone, drawn by the published renderer.

Privileged, as both are given the exact depth; the semantic one is given the exact classes of the source too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gcd_model.colours import nearest_classes, palette
from gcd_model.config import SemanticClass
from gcd_train.baselines.predictor import Prediction, SourceClip
from gcd_train.datasets.clip_source import Bytes
from gcd_train.errors import DataError
from gcd_train.metrics import NO_CLASS
from gcd_train.pointcloud import SplatOptions, published_tensor
from gcd_train.scene_view import SceneView

REPROJECT_RGBD = "reproject_rgbd"
REPROJECT_SEMD = "reproject_semd"

_KERNEL, _SIGMA = 3, 0.75
_WHITE = 255
_HOLE = 0.5  # share of a pixel below which it counts as a hole
_SKY_M = 1e4  # what a source depth of 0 stands for; where points are so far apart, how far does not show


@dataclass(frozen=True, kw_only=True, slots=True)
class ReprojectRgbd:
    """The source's colours where its depth puts them; black where no point falls within a pixel.

    published: pixels are counted as released, see `SplatOptions`.
    Source: Van Hoorick et al. 2024 (GCD), section 5, "Reproject RGB-D"; the renderer as released.
    """

    published: bool = False
    name: str = REPROJECT_RGBD
    privileged: bool = True

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. No class map. Raises DataError where colour, depth and lens are of different sizes."""
        return Prediction(video=_drawn(clip, source_views(clip), None, self.published))


@dataclass(frozen=True, kw_only=True, slots=True)
class ReprojectSemd:
    """The source's class map in colours, drawn where its depth puts them, and read back: the nearest colour's class.

    A pixel of which points cover less than half is a hole, and of no class: wrong, whatever the target shows. Colours
    are read as if points covered the whole pixel, so that edges of holes are not darker than what is there.

    classes: by id. published: see `ReprojectRgbd`.
    Source: Van Hoorick et al. 2024 (GCD), section 5, "Reproject Sem-D". How colours are read back, and what holes count
    as, is not published.
    """

    classes: tuple[SemanticClass, ...]
    published: bool = False
    name: str = REPROJECT_SEMD
    privileged: bool = True

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. A class map alone. Raises DataError for a clip without classes."""
        views = source_views(clip)
        colours = palette(self.classes).numpy()
        painted = [_with_cover(colours[_ids(view, len(self.classes), clip.key)]) for view in views]
        drawn = _drawn(clip, views, painted, self.published)
        cover = drawn[:, 3:4]
        read = nearest_classes(drawn[:, :3] / cover.clamp(min=_HOLE), self.classes)
        return Prediction(classes=torch.where(cover[:, 0] < _HOLE, NO_CLASS, read))


def source_views(clip: SourceClip) -> Sequence[SceneView]:
    """The T views of the source camera: as the data set holds them where the clip tells, else as the clip shows them.

    The clip's own stand in the axes of the source camera, with its declared lens.
    """
    if clip.points is not None:
        return clip.points()
    depth = np.where(clip.source_depth > 0, clip.source_depth, np.float32(_SKY_M))
    classes = [None] * len(depth) if clip.source_classes is None else clip.source_classes
    return [
        SceneView(
            rgb=clip.source[t],
            depth=depth[t],
            classes=classes[t],
            instances=None,
            world_from_camera=np.eye(4),
            lens=clip.cameras.source,
        )
        for t in range(len(depth))
    ]


def _drawn(clip: SourceClip, views: Sequence[SceneView], values: Sequence[Bytes] | None, published: bool) -> Tensor:
    """What the target camera sees of them, float32 [T, C, H, W] in [0, 1].

    values: uint8 [H, W, C] for each, shown instead of the colours.
    """
    lens, poses = clip.cameras.target, clip.cameras.source_from_target.numpy()
    options = replace(SplatOptions(), published=published)
    frames = [
        published_tensor(
            [view],
            view.world_from_camera @ pose,
            lens,
            width=lens.width,
            height=lens.height,
            values=None if values is None else [values[t]],
            options=options,
            kernel=_KERNEL,
            sigma=_SIGMA,
        )
        for t, (view, pose) in enumerate(zip(views, poses, strict=True))
    ]
    return torch.stack(frames).permute(0, 3, 1, 2)


def _with_cover(painted: Bytes) -> Bytes:
    """A picture uint8 [H, W, 3] before a white one: what is drawn of that says how much of a pixel points cover."""
    return np.concatenate([painted, np.full_like(painted, _WHITE)], axis=-1)


def _ids(view: SceneView, count: int, key: str) -> Bytes:
    if view.classes is None:
        raise DataError(f"{REPROJECT_SEMD} wants clips with class maps, got {key or 'one'} without; leave it out")
    if int(view.classes.max()) >= count:
        raise DataError(
            f"{key or 'a clip'} has class {int(view.classes.max())} of {count}; are the ontologies the same?"
        )
    return view.classes
