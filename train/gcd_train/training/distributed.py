"""The processes of a run, how they share a module, and what saves memory in it."""

import os
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial
from threading import Event
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch._dynamo import config as dynamo
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.distributed_c10d import PrefixStore, ProcessGroup, Store
from torch.distributed.fsdp import fully_shard
from torch.distributed.rendezvous import rendezvous
from torch.distributed.tensor import DTensor
from torch.nn.parallel import DistributedDataParallel
from torch.utils.checkpoint import checkpoint

from gcd_model.layers import Dormant
from gcd_model.unet import Stage
from gcd_train.errors import Interrupted, RecipeError, TrainError
from gcd_train.recipe_data import ComputeRecipe

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

    def batches(self, parts: int) -> list[tuple[int, float]]:
        """Which of an update's `parts` batches this process computes, and how much each counts: 1, or 0.

        Every batch draws as it would in one process. All processes compute equally many, as gradients are exchanged
        together: where they do not divide the parts, some compute one that counts nothing.
        """
        own = [(part, 1.0) for part in range(self.rank, parts, self.count)]
        idle = (own[-1][0] if own else self.rank % parts, 0.0)
        return own + [idle] * (-(-parts // self.count) - len(own))

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

    def averaged(self, means: dict[str, tuple[float, int]]) -> dict[str, float]:
        """Means over all processes, from each one's and of how many values it is. Raises TrainError as `agreed`."""
        given = [means]
        if self.control is not None:
            given *= self.count
            with self.others_gone():
                dist.all_gather_object(given, means, group=self.control)
        values: dict[str, list[tuple[float, int]]] = {}
        for name, value in (item for each in given for item in each.items()):
            values.setdefault(name, []).append(value)
        return {name: sum(m * n for m, n in each) / sum(n for _, n in each) for name, each in values.items()}

    def told(self, value: object) -> object:
        """What the first process gives here, in every process. Raises TrainError as `agreed`."""
        if self.control is None:
            return value
        holder = [value]
        with self.others_gone():
            dist.broadcast_object_list(holder, src=0, group=self.control)
        return holder[0]

    def by_the_first(self, work: Callable[[], None], stop: Event) -> None:
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
    Raises RecipeError if there are too few devices.
    """
    if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ:
        yield ALONE
        return
    rank, count = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    on_cpu = compute.device == "cpu" or not torch.cuda.is_available()
    local, there = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
    if not on_cpu and local >= there:
        raise RecipeError(
            f"torchrun started process {local + 1} of this machine, which has {there} CUDA devices; "
            f"start at most {there} with --nproc-per-node, one for each"
        )
    with nullcontext() if on_cpu else torch.cuda.device(local):
        timeout, backend = timedelta(seconds=compute.timeout_s), "gloo" if on_cpu else "nccl"
        store, _, _ = next(rendezvous("env://", rank, count, timeout=timeout))
        dist.init_process_group(backend, store=PrefixStore("c10d", store), rank=rank, world_size=count, timeout=timeout)
        yield Processes(rank, count, store, _small_group(timeout), _small_group(timeout))
        dist.destroy_process_group()  # not after an error: it could wait for processes that are gone


def _small_group(timeout: timedelta) -> ProcessGroup:
    made = dist.new_group(backend="gloo", timeout=timeout)
    assert isinstance(made, ProcessGroup), "all processes are in it"
    return made


def stages_of(module: nn.Module) -> list[Stage]:
    """The U-Net's blocks in the order of the forward pass; none for a module without a U-Net."""
    return [part for part in module.modules() if isinstance(part, Stage)]


def compile_blocks(module: nn.Module) -> None:
    """Compile each block's forward pass; shapes are fixed but for single frames, which compile once more."""
    stages = stages_of(module)
    # all blocks are one function to the compiler, which gives up after 8 versions of a function
    dynamo.recompile_limit = max(dynamo.recompile_limit, 4 * len(stages))
    for stage in stages:
        stage.forward = torch.compile(stage.forward, dynamic=False)


def recompute_blocks(module: nn.Module, every: int) -> None:
    """Let every n-th block forget what it computed and compute it anew in the backward pass.

    Trades a second forward pass of those blocks for their activations. Gradients stay the same.
    """
    for stage in stages_of(module)[every - 1 :: every]:
        stage.forward = partial(_recomputed, stage.forward)  # pyright: ignore[reportAttributeAccessIssue]


def _recomputed(forward: Callable[..., Any], *given: Any) -> Any:
    if not torch.is_grad_enabled():
        return forward(*given)
    return checkpoint(forward, *given, use_reentrant=False, preserve_rng_state=False)


def whole(value: Tensor) -> Tensor:
    """All of a tensor of which this process may hold a share only. Where it is shared, every process has to ask."""
    return value.full_tensor() if isinstance(value, DTensor) else value


def replicated(module: nn.Module) -> DistributedDataParallel:
    """The module so that gradients are averaged over the processes; starts from the first one's weights.

    What never takes part, the published weights that cannot matter, stays out of it and on the host.
    """
    idle = {id(parameter) for part in _dormant(module) for parameter in part.parameters()}
    names = [name for name, parameter in module.named_parameters() if id(parameter) in idle]
    DistributedDataParallel._set_params_and_buffers_to_ignore_for_model(module, names)  # pyright: ignore[reportPrivateUsage]
    # single frames leave out the layers across frames
    return DistributedDataParallel(module, find_unused_parameters=True)


def share_out(module: nn.Module, processes: Processes) -> None:
    """Give every process its share of the module's weights, in place: a group for each block, one for the rest.

    What a block lays ready before its forward pass (projected embeddings, image tokens) is gathered by itself, as it
    is called by itself.
    """
    device = next(parameter.device.type for parameter in module.parameters() if parameter.requires_grad)
    mesh = init_device_mesh(device, (processes.count,))
    idle = {parameter for part in _dormant(module) for parameter in part.parameters()}
    for parameter in module.parameters():
        if parameter not in idle:
            parameter.data = parameter.data.contiguous()  # FSDP2 takes no other layout
    for stage in stages_of(module):
        for part in _called_early(stage):
            fully_shard(part, mesh=mesh, ignored_params=idle)
        fully_shard(stage, mesh=mesh, ignored_params=idle)
    fully_shard(module, mesh=mesh, ignored_params=idle)


def held_back(network: nn.Module, *, last: bool) -> AbstractContextManager[object]:
    """Context of a backward pass; before the last batch of an update, copies keep their gradients to themselves.

    Shares are summed at once instead, since whole gradients are what there is no memory for.
    """
    return network.no_sync() if isinstance(network, DistributedDataParallel) and not last else nullcontext()


def _dormant(module: nn.Module) -> Iterator[Dormant]:
    return (part for part in module.modules() if isinstance(part, Dormant))


def _called_early(stage: Stage) -> list[nn.Module]:
    """The parts of a block that `Stage.plan` calls, before the block itself is."""
    parts: list[nn.Module | None] = [stage.res.spatial.embed, stage.res.temporal.embed]
    if stage.attention is not None:
        parts += [stage.attention.spatial.token, stage.attention.temporal.token]
    return [part for part in parts if part is not None]


@dataclass(frozen=True, kw_only=True, slots=True)
class Engine:
    """How a stage computes. The default is one process with float32 weights, as they are."""

    processes: Processes = ALONE
    compute: ComputeRecipe = field(default_factory=ComputeRecipe)

    def prepare(self, module: nn.Module) -> nn.Module:
        """Make a module ready to be trained, in place; returns what its losses are to be computed through.

        Weights keep their names. Must come before the optimiser is made.
        """
        compute = self.compute
        if compute.weights == "bfloat16":
            for parameter in module.parameters():
                if parameter.requires_grad:
                    parameter.data = parameter.data.bfloat16()
        if compute.compile:
            compile_blocks(module)
        if compute.checkpoint_activations:
            recompute_blocks(module, int(compute.checkpoint_activations))
        if not self.processes.several:
            return module
        if compute.parallel == "ddp":
            return replicated(module)
        share_out(module, self.processes)
        return module
