"""The processes of one run: started by `torchrun`, one for each device, or just this one."""

import os
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, nullcontext
from datetime import timedelta
from statistics import fmean as mean

import torch
import torch.distributed as dist
from torch.distributed.distributed_c10d import PrefixStore, ProcessGroup, Store
from torch.distributed.rendezvous import rendezvous

from gcd_train.errors import Interrupted, RecipeError, TrainError
from gcd_train.recipe import ComputeRecipe
from gcd_train.stop import StopSignal

_POLL_S = 0.2


class Processes:
    """This process among those of its run.

    rank: its number, 0 for the one that writes. count: how many there are. control, saving: groups that carry small
    CPU tensors and states (gloo), whatever carries the gradients; None for one process that nobody started as several.
    """

    def __init__(
        self,
        rank: int = 0,
        count: int = 1,
        store: Store | None = None,
        control: ProcessGroup | None = None,
        saving: ProcessGroup | None = None,
    ) -> None:
        self.rank, self.count = rank, count
        self.control, self.saving = control, saving
        self._store, self._calls = store, 0

    @property
    def first(self) -> bool:
        """Whether this process writes logs, samples and weights."""
        return self.rank == 0

    @property
    def several(self) -> bool:
        """Whether `torchrun` started this process, be it as the only one."""
        return self.control is not None

    def batches(self, parts: int) -> range:
        """Which of an update's `parts` batches this process computes; every batch draws as it would in one process.

        Raises RecipeError if they cannot be shared equally.
        """
        if parts % self.count:
            raise RecipeError(
                f"an update of {parts} batches cannot be shared by {self.count} processes: start a number of processes "
                f"that divides {parts}, or give unet.batch and a smaller unet.clip_batch"
            )
        return range(self.rank, parts, self.count)

    def agreed(self, now: float, seconds: float, stop: bool) -> tuple[float, float, bool]:
        """The first process's clock and training time, and whether any process was asked to stop.

        Raises TrainError if another process is gone.
        """
        if self.control is None:
            return now, seconds, stop
        said = torch.tensor([now, seconds, 0.0] if self.first else [-torch.inf] * 3, dtype=torch.float64)
        said[2] = float(stop)
        with self.others_gone():
            dist.all_reduce(said, dist.ReduceOp.MAX, group=self.control)
        return float(said[0]), float(said[1]), bool(said[2])

    def averaged(self, values: dict[str, float]) -> dict[str, float]:
        """The mean of every value over the processes that give it. Raises TrainError as `agreed`."""
        if self.control is None:
            return values
        given = [dict[str, float]() for _ in range(self.count)]
        with self.others_gone():
            dist.all_gather_object(given, values, group=self.control)
        names = {name: None for each in given for name in each}
        return {name: mean(each[name] for each in given if name in each) for name in names}

    def told(self, value: object) -> object:
        """What the first process gives here, in every process. Raises TrainError as `agreed`."""
        if self.control is None:
            return value
        holder = [value]
        with self.others_gone():
            dist.broadcast_object_list(holder, src=0, group=self.control)
        return holder[0]

    def by_the_first(self, work: Callable[[], None], stop: StopSignal) -> None:
        """Let the first process do something that may take hours, while the others wait.

        Raises Interrupted in a waiting process that was asked to stop, TrainError if the first one is gone.
        """
        self._calls += 1
        key = f"gcd-train/{self._calls}"
        if self.first:
            work()
        if self._store is None:
            return
        with self.others_gone():
            if self.first:
                self._store.set(key, "done")
            while not self._store.check([key]):
                if stop.is_set():
                    raise Interrupted("stopped while the first process was at work; run again to go on")
                time.sleep(_POLL_S)

    @contextmanager
    def others_gone(self) -> Generator[None]:
        """Errors of communication inside the block become a TrainError that says so."""
        if self.control is None:
            yield
            return
        try:
            yield
        except RuntimeError as error:  # torch raises its DistError, or a plain one from gloo
            if not isinstance(error, dist.DistError) and "gloo" not in str(error) and "onnection" not in str(error):
                raise
            raise TrainError(
                f"process {self.rank} of {self.count} lost another process of this run ({str(error).splitlines()[0]}); "
                "look for that one's message, then start all of them again to go on from the newest state"
            ) from error


ALONE = Processes()
"""A run of one process, without communication."""


@contextmanager
def processes_of(compute: ComputeRecipe) -> Generator[Processes]:
    """The processes that torchrun started, connected, until the block is left; ALONE without torchrun.

    nccl carries the gradients on CUDA, one device a process; gloo on the CPU.
    Raises RecipeError if there are several and the recipe does not say how they share the work, or too few devices.
    """
    if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
        yield ALONE
        return
    rank, count = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    if count > 1 and compute.parallel == "none":
        raise RecipeError(
            f'torchrun started {count} processes, but compute.parallel is "none"; say "ddp" or "fsdp", or start one'
        )
    with _device(compute) as backend:
        timeout = timedelta(seconds=compute.timeout_s)
        store, _, _ = next(rendezvous("env://", rank, count, timeout=timeout))
        dist.init_process_group(backend, store=PrefixStore("c10d", store), rank=rank, world_size=count, timeout=timeout)
        yield Processes(rank, count, store, _small_group(timeout), _small_group(timeout))
        dist.destroy_process_group()  # not after an error: it could wait for processes that are gone


def _small_group(timeout: timedelta) -> ProcessGroup:
    made = dist.new_group(backend="gloo", timeout=timeout)
    assert isinstance(made, ProcessGroup), "all processes are in it"
    return made


@contextmanager
def _device(compute: ComputeRecipe) -> Generator[str]:
    """Makes this process's own CUDA device the current one; gives the backend."""
    if compute.device == "cpu" or not torch.cuda.is_available():
        with nullcontext():
            yield "gloo"
        return
    local, there = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
    if local >= there:
        raise RecipeError(
            f"torchrun started process {local + 1} of this machine, which has {there} CUDA devices; "
            f"start at most {there} with --nproc-per-node, one for each"
        )
    with torch.cuda.device(local):
        yield "nccl"
