"""The states of a stage on disk; a damaged one is passed over for the one before.

    STAGE/states/0001250/       after 1250 updates: the tensors, and state.json with their files' digests

One format for one and many processes: torch.distributed.checkpoint in safetensors files, each process its share, so a
state of two processes is read by one, and the other way round. Nothing in it is a pickle: a folder that somebody else
made cannot run anything. Folders appear and go by being renamed, so one with its final name is complete.

Random numbers need no state of their own: they follow from the seed and the number of the update, see `Draws`.
"""

import hashlib
import logging
import math
import os
import shutil
import warnings
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import msgspec
import torch
from torch import Tensor, nn
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageReader, HuggingFaceStorageWriter
from torch.distributed.checkpoint.metadata import TensorStorageMetadata
from torch.distributed.checkpoint.state_dict_loader import load
from torch.distributed.checkpoint.state_dict_saver import async_save, save
from torch.distributed.tensor import DTensor

from gcd_model.errors import FileError
from gcd_model.small_files import decode_json, read_small
from gcd_train.errors import RunError
from gcd_train.recipe_data import LogRecipe
from gcd_train.training.distributed import Processes
from gcd_train.training.optimiser import Ema

_log = logging.getLogger(__name__)
_MODULE, _AVERAGE, _OPTIMISER = "module.", "average.", "optimiser."
_NOTE, _FORMAT = "state.json", 2
_FILE_BYTES = 2 << 30  # a file is put together in memory before it is written


class DamagedStateError(RunError):
    """A state that cannot be used: cut short, changed, or not a state at all."""

    def __init__(self, folder: Path, reason: str) -> None:
        super().__init__(f"the state {folder} is damaged: {reason}")


class StateNote(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a state says of itself.

    identity: what it belongs to: model, seed and what was trained before; another one is not resumed. updates: done.
    seconds: spent on them. files: SHA-256.
    """

    format: int = _FORMAT
    stage: str
    identity: str
    updates: int
    seconds: float
    files: dict[str, str] = {}


@dataclass(frozen=True, kw_only=True, slots=True)
class SavedWeights:
    """The weights of a state. path: of its folder. average: their moving average, empty without one."""

    path: Path
    note: StateNote
    module: dict[str, Tensor]
    average: dict[str, Tensor]

    @property
    def best(self) -> dict[str, Tensor]:
        """The weights to use: averaged where there is an average."""
        return {**self.module, **self.average}


@dataclass(frozen=True, slots=True)
class Trained:
    """A module, what updates it, and its average: what is saved, as flat tensors by name."""

    module: nn.Module
    optimiser: torch.optim.Optimizer
    ema: Ema | None

    def tensors(self) -> dict[str, Tensor]:
        """The tensors themselves, or this process's shares of them; moments by the name of their weight."""
        found = {_MODULE + name: value for name, value in self.module.state_dict().items()}
        if self.ema is not None:
            found |= {_AVERAGE + name: value for name, value in self.ema.state_dict().items()}
        for name, parameter in self._updated().items():
            moments: dict[str, Any] = self.optimiser.state.get(parameter, {})
            found |= {f"{_OPTIMISER}{name}.{key}": value for key, value in moments.items()}
        return {name: part for whole, value in found.items() for name, part in _plain(whole, value).items()}

    def ready_for(self, names: set[str]) -> dict[str, Tensor]:
        """As `tensors`, with room for the moments that a state has. Raises RunError where state and recipe disagree."""
        moments = [name.removeprefix(_OPTIMISER) for name in names if name.startswith(_OPTIMISER)]
        self._start_moments(
            [p for name, p in self._updated().items() if any(m.startswith(f"{name}.") for m in moments)]
        )
        there = self.tensors()
        wrong = sorted(set(there) ^ names)
        if wrong:
            raise RunError(
                f"the state and the recipe disagree about {len(wrong)} tensors, first {wrong[0]}; go on with the "
                "recipe, the optimiser and the average it was made with, or delete the state to start the stage anew"
            )
        return there

    def _updated(self) -> dict[str, nn.Parameter]:
        """What the optimiser updates, in its order, by name."""
        names = {id(parameter): name for name, parameter in self.module.named_parameters()}
        listed = [parameter for group in self.optimiser.param_groups for parameter in group["params"]]
        return {names[id(parameter)]: parameter for parameter in listed}

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


class States:
    """Saves a stage's states and finds the newest good one. stage_folder: the folder of the stage."""

    def __init__(
        self, stage_folder: Path, trained: Trained, stage: str, identity: str, log: LogRecipe, processes: Processes
    ) -> None:
        self._folder, self._trained, self._stage, self._identity = stage_folder / "states", trained, stage, identity
        self._log, self._processes = log, processes
        self._newest: int | None = None
        self._closing: Future[None] | None = None
        self._closer = ThreadPoolExecutor(1, thread_name_prefix="state")

    def save(self, updates: int, seconds: float) -> None:
        """Write a state, beside training if the recipe says so. Raises RunError if it cannot be written."""
        if self._newest == updates:
            return
        note = StateNote(stage=self._stage, identity=self._identity, updates=updates, seconds=seconds)
        unfinished = self._folder / f"{updates:07d}.part"
        with self._written():
            if self._processes.first:
                shutil.rmtree(unfinished, ignore_errors=True)
                unfinished.mkdir(parents=True)
            self._processes.told(None)
            self._write(unfinished, note)
        self._newest = updates

    def restore(self) -> StateNote | None:
        """Put the newest good state into what is trained; None if there is none. Raises RunError if it does not fit.

        The first process chooses for all, and puts damaged ones aside.
        """
        chosen: tuple[Path, StateNote] | str | None = None
        if self._processes.first:
            try:
                chosen = self._newest_good()
            except (RunError, OSError) as error:  # told to the others, too, which wait for it
                chosen = str(error)
        chosen = cast("tuple[Path, StateNote] | str | None", self._processes.told(chosen))
        if isinstance(chosen, str):
            raise RunError(chosen)
        if chosen is None:
            return None
        folder, note = chosen
        _load(folder, self._trained.ready_for(set(_metadata(folder))), self._processes)
        self._newest = note.updates
        return note

    def finish(self) -> None:
        """Wait until all is written. Raises RunError if it cannot be."""
        with self._written():
            self._processes.told(None)

    @contextmanager
    def _written(self) -> Generator[None]:
        """First wait for what is being written. Raises RunError, there and in the block, if it cannot be."""
        try:
            if self._closing is not None:
                self._closing.result()
                self._closing = None
            yield
        except (OSError, CheckpointException) as error:
            raise RunError(
                f"cannot write a state in {self._folder}: {_told(error)}; free some space, or choose --out"
            ) from error

    def _write(self, unfinished: Path, note: StateNote) -> None:
        tensors = {name: value.contiguous() for name, value in self._trained.tensors().items()}
        files = _files_of(tensors) if all("@" not in name for name in tensors) else None
        writer = HuggingFaceStorageWriter(str(unfinished), files, save_distributed=True)
        group, alone = self._processes.saving, not self._processes.several
        with self._processes.others_gone(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="torch.distributed is disabled")  # as it should be
            if self._log.save == "async":
                written = async_save(cast(Any, tensors), storage_writer=writer, process_group=group, no_dist=alone)
                self._closing = self._closer.submit(self._close, unfinished, note, cast("Future[object]", written))
            else:
                save(cast(Any, tensors), storage_writer=writer, process_group=group, no_dist=alone)
                self._close(unfinished, note)
                self._processes.told(None)

    def _close(self, unfinished: Path, note: StateNote, written: "Future[object] | None" = None) -> None:
        """Once all processes have written, the first one gives the folder its name, and deletes old ones."""
        if written is not None:
            written.result()
        if self._processes.first:
            close_folder(unfinished, note)
            keep_every = self._log.keep_every
            for path in listed(self._folder)[self._log.keep :]:
                if not keep_every or int(path.name) % keep_every:
                    path.rename(path.with_suffix(".going"))
            self._sweep()

    def _sweep(self) -> None:
        """Delete what is half written or half deleted."""
        for path in [*self._folder.glob("*.going"), *self._folder.glob("*.part")]:
            shutil.rmtree(path)

    def _newest_good(self) -> "tuple[Path, StateNote] | None":
        """Damaged ones before it are put aside. Raises RunError where all are damaged, or the newest does not fit."""
        self._sweep()
        states = listed(self._folder)
        for path in states:
            try:
                note = checked_note(path, self._stage)
                require_identity(path, note.identity, self._identity)
                _metadata(path)
            except DamagedStateError as error:
                _log.warning("%s", error)
                if path == states[-1]:
                    told = f"all {len(states)} states are damaged, see above; delete {self._folder} to start anew"
                    raise RunError(told) from error
                continue
            for damaged in states[: states.index(path)]:
                shutil.rmtree(damaged.with_suffix(".damaged"), ignore_errors=True)
                damaged.rename(damaged.with_suffix(".damaged"))
            return path, note
        return None


def listed(folder: Path) -> list[Path]:
    """All states of a stage's folder `states`, newest first."""
    found = [path for path in folder.glob("[0-9]*") if path.name.isdecimal()]
    return sorted(found, key=lambda path: int(path.name), reverse=True)


def newest_weights(stage_folder: Path, stage: str) -> SavedWeights | None:
    """The newest state of a stage, for its weights; None if there is none.

    Raises RunError if it is damaged: the one before it is less trained, so running the stage again has to choose it.
    """
    states = listed(stage_folder / "states")
    if not states:
        return None
    try:
        return read_weights(states[0], stage)
    except DamagedStateError as error:
        raise RunError(f"{error}; run the stage {stage!r} again, it goes on from the state before") from error


def read_weights(folder: Path, stage: str) -> SavedWeights:
    """Weights and averages of a state, in one process. Raises as `checked_note`."""
    note = checked_note(folder, stage)
    tensors = {
        name: torch.empty(value.size, dtype=value.properties.dtype)
        for name, value in _metadata(folder).items()
        if name.startswith((_MODULE, _AVERAGE))
    }
    _load(folder, tensors, Processes())
    module, average = (
        {name.removeprefix(start): value for name, value in tensors.items() if name.startswith(start)}
        for start in (_MODULE, _AVERAGE)
    )
    return SavedWeights(path=folder, note=note, module=module, average=average)


def require_identity(path: Path, identity: str, expected: str) -> None:
    """Raises RunError if a state belongs to something else than is about to be trained."""
    if identity != expected:
        raise RunError(
            f"{path} belongs to another model, seed or earlier stage ({identity}, now {expected}); "
            f"choose another --out, or delete {path.parent.parent} and what follows it"
        )


def close_folder(unfinished: Path, note: StateNote) -> None:
    """Add the digests to a written folder, and give it its name."""
    found = {path.name: _digest(path) for path in sorted(unfinished.iterdir()) if path.name != _NOTE}
    content = msgspec.json.encode(msgspec.structs.replace(note, files=found))
    with (unfinished / _NOTE).open("wb") as file:
        file.write(content + b"\n" + hashlib.sha256(content).hexdigest().encode())
        file.flush()
        os.fsync(file.fileno())
    unfinished.rename(unfinished.with_suffix(""))


def checked_note(folder: Path, stage: str) -> StateNote:
    """What a state says of itself, when all of it is as it was written.

    Raises DamagedStateError; RunError for another stage.
    """
    try:
        content, _, digest = read_small(folder / _NOTE).encode().rpartition(b"\n")
        if hashlib.sha256(content).hexdigest().encode() != digest:
            raise DamagedStateError(folder, f"{_NOTE} is not as it was written")
        note = decode_json(content, StateNote)
        there = list(folder.iterdir())
        if {path.name for path in there} != {*note.files, _NOTE} or not all(path.is_file() for path in there):
            raise DamagedStateError(folder, "it has not the files that were written")
        for name, digest in note.files.items():
            if _digest(folder / name) != digest:
                raise DamagedStateError(folder, f"the bytes of {name} are not those that were written")
    except (FileError, OSError) as error:
        raise DamagedStateError(folder, str(error)) from error
    if (note.stage, note.format) != (stage, _FORMAT):
        raise RunError(f"{folder} is no state of the stage {stage!r} in format {_FORMAT}; delete it to start anew")
    return note


def _metadata(folder: Path) -> dict[str, TensorStorageMetadata]:
    """The tensors a state holds, by name. Raises DamagedStateError."""
    try:
        found = cast(dict[str, Any], HuggingFaceStorageReader(str(folder)).read_metadata().state_dict_metadata)
        for name, whole in found.items():
            parts = sum(math.prod(part.sizes) for part in whole.chunks)
            if parts != math.prod(whole.size) or any(first < 0 for part in whole.chunks for first in part.offsets):
                raise ValueError(f"the parts of {name} do not make the whole")
    except Exception as error:  # a header that somebody made up fails in any way
        raise DamagedStateError(folder, f"its tensors cannot be listed ({error})") from error
    return found


def _load(folder: Path, tensors: dict[str, Tensor], processes: Processes) -> None:
    """Read a state's values into tensors, each process its share."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="torch.distributed is disabled")
        reader, group = HuggingFaceStorageReader(str(folder)), processes.saving
        try:
            load(cast(Any, tensors), storage_reader=reader, process_group=group, no_dist=not processes.several)
        except CheckpointException as error:
            raise RunError(f"the state {folder} does not fit what is trained: {_told(error)}") from error


def _told(error: OSError | CheckpointException) -> str:
    """In one line: torch's message holds every process's whole traceback."""
    failures = error.failures if isinstance(error, CheckpointException) else {0: (error, None)}
    return "; ".join(f"process {rank}: {str(fault).strip()}" for rank, (fault, _) in failures.items())


def _plain(name: str, value: Tensor) -> dict[str, Tensor]:
    """A tensor as the format takes it: 8-bit moments in their parts, a process's share of them by its rank."""
    local = value.to_local() if isinstance(value, DTensor) else value
    if not hasattr(local, "__tensor_flatten__"):
        return {name: value}
    share = f"@{value.device_mesh.get_rank()}/{value.device_mesh.size()}" if isinstance(value, DTensor) else ""
    return {f"{name}.{part}{share}": getattr(local, part) for part in cast(Any, local).__tensor_flatten__()[0]}


def _files_of(tensors: dict[str, Tensor]) -> dict[str, int]:
    """The number of the file that each tensor goes to, from 1 on."""
    found, total = dict[str, int](), 0
    for name, value in tensors.items():
        total += value.numel() * value.element_size()
        found[name] = 1 + total // _FILE_BYTES
    return found


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
