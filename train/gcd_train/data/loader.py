"""Samples by number, made ahead by other processes, in an order that a resumed run finds again."""

import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count, islice
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


class SampleLoader:
    """Batches by number; those that follow are made ahead.

    turns, parts: of an update's `parts` batches this process computes those of these numbers, see `Processes.batches`.
    Worker processes are spawned, not forked: a fork would share OpenGL's and torch's state.
    """

    def __init__(
        self, samples: Samples, seed: int, recipe: LoaderRecipe, turns: Sequence[int] = (0,), parts: int = 1
    ) -> None:
        self._samples, self._recipe, self._turns, self._parts = samples, recipe, turns, parts
        self._order = SampleOrder(len(samples), seed)
        self._count = 0
        self._expected: Iterator[int] = iter(())
        self._batches: Iterator[SampleBatch | TrainError] = iter(())

    def batch(self, number: int, count: int) -> tuple[SampleBatch, list[int]]:
        """Batch `number` of `count` samples, and their numbers.

        Raises: as `Samples.sample`; RunError if a process was killed.
        """
        if count != self._count or number != next(self._expected):
            self._start(number, count)
        batch = self._following()
        if self._recipe.workers:  # each worker has its own account
            self._samples.skips.extend(skipped for sample in batch.samples for skipped in sample.skipped)
        return batch, self._order.batch(number, count)

    def _following(self) -> SampleBatch:
        try:
            samples = next(self._batches)
        except RuntimeError as error:  # what torch makes of a process that is gone
            raise RunError(
                f"a process that makes samples was killed, most likely for want of memory ({error}); give fewer "
                "data.loader.workers, or more room in /dev/shm, and run again"
            ) from error
        if isinstance(samples, TrainError):
            raise samples
        return samples

    def _start(self, number: int, count: int) -> None:
        """From this number on, in this process's turns."""
        self._count = count
        self._expected, numbers = islice(self._from(number), 1, None), self._from(number)
        if self._recipe.workers:
            self._batches = iter(self._loader(numbers))
        else:
            ahead = (self._order.batch(each, count) for each in numbers)
            self._batches = (collate([self._samples.sample(index) for index in batch]) for batch in ahead)

    def _from(self, number: int) -> Iterator[int]:
        update, part = divmod(number, self._parts)
        first = self._turns.index(part) if part in self._turns else 0
        yield from (update * self._parts + turn for turn in self._turns[first:])
        for later in count(update + 1):
            yield from (later * self._parts + turn for turn in self._turns)

    def _loader(self, numbers: Iterator[int]) -> DataLoader[Sample | TrainError]:
        recipe, size = self._recipe, self._count
        order = SampleOrder(self._order.length, self._order.seed)  # read ahead, so not the one that is looked up
        return DataLoader(
            _Numbered(self._samples),
            batch_sampler=(order.batch(number, size) for number in numbers),
            num_workers=recipe.workers,
            collate_fn=_collated,
            pin_memory=torch.cuda.is_available(),
            multiprocessing_context=get_context("spawn"),
            worker_init_fn=_settle,
        )


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
