"""Samples by number, made ahead by other processes, in an order that a resumed run finds again."""

import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, cycle
from multiprocessing import get_context

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from gcd_train.data.sample import Sample, SampleBatch, Samples, collate
from gcd_train.errors import RunError, TrainError
from gcd_train.parallel import one_thread_each
from gcd_train.recipe_data import LoaderRecipe


@dataclass(slots=True)
class SampleOrder:
    """Which samples a batch takes: of all samples in an order shuffled by the seed, then of all again in another.

    Batch n of `count` clips takes the places n * count and on, so a batch follows from its number alone.
    """

    length: int
    seed: int
    _round: int = -1
    _places: Sequence[int] = ()

    def batch(self, number: int, count: int) -> list[int]:
        """Numbers of the samples."""
        return [self._at(place) for place in range(number * count, (number + 1) * count)]

    def _at(self, place: int) -> int:
        round_, within = divmod(place, self.length)
        if round_ != self._round:
            self._round = round_
            self._places = np.random.default_rng((self.seed, round_)).permutation(self.length).tolist()
        return round_ * self.length + self._places[within]


@dataclass(frozen=True, slots=True)
class LoadedBatch:
    """Samples, their numbers, and how long they were waited for."""

    samples: SampleBatch
    numbers: tuple[int, ...]
    wait_s: float


_LONGEST = 64  # steps of a process from batch to batch within one update


class SampleLoader:
    """Batches by number. Those that follow are made ahead, as long as the steps from number to number repeat.

    Worker processes are spawned, not forked: a fork would share OpenGL's and torch's state.
    """

    def __init__(self, samples: Samples, seed: int, recipe: LoaderRecipe) -> None:
        self._samples, self._recipe = samples, recipe
        self._order = SampleOrder(len(samples), seed)
        self._count, self._last, self._steps = 0, 0, list[int]()
        self._numbers: Iterator[int] = iter(())
        self._batches: Iterator[SampleBatch | TrainError] | None = None

    def batch(self, number: int, count: int) -> LoadedBatch:
        """Batch `number` of `count` samples. Raises: as `Samples.sample`; RunError if a process was killed."""
        started = time.perf_counter()
        if len(self._steps) <= _LONGEST:
            self._steps.append(number - self._last)
        if self._batches is None or count != self._count or number != next(self._numbers):
            self._start(number, count)
        assert self._batches is not None, "just started"
        samples, self._last = self._following(self._batches), number
        if self._recipe.workers:
            self._samples.skips.extend(samples.skipped)  # each worker has its own account
        numbers = tuple(self._order.batch(number, count))
        return LoadedBatch(samples, numbers, time.perf_counter() - started)

    def _following(self, batches: "Iterator[SampleBatch | TrainError]") -> SampleBatch:
        try:
            samples = next(batches)
        except RuntimeError as error:  # what torch makes of a process that is gone
            raise RunError(
                f"a process that makes samples was killed, most likely for want of memory ({error}); give fewer "
                "data.loader.workers, or more room in /dev/shm, and run again"
            ) from error
        if isinstance(samples, TrainError):
            raise samples
        return samples

    def _start(self, number: int, count: int) -> None:
        """From this number on, in the steps that were taken so far: processes of a group take turns, if need be
        unevenly, and an update's steps are those of the one before. Later, or backwards, it is a jump."""
        known = self._batches is not None and count == self._count and number >= self._last
        if not known or len(self._steps) > _LONGEST:
            self._steps = []
        steps, self._count = tuple(self._steps) or (1,), count
        self._numbers, numbers = _numbered(number + steps[0], (*steps[1:], steps[0])), _numbered(number, steps)
        self._batches = iter(self._loader(numbers)) if self._recipe.workers else self._here(numbers)

    def _here(self, numbers: Iterator[int]) -> Iterator[SampleBatch | TrainError]:
        for number in numbers:
            yield collate([self._samples.sample(index) for index in self._order.batch(number, self._count)])

    def _loader(self, numbers: Iterator[int]) -> DataLoader[Sample | TrainError]:
        recipe, count = self._recipe, self._count
        order = SampleOrder(self._order.length, self._order.seed)  # read ahead, so not the one that is looked up
        return DataLoader(
            _Numbered(self._samples),
            batch_sampler=(order.batch(number, count) for number in numbers),
            num_workers=recipe.workers,
            prefetch_factor=recipe.prefetch,
            collate_fn=_collated,
            pin_memory=recipe.pin and torch.cuda.is_available(),
            multiprocessing_context=get_context("spawn"),
            worker_init_fn=_settle,
        )


def _numbered(first: int, steps: Sequence[int]) -> Iterator[int]:
    """`first`, then on and on by the steps in turn."""
    return accumulate(cycle(steps), initial=first)


class _Numbered(Dataset[Sample | TrainError]):
    """Samples as torch's loader takes them; an error is handed over as it is, torch would bury it in a trace."""

    def __init__(self, samples: Samples) -> None:
        self._samples = samples

    def __getitem__(self, index: int) -> Sample | TrainError:
        try:
            return self._samples.sample(index)
        except TrainError as error:
            return error


def _collated(samples: list[Sample | TrainError]) -> SampleBatch | TrainError:
    failed = [sample for sample in samples if isinstance(sample, TrainError)]
    return failed[0] if failed else collate([sample for sample in samples if isinstance(sample, Sample)])


def _settle(_worker: int) -> None:
    """In a new process: one thread; Ctrl-C is for the main process, which finishes its update and saves."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    one_thread_each()
    cv2.setNumThreads(1)
