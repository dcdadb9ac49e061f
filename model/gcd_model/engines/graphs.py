"""Work on a GPU recorded once and replayed with one call: no Python and no allocation between its kernels."""

from collections.abc import Callable, Generator, Hashable
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor

from gcd_model.conditioning import Conditioning
from gcd_model.diffusion import Backbone, GuidedDenoiser, Schedule, StepInputs, advanced, denoised, evaluated

Kept = TypeVar("Kept")
Replay = Callable[[], object]
"""Does the recorded work again, on the same memory."""

_WARM_RUNS = 2  # the first compiles and lets cuDNN choose, the second shows that neither is left to do
_SHAPES = 16  # of all kinds of work together: a step guided or not, encoders, decoder


class Recorder:
    """What turns work into a replay: this one does the work anew each time, for a CPU and where graphs are not wanted.

    The work reads and writes memory that stays where it is, and never asks what a tensor holds.
    """

    def record(self, work: Replay) -> Replay:
        """The work, done at least once, ready to be done again and again. Raises torch.OutOfMemoryError."""
        work()
        return work

    def forget(self) -> None:
        """What was recorded is used no more."""


class CudaGraphs(Recorder):
    """Records CUDA graphs.

    All share one pool of memory, so that together they take as much as the largest: what a graph leaves in the pool
    must be copied out before another is replayed. Other threads may use the device meanwhile.
    """

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()

    def record(self, work: Replay) -> Replay:
        graph, side = torch.cuda.CUDAGraph(), torch.cuda.Stream()
        with _choosing_convolutions():
            _warm(work, side)
            try:
                with (
                    torch.compiler.set_stance("fail_on_recompile"),  # a compiler at work would be recorded, too
                    torch.cuda.graph(graph, pool=self._pool, stream=side, capture_error_mode="thread_local"),
                ):
                    work()
            except RuntimeError as error:  # ending a broken capture raises, too, and hides why it broke
                if isinstance(error.__context__, torch.OutOfMemoryError):
                    raise error.__context__ from None
                raise
        return graph.replay

    def forget(self) -> None:
        """A pool without graphs gives its memory back."""
        self._pool = torch.cuda.graph_pool_handle()


@contextmanager
def _choosing_convolutions() -> Generator[None]:
    """cuDNN tries its ways of convolving and takes the fastest: worth it for what is done again and again. Not where
    results must be the same in every run."""
    before = torch.backends.cudnn.benchmark
    torch.backends.cudnn.benchmark = not torch.backends.cudnn.deterministic
    try:
        yield
    finally:
        torch.backends.cudnn.benchmark = before


def _warm(work: Replay, side: torch.cuda.Stream) -> None:
    """On the stream of the capture that follows: compiled code may ask which one it is on."""
    main = torch.cuda.current_stream()
    side.wait_stream(main)
    with torch.cuda.stream(side):
        for _ in range(_WARM_RUNS):
            work()
    main.wait_stream(side)


def recent(kept: dict[Hashable, Kept], key: Hashable, make: Callable[[], Kept], limit: int = _SHAPES) -> Kept:
    """What is kept of this key, made where there is none; beyond the limit the one not used for longest goes."""
    if key not in kept:
        while len(kept) >= limit:
            del kept[next(iter(kept))]
        kept[key] = make()
    kept[key] = kept.pop(key)  # the last one is the one last used
    return kept[key]


class RecordedCall:
    """A function of one tensor, recorded for the shape of `given`. What it returns is the caller's own."""

    def __init__(self, work: Callable[[Tensor], Tensor], given: Tensor, recorder: Recorder) -> None:
        self._given = given.clone()
        self._made = torch.empty_like(work(self._given))  # lies outside the pool of the graphs
        self._replay = recorder.record(lambda: self._made.copy_(work(self._given)))

    def __call__(self, given: Tensor) -> Tensor:
        """The function of `given`, on its device and in its precision."""
        self._given.copy_(given)
        self._replay()
        return self._made.clone()


# --- a whole denoising step, in memory that stays where it is --------------------------------------------------------


Update = Callable[[Tensor, Tensor, Tensor, StepInputs], tuple[Tensor, Tensor]]
"""`solved`, as it is or compiled."""


def solved(x: Tensor, before: Tensor, raw: Tensor, inputs: StepInputs) -> tuple[Tensor, Tensor]:
    """What follows the network in a step: preconditioning, guidance, solver.

    Args:
        x, before: [K, T, C, h, w], float32. raw: [R, K, T, C, h, w], what the network said, R = 2 with guidance.
    Returns:
        The next x, and D of this step.
    """
    *_, keep, gain = inputs.numbers.unbind()
    clean = denoised(x, raw, inputs)
    return advanced(x, clean, before, keep, gain), clean


class StepMemory:
    """All that a step reads and writes, for batches of one shape, and the steps recorded on it. x: the latents."""

    def __init__(
        self, backbone: Backbone, update: Update, start: Tensor, given: Conditioning, schedule: Schedule
    ) -> None:
        self._backbone, self._update = backbone, update
        self.x, self._before = start.clone(), start.clone()
        self._denoiser = GuidedDenoiser(backbone, given, schedule, start)
        self._inputs = StepInputs._make(each if each is None else each.clone() for each in self._denoiser.inputs(0))
        self._replays: dict[int, Replay] = {}

    def load(self, start: Tensor, given: Conditioning, schedule: Schedule) -> None:
        """A batch takes the place of the one before."""
        self._denoiser = GuidedDenoiser(self._backbone, given, schedule, start)
        self.x.copy_(start)
        self._before.copy_(start)

    def record(self, branches: set[int], recorder: Recorder) -> bool:
        """Record what is missing of steps of so many branches; then a batch that was loaded must be loaded again.
        Whether anything was."""
        missing = branches - self._replays.keys()
        for each in missing:
            self._seek(0)
            self._replays[each] = recorder.record(lambda each=each: self._advance(each))
        return bool(missing)

    def step(self, number: int, branches: int) -> None:
        """Do a step of the schedule."""
        self._seek(number)
        self._replays[branches]()

    def _seek(self, step: int) -> None:
        for memory, value in zip(self._inputs, self._denoiser.inputs(step), strict=True):
            if memory is not None and value is not None:
                memory.copy_(value)

    def _advance(self, branches: int) -> None:
        raw = evaluated(self._backbone, self.x, self._inputs, branches)
        after, clean = self._update(self.x, self._before, raw, self._inputs)
        self.x.copy_(after)
        self._before.copy_(clean)
