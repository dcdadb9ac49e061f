"""The state of a training stage on disk: written in one piece, read back to the update.

Random numbers need no state of their own: they follow from the seed and the number of the update, see `Draws`.
"""

from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import Tensor
from torch.serialization import get_unsafe_globals_in_checkpoint

from gcd_train.engine.optimisers import torchao_optimisers
from gcd_train.engine.sealed import damage, write_sealed
from gcd_train.errors import RunError

_FORMAT = 1


@dataclass(frozen=True, kw_only=True, slots=True)
class StageState:
    """All that a stage needs to go on as if it had never stopped.

    identity: what the state belongs to: model, seed and what was trained before; another one is not resumed.
    updates, seconds: done so far. module: weights and buffers. optimiser: its own state dict.
    average: the moving average of the weights, or None without one.
    """

    stage: str
    identity: str
    updates: int
    seconds: float
    module: dict[str, Tensor]
    optimiser: dict[str, Any]
    average: dict[str, Tensor] | None

    @property
    def best(self) -> dict[str, Tensor]:
        """The weights to use: averaged where there is an average."""
        return self.module if self.average is None else {**self.module, **self.average}


class DamagedStateError(RunError):
    """A state that cannot be used: cut short, changed, or not a state at all."""


def save_state(path: Path, state: StageState) -> None:
    """Write, replacing an older state only when all of it is on the disk, digest included. Raises RunError."""
    names = StageState.__dataclass_fields__
    content = {"format": _FORMAT, **{name: getattr(state, name) for name in names}}
    unfinished = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_sealed(unfinished, lambda file: torch.save(content, file))
        unfinished.replace(path)
    except OSError as error:
        raise RunError(f"cannot write the state {path}: {error.strerror}; free some space or choose --out") from error


def load_state(path: Path, stage: str) -> StageState:
    """Read a state, checking its digest. Raises DamagedStateError; RunError for another stage or format."""
    wrong = damage(path)
    if wrong is not None:
        raise DamagedStateError(f"the state {path} is damaged: {wrong}")
    try:
        _admit_torchao(path)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, UnpicklingError, EOFError, ValueError) as error:
        raise DamagedStateError(f"cannot read the state {path}: {error}") from error
    if not isinstance(content, dict) or content.pop("format", None) != _FORMAT or content.get("stage") != stage:
        raise RunError(f"{path} is no state of the stage {stage!r} in format {_FORMAT}; delete it to start anew")
    try:
        return StageState(**content)
    except TypeError as error:
        raise DamagedStateError(f"the state {path} is damaged: {error}") from error


def _admit_torchao(path: Path) -> None:
    """Let torch read the 8-bit moments that a state holds; torchao says itself what is safe in them."""
    if any(name.startswith("torchao.") for name in get_unsafe_globals_in_checkpoint(path)):
        torchao_optimisers(f"the state {path} holds 8-bit moments; reading it")


def require_identity(path: Path, said: str, identity: str) -> None:
    """Raises RunError if a state belongs to something else than is about to be trained."""
    if said != identity:
        raise RunError(
            f"{path} belongs to another model, seed or earlier stage ({said}, now {identity}); "
            f"choose another --out, or delete {path.parent} and what follows it"
        )
