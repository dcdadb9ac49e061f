"""Work on a GPU recorded once and replayed with one call: no Python and no allocation between its kernels."""

from collections import OrderedDict
from collections.abc import Callable, Generator, Hashable
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor

Kept = TypeVar("Kept")
Replay = Callable[[], None]
"""Does the recorded work again, on the same memory."""

_WARM_RUNS = 2  # the first compiles and lets cuDNN choose, the second shows that neither is left to do
_SHAPES = 4


class Recorder(Protocol):
    """Whatever can turn work into a replay.

    The work reads and writes memory that stays where it is, and never asks what a tensor holds. Recording runs it at
    least once.
    """

    def record(self, work: Replay) -> Replay:
        """The work, ready to be done again and again. Raises torch.OutOfMemoryError."""
        ...

    def forget(self) -> None:
        """What was recorded is used no more."""
        ...


class Unrecorded:
    """Implements Recorder: does the work anew each time. On a CPU, and where graphs are not wanted."""

    def record(self, work: Replay) -> Replay:
        """See Recorder."""
        work()
        return work

    def forget(self) -> None:
        """See Recorder."""


class CudaGraphs:
    """Implements Recorder by CUDA graphs.

    All share one pool of memory, so that together they take as much as the largest: what a graph leaves in the pool
    must be copied out before another is replayed. Other threads may use the device meanwhile.
    """

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()

    def record(self, work: Replay) -> Replay:
        """See Recorder."""
        graph = torch.cuda.CUDAGraph()
        with _choosing_convolutions():
            _warm(work)
            try:
                with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
                    work()
            except RuntimeError as error:  # ending a broken capture raises, too, and hides why it broke
                if isinstance(error.__context__, torch.OutOfMemoryError):
                    raise error.__context__ from None
                raise
        return graph.replay

    def forget(self) -> None:
        """See Recorder. A pool without graphs gives its memory back."""
        self._pool = torch.cuda.graph_pool_handle()


@contextmanager
def _choosing_convolutions() -> Generator[None]:
    """cuDNN tries its ways of convolving and takes the fastest: worth it for what is done again and again."""
    before = torch.backends.cudnn.benchmark
    torch.backends.cudnn.benchmark = True
    try:
        yield
    finally:
        torch.backends.cudnn.benchmark = before


def _warm(work: Replay) -> None:
    """On a stream of its own, as captures demand."""
    side, main = torch.cuda.Stream(), torch.cuda.current_stream()
    side.wait_stream(main)
    with torch.cuda.stream(side):
        for _ in range(_WARM_RUNS):
            work()
    main.wait_stream(side)


class Recent(Generic[Kept]):
    """The things last used, by key: what is made for one shape of batch is kept for a few of them."""

    def __init__(self, limit: int = _SHAPES) -> None:
        self._limit = limit
        self._kept: OrderedDict[Hashable, Kept] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Kept]) -> Kept:
        """The one of this key, made where there is none; the one that was not used for longest makes room."""
        if key not in self._kept:
            while len(self._kept) >= self._limit:
                self._kept.popitem(last=False)
            self._kept[key] = make()
        self._kept.move_to_end(key)
        return self._kept[key]

    def clear(self) -> None:
        """Keep nothing."""
        self._kept.clear()

    def __len__(self) -> int:
        return len(self._kept)


@dataclass(frozen=True, slots=True)
class _Recording:
    given: Tensor
    made: Tensor
    replay: Replay


class RecordedCall:
    """A function of one tensor, recorded for every shape it is given. What it returns is the caller's own."""

    def __init__(self, work: Callable[[Tensor], Tensor], recorder: Recorder) -> None:
        self._work, self._recorder = work, recorder
        self._recordings: Recent[_Recording] = Recent()

    def __call__(self, given: Tensor) -> Tensor:
        """The function of `given`, on its device and in its precision."""
        recording = self._recordings.get(tuple(given.shape), lambda: self._record(given))
        recording.given.copy_(given)
        recording.replay()
        return recording.made.clone()

    def forget(self) -> None:
        """Drop what was recorded."""
        self._recordings.clear()

    def _record(self, given: Tensor) -> _Recording:
        steady = given.clone()
        made = torch.empty_like(self._work(steady))  # lies outside the pool of the graphs

        def run() -> None:
            made.copy_(self._work(steady))

        return _Recording(given=steady, made=made, replay=self._recorder.record(run))


class Pace:
    """Lets the host wait for a step, so that it neither runs ahead of a wish to stop nor reports what is not done.

    Waits for an event, which the device does not notice; on a CPU work is done when the call returns.
    """

    def __init__(self, device: torch.device) -> None:
        self._done = torch.cuda.Event(blocking=True) if device.type == "cuda" else None

    def wait(self) -> None:
        """Until all that was queued is done."""
        if self._done is not None:
            self._done.record()
            self._done.synchronize()
