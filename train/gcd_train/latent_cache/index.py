"""What a cache folder says about itself: `index.json`, one entry a scene, replaced as a whole."""

import hashlib
from pathlib import Path
from typing import Literal

import msgspec

from gcd_model.errors import FileError
from gcd_model.small_files import read_json
from gcd_train.errors import RunError
from gcd_train.files import write_whole
from gcd_train.latent_cache.plan import ClipPlan

INDEX = "index.json"
_MOST_BYTES = 1 << 26
Moments = Literal["both", "mean"]


class CacheIdentity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every shard of a cache was made with; another identity is another cache.

    encoders: digest of the frozen weights. dtype: they computed in. pictures: the set and its rendering. fps: of the
    scenes, before any stride.
    copies: differently noised source latents a frame. augmentation: strength of that noise, on pixels in [-1, 1].
    moments: "both" keeps the posterior's mean and variance, "mean" the mean alone. height, width: pixels.
    scale: of target latents, applied when read. emphasis: whether class emphasis maps are kept (semantic targets).
    """

    encoders: str
    dtype: str
    pictures: str
    fps: float
    plan: ClipPlan
    copies: int
    augmentation: float
    moments: Moments
    seed: int
    height: int
    width: int
    scale: float
    emphasis: bool = False


class ShardEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One scene.

    file: in the cache folder. frames: time steps of the scene. times: those that are in. missing: the others that were
    wanted, with the reason. arrays: shape by name. seconds: it took, encoding and rendering.
    """

    file: str
    sha256: str
    bytes: int
    frames: int
    times: tuple[int, ...]
    missing: dict[str, str]
    arrays: dict[str, tuple[int, ...]]
    seconds: float


class CacheIndex(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The whole folder. format: of index and shards."""

    identity: CacheIdentity
    scenes: dict[str, ShardEntry] = {}
    format: int = 1

    def with_scene(self, name: str, entry: ShardEntry) -> "CacheIndex":
        """The index with one more scene, ordered by name."""
        return msgspec.structs.replace(self, scenes=dict(sorted({**self.scenes, name: entry}.items())))

    def without(self, names: set[str]) -> "CacheIndex":
        """The index without some scenes."""
        return msgspec.structs.replace(self, scenes={n: e for n, e in self.scenes.items() if n not in names})


def read_index(folder: Path) -> CacheIndex | None:
    """The index of a folder, None where there is none yet. Raises RunError if it cannot be read."""
    path = folder / INDEX
    if not path.exists():
        return None
    try:
        index = read_json(path, CacheIndex, _MOST_BYTES)
    except FileError as error:
        raise RunError(f"{path} {error}; delete the folder and run `gcd-train cache` again") from error
    if index.format != 1:
        raise RunError(f"{path} has format {index.format}, this version reads 1; make the cache anew")
    return index


def write_index(folder: Path, index: CacheIndex) -> None:
    """Replace the index; a reader sees the old one or the new one."""
    write_whole(folder / INDEX, msgspec.json.format(msgspec.json.encode(index)), lasting=True)


def require_same(folder: Path, there: CacheIdentity, wanted: CacheIdentity) -> None:
    """Raises RunError, naming what differs, unless a folder was made as is asked now."""
    differs = [
        f"{name} {getattr(there, name)!r}, now {getattr(wanted, name)!r}"
        for name in CacheIdentity.__struct_fields__
        if getattr(there, name) != getattr(wanted, name)
    ]
    if differs:
        raise RunError(f"{folder} was cached with {'; '.join(differs)}: choose another --out, or delete the folder")


def digest(content: bytes) -> str:
    """SHA-256, 64 digits."""
    return hashlib.sha256(content).hexdigest()


def fault(folder: Path, entry: ShardEntry) -> str | None:
    """What is wrong with a scene's shard: missing, cut, changed; None if it is as it was written."""
    path = folder / entry.file
    try:
        size = path.stat().st_size
        if size != entry.bytes or not path.is_file():
            return f"{path}: {size} bytes, written were {entry.bytes}"
        content = path.read_bytes()
    except OSError as error:
        return f"{path}: {error.strerror}"
    return None if digest(content) == entry.sha256 else f"{path}: its SHA-256 is not the one it was written with"
