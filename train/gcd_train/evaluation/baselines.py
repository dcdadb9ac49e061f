"""Baselines without weights that learn nothing: copies and reprojections."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.clip import nearest_classes, palette
from gcd_model.config import SemanticClass
from gcd_train.data.sample import Bytes, SceneView
from gcd_train.data.visibility import NARROW, published_tensor
from gcd_train.errors import DataError
from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.predictors import (
    CameraPair,
    Prediction,
    SourceClip,
    own_views,
    pixel_rays,
    to_labels,
    to_pictures,
    to_pixels,
)

REPROJECT_RGBD, REPROJECT_SEMD = "reproject_rgbd", "reproject_semd"
FROM_EXACT_CLASSES = ("copy_source", "ground_homography")
"""Baselines that are not privileged in their pictures, but make their class maps from the source's exact ones."""

_NEAREST_SOURCE_M = 0.1  # in front of the source camera
_HOLE = 0.5  # share of a pixel below which it counts as a hole


@dataclass(frozen=True, kw_only=True, slots=True)
class Baseline:
    """What all that moves the source about has; see Predictor. published: points count as released, see `splat`."""

    name: str
    privileged: bool = False
    published: bool = False

    @property
    def details(self) -> dict[str, str]:
        return {"baseline": self.name} | ({"published rounding": "yes"} if self.published else {})


@dataclass(frozen=True, kw_only=True, slots=True)
class CopySource(Baseline):
    """The source picture and its class map, as if they were the target's."""

    name: str = "copy_source"

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. The class map is the source's exact one."""
        return Prediction(video=to_pictures(clip.source), classes=to_labels(clip.source_classes))


@dataclass(frozen=True, kw_only=True, slots=True)
class GroundHomography(Baseline):
    """The source picture and its class map as the target camera sees them if all of it lies on the ground.

    Black, and of no class, where the target camera looks above the horizon or the source does not see the ground.
    """

    name: str = "ground_homography"

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. The class map is warped from the source's exact one."""
        grid, seen = ground_grid(clip.cameras)
        video = F.grid_sample(to_pictures(clip.source), grid, padding_mode="border", align_corners=False)
        classes = labels = to_labels(clip.source_classes)
        if labels is not None:
            each = labels[:, None].float()
            moved = F.grid_sample(each, grid, mode="nearest", padding_mode="border", align_corners=False)
            classes = torch.where(seen, moved[:, 0].to(torch.uint8), NO_CLASS)
        return Prediction(video=torch.where(seen[:, None], video, 0.0), classes=classes)


def ground_grid(cameras: CameraPair) -> tuple[Tensor, Tensor]:
    """Sampling grid float32 [T, H, W, 2] and where it is meant, bool [T, H, W].

        H = R + t n^T / d        for the plane n . x = d in the target camera's axes

    takes rays of the target camera to rays of the source camera that meet the same point of the ground; H r is the
    point itself over the multiple of r at which r meets the plane.
    Source: Hartley and Zisserman 2004, result 13.1, with the opposite sign of d.
    """
    ground_from_target = cameras.ground_from_source @ cameras.source_from_target
    normal = -ground_from_target[:, 2, :3]  # downwards, in the target camera's axes
    height_m = ground_from_target[:, 2, 3]  # above the ground
    turn, step = cameras.source_from_target[:, :3, :3], cameras.source_from_target[:, :3, 3]
    homography = turn + step[:, :, None] * normal[:, None, :] / height_m[:, None, None]
    rays = pixel_rays(cameras.target)
    points = torch.einsum("tij,hwj->thwi", homography, rays)
    below = torch.einsum("ti,hwi->thw", normal, rays) / height_m[:, None, None]  # 1 / reach, positive on the ground
    ahead = points[..., 2] > _NEAREST_SOURCE_M * below.clamp(min=0.0)
    size = points.new_tensor([cameras.source.width, cameras.source.height])
    grid = to_pixels(points, cameras.source) * 2 / size - 1
    seen = (below > 0) & ahead & (grid.abs() <= 1).all(dim=-1)
    return grid.nan_to_num().clamp(-2.0, 2.0).float(), seen


@dataclass(frozen=True, kw_only=True, slots=True)
class ReprojectRgbd(Baseline):
    """The source's colours where its depth puts them; black where no point falls within a pixel.

    Source: Van Hoorick et al. 2024 (GCD), section 5, "Reproject RGB-D"; the renderer as released.
    """

    name: str = REPROJECT_RGBD
    privileged: bool = True

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. No class map. Raises DataError where colour, depth and lens are of different sizes."""
        return Prediction(video=_published(clip, source_views(clip), None, self.published))


@dataclass(frozen=True, kw_only=True, slots=True)
class ReprojectSemd(Baseline):
    """The source's class map in colours, drawn where its depth puts them, and read back: the nearest colour's class.

    A pixel of which points cover less than half is a hole, and of no class: wrong, whatever the target shows. Colours
    are read as if points covered the whole pixel, so that edges of holes are not darker than what is there.

    classes: by id.
    Source: Van Hoorick et al. 2024 (GCD), section 5, "Reproject Sem-D". How colours are read back, and what holes count
    as, is not published.
    """

    classes: tuple[SemanticClass, ...]
    name: str = REPROJECT_SEMD
    privileged: bool = True

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. A class map alone. Raises DataError for a clip without classes."""
        views = source_views(clip)
        colours = palette(self.classes).numpy()
        painted = [colours[_ids(view, len(self.classes), clip.key)] for view in views]
        white = [np.full_like(each, 255) for each in painted]  # drawn with it, for how much of a pixel points cover
        both = [np.concatenate(each, axis=-1) for each in zip(painted, white, strict=True)]
        drawn = _published(clip, views, both, self.published)
        cover = drawn[:, 3:4]
        read = nearest_classes(drawn[:, :3] / cover.clamp(min=_HOLE), self.classes)
        return Prediction(classes=torch.where(cover[:, 0] < _HOLE, NO_CLASS, read))


def source_views(clip: SourceClip) -> Sequence[SceneView]:
    """The T views of the source camera: as the data set holds them where the clip tells, else as the clip shows them.

    The clip's own stand in the axes of the source camera, with its declared lens.
    """
    return clip.points or own_views(clip.source, clip.source_depth, clip.source_classes, clip.cameras.source)


def _published(clip: SourceClip, views: Sequence[SceneView], values: Sequence[Bytes] | None, published: bool) -> Tensor:
    """What the target camera sees of them, float32 [T, C, H, W] in [0, 1].

    values: uint8 [H, W, C] for each, shown instead of the colours.
    """
    lens, poses = clip.cameras.target, clip.cameras.source_from_target.numpy()
    size = lens.width, lens.height
    frames = [
        published_tensor(
            [view],
            view.world_from_camera @ pose,
            lens,
            size,
            values=None if values is None else [values[t]],
            published=published,
            filling=NARROW,
        )
        for t, (view, pose) in enumerate(zip(views, poses, strict=True))
    ]
    return torch.stack(frames).permute(0, 3, 1, 2)


def _ids(view: SceneView, count: int, key: str) -> Bytes:
    if view.classes is None:
        raise DataError(f"{REPROJECT_SEMD} wants clips with class maps, got {key or 'one'} without; leave it out")
    if int(view.classes.max()) >= count:
        raise DataError(
            f"{key or 'a clip'} has class {int(view.classes.max())} of {count}; are the ontologies the same?"
        )
    return view.classes
