"""An evaluation over processes of this machine or a Ray cluster: clip by clip, what is there already is kept."""

import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

from gcd_model.errors import ModelError
from gcd_train.baselines import Prediction, Predictor
from gcd_train.errors import RunError, TrainError
from gcd_train.evaluation.clips import EvaluationSet, HeldOutClip
from gcd_train.evaluation.keeping import RunKeeper
from gcd_train.evaluation.kept_frames import KeptViews, has_views, write_views
from gcd_train.evaluation.run import predicted_and_measured, require_measurable
from gcd_train.map_items import Outcome, map_items, one_thread_each
from gcd_train.metrics import Lpips

GIVE_UP_AFTER = 5
"""Clips in a row of which nothing could be measured, after which a run stops: something is wrong with all of them."""

Maker: TypeAlias = Callable[[], Predictor]
"""Makes a method where it is to run. It is sent to other processes: a function of a module, or `partial` of one."""

_MADE: dict[tuple[str, str], Predictor] = {}
"""Methods of this process by run and name: weights are opened once, and those of an earlier run are let go."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipItem:
    """One clip, the methods that have no record of it yet, and those that only lack frames that are to be kept."""

    key: str
    methods: tuple[str, ...]
    unseen: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipDone:
    """What became of a clip's methods. drawn: for their frames alone. failed: name to why there is nothing."""

    measured: tuple[str, ...]
    failed: dict[str, str]
    drawn: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipWork:
    """Measures methods on one clip and keeps the records; goes to other processes whole.

    folder: the run's. makers: of all methods, by name. lpips: folder of the weights, or None. views: frames to keep.
    run: names this run within a process.
    """

    folder: Path
    clips: EvaluationSet
    makers: Mapping[str, Maker]
    lpips: Path | None = None
    views: KeptViews = "none"
    run: str = field(default_factory=lambda: uuid.uuid4().hex)

    def __call__(self, item: ClipItem) -> ClipDone:
        """Raises: DataError where the clip cannot be read, RunError where nothing can be written."""
        predictors = {name: self.predictor(name) for name in (*item.methods, *item.unseen)}
        clip = self.clips.clip(item.key)
        failed: dict[str, str] = {}
        for name, predictor in predictors.items():
            try:
                if name in item.methods:
                    self._keep(predictor, clip)
                else:
                    self._show(clip, name, predictor.predict(clip.seen))
            except RunError:
                raise
            except (TrainError, ModelError) as error:
                failed[name] = str(error)
        return ClipDone(
            measured=tuple(name for name in item.methods if name not in failed),
            failed=failed,
            drawn=tuple(name for name in item.unseen if name not in failed),
        )

    def predictor(self, name: str) -> Predictor:
        """The method of that name, made once in each process."""
        for place in [place for place in _MADE if place[0] != self.run]:
            del _MADE[place]
        if (self.run, name) not in _MADE:
            _MADE[self.run, name] = self.makers[name]()
        return _MADE[self.run, name]

    def _keep(self, predictor: Predictor, clip: HeldOutClip) -> None:
        """The record is written last: what has one is whole."""
        lpips = None if self.lpips is None else _opened_lpips(self.lpips)
        prediction, record = predicted_and_measured(predictor, clip, classes=self.clips.classes, lpips=lpips)
        self._show(clip, record.method, prediction)
        RunKeeper(self.folder).keep(record)

    def _show(self, clip: HeldOutClip, method: str, prediction: Prediction) -> None:
        """Keep the frames that are wanted."""
        folder = RunKeeper(self.folder).views(method, clip.key)
        write_views(folder, clip, prediction, self.views, self.clips.classes)


@dataclass(slots=True)
class Account:
    """How a run gets on. there: clips that had all their records before, and all frames that are to be kept.

    measured: clips with a new record. drawn: clips of which only frames were lacking, and now are there. failures:
    clip, or clip and method, to why. done: clips with an outcome. gave_up: stopped before its end, see `GIVE_UP_AFTER`.
    """

    clips: int
    there: int = 0
    measured: int = 0
    drawn: int = 0
    failures: dict[str, str] = field(default_factory=dict[str, str])
    gave_up: bool = False
    exit_code: int = 0
    _tried: int = 0
    _in_a_row: int = 0

    @property
    def done(self) -> int:
        """Clips with an outcome."""
        return self.there + self._tried

    def add(self, outcome: Outcome[ClipItem, ClipDone]) -> None:
        """Count one clip. Raises RunError where nothing can be written."""
        self._tried += 1
        try:
            found = outcome.unwrap()
        except RunError:
            if outcome.kind == RunError.__name__:
                raise
            self._failed({outcome.item.key: outcome.error or "nobody knows why"}, whole=True)
        except TrainError as error:
            self._failed({outcome.item.key: str(error)}, whole=True)
        else:
            faults = {f"{outcome.item.key}, {name}": why for name, why in found.failed.items()}
            self.measured += bool(found.measured)
            self.drawn += bool(found.drawn and not found.measured)
            self._failed(faults, whole=not (found.measured or found.drawn))

    def lines(self) -> list[str]:
        """What to tell at the end: a summary, and one line for each failure."""
        again = f", {self.drawn} drawn again for their frames" if self.drawn else ""
        counts = f"clips: {self.measured} measured, {self.there} there already{again}; {len(self.failures)} failures"
        told = [f"  {what}: {why}" for what, why in self.failures.items()]
        if self.gave_up:
            told.append(f"  gave up after {GIVE_UP_AFTER} clips in a row without a record; the same line goes on")
        return [counts, *told]

    def _failed(self, faults: Mapping[str, str], *, whole: bool) -> None:
        self.failures.update(faults)
        self.exit_code = TrainError.exit_code if self.failures else 0
        self._in_a_row = self._in_a_row + 1 if faults and whole else 0
        self.gave_up = self._in_a_row >= GIVE_UP_AFTER


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
    require_measurable(work.clips)
    if workers > 1 or ray_address is not None:
        one_thread_each()
    items = _missing(work)
    account = Account(clips=len(work.clips.keys), there=len(work.clips.keys) - len(items))
    yield account
    for outcome in map_items(
        work, items, workers=workers, ray_address=ray_address, gpus=gpus, environments=environments
    ):
        account.add(outcome)
        yield account
        if account.gave_up:
            return


def _missing(work: ClipWork) -> list[ClipItem]:
    """Clips with the methods that have no record of them, or not the frames that are to be kept."""
    every = [_item(work, key) for key in work.clips.keys]
    return [item for item in every if item.methods or item.unseen]


def _item(work: ClipWork, key: str) -> ClipItem:
    keeper = RunKeeper(work.folder)
    lacking = tuple(name for name in work.makers if not keeper.has(name, key))
    rest = [name for name in work.makers if name not in lacking]
    unseen = [name for name in rest if not has_views(keeper.views(name, key), work.views, work.clips.frames)]
    return ClipItem(key=key, methods=lacking, unseen=tuple(unseen))


@lru_cache(maxsize=1)
def _opened_lpips(folder: Path) -> Lpips:
    return Lpips.open(folder)
