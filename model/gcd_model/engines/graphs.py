"""Work on a GPU recorded once and replayed with one call: no Python and no allocation between its kernels."""

from collections import OrderedDict
from collections.abc import Callable, Generator, Hashable
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor

from gcd_model.conditioning import Conditioning
from gcd_model.diffusion import Backbone, Schedule, denoised, preconditioning
from gcd_model.unet import StageInputs, UNetPlan

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
        """See Recorder. A pool without graphs gives its memory back."""
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


# --- a whole denoising step, in memory that stays where it is --------------------------------------------------------


Update = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""`solved`, as it is or compiled."""


def step_numbers(schedule: Schedule) -> Tensor:
    """What a step multiplies with, float64 [S, 6]: c_in, c_out, c_skip, keep, rest, before.

    keep, rest and before are the solver's: x <- D + keep * (x - D) + rest * D + before * (D of the step before).
    """
    levels = preconditioning(schedule.sigmas[:-1], schedule.prediction)
    solver = [[step.keep, step.new + step.keep - 1.0, step.before] for step in schedule.steps]
    made = torch.stack([levels.c_in, levels.c_out, levels.c_skip], dim=1)
    return torch.cat([made, torch.tensor(solver, dtype=torch.float64)], dim=1)


def solved(x: Tensor, before: Tensor, raw: Tensor, numbers: Tensor, guidance: Tensor) -> tuple[Tensor, Tensor]:
    """What follows the network in a step: preconditioning, guidance, solver.

    Args:
        x, before: [K, T, C, h, w], float32. raw: [R, K, T, C, h, w], what the network said, R = 2 with guidance.
        numbers: [6], one row of `step_numbers`. guidance: [T].
    Returns:
        The next x, and D of this step.
    """
    _, c_out, c_skip, keep, rest, early = numbers.unbind()
    clean = denoised(x, raw, c_skip, c_out, guidance)
    return torch.lerp(clean, x, keep) + rest * clean + early * before, clean


class PlanMemory:
    """What the stages of the U-Net are given, in memory that stays where it is."""

    def __init__(self, plan: UNetPlan) -> None:
        """plan: any one of this batch's shape."""
        self._plan = plan
        self._spatial, self._temporal = plan.spatial_embedding[0].clone(), plan.temporal_embedding[0].clone()
        self._crosses = [None if each is None else each.clone() for each in (plan.spatial_cross, plan.temporal_cross)]

    def load(self, plan: UNetPlan) -> None:
        """From now on this plan, of the same shape but for its number of steps, counts."""
        self._plan = plan
        for memory, cross in zip(self._crosses, (plan.spatial_cross, plan.temporal_cross), strict=True):
            if memory is not None and cross is not None:
                memory.copy_(cross)

    def seek(self, step: int) -> None:
        """The embeddings of this step."""
        self._spatial.copy_(self._plan.spatial_embedding[step])
        self._temporal.copy_(self._plan.temporal_embedding[step])

    def inputs(self, branches: int, given: int) -> StageInputs:
        """Of as many branches as a step computes. given: those there are; the conditional one comes last."""
        crosses = (None if each is None else _last(each, branches, given) for each in self._crosses)
        return StageInputs(self._spatial.repeat(branches, 1), self._temporal.repeat(branches, 1), *crosses)


def _last(rows: Tensor, branches: int, given: int) -> Tensor:
    """Of rows of `given` branches those of the last `branches`."""
    return rows[len(rows) // given * (given - branches) :]


class StepMemory:
    """All that a step reads and writes, for batches of one shape, and the steps recorded on it."""

    def __init__(
        self, backbone: Backbone, update: Update, start: Tensor, given: Conditioning, schedule: Schedule
    ) -> None:
        self._backbone, self._update, self._branches = backbone, update, given.branches
        self._x, self._before = torch.empty_like(start), torch.empty_like(start)
        self._condition = torch.empty_like(given.latents)
        self._guidance = start.new_empty(len(schedule.guidance))
        self._table = start.new_empty(0)
        self._numbers = start.new_empty(step_numbers(schedule).shape[1])
        self._plan: PlanMemory | None = None
        self._replays: dict[int, Replay] = {}

    def begin(self, start: Tensor, given: Conditioning, schedule: Schedule) -> None:
        """Load a batch."""
        labels = preconditioning(schedule.sigmas[:-1], schedule.prediction).c_noise.float()
        plan = self._backbone.plan(labels, given)
        if self._plan is None:
            self._plan = PlanMemory(plan)
        self._plan.load(plan)
        self._table = step_numbers(schedule).to(self._x)
        self._x.copy_(start)
        self._before.copy_(start)
        self._condition.copy_(given.latents)
        self._guidance.copy_(schedule.guidance)

    def record(self, branches: set[int], recorder: Recorder) -> bool:
        """Record what is missing of steps of so many branches; then a batch that was loaded must be loaded again.
        Whether anything was."""
        missing = [each for each in branches if each not in self._replays]
        for each in missing:
            self.seek(0)
            self._replays[each] = recorder.record(lambda each=each: self._advance(each))
        return bool(missing)

    def seek(self, step: int) -> None:
        """Bring what this step needs."""
        assert self._plan is not None, "begin() comes first"
        self._numbers.copy_(self._table[step])
        self._plan.seek(step)

    def advance(self, branches: int) -> None:
        """Do the step."""
        self._replays[branches]()

    def result(self) -> Tensor:
        """Latents, a copy."""
        return self._x.clone()

    def _advance(self, branches: int) -> None:
        raw = self._network(branches).unflatten(0, (branches, *self._x.shape[:2]))
        after, denoised = self._update(self._x, self._before, raw, self._numbers, self._guidance)
        self._x.copy_(after)
        self._before.copy_(denoised)

    def _network(self, branches: int) -> Tensor:
        assert self._plan is not None, "begin() comes first"
        rows = (self._x * self._numbers[0]).flatten(0, 1).repeat(branches, 1, 1, 1)
        condition = _last(self._condition, branches, self._branches)
        inputs = self._plan.inputs(branches, self._branches)
        return self._backbone.predict(rows, condition, inputs)
