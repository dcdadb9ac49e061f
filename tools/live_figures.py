"""Figures of views whose truth is known: by what the source had seen of each pixel, and summed clip by clip.

Every figure is over frames 2 to 14; the first is the source's own picture on most paths. What nobody can know is
judged by a network of random weights: pictures need not agree pixel by pixel, but must be made of the same stuff, so
that its features, averaged over cells of 16 x 16 pixels, are as in the truth.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.config import SemanticClass
from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_train.data.sample import to_network
from gcd_train.evaluation.metrics import class_iou, confusion_matrix, gradient_map, psnr, ssim_map, window_mask
from gcd_train.evaluation.predictors import pixel_rays, to_pixels
from gcd_train.live.calibration import SpreadHistogram
from gcd_train.live.clips import NEVER, STATES, LiveClip

NAMED_CLASSES = ("person", "cyclist", "car", "pole")
"""Classes whose IoU is reported apart."""
_FULL_CELL = 0.8
"""A cell counts as never seen from this share of its pixels."""
_SAME_SURFACE = 0.02
_CELL, _FEATURES, _JUDGE_SEED = 16, 64, 7
"""Pixels a side of a cell of the judge, its features, and what its weights are drawn from."""
_RIDGE = 1e-3
"""Added to every variance of features that vary by 1 in the truth."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Truth:
    """What the target camera saw of a clip.

    video: float32 [T, 3, H, W] in [0, 1]. labels: uint8 [T, H, W]. visibility: uint8 [T, H, W], see STATES.
    before: float32 [T-1, H, W, 2], where the surface of a pixel was a frame earlier, in [-1, 1] across the picture.
    static: bool [T-1, H, W], the pixels whose surface stands still and was in the picture a frame earlier.
    gradient: float32 [T-1, H, W], of frames 2 to T. features: of the same frames by the judge, [T-1, H/16, W/16, 64].
    """

    video: Tensor
    labels: Tensor
    visibility: Tensor
    before: Tensor
    static: Tensor
    gradient: Tensor
    features: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodViews:
    """What a method shows of a clip; None for what it does not say.

    video: float32 [T, 3, H, W] in [0, 1]. classes: uint8 [T, H, W], ids of LIVE_CLASSES. visibility: uint8 [T, H, W].
    log_variance: float32 [T, H, W], of the truth about the video, channel mean.
    """

    video: Tensor
    classes: Tensor | None = None
    visibility: Tensor | None = None
    log_variance: Tensor | None = None


def truth_of(clip: LiveClip) -> Truth:
    """Of a whole clip."""
    moves = torch.from_numpy(clip.arrays["target.moves"] > 0)
    before, static = surface_motion(clip.depth("target"), moves, clip.poses("target"), clip.lens("target"))
    video = (to_network(clip.arrays["target.rgb"]) + 1) / 2
    return Truth(
        video=video,
        labels=torch.from_numpy(clip.arrays["target.labels"]),
        visibility=torch.from_numpy(clip.arrays["target.visibility"]),
        before=before,
        static=static,
        gradient=gradient_map(video[1:]),
        features=cells(video[1:]),
    )


def surface_motion(metres: Tensor, moves: Tensor, poses: Tensor, lens: Intrinsics) -> tuple[Tensor, Tensor]:
    """Where each pixel's surface was a frame earlier, and whether that can be known; see `Truth`.

    Args:
        metres: [T, H, W]. moves: bool [T, H, W]. poses: float64 [T, 4, 4], world_from_camera.
    """
    then_from_now = invert_rigid(poses[:-1]) @ poses[1:]
    points = pixel_rays(lens) * metres[1:, ..., None].double()  # [T-1, H, W, 3]
    turned = torch.einsum("tij,thwj->thwi", then_from_now[:, :3, :3], points) + then_from_now[:, None, None, :3, 3]
    z = turned[..., 2].clamp(min=1e-3)
    size = torch.tensor([lens.width, lens.height], dtype=torch.float64)
    place = (to_pixels(torch.cat([turned[..., :2], z[..., None]], dim=-1), lens) * 2 / size - 1).float()
    facts = torch.stack([metres[:-1], moves[:-1].float()], dim=1)
    there = F.grid_sample(facts, place, mode="nearest", align_corners=False)
    same = (there[:, 0] / turned[..., 2] - 1).abs() < _SAME_SURFACE
    inside = (place.abs() <= 1).all(dim=-1) & (turned[..., 2] > 1e-3)
    return place, inside & same & (there[:, 1] == 0) & ~moves[1:]


class Tally:
    """All figures of one method on one set, clip by clip."""

    def __init__(self, classes: Sequence[SemanticClass]) -> None:
        self._names = [entry.name for entry in classes]
        self._sums: defaultdict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        """What is summed up, and of how many, by figure."""
        self._confusion = torch.zeros(len(classes), len(classes), dtype=torch.int64)
        self._states = torch.zeros(3, 3, dtype=torch.int64)
        self._views, self._truths = list[Tensor](), list[Tensor]()
        self.spread = SpreadHistogram()
        self.psnr: dict[str, list[float]] = defaultdict(list)
        """Mean over frames of every clip, by scene."""

    def add(self, scene: str, truth: Truth, views: MethodViews, splat: Tensor) -> None:
        """Count a clip in.

        splat: [T, 3, H, W], the exact splat's video, whose error seen pixels are compared to.
        """
        never, made, true = truth.visibility[1:] == NEVER, views.video[1:], truth.video[1:]
        quality, likeness = psnr(made, true), ssim_map(made, true)
        self.psnr[scene].append(float(quality.mean()))
        self._mean("psnr", quality)
        self._mean("ssim", likeness)
        self._mean("ssim_seen", likeness, window_mask(~never))
        for name, mask in (("seen", ~never), ("never", never)):
            self._mean(f"share_{name}", mask.float())
            self._mean(f"square_{name}", (made - true).square().mean(dim=1), mask)
            self._mean(f"splat_{name}", (splat[1:] - true).square().mean(dim=1), mask)
        inside = F.max_pool2d((~never).float(), 3, 1, 1) == 0  # pixels whose eight neighbours were not seen, either
        self._mean("gradient_made", gradient_map(made), inside)
        self._mean("gradient_true", truth.gradient, inside)
        judged = F.avg_pool2d(never.float(), _CELL) >= _FULL_CELL
        self._views.append(cells(made)[judged])
        self._truths.append(truth.features[judged])
        for name, video in (("made", views.video), ("true", truth.video)):
            self._mean(f"flicker_{name}", _flicker(video, truth)[1:], truth.static[1:])
            self._mean(f"jump_{name}", (video[2:] - video[1:-1]).abs())
        if views.classes is not None:
            self._confusion += confusion_matrix(views.classes[1:], truth.labels[1:], len(self._names))
        if views.visibility is not None:
            self._states += confusion_matrix(views.visibility[1:], truth.visibility[1:], 3)
            if views.log_variance is not None:
                self.spread.add(made - true, views.log_variance[1:], views.visibility[1:])

    def _mean(self, name: str, values: Tensor, weights: Tensor | None = None) -> None:
        """Count values into the mean of a figure."""
        sums = self._sums[name]
        sums[0] += float((values if weights is None else values * weights).sum())
        sums[1] += float(values.numel() if weights is None else weights.sum())

    def figures(self) -> dict[str, float]:
        """All of them by name; NaN for what the method does not say, or what does not occur in the set."""
        means = {name: total / count if count else math.nan for name, (total, count) in self._sums.items()}
        made = {name: means[name] for name in ("psnr", "ssim", "ssim_seen", "share_seen", "share_never")}
        for name in ("seen", "never"):
            made[f"psnr_{name}"] = -10 * math.log10(max(means[f"square_{name}"], 1e-10))
        for name, of, by in (
            ("error_ratio_seen", "square_seen", "splat_seen"),
            ("gradient_energy", "gradient_made", "gradient_true"),
            ("flicker", "flicker_made", "flicker_true"),
            ("jump", "jump_made", "jump_true"),
        ):
            made[name] = means[of] / max(means[by], 1e-10)
        made["frechet_random"] = frechet_distance(torch.cat(self._views), torch.cat(self._truths))
        iou = np.array(_occurring_iou(self._confusion))
        made["miou"] = float(np.nanmean(iou)) if np.isfinite(iou).any() else math.nan
        made |= {name: float(iou[self._names.index(name)]) for name in NAMED_CLASSES}
        made |= {f"iou_{name}": iou for name, iou in zip(STATES, _occurring_iou(self._states), strict=True)}
        made |= {f"inside_90_{name}": share for name, share in zip(STATES, self.spread.coverage, strict=True)}
        return made


def _occurring_iou(confusion: Tensor) -> list[float]:
    """IoU of each class that occurs in the truth, NaN for others; all NaN where nothing was said."""
    return torch.where(confusion.sum(1) > 0, class_iou(confusion), math.nan).tolist()


def _flicker(video: Tensor, truth: Truth) -> Tensor:
    """How much each pixel's surface has changed its colour since the frame before: [T-1, H, W]."""
    then = F.grid_sample(video[:-1], truth.before, mode="bilinear", padding_mode="border", align_corners=False)
    return (video[1:] - then).abs().mean(dim=1)


@cache
def _judge() -> nn.Module:
    """0.3 M random weights, always the same; a feature looks at 43 pixels a side, one for every 8."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(_JUDGE_SEED)
        layers = [(3, 32, 2), (32, 32, 1), (32, 64, 2), (64, 64, 1), (64, 128, 2), (128, 128, 1)]
        made = [(nn.Conv2d(a, b, 3, stride, 1), nn.GroupNorm(8, b), nn.SiLU()) for a, b, stride in layers]
        return nn.Sequential(*chain(*made), nn.Conv2d(128, _FEATURES, 1), nn.SiLU()).eval()


@torch.no_grad()
def cells(pictures: Tensor) -> Tensor:
    """What the judge sees of pictures [N, 3, H, W] in [0, 1]: features of cells, [N, H/16, W/16, 64]."""
    return F.avg_pool2d(_judge()(pictures * 2 - 1), 2).permute(0, 2, 3, 1)


def frechet_distance(views: Tensor, truths: Tensor) -> float:
    """Between features [N, 64] of the two as Gaussians, in standard deviations of the truth's; NaN for too few.

        |m - m'|^2 + tr(C + C' - 2 (C^1/2 C' C^1/2)^1/2)

    Source: Dowson and Landau 1982; Heusel et al. 2017, with features of our own.
    """
    if min(len(views), len(truths)) < 2 * _FEATURES:
        return math.nan
    (mean, covariance), (true_mean, true_covariance) = (
        (each.mean(0), each.T.cov(correction=0)) for each in (views.double(), truths.double())
    )
    scale = true_covariance.diagonal().clamp(min=1e-12).rsqrt()
    ridge = _RIDGE * torch.eye(_FEATURES, dtype=torch.float64)
    a, b = (c * scale[:, None] * scale + ridge for c in (covariance, true_covariance))
    root = torch.linalg.cholesky(a)
    shared = torch.linalg.eigvalsh(root.T @ b @ root).clamp(min=0).sqrt().sum()
    apart = ((mean - true_mean) * scale).square().sum() + a.trace() + b.trace() - 2 * shared
    return max(float(apart), 0.0)
