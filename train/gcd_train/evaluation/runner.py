"""An evaluation over processes of this machine or a Ray cluster: clip by clip, what is there already is kept."""

import os
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

from gcd_model.errors import ModelError
from gcd_train.errors import DataError, RunError, TrainError
from gcd_train.evaluation.clips import EvaluationSet, HeldOutClip
from gcd_train.evaluation.galleries import KeptViews, has_rows, has_views, write_rows, write_views
from gcd_train.evaluation.lpips import Lpips
from gcd_train.evaluation.measure import predicted_and_measured
from gcd_train.evaluation.predictors import Prediction, Predictor
from gcd_train.evaluation.statistics import FIRST_MEASURED
from gcd_train.evaluation.store import ClipRecord, RunKeeper
from gcd_train.parallel import Outcome, map_items, one_thread_each

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
        failed: dict[str, str] = {}
        for name, predictor in predictors.items():
            try:
                if name in item.methods:
                    measured.append(self._measured(predictor, clip))
                else:
                    self._keep_frames(clip, name, predictor.predict(clip.seen))
                    drawn.append(name)
            except RunError:
                raise
            except (TrainError, ModelError) as error:
                failed[name] = str(error)
        return ClipDone(measured=tuple(measured), failed=failed, drawn=tuple(drawn))

    def missing(self) -> list[ClipItem]:
        """Clips with the methods that have no record of them, or not the frames that are to be kept."""
        items = [self._missing(key) for key in self.clips.keys]
        return [item for item in items if item.methods or item.unseen]

    def _missing(self, key: str) -> ClipItem:
        keeper = RunKeeper(self.folder)
        lacking = tuple(name for name in self.makers if not keeper.has(name, key))
        unseen = [
            name
            for name in self.makers
            if name not in lacking
            and not (
                has_views(keeper.views(name, key), self.views, self.clips.frames)
                and (key not in self.sheet or has_rows(keeper.sheet_rows(name, key), keeper.read(name, key)))
            )
        ]
        return ClipItem(key=key, methods=lacking, unseen=tuple(unseen))

    def _predictor(self, name: str) -> Predictor:
        """The method of that name, made once in each process."""
        for place in [place for place in _MADE if place[0] != self.run]:
            del _MADE[place]
        if (self.run, name) not in _MADE:
            _MADE[self.run, name] = self.makers[name]()
        return _MADE[self.run, name]

    def _measured(self, predictor: Predictor, clip: HeldOutClip) -> ClipRecord:
        """The record is written last: what has one is whole."""
        lpips = None if self.lpips is None else _opened_lpips(self.lpips)
        prediction, record = predicted_and_measured(predictor, clip, classes=self.clips.classes, lpips=lpips)
        self._keep_frames(clip, record.method, prediction)
        RunKeeper(self.folder).keep(record)
        return record

    def _keep_frames(self, clip: HeldOutClip, method: str, prediction: Prediction) -> None:
        keeper = RunKeeper(self.folder)
        write_views(keeper.views(method, clip.key), clip, prediction, self.views, self.clips.classes)
        if clip.key in self.sheet:
            write_rows(keeper.sheet_rows(method, clip.key), prediction, self.clips.classes)


@lru_cache(maxsize=1)
def _opened_lpips(folder: Path) -> Lpips:
    return Lpips.open(folder)


@dataclass(slots=True)
class Account:
    """How far a run is. there: clips that had all their records before, and all frames that are to be kept.

    measured: clips with a new record. drawn: clips of which only frames were lacking, and now are there. failures:
    clip, or clip and method, to why. gave_up: stopped before its end, see `GIVE_UP_AFTER`. records: the new ones, by
    method and key.
    """

    clips: int
    there: int = 0
    measured: int = 0
    drawn: int = 0
    failures: dict[str, str] = field(default_factory=dict[str, str])
    records: dict[tuple[str, str], ClipRecord] = field(default_factory=dict[tuple[str, str], ClipRecord])
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

    def failed(self) -> tuple[str, ...]:
        """For each method that failed on clips, on how many and why the first time; all of them for clips that could
        not be read."""
        reasons: dict[str, list[str]] = {}
        for what, why in self.failures.items():
            reasons.setdefault(what.partition(", ")[2] or "every method", []).append(why)
        return tuple(f"{name} on {len(each)} of {self.clips} clips ({each[0]})" for name, each in reasons.items())

    @property
    def exit_code(self) -> int:
        """Of the command."""
        return TrainError.exit_code if self.failures else 0

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
            self.records |= {(record.method, key): record for record in found.measured}
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
