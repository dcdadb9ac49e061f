"""Folders of what encoders made of clips or scenes: shards that appear whole, and an index that names them.

index.json      how everything was made and, of every shard, size, SHA-256 and arrays; replaced as a whole
*.safetensors   a shard

Of the clips of a run, as the U-Net needs them, a shard holds some that follow each other (a scene's: see `cache`):

source      float16 [N, F, T, C, h, w]      clean condition latents, plain and (F = 2) mirrored
target      float16 [N, F, T, C, h, w]      target latents, as the U-Net works on them
motion      float32 [N]                     the number that says how far the camera goes
control     float32 [N, F, T, K]            camera features, where the model is steered
emphasis    float16 [N, T, 1, h, w]         how much more a class counts, see `class_emphasis`
"""

import fcntl
import hashlib
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

import msgspec
import torch
from safetensors.torch import load_file, save
from torch import Tensor

from gcd_model.errors import FileError
from gcd_model.small_files import read_json
from gcd_train.errors import DataError, RunError
from gcd_train.files import write_whole

FORMAT = 2
_INDEX, _MOST_INDEX = "index.json", 1 << 26


class Shard(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One file. file: in the folder. arrays: shape by name."""

    file: str
    sha256: str
    bytes: int
    arrays: dict[str, tuple[int, ...]]


class Index(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What `index.json` says. format: of index and shards."""

    format: int = FORMAT


Kind = TypeVar("Kind", bound=Index)
AnyShard = TypeVar("AnyShard", bound=Shard)
_ANEW = "delete its folder and run `gcd-train train ... --stage latents`"


def read_index(folder: Path, kind: type[Kind]) -> Kind | None:
    """The index of a folder, None where there is none yet. Raises RunError if it cannot be read."""
    path = folder / _INDEX
    if not (path.exists() or path.is_symlink()):
        return None
    try:
        index = read_json(path, kind, _MOST_INDEX)
    except FileError as error:
        raise RunError(f"{path} {error}; delete {folder} and encode again") from error
    if index.format != FORMAT:
        raise RunError(f"{path} has format {index.format}, this version reads {FORMAT}; delete {folder}, encode again")
    return index


def write_index(folder: Path, index: Index) -> None:
    """Replace the index; a reader sees the old one or the new one. Raises RunError if it cannot be written."""
    write_whole(folder / _INDEX, msgspec.json.format(msgspec.json.encode(index)), lasting=True)


def write_shard(folder: Path, name: str, tensors: dict[str, Tensor], kind: type[AnyShard], **facts: Any) -> AnyShard:
    """Write a shard and say what it is, with some more facts. Raises RunError if it cannot be written."""
    content, file = save(tensors), f"{name}.safetensors"
    write_whole(folder / file, content, lasting=True)
    arrays = {name: tuple(values.shape) for name, values in sorted(tensors.items())}
    digest = hashlib.sha256(content).hexdigest()
    return kind(file=file, sha256=digest, bytes=len(content), arrays=arrays, **facts)


def fault(folder: Path, shard: Shard) -> str | None:
    """What is wrong with a shard: missing, cut, changed; None if it is as it was written."""
    path = folder / shard.file
    try:
        if not path.is_file() or path.stat().st_size != shard.bytes:
            return f"{path} is missing or not of the {shard.bytes} bytes that were written"
        content = path.read_bytes()
    except OSError as error:
        return f"{path}: {error.strerror}"
    same = hashlib.sha256(content).hexdigest() == shard.sha256
    return None if same else f"{path} is damaged: its SHA-256 is not the one it was written with"


def open_shard(folder: Path, shard: Shard, redo: str) -> dict[str, Tensor]:
    """The arrays of a shard, mapped: read where they are used.

    Raises DataError, with how to make it again, if it is missing or not as it was written.
    """
    wrong = fault(folder, shard)
    if wrong is not None:
        raise DataError(f"{wrong}; {redo}")
    return load_file(folder / shard.file)


@contextmanager
def only_writer(folder: Path) -> Generator[None]:
    """Hold a folder for one run. Raises RunError if another run has it; a killed one lets go by itself."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunError(f"another run is writing to {folder}; wait for it, or stop it") from error
        for leftover in folder.glob(".*.partial"):
            leftover.unlink(missing_ok=True)
        yield


class LatentsMeta(Index, frozen=True, kw_only=True):
    """The index of a folder of latents.

    identity: the autoencoder and the options it was made with. seeds: of the N clips there are to be; `shards` hold
    them in this order. frames: T. flips: F. sensitivity, when all are there: what a unit change of each latent channel
    does to the decoded picture, one on average.
    """

    identity: str
    seeds: tuple[int, ...]
    frames: int
    flips: int
    shards: tuple[Shard, ...] = ()
    sensitivity: tuple[float, ...] = ()

    @property
    def clips(self) -> int:
        """N."""
        return len(self.seeds)

    @property
    def done(self) -> int:
        """Clips that are there."""
        return sum(shard.arrays["motion"][0] for shard in self.shards)


@dataclass(frozen=True, kw_only=True, slots=True)
class LatentRows:
    """Some frames. Each row is one frame, mirrored or not.

    source, target: float32 [N, C, h, w]. motion: float32 [N]. control: float32 [N, K], None where nothing is steered.
    emphasis: float32 [N, 1, h, w] or None.
    """

    source: Tensor
    target: Tensor
    motion: Tensor
    control: Tensor | None
    emphasis: Tensor | None


class LatentClips:
    """An opened folder of latents."""

    def __init__(self, meta: LatentsMeta, shards: Sequence[dict[str, Tensor]]) -> None:
        self.meta, self._shards = meta, tuple(shards)
        self._ends = torch.tensor([len(shard["motion"]) for shard in shards]).cumsum(0)

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Map the arrays. Raises RunError if the folder is unfinished, DataError for a damaged shard."""
        meta = read_index(folder, LatentsMeta)
        if meta is None or not meta.sensitivity:
            raise RunError(f"{folder} holds no finished latents; run `gcd-train train ... --stage latents`")
        return cls(meta, [open_shard(folder, shard, _ANEW) for shard in meta.shards])

    def resident(self, device: torch.device) -> Self:
        """The same, held in the device's memory."""
        names = self._shards[0]
        return type(self)(self.meta, [{name: torch.cat([s[name] for s in self._shards]).to(device) for name in names}])

    def rows(self, clips: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device) -> LatentRows:
        """The frames (clips[i], frames[i]), mirrored where the flag says so; all int64 or bool [N] on the CPU."""

        part_of = torch.bucketize(clips, self._ends, right=True)
        parts: list[int] = part_of.unique().tolist()
        places = [(part_of == part).nonzero()[:, 0] for part in parts]
        order = torch.cat(places).argsort()

        def at(name: str, *index: Tensor) -> Tensor | None:
            """Rows of an array, which lie in several shards, in the order of `clips`."""
            if name not in self._shards[0]:
                return None
            found: list[Tensor] = []
            for part, which in zip(parts, places, strict=True):
                values = self._shards[part][name]
                numbers = clips[which] - (self._ends[part - 1] if part else 0)
                found.append(values[tuple(each.to(values.device) for each in (numbers, *(i[which] for i in index)))])
            rows = torch.cat(found)
            return rows[order.to(rows.device)].to(device)

        side = mirrored.long()
        source, target, motion = at("source", side, frames), at("target", side, frames), at("motion")
        assert source is not None
        assert target is not None
        assert motion is not None
        emphasis = at("emphasis", frames)
        if emphasis is not None:
            flip = mirrored.to(device).view(-1, *[1] * (emphasis.ndim - 1))
            emphasis = torch.where(flip, emphasis.flip(-1), emphasis).float()
        return LatentRows(
            source=source.float(),
            target=target.float(),
            motion=motion,
            control=at("control", side, frames),
            emphasis=emphasis,
        )

    def names(self, clips: Tensor) -> tuple[str, ...]:
        """What the clips are called in messages: their seeds."""
        return tuple(f"clip {self.meta.seeds[number]}" for number in clips.tolist())
