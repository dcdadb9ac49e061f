"""What a stage trains, as flat tensors by name: what is saved, and where it is put back."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor, distribute_tensor

from gcd_train.checkpoint import StageState
from gcd_train.ema import Ema
from gcd_train.errors import RunError

MODULE, AVERAGE, OPTIMISER = "module.", "average.", "optimiser."


@dataclass(frozen=True, slots=True)
class Mark:
    """How far a stage is: updates done, seconds spent on them."""

    updates: int
    seconds: float


@dataclass(frozen=True, slots=True)
class Trained:
    """A module, what updates it, and its average."""

    module: nn.Module
    optimiser: torch.optim.Optimizer
    ema: Ema | None

    def state(self, stage: str, identity: str, mark: Mark) -> StageState:
        """Everything, as one process keeps it."""
        return StageState(
            stage=stage,
            identity=identity,
            updates=mark.updates,
            seconds=mark.seconds,
            module=self.module.state_dict(),
            optimiser=self.optimiser.state_dict(),
            average=None if self.ema is None else self.ema.state_dict(),
        )

    def restore(self, state: StageState) -> None:
        """Inverse of `state`, in one process. Raises RunError as `put`."""
        self._require_average(state.average is not None)
        self.module.load_state_dict(state.module)
        self.optimiser.load_state_dict(state.optimiser)
        if self.ema is not None and state.average is not None:
            self.ema.load_state_dict(state.average)

    def flat(self) -> dict[str, Tensor]:
        """The tensors themselves, or this process's shares of them, by name; moments by the name of their weight."""
        found = {MODULE + name: value for name, value in self.module.state_dict().items()}
        if self.ema is not None:
            found |= {AVERAGE + name: value for name, value in self.ema.state_dict().items()}
        for name, parameter in self._updated().items():
            found |= {f"{OPTIMISER}{name}.{key}": value for key, value in self._moments(parameter).items()}
        return found

    def ready_for(self, names: set[str]) -> dict[str, Tensor]:
        """As `flat`, with room for the moments that `names` has, and no others. Raises RunError where they disagree."""
        self._require_average(any(name.startswith(AVERAGE) for name in names))
        wanted = {name[len(OPTIMISER) :].rpartition(".")[0] for name in names if name.startswith(OPTIMISER)}
        self._start_moments([parameter for name, parameter in self._updated().items() if name in wanted])
        there = self.flat()
        wrong = sorted(set(there) ^ names)
        if wrong:
            raise RunError(
                f"the state and the recipe disagree about {len(wrong)} tensors, first {wrong[0]}; go on with the "
                "recipe and the optimiser it was made with, or delete the state to start the stage anew"
            )
        return there

    @torch.no_grad()
    def put(self, state: StageState) -> None:
        """Take in what one process kept, where this one may hold a share only. Raises RunError where they disagree."""
        given = {MODULE + name: value for name, value in state.module.items()}
        given |= {AVERAGE + name: value for name, value in (state.average or {}).items()}
        names = list(self._updated())
        for number, moments in state.optimiser["state"].items():
            given |= {f"{OPTIMISER}{names[number]}.{key}": value for key, value in moments.items()}
        for name, value in self.ready_for(set(given)).items():
            _copy(value, given[name])

    def _require_average(self, there: bool) -> None:
        if there != (self.ema is not None):
            raise RunError("state and recipe disagree about a moving average; delete the state to start anew")

    def _updated(self) -> dict[str, nn.Parameter]:
        """What the optimiser updates, in its order, by name."""
        names = {id(parameter): name for name, parameter in self.module.named_parameters()}
        listed = [parameter for group in self.optimiser.param_groups for parameter in group["params"]]
        return {names[id(parameter)]: parameter for parameter in listed}

    def _moments(self, parameter: nn.Parameter) -> dict[str, Any]:
        return self.optimiser.state.get(parameter, {})

    def _start_moments(self, parameters: list[nn.Parameter]) -> None:
        """Let the optimiser make its moments, by an update without gradient and rate; their values do not matter."""
        kept = [group["lr"] for group in self.optimiser.param_groups]
        for group in self.optimiser.param_groups:
            group["lr"] = torch.zeros_like(group["lr"]) if isinstance(group["lr"], Tensor) else 0.0
        self.optimiser.zero_grad(set_to_none=True)
        for parameter in parameters:
            parameter.grad = torch.zeros_like(parameter)
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        for group, rate in zip(self.optimiser.param_groups, kept, strict=True):
            group["lr"] = rate


def _copy(into: Tensor, full: Tensor) -> None:
    if isinstance(into, DTensor):
        mesh = into.device_mesh
        full = distribute_tensor(full.to(into.device), mesh, into.placements, src_data_rank=None)
    into.copy_(full)
