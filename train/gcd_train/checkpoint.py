"""The state of a training stage on disk: written in one piece, read back to the update.

Random numbers need no state of their own: they follow from the seed and the number of the update, see `Draws`.
"""

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import IO, Any

import torch
from torch import Tensor
from torch.serialization import get_unsafe_globals_in_checkpoint

from gcd_train.engine.optimisers import torchao_optimisers
from gcd_train.errors import RunError

_MARK = b"gcd-train sha256 "
_COMMENT = len(_MARK) + 64
_CHUNK = 1 << 22


class _Hashing:
    """A file that is written front to back, with the digest of all that went in."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.digest = file, hashlib.sha256()

    def write(self, data: Any) -> int:
        self.digest.update(data)
        return self._file.write(data)

    def flush(self) -> None:
        self._file.flush()


def write_sealed(path: Path, write: Callable[[Any], None]) -> None:
    """Write a zip archive with its digest and wait until it is on the disk. write: puts the archive into a file."""
    with path.open("wb") as file:
        hashing = _Hashing(file)
        write(hashing)
        file.seek(-2, os.SEEK_END)  # the length of the comment, zero so far
        file.write(_COMMENT.to_bytes(2, "little") + _MARK + hashing.digest.hexdigest().encode())
        file.flush()
        os.fsync(file.fileno())


def damage(path: Path) -> str | None:
    """What is wrong with a sealed file, or None."""
    if not path.is_file():
        return "it is no regular file"
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - _COMMENT - 2))
        length, comment = file.read(2), file.read()
        if length != _COMMENT.to_bytes(2, "little") or not comment.startswith(_MARK):
            return "it is no state, or only half of one"
        right = comment.removeprefix(_MARK).decode("ascii", "replace") == _digest(file, size - _COMMENT - 2)
        return None if right else "its bytes are not those that were written"


def _digest(file: IO[bytes], size: int) -> str:
    file.seek(0)
    total, left = hashlib.sha256(), size
    while left > 0:
        chunk = file.read(min(left, _CHUNK))
        if not chunk:
            return ""
        total.update(chunk)
        left -= len(chunk)
    total.update(b"\0\0")
    return total.hexdigest()


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
