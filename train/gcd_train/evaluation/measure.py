"""Methods measured on clips: one view against its target as a record, and all clips over processes or a Ray cluster."""

import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeAlias

import msgspec
import torch
from torch import Tensor

from gcd_model.config import SemanticClass
from gcd_model.errors import ModelError, NonFiniteError, ShapeError, ViewRangeError
from gcd_train.errors import DataError, RunError, TrainError
from gcd_train.evaluation import metrics
from gcd_train.evaluation.clips import EvaluationSet, HeldOutClip
from gcd_train.evaluation.galleries import FEW_CLIPS, KeptViews, has_views, write_views
from gcd_train.evaluation.predictors import Prediction, Predictor, to_labels, to_pictures
from gcd_train.evaluation.statistics import FIRST_MEASURED
from gcd_train.evaluation.store import Box, ClipRecord, Counted, Frames, Region, RegionRecord, RunKeeper
from gcd_train.parallel import Outcome, map_items, one_thread_each


def predicted_and_measured(
    predictor: Predictor,
    clip: HeldOutClip,
    *,
    classes: Sequence[SemanticClass],
    painted: bool = False,
    lpips: metrics.Lpips | None = None,
) -> tuple[Prediction, ClipRecord]:
    """What a method makes of a clip, and all figures of that, of every frame from the first on.

    Visible and occluded pixels are measured apart, too, where it is known which those are. A method that shows a part
    of the target, see `Prediction.crop`, is measured on that part of it and of its regions.

    Args:
        classes: the ontology, empty for none. Those that stand for no class, see `void_ids`, are not counted where they
            are true, and wrong where they are said. painted: targets are painted in the classes' colours, and
            class maps alone count. lpips: None for no such figure.
    Raises:
        what the method raises; ShapeError: a view is of another size or length than its target, a class id is unknown,
            or the draws of one prediction do not all show the same kinds of things; NonFiniteError: a view holds values
            that are no numbers.
    """
    start = time.perf_counter()
    prediction = predictor.predict(clip.seen)
    seconds = time.perf_counter() - start
    if painted:
        first, *more = (replace(draw, video=None, more=()) for draw in prediction.draws)
        prediction = replace(first, more=tuple(more))
    clip = clip if prediction.crop is None else _part(clip, prediction.crop)
    target, draws = to_pictures(clip.target), _alike([draw.video for draw in prediction.draws], "pictures")
    if draws is not None and not draws.isfinite().all():
        raise NonFiniteError(f"pictures must be finite to be measured; {predictor.name} on {clip.key} gave NaN or Inf")
    draws = None if draws is None else draws.float()
    said, true = _alike([draw.classes for draw in prediction.draws], "class maps"), to_labels(clip.target_classes)
    labels, void = None, metrics.void_ids([each.name for each in classes])
    if said is not None and true is not None and classes:
        labels = (metrics.without_classes(said, void), metrics.without_classes(true, void))
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
        regions=_regions(clip, target, draws, labels, len(classes)),
        lpips=None if lpips is None or draws is None else tuple(map(_frames, _counting(lpips(draws, target), clip))),
        step=None if draws is None else tuple(tuple(metrics.frame_change(each).tolist()) for each in draws),
        step_target=tuple(metrics.frame_change(target).tolist()),
        crop=prediction.crop,
    )


def _part(clip: HeldOutClip, crop: Box) -> HeldOutClip:
    """The clip with a part of its target alone."""
    left, top, width, height = crop
    part = (slice(None), slice(top, top + height), slice(left, left + width))
    return replace(
        clip,
        target=clip.target[part],
        target_classes=None if clip.target_classes is None else clip.target_classes[part],
        visible=None if clip.visible is None else clip.visible[part],
    )


def _counting(values: Tensor, clip: HeldOutClip) -> Tensor:
    """Values [..., T], NaN in frames that do not count."""
    return values if clip.counted is None else values.masked_fill(~torch.from_numpy(clip.counted), math.nan)


def _regions(
    clip: HeldOutClip,
    target: Tensor,
    draws: Tensor | None,
    labels: tuple[Tensor, Tensor] | None,
    classes: int,
) -> dict[Region, RegionRecord]:
    """Figures on all pixels and, where it is known which are visible, on those and the others.

    draws: [S, T, 3, H, W]. labels: what was said, [S, T, H, W], and what is true, [T, H, W]. classes: how many.
    """
    likeness = [] if draws is None else [metrics.ssim_map(each, target) for each in draws]  # [S][T, H-6, W-6]
    detail = [] if draws is None else [metrics.gradient_map(each) for each in draws]
    target_detail, found = metrics.gradient_map(target), dict[Region, RegionRecord]()
    masks: dict[Region, Tensor | None] = {"all": None}
    if clip.counted is not None:
        masks = {"all": torch.from_numpy(clip.counted)[:, None, None].expand_as(target[:, 0])}
    if clip.visible is not None:
        seen = torch.from_numpy(clip.visible.copy())
        masks |= {"visible": seen, "occluded": ~seen}
    for name, mask in masks.items():
        share = torch.ones(len(target)) if mask is None else mask.double().mean(dim=(1, 2))
        found[name] = RegionRecord(
            pixels=tuple(share.tolist()),
            gradient_target=_within(target_detail, mask),
            confusion=None if labels is None else _counted(*labels, classes, mask),
        )
        if draws is not None:
            near = [metrics.psnr(d, target) if mask is None else metrics.masked_psnr(d, target, mask) for d in draws]
            inside = None if mask is None else metrics.window_mask(mask)
            found[name] = msgspec.structs.replace(
                found[name],
                psnr_db=tuple(map(_frames, near)),
                ssim=tuple(_within(each, inside) for each in likeness),
                diversity=None if len(draws) < 2 else _within(metrics.pixel_deviation(draws), mask),
                gradient=tuple(_within(each, mask) for each in detail),
            )
    return found


def _alike(draws: Sequence[Tensor | None], what: str) -> Tensor | None:
    """Draws one after the other, [S, ...]; None where none shows such things."""
    made = [each for each in draws if each is not None]
    if len({each.shape for each in made}) > 1 or 0 < len(made) < len(draws):
        got = [None if each is None else list(each.shape) for each in draws]
        raise ShapeError(f"draws of one prediction must have {what} of one shape, all or none of them; got {got}")
    return torch.stack(made).cpu() if made else None


def _counted(said: Tensor, true: Tensor, classes: int, mask: Tensor | None) -> tuple[Counted, ...]:
    """What occurs in each frame, all draws together."""
    each = [metrics.frame_confusions(draw, true, classes, mask) for draw in said]
    frames: list[Counted] = []
    for confusion in torch.stack(each).sum(dim=0):  # [K, K + 1], last what is said to be of no class
        places = confusion.nonzero()
        pixels = confusion[places[:, 0], places[:, 1]].tolist()
        pairs = zip(places.tolist(), pixels, strict=True)
        frames.append(tuple((row, column if column < classes else metrics.NO_CLASS, n) for (row, column), n in pairs))
    return tuple(frames)


def _within(values: Tensor, mask: Tensor | None) -> Frames:
    """Mean of [T, H, W] over each frame, or over a mask of it."""
    return _frames(values.mean(dim=(1, 2)) if mask is None else metrics.masked_mean(values, mask))


def _frames(values: Tensor) -> Frames:
    """NaN, where there was no pixel to measure, becomes None."""
    return tuple(None if math.isnan(value) else value for value in tuple(values.tolist()))


GIVE_UP_AFTER = 5
"""Clips in a row of which nothing could be measured, after which a run stops: something is wrong with all of them."""

_VISIBLE = "CUDA_VISIBLE_DEVICES"


ClipItem: TypeAlias = tuple[str, tuple[str, ...]]
"""A clip's key, and the methods that have no record of it yet, or not the frames that are to be kept."""


class Fault(NamedTuple):
    """Why a method has no record of a clip. is_refusal: the model takes other views, but not this one."""

    why: str
    is_refusal: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipWork:
    """Measures methods on one clip, keeps the records, and says which failed and why; goes to other processes whole.

    folder: the run's. methods: all, by name. lpips: folder of the weights, or None. views: frames to keep.
    """

    folder: Path
    clips: EvaluationSet
    methods: Mapping[str, Predictor]
    lpips: Path | None = None
    views: KeptViews = "none"

    def __call__(self, item: ClipItem) -> dict[str, Fault]:
        """Raises: DataError where the clip cannot be read, RunError where nothing can be written."""
        key, methods = item
        clip, keeper, views = self.clips.clip(key), RunKeeper(self.folder), self._views(key)
        classes, painted, failed = self.clips.classes, self.clips.painted, dict[str, Fault]()
        lpips = None if self.lpips is None else _opened_lpips(self.lpips)
        for name in methods:
            try:
                prediction, record = predicted_and_measured(
                    self.methods[name], clip, classes=classes, painted=painted, lpips=lpips
                )
                write_views(keeper.views(name, key), clip, prediction, views, classes)
                keeper.keep(record)  # written last: what has a record is whole
            except RunError:
                raise
            except (TrainError, ModelError) as error:
                failed[name] = Fault(str(error), isinstance(error, ViewRangeError))
        return failed

    def missing(self) -> list[ClipItem]:
        """Clips with the methods that have no record of them, or not the frames that are to be kept."""
        keeper, items = RunKeeper(self.folder), list[ClipItem]()
        for key in self.clips.keys:
            views, frames = self._views(key), self.clips.length(key)
            lacking = [
                name
                for name in self.methods
                if not (keeper.has(name, key) and has_views(keeper.views(name, key), views, frames))
            ]
            items += [(key, tuple(lacking))] if lacking else []
        return items

    def _views(self, key: str) -> KeptViews:
        """The frames of a clip that are kept."""
        if self.views == "few":
            return "all" if key in self.clips.keys[:FEW_CLIPS] else "none"
        return self.views


_opened_lpips = lru_cache(maxsize=1)(metrics.Lpips.open)


@dataclass(slots=True)
class Account:
    """How far a run is. there: clips that had all their records before, and all frames that are to be kept.

    measured: clips with a new record. failures: clip, or clip and method, to why. gave_up: stopped before its end, see
    `GIVE_UP_AFTER`.
    """

    clips: int
    there: int = 0
    measured: int = 0
    failures: dict[str, str] = field(default_factory=dict[str, str])
    _tried: int = 0
    _in_a_row: int = 0

    @property
    def done(self) -> int:
        """Clips with an outcome."""
        return self.there + self._tried

    @property
    def gave_up(self) -> bool:
        """Whether too many clips in a row had no record."""
        return self._in_a_row >= GIVE_UP_AFTER

    def add(self, outcome: Outcome[ClipItem, dict[str, Fault]]) -> None:
        """Count one clip. Raises RunError where nothing can be written."""
        self._tried += 1
        key, methods = outcome.item
        try:
            failed = outcome.unwrap()
        except TrainError as error:
            if type(error) is RunError:  # and not an item's own
                raise
            self.failures[key] = str(error)
            self._in_a_row += 1
            return
        self.failures |= {f"{key}, {name}": each.why for name, each in failed.items()}
        if len(failed) < len(methods):
            self.measured += 1
            self._in_a_row = 0
        else:
            self._in_a_row += not all(each.is_refusal for each in failed.values())

    def lines(self) -> list[str]:
        """What to tell at the end: a summary, and one line for each failure."""
        counts = f"clips: {self.measured} measured, {self.there} there already; {len(self.failures)} failures"
        lines = [counts, *(f"  {what}: {why}" for what, why in self.failures.items())]
        if self.gave_up:
            lines.append(f"  gave up after {GIVE_UP_AFTER} clips in a row without a record; the same line goes on")
        return lines


def measure_all(
    work: ClipWork,
    *,
    workers: int = 1,
    ray_address: str | None = None,
    gpus: float = 0.0,
    environments: Sequence[Mapping[str, str]] = (),
) -> Iterator[Account]:
    """Measure every method on every clip that has no record of it; gives the account after every clip, the same object.

    Where frames that are to be kept are missing, the clip is measured again.

    Args:
        workers, ray_address, gpus, environments: see `map_items`.
    Raises:
        DataError: there is nothing to measure. RunError: nothing can be written, or as `map_items`.
    """
    clips = work.clips
    if not clips.keys or clips.frames <= FIRST_MEASURED + 1:
        raise DataError(
            f"evaluation wants a clip of 3 frames or more, got {len(clips.keys)} of {clips.frames}; generate some"
        )
    if workers > 1 or ray_address is not None:
        one_thread_each()
    items = work.missing()
    account = Account(clips=len(clips.keys), there=len(clips.keys) - len(items))
    yield account
    for outcome in map_items(
        work, items, workers=workers, ray_address=ray_address, gpus=gpus, environments=environments
    ):
        account.add(outcome)
        yield account
        if account.gave_up:
            return


def assign_gpus(device: str, count: int) -> tuple[Mapping[str, str], ...]:
    """Environments of workers that see one GPU each, in turn; none where there is no choice.

    Args:
        device: as asked for; one that is named, as `cuda:1` or `cpu`, is every worker's. count: of this process' GPUs.
    """
    if device not in ("auto", "cuda") or count < 2:
        return ()
    given = [name.strip() for name in os.environ.get(_VISIBLE, "").split(",") if name.strip()]
    names = given[:count] if len(given) >= count else [str(number) for number in range(count)]
    return tuple({_VISIBLE: name} for name in names)
