"""Makes the cache, scene by scene, here or on many machines; a run that was killed goes on."""

import fcntl
import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from safetensors.torch import save

from gcd_train.errors import RunError
from gcd_train.files import write_whole
from gcd_train.latent_cache.encoders import EncoderChoice, Encoders, load_encoders
from gcd_train.latent_cache.index import (
    CacheIdentity,
    CacheIndex,
    Moments,
    ShardEntry,
    digest,
    fault,
    read_index,
    require_same,
    write_index,
)
from gcd_train.latent_cache.pictures import PathPictures
from gcd_train.latent_cache.plan import ClipPlan
from gcd_train.latent_cache.shard import encode_scene
from gcd_train.parallel import map_items

_log = logging.getLogger(__name__)
_MARGIN_BYTES = 64 * 2**20
_PUBLISHED = ClipPlan()


@dataclass(frozen=True, kw_only=True, slots=True)
class CacheOptions:
    """copies, augmentation, moments, seed: see CacheIdentity. augmentation None: as the checkpoint is sampled."""

    plan: ClipPlan = _PUBLISHED
    copies: int = 4
    augmentation: float | None = None
    moments: Moments = "both"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.copies < 1:
            raise RunError(f"at least one noise copy is needed, got {self.copies}")


@dataclass(frozen=True, kw_only=True, slots=True)
class CacheJob:
    """One scene's work, as a worker gets it."""

    folder: Path
    pictures: PathPictures
    choice: EncoderChoice
    identity: CacheIdentity

    def __call__(self, scene: str) -> ShardEntry:
        """Encode a scene and write its shard. Raises TrainError."""
        encoders = load_encoders(self.choice)
        if encoders.digest != self.identity.encoders:
            raise RunError(
                f"{self.choice.weights} holds encoders {encoders.digest} on this machine, {self.identity.encoders} "
                "where the run was started; copy the same file there"
            )
        started = time.perf_counter()
        encoded = encode_scene(encoders, self.pictures, self.identity, scene)
        content = save(encoded.tensors)
        file = f"{scene}.safetensors"
        write_whole(self.folder / file, content, lasting=True)
        return ShardEntry(
            file=file,
            sha256=digest(content),
            bytes=len(content),
            frames=encoded.frames,
            times=tuple(encoded.tensors["times"].tolist()),
            missing={str(moment): reason for moment, reason in encoded.missing.items()},
            arrays={name: tuple(values.shape) for name, values in sorted(encoded.tensors.items())},
            seconds=round(time.perf_counter() - started, 3),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class CacheProgress:
    """A scene is done, or failed. entry: None if it failed. error: why. done, failed, total: scenes so far."""

    scene: str
    entry: ShardEntry | None
    error: str | None
    done: int
    failed: int
    total: int


def identity_of(encoders: Encoders, pictures: PathPictures, options: CacheOptions) -> CacheIdentity:
    """What a cache made now would say of itself."""
    config = encoders.config
    strength = config.sampling.augmentation if options.augmentation is None else options.augmentation
    return CacheIdentity(
        encoders=encoders.digest,
        dtype=encoders.choice.dtype,
        pictures=pictures.origin,
        fps=pictures.fps,
        plan=options.plan,
        copies=options.copies,
        augmentation=strength,
        moments=options.moments,
        seed=options.seed,
        height=config.height,
        width=config.width,
        scale=config.vae.scale,
        emphasis=pictures.semantic,
    )


@contextmanager
def only_writer(folder: Path) -> Generator[None]:
    """Hold a cache folder for one run. Raises RunError if another run has it; a killed one lets go by itself."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunError(f"another `gcd-train cache` is writing to {folder}; wait for it, or stop it") from error
        for leftover in folder.glob(".*.partial"):
            leftover.unlink(missing_ok=True)
        yield


def damaged_scenes(folder: Path, index: CacheIndex) -> dict[str, str]:
    """What is wrong, by scene, after reading every shard."""
    found = {scene: fault(folder, entry) for scene, entry in index.scenes.items()}
    return {scene: reason for scene, reason in found.items() if reason is not None}


def cache_scenes(
    job: CacheJob,
    scenes: Sequence[str],
    *,
    workers: int = 1,
    ray_address: str | None = None,
    free_bytes: Callable[[], int] | None = None,
) -> Iterator[CacheProgress]:
    """Make the shards that are missing or damaged; each scene ends in the index or is reported with its error.

    The caller holds `only_writer`. free_bytes: room on the disk, asked after each scene.
    Raises: RunError if the folder holds another cache, cannot be written, or is too small for what is to come.
    """
    index = _begun(job)
    todo = [scene for scene in scenes if scene not in index.scenes]
    done, failed = len(scenes) - len(todo), 0
    for outcome in _outcomes(job, todo, workers, ray_address):
        scene, entry, error = outcome
        if entry is None:
            failed += 1
        else:
            done += 1
            index = index.with_scene(scene, entry)
            write_index(job.folder, index)
        yield CacheProgress(scene=scene, entry=entry, error=error, done=done, failed=failed, total=len(scenes))
        if free_bytes is not None:
            _require_room(job.folder, index, len(scenes) - done - failed, free_bytes())


def _begun(job: CacheJob) -> CacheIndex:
    index = read_index(job.folder) or CacheIndex(identity=job.identity)
    require_same(job.folder, index.identity, job.identity)
    damaged = damaged_scenes(job.folder, index)
    for reason in damaged.values():
        _log.warning("made anew: %s", reason)
    index = index.without(set(damaged))
    write_index(job.folder, index)
    return index


def _outcomes(
    job: CacheJob, scenes: Iterable[str], workers: int, ray_address: str | None
) -> Iterator[tuple[str, ShardEntry | None, str | None]]:
    for outcome in map_items(job, scenes, workers=workers, ray_address=ray_address):
        yield outcome.item, outcome.value, outcome.error


def _require_room(folder: Path, index: CacheIndex, left: int, free: int) -> None:
    if not index.scenes or not left:
        return
    needed = left * max(entry.bytes for entry in index.scenes.values()) + _MARGIN_BYTES
    if free < needed:
        raise RunError(
            f"{folder}: {left} more scenes need up to {needed / 1e9:.2f} GB, the disk has {free / 1e9:.2f} GB; "
            "make room or take fewer --copies, then run the same line again"
        )
