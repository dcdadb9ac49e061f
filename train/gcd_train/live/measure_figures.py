"""Figures of views whose truth is known: by what the source had seen of each pixel, and summed clip by clip.

Every figure is over frames 2 to 14; the first is the source's own picture on most paths.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.config import SemanticClass
from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_train.evaluation.metrics import (
    class_iou,
    confusion_matrix,
    gradient_map,
    majority_classes,
    psnr,
    ssim_map,
    window_mask,
)
from gcd_train.evaluation.predictors import pixel_rays
from gcd_train.live.batches import to_video
from gcd_train.live.clips import SKY_M, LiveClip
from gcd_train.live.judge import CELL, JudgeNet, Moments, frechet_distance

NEVER, BEFORE, NOW = 0, 1, 2
STATES = ("painted", "before", "now")
"""Names of the visibility's values."""
NAMED_CLASSES = ("person", "cyclist", "car", "pole")
"""Classes whose IoU is reported apart."""
COARSE = (64, 96)
"""Height and width of the grid on which class maps of small models are compared."""
INTERVAL, _Z = 0.9, 1.6448536269514722
_FULL_CELL = 0.8
"""A cell counts as never seen from this share of its pixels."""
_SAME_SURFACE = 0.02
_BINS, _FARTHEST = 8000, 40.0
"""Of the histograms of `needed_shift`, which reach this far to both sides: steps of 0.01."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Truth:
    """What the target camera saw of a clip.

    video: float32 [T, 3, H, W] in [0, 1]. labels: uint8 [T, H, W]. visibility: uint8 [T, H, W], see STATES. metres:
    float32 [T, H, W], SKY_M for the sky.
    before: float32 [T-1, H, W, 2], where the surface of a pixel was a frame earlier, in [-1, 1] across the picture.
    static: bool [T-1, H, W], the pixels whose surface stands still and was in the picture a frame earlier.
    gradient: float32 [T-1, H, W], of frames 2 to T. features: of the same frames by each judge, [T-1, H/16, W/16, 64].
    """

    video: Tensor
    labels: Tensor
    visibility: Tensor
    metres: Tensor
    before: Tensor
    static: Tensor
    gradient: Tensor
    features: tuple[Tensor, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodViews:
    """What a method shows of a clip; None for what it does not say.

    video: float32 [T, 3, H, W] in [0, 1]. classes: uint8 [T, H, W], ids of LIVE_CLASSES. visibility: uint8 [T, H, W].
    log_variance: float32 [T, H, W], of the truth about the video, channel mean. inverse_depth: float32 [T, H, W], of
    metres, 0 for the sky. within: whether the clip lies within what the method was made for. cpu_s: of computing.
    """

    video: Tensor
    classes: Tensor | None = None
    visibility: Tensor | None = None
    log_variance: Tensor | None = None
    inverse_depth: Tensor | None = None
    within: bool = True
    cpu_s: float | None = None


def truth_of(clip: LiveClip, judges: Sequence[JudgeNet]) -> Truth:
    """Of a whole clip."""
    arrays = clip.arrays
    height, width = arrays["target.labels"].shape[1:]
    lens = Intrinsics.from_hfov(clip.hfov_deg("target"), width, height)
    metres = torch.from_numpy(clip.depth("target"))
    before, static = surface_motion(
        metres,
        torch.from_numpy(arrays["target.moves"] > 0),
        torch.from_numpy(arrays["target.pose"]),
        lens,
    )
    video = (to_video(arrays["target.rgb"]) + 1) / 2
    return Truth(
        video=video,
        labels=torch.from_numpy(arrays["target.labels"]),
        visibility=torch.from_numpy(arrays["target.visibility"]),
        metres=metres,
        before=before,
        static=static,
        gradient=gradient_map(video[1:]),
        features=tuple(judge.cells(video[1:]) for judge in judges),
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
    place = torch.stack(
        [
            (turned[..., 0] / z * lens.fx + lens.cx) * 2 / lens.width - 1,
            (turned[..., 1] / z * lens.fy + lens.cy) * 2 / lens.height - 1,
        ],
        dim=-1,
    ).float()
    facts = torch.stack([metres[:-1], moves[:-1].float()], dim=1)
    there = F.grid_sample(facts, place, mode="nearest", align_corners=False)
    same = (there[:, 0] / turned[..., 2] - 1).abs() < _SAME_SURFACE
    inside = (place.abs() <= 1).all(dim=-1) & (turned[..., 2] > 1e-3)
    return place, inside & same & (there[:, 1] == 0) & ~moves[1:]


def needed_shift(error: Tensor, log_variance: Tensor) -> Tensor:
    """By how much the log-variance must at least rise for each error [T, 3, H, W] to lie in the 90 % interval.

    log_variance: [T, H, W]. An error is inside where this is not above 0.
    """
    return 2 * (error.abs().clamp(min=1e-9) / _Z).log() - log_variance[:, None]


class SpreadHistogram:
    """How many errors, channel by channel, need which shift of the log-variance, apart for each state of visibility."""

    def __init__(self) -> None:
        self.counts = torch.zeros(len(STATES), _BINS, dtype=torch.float64)

    def add(self, error: Tensor, log_variance: Tensor, visibility: Tensor) -> None:
        """error: [T, 3, H, W], view minus truth in [0, 1]. log_variance, visibility: [T, H, W], as published."""
        shift = needed_shift(error, log_variance)
        place = torch.ceil((shift + _FARTHEST) * (_BINS / (2 * _FARTHEST))).long().clamp(1, _BINS) - 1
        state = visibility[:, None].expand_as(error).long()
        self.counts += torch.bincount((state * _BINS + place).flatten(), minlength=self.counts.numel()).view(3, -1)

    @property
    def coverage(self) -> list[float]:
        """Share of errors inside the 90 % interval, by state; NaN for a state that never occurs."""
        inside = self.counts[:, : _BINS // 2].sum(1)
        return (inside / self.counts.sum(1)).tolist()


def fit_spread(histogram: SpreadHistogram) -> tuple[float, float, float]:
    """What to add to the log-variance of each state so that the 90 % interval holds 90 %; 0 for an absent state."""
    shifts: list[float] = []
    for counts in histogram.counts:
        share = counts.cumsum(0) / counts.sum()
        enough = int((share < INTERVAL).sum()) + 1  # right edge of the first bin that reaches it
        shifts.append(enough * (2 * _FARTHEST / _BINS) - _FARTHEST if bool(counts.sum() > 0) else 0.0)
    return shifts[0], shifts[1], shifts[2]


class Tally:
    """All figures of one method on one set, clip by clip."""

    def __init__(self, classes: Sequence[SemanticClass], judges: dict[str, JudgeNet]) -> None:
        """judges: by the names that their distances get; in the order of `Truth.features`."""
        self._names = [entry.name for entry in classes]
        self._judges = judges
        self._sums: defaultdict[str, float] = defaultdict(float)
        self._confusions = {"miou": self._square(), "miou_coarse": self._square()}
        self._states = torch.zeros(3, 3, dtype=torch.int64)
        self._moments = {name: (Moments.none(), Moments.none()) for name in judges}
        self.spread = SpreadHistogram()
        self.psnr: dict[str, list[float]] = defaultdict(list)
        """Mean over frames of every clip, by scene."""
        self.outside: set[str] = set()
        """Scenes with a clip that is not what the method was made for."""

    def _square(self) -> Tensor:
        return torch.zeros(len(self._names), len(self._names), dtype=torch.int64)

    def add(self, scene: str, truth: Truth, views: MethodViews, splat: Tensor) -> None:
        """Count a clip in.

        splat: [T, 3, H, W], the exact splat's video, whose error seen pixels are compared to.
        """
        never = truth.visibility[1:] == NEVER
        made, true = views.video[1:], truth.video[1:]
        if not views.within:
            self.outside.add(scene)
        quality = psnr(made, true)
        self.psnr[scene].append(float(quality.mean()))
        self._mean("psnr", quality)
        self._mean("psnr_last", quality[-1:])
        self._add_structure(made, true, ~never)
        self._add_errors(made, true, splat[1:], truth.visibility[1:])
        self._add_never(made, truth, never)
        self._add_time(views.video, truth)
        if views.cpu_s is not None:
            self._mean("cpu_s", torch.tensor([views.cpu_s / len(views.video)]))
        if views.classes is not None:
            self._add_classes(views.classes[1:], truth.labels[1:])
        if views.inverse_depth is not None:
            right = _right_depth(views.inverse_depth[1:], truth.metres[1:])
            self._mean("depth_seen", right.float(), ~never)
        if views.visibility is not None:
            self._states += confusion_matrix(views.visibility[1:], truth.visibility[1:], 3)
            if views.log_variance is not None:
                self.spread.add(made - true, views.log_variance[1:], views.visibility[1:])

    def _mean(self, name: str, values: Tensor, weights: Tensor | None = None) -> None:
        """Count values into the mean of a figure."""
        self._sums[f"{name}/sum"] += float((values if weights is None else values * weights).sum())
        self._sums[f"{name}/count"] += float(values.numel() if weights is None else weights.sum())

    def _read(self, name: str) -> float:
        count = self._sums[f"{name}/count"]
        return self._sums[f"{name}/sum"] / count if count else float("nan")

    def _add_structure(self, made: Tensor, true: Tensor, seen: Tensor) -> None:
        likeness = ssim_map(made, true)
        self._mean("ssim", likeness)
        self._mean("ssim_seen", likeness, window_mask(seen))

    def _add_errors(self, made: Tensor, true: Tensor, splat: Tensor, visibility: Tensor) -> None:
        for name, mask in (("seen", visibility > NEVER), ("now", visibility == NOW), ("never", visibility == NEVER)):
            self._mean(f"share_{name}", mask.float())
            self._mean(f"square_{name}", (made - true).square().mean(dim=1), mask)
            self._mean(f"splat_{name}", (splat - true).square().mean(dim=1), mask)

    def _add_never(self, made: Tensor, truth: Truth, never: Tensor) -> None:
        inside = _eroded(never)
        self._mean("gradient_made", gradient_map(made), inside)
        self._mean("gradient_true", truth.gradient, inside)
        cells = F.avg_pool2d(never.float(), CELL) >= _FULL_CELL
        for (name, judge), features in zip(self._judges.items(), truth.features, strict=True):
            of_views, of_truths = self._moments[name]
            of_views.add(judge.cells(made)[cells])
            of_truths.add(features[cells])

    def _add_time(self, video: Tensor, truth: Truth) -> None:
        self._mean("flicker_made", _flicker(video, truth)[1:], truth.static[1:])
        self._mean("flicker_true", _flicker(truth.video, truth)[1:], truth.static[1:])
        for name, pictures in (("jump_made", video), ("jump_true", truth.video)):
            self._mean(name, (pictures[2:] - pictures[1:-1]).abs())

    def _add_classes(self, made: Tensor, true: Tensor) -> None:
        count = len(self._names)
        self._confusions["miou"] += confusion_matrix(made, true, count)
        if all(side % cells == 0 for side, cells in zip(true.shape[1:], COARSE, strict=True)):
            coarse = [majority_classes(labels, *COARSE, count) for labels in (made, true)]
            self._confusions["miou_coarse"] += confusion_matrix(coarse[0], coarse[1], count)

    def figures(self) -> dict[str, float]:
        """All of them by name; NaN for what the method does not say, or what does not occur in the set."""
        read = self._read
        made = {name: read(name) for name in ("psnr", "psnr_last", "ssim", "ssim_seen")}
        for name in ("seen", "now", "never"):
            made[f"share_{name}"] = read(f"share_{name}")
            made[f"psnr_{name}"] = -10 * float(np.log10(max(read(f"square_{name}"), 1e-10)))
        for name in ("seen", "now"):
            made[f"error_ratio_{name}"] = read(f"square_{name}") / max(read(f"splat_{name}"), 1e-10)
        made["gradient_energy"] = read("gradient_made") / max(read("gradient_true"), 1e-10)
        made |= {f"frechet_{name}": frechet_distance(*moments) for name, moments in self._moments.items()}
        made |= self._class_figures()
        made |= {f"iou_{name}": iou for name, iou in zip(STATES, _occurring_iou(self._states), strict=True)}
        made |= {f"inside_90_{name}": share for name, share in zip(STATES, self.spread.coverage, strict=True)}
        for name in ("flicker", "jump"):
            made[name] = read(f"{name}_made") / max(read(f"{name}_true"), 1e-10)
            made[f"{name}_levels"] = 255 * read(f"{name}_made")
        made["depth_within_10_seen"] = read("depth_seen")
        made["cpu_ms_a_frame"] = 1000 * read("cpu_s")
        return made

    def _class_figures(self) -> dict[str, float]:
        made: dict[str, float] = {}
        for name, confusion in self._confusions.items():
            iou = np.array(_occurring_iou(confusion))
            made[name] = float(np.nanmean(iou)) if np.isfinite(iou).any() else float("nan")
            suffix = name.removeprefix("miou")
            made |= {f"{each}{suffix}": float(iou[self._names.index(each)]) for each in NAMED_CLASSES}
        return made


def _occurring_iou(confusion: Tensor) -> list[float]:
    """IoU of each class that occurs in the truth, NaN for others; all NaN where nothing was said."""
    return torch.where(confusion.sum(1) > 0, class_iou(confusion), float("nan")).tolist()


def _right_depth(inverse: Tensor, metres: Tensor) -> Tensor:
    """Which pixels are off by less than 10 %; beyond half of SKY_M all is sky."""
    both_far = (inverse * SKY_M < 2) & (metres > SKY_M / 2)
    return both_far | ((inverse * metres - 1).abs() < 0.1)


def _eroded(mask: Tensor) -> Tensor:
    """Pixels of a mask [T, H, W] whose eight neighbours are in it, too."""
    return F.max_pool2d((~mask).float(), 3, 1, 1) == 0


def _flicker(video: Tensor, truth: Truth) -> Tensor:
    """How much each pixel's surface has changed its colour since the frame before: [T-1, H, W]."""
    then = F.grid_sample(video[:-1], truth.before, mode="bilinear", padding_mode="border", align_corners=False)
    return (video[1:] - then).abs().mean(dim=1)


def scene_interval(differences: Sequence[float], draws: int = 4000, seed: int = 0) -> tuple[float, float]:
    """The 95 % interval of the mean over scenes, by drawing scenes anew; NaN for none."""
    if not differences:
        return float("nan"), float("nan")
    values, random = np.array(differences), np.random.default_rng(seed)
    means = values[random.integers(len(values), size=(draws, len(values)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)
