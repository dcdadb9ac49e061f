"""How the processes of a run share a module: each a whole copy (DDP), or each a share of it (FSDP2)."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext

from torch import Tensor, nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard
from torch.distributed.tensor import DTensor
from torch.nn.parallel import DistributedDataParallel

from gcd_model.layers import Dormant
from gcd_model.unet import Stage
from gcd_train.engine.blocks import stages_of
from gcd_train.engine.processes import Processes


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
    mesh = init_device_mesh(_device_type(module), (processes.count,))
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


def _device_type(module: nn.Module) -> str:
    """Where what is trained lies."""
    return next(parameter.device.type for parameter in module.parameters() if parameter.requires_grad)
