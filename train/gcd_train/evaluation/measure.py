"""One method's view of one clip against its target, as the record that all tables are made from."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.config import SemanticClass
from gcd_model.errors import NonFiniteError, ShapeError
from gcd_train.evaluation import metrics
from gcd_train.evaluation.clips import HeldOutClip
from gcd_train.evaluation.predictors import Prediction, Predictor, to_labels, to_pictures
from gcd_train.evaluation.store import ClipRecord, Counted, Frames, Region, RegionRecord


def predicted_and_measured(
    predictor: Predictor, clip: HeldOutClip, *, classes: Sequence[SemanticClass], lpips: metrics.Lpips | None = None
) -> tuple[Prediction, ClipRecord]:
    """What a method makes of a clip, and all figures of that, of every frame from the first on.

    Visible and occluded pixels are measured apart, too, where it is known which those are.

    Args:
        classes: the ontology, empty for none. Those that stand for no class, see `void_ids`, are not counted where they
            are true, and wrong where they are said. lpips: None for no such figure.
    Raises:
        what the method raises; ShapeError: a view is of another size or length than its target, a class id is unknown,
            or the draws of one prediction do not all show the same kinds of things; NonFiniteError: a view holds values
            that are no numbers.
    """
    start = time.perf_counter()
    prediction = predictor.predict(clip.seen)
    seconds = time.perf_counter() - start
    target, draws = to_pictures(clip.target), _pictures(prediction, f"{predictor.name} on {clip.key}")
    painted = _Painted.of(clip, prediction, classes)
    shown = None if draws is None else _Shown.of(draws, target)
    masks: dict[Region, Tensor | None] = {"all": None}
    if clip.visible is not None:
        visible = torch.from_numpy(clip.visible.copy())
        masks |= {"visible": visible, "occluded": ~visible}
    return prediction, ClipRecord(
        method=predictor.name,
        privileged=predictor.privileged,
        key=clip.key,
        scene=clip.scene,
        change=clip.change,
        frames=len(target),
        fps=clip.seen.fps,
        draws=len(prediction.draws),
        seconds=seconds,
        regions={region: _region(mask, target, shown, painted) for region, mask in masks.items()},
        lpips=None if lpips is None or draws is None else tuple(map(_frames, lpips(draws, target))),
        step=None if draws is None else tuple(tuple(metrics.frame_change(each).tolist()) for each in draws),
        step_target=tuple(metrics.frame_change(target).tolist()),
        grid_confusion=None if painted is None else _counted(painted.halved().confusion(None)),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Shown:
    """Pictures that a method made. draws: [S, T, 3, H, W]. likeness: SSIM maps of each draw, [S][T, H-6, W-6].

    detail, target_detail: length of the gradient, [S][T, H, W] and [T, H, W].
    """

    draws: Tensor
    likeness: tuple[Tensor, ...]
    detail: tuple[Tensor, ...]
    target_detail: Tensor

    @classmethod
    def of(cls, draws: Tensor, target: Tensor) -> "_Shown":
        return cls(
            draws=draws,
            likeness=tuple(metrics.ssim_map(each, target) for each in draws),
            detail=tuple(map(metrics.gradient_map, draws)),
            target_detail=metrics.gradient_map(target),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Painted:
    """Class maps: what was said, [S, T, H, W], and what is true, [T, H, W]. classes: how many there are."""

    said: Tensor
    true: Tensor
    classes: int

    @classmethod
    def of(cls, clip: HeldOutClip, prediction: Prediction, classes: Sequence[SemanticClass]) -> "_Painted | None":
        said = _alike([draw.classes for draw in prediction.draws], "class maps")
        true, void = to_labels(clip.target_classes), metrics.void_ids([each.name for each in classes])
        if said is None or true is None or not classes:
            return None
        said, true = metrics.without_classes(said.cpu(), void), metrics.without_classes(true, void)
        return cls(said=said, true=true, classes=len(classes))

    def confusion(self, mask: Tensor | None) -> Tensor:
        """Of each frame, all draws together: int64 [T, K, K + 1], last what is said to be of no class."""
        each = [metrics.frame_confusions(said, self.true, self.classes, mask) for said in self.said]
        return torch.stack(each).sum(dim=0)

    def halved(self) -> "_Painted":
        """At half the height and width; an odd last row or column is left out."""
        return _Painted(said=self._coarse(self.said), true=self._coarse(self.true), classes=self.classes)

    def _coarse(self, labels: Tensor) -> Tensor:
        height, width = labels.shape[-2] // 2, labels.shape[-1] // 2
        even = labels[..., : 2 * height, : 2 * width]
        coarse = metrics.majority_classes(even, height, width, self.classes)
        there = F.max_pool2d((even < self.classes).flatten(end_dim=-3).float(), 2) > 0
        return torch.where(there.view(coarse.shape), coarse, metrics.NO_CLASS)


def _region(mask: Tensor | None, target: Tensor, shown: _Shown | None, painted: _Painted | None) -> RegionRecord:
    """Figures on some pixels. mask: bool [T, H, W], or None for all."""
    share = torch.ones(len(target)) if mask is None else mask.double().mean(dim=(1, 2))
    confusion = None if painted is None else _counted(painted.confusion(mask))
    found = RegionRecord(pixels=tuple(share.tolist()), confusion=confusion)
    if shown is None:
        return found
    near = (metrics.psnr(d, target) if mask is None else metrics.masked_psnr(d, target, mask) for d in shown.draws)
    inside = None if mask is None else metrics.window_mask(mask)
    return msgspec.structs.replace(
        found,
        psnr_db=tuple(map(_frames, near)),
        ssim=tuple(_within(each, inside) for each in shown.likeness),
        diversity=None if len(shown.draws) < 2 else _frames(metrics.diversity(shown.draws, mask)),
        gradient=tuple(_within(each, mask) for each in shown.detail),
        gradient_target=_within(shown.target_detail, mask),
    )


def _within(values: Tensor, mask: Tensor | None) -> Frames:
    """Mean of [T, H, W] over each frame, or over a mask of it."""
    return _frames(values.mean(dim=(1, 2)) if mask is None else metrics.masked_mean(values, mask))


def _pictures(prediction: Prediction, whose: str) -> Tensor | None:
    """All draws' pictures, float32 [S, T, 3, H, W]."""
    draws = _alike([draw.video for draw in prediction.draws], "pictures")
    if draws is None:
        return None
    if not draws.isfinite().all():
        raise NonFiniteError(f"pictures must be finite to be measured; {whose} gave NaN or Inf")
    return draws.float().cpu()


def _alike(draws: list[Tensor | None], what: str) -> Tensor | None:
    """Draws one after the other; None where none shows such things."""
    made = [each for each in draws if each is not None]
    if len({each.shape for each in made}) > 1 or 0 < len(made) < len(draws):
        got = [None if each is None else list(each.shape) for each in draws]
        raise ShapeError(f"draws of one prediction must have {what} of one shape, all or none of them; got {got}")
    return torch.stack(made) if made else None


def _counted(confusions: Tensor) -> tuple[Counted, ...]:
    """What occurs in each frame's matrix, [T, K, K + 1]."""
    classes, frames = confusions.shape[1], list[Counted]()
    for confusion in confusions:
        places = confusion.nonzero()
        pixels = confusion[places[:, 0], places[:, 1]].tolist()
        pairs = zip(places.tolist(), pixels, strict=True)
        frames.append(tuple((true, said if said < classes else metrics.NO_CLASS, n) for (true, said), n in pairs))
    return tuple(frames)


def _frames(values: Tensor) -> Frames:
    """NaN, where there was no pixel to measure, becomes None."""
    return tuple(None if math.isnan(value) else value for value in tuple(values.tolist()))
