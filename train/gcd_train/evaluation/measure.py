"""Methods measured on clips: one view against its target as a record, and all clips over processes or a Ray cluster."""

import math
import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import msgspec
import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.config import SemanticClass
from gcd_model.errors import ModelError, NonFiniteError, ShapeError
from gcd_train.errors import DataError, RunError, TrainError
from gcd_train.evaluation import metrics
from gcd_train.evaluation.clips import EvaluationSet, HeldOutClip
from gcd_train.evaluation.galleries import KeptViews, has_rows, has_views, write_rows, write_views
from gcd_train.evaluation.predictors import Prediction, Predictor, to_labels, to_pictures
from gcd_train.evaluation.statistics import FIRST_MEASURED
from gcd_train.evaluation.store import ClipRecord, Counted, Frames, Region, RegionRecord, RunKeeper
from gcd_train.parallel import Outcome, map_items, one_thread_each


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


GIVE_UP_AFTER = 5
"""Clips in a row of which nothing could be measured, after which a run stops: something is wrong with all of them."""

Maker: TypeAlias = Callable[[], Predictor]
"""Makes a method where it is to run. It is sent to other processes: a function of a module, or `partial` of one."""

_MADE: dict[tuple[str, str], Predictor] = {}
"""Methods of this process by run and name: weights are opened once, and those of an earlier run are let go."""
_VISIBLE = "CUDA_VISIBLE_DEVICES"


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipItem:
    """One clip, the methods that have no record of it yet, and those that only lack frames that are to be kept."""

    key: str
    methods: tuple[str, ...]
    unseen: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipDone:
    """What became of a clip's methods. drawn: for their frames alone. failed: name to why there is nothing."""

    measured: tuple[ClipRecord, ...]
    failed: dict[str, str]
    drawn: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipWork:
    """Measures methods on one clip and keeps the records; goes to other processes whole.

    folder: the run's. makers: of all methods, by name. lpips: folder of the weights, or None. views: frames to keep.
    sheet: clips of the contact sheet. run: names this run within a process.
    """

    folder: Path
    clips: EvaluationSet
    makers: Mapping[str, Maker]
    lpips: Path | None = None
    views: KeptViews = "none"
    sheet: tuple[str, ...] = ()
    run: str = field(default_factory=lambda: uuid.uuid4().hex)

    def __call__(self, item: ClipItem) -> ClipDone:
        """Raises: DataError where the clip cannot be read, RunError where nothing can be written."""
        predictors = {name: self._predictor(name) for name in (*item.methods, *item.unseen)}
        clip, measured, drawn = self.clips.clip(item.key), list[ClipRecord](), list[str]()
        keeper, classes, failed = RunKeeper(self.folder), self.clips.classes, dict[str, str]()
        lpips = None if self.lpips is None else _opened_lpips(self.lpips)
        for name, predictor in predictors.items():
            try:
                if name in item.methods:
                    prediction, record = predicted_and_measured(predictor, clip, classes=classes, lpips=lpips)
                else:
                    prediction, record = predictor.predict(clip.seen), None
                write_views(keeper.views(name, clip.key), clip, prediction, self.views, classes)
                if clip.key in self.sheet:
                    write_rows(keeper.sheet_rows(name, clip.key), prediction, classes)
                if record is None:
                    drawn.append(name)
                else:  # written last: what has a record is whole
                    keeper.keep(record)
                    measured.append(record)
            except RunError:
                raise
            except (TrainError, ModelError) as error:
                failed[name] = str(error)
        return ClipDone(measured=tuple(measured), failed=failed, drawn=tuple(drawn))

    def missing(self) -> list[ClipItem]:
        """Clips with the methods that have no record of them, or not the frames that are to be kept."""
        keeper, items = RunKeeper(self.folder), list[ClipItem]()
        for key in self.clips.keys:
            lacking = tuple(name for name in self.makers if not keeper.has(name, key))
            others = [name for name in self.makers if name not in lacking]
            unseen = tuple(name for name in others if not self._has_frames(keeper, name, key))
            items += [ClipItem(key=key, methods=lacking, unseen=unseen)] if lacking or unseen else []
        return items

    def _has_frames(self, keeper: RunKeeper, name: str, key: str) -> bool:
        if not has_views(keeper.views(name, key), self.views, self.clips.frames):
            return False
        return key not in self.sheet or has_rows(keeper.sheet_rows(name, key), keeper.read(name, key))

    def _predictor(self, name: str) -> Predictor:
        """The method of that name, made once in each process."""
        for place in [place for place in _MADE if place[0] != self.run]:
            del _MADE[place]
        if (self.run, name) not in _MADE:
            _MADE[self.run, name] = self.makers[name]()
        return _MADE[self.run, name]


_opened_lpips = lru_cache(maxsize=1)(metrics.Lpips.open)


@dataclass(slots=True)
class Account:
    """How far a run is. there: clips that had all their records before, and all frames that are to be kept.

    measured: clips with a new record. drawn: clips of which only frames were lacking, and now are there. failures:
    clip, or clip and method, to why. gave_up: stopped before its end, see `GIVE_UP_AFTER`.
    """

    clips: int
    there: int = 0
    measured: int = 0
    drawn: int = 0
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

    def add(self, outcome: Outcome[ClipItem, ClipDone]) -> None:
        """Count one clip. Raises RunError where nothing can be written."""
        self._tried += 1
        key, useful, faults = outcome.item.key, False, dict[str, str]()
        try:
            found = outcome.unwrap()
        except TrainError as error:
            if type(error) is RunError:  # and not an item's own
                raise
            faults = {key: str(error)}
        else:
            faults = {f"{key}, {name}": why for name, why in found.failed.items()}
            useful = bool(found.measured or found.drawn)
            self.measured += bool(found.measured)
            self.drawn += bool(found.drawn and not found.measured)
        self.failures |= faults
        self._in_a_row = self._in_a_row + 1 if faults and not useful else 0

    def lines(self) -> list[str]:
        """What to tell at the end: a summary, and one line for each failure."""
        again = f", {self.drawn} drawn again for their frames" if self.drawn else ""
        counts = f"clips: {self.measured} measured, {self.there} there already{again}; {len(self.failures)} failures"
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

    Where only frames that are to be kept are missing, they are drawn again and the record stays as it is.

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
