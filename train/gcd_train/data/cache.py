"""What frozen encoders gave, on disk: shards that appear whole, and an `index.json` that names them, replaced whole.

The latent cache of a driving set: encoders run once, training reads what they gave. One shard a scene:

times                 int16  [N]                  frames that are in
pairs                 int16  [R, 2]               time and path position of every target row
source                f16    [N, K, C, h, w]      condition latents of the noised source, K draws of the noise
tokens                f16    [N, D]               image tokens of the clean source; only with an image tower
target_mean           f16    [R, C, h, w]         posterior of the target latents, not scaled
target_log_variance   u8     [R, C, h, w]         of it, -30..20 in 255 steps: the deviation to 5 %
emphasis              f16    [R, 1, h, w]         class emphasis of semantic targets; only for semantic targets
splat                 f16    [R, C + 1, h, w]     the source's points from the target camera; only where asked for

The source picture of a frame depends on its time t alone. With the fixed path of ParallelDomain-4D the target picture
depends on t and on how far along the path the camera is, the position i = 0..13; stride and start do not matter beyond
t = start + i * stride. In a scene of 50 frames (T = 14, strides 1 and 2, the last frame is never reached, as published)
that leaves 49 sources, 504 targets of gradual clips (every pair of stride 2 is also one of stride 1) and 49 of direct
ones, 517 together, instead of the 2 x 14 x 59 = 1652 pictures of all 59 clips one by one. At 384 x 256 with the
published networks such a scene takes 12.0 MB with K = 4, 1 533 scenes 18.5 GB (as published, the point clouds: 4.4 TB).

K copies keep the 0.02 pixel noise of the paper: every frame of every clip draws one of the K on its own, K^14 mixes a
clip.
"""

import hashlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn

from gcd_model.conditioning import clip_pixels, splat_channels
from gcd_model.config import SplatDepth
from gcd_model.errors import FileError
from gcd_model.networks import Networks, weights_digest
from gcd_model.small_files import read_json
from gcd_model.vae import Posterior
from gcd_train.data.files import Recent
from gcd_train.errors import DataError, RunError
from gcd_train.files import write_whole
from gcd_train.training.setup import Draws

FORMAT = 2
_INDEX, _MOST_INDEX = "index.json", 1 << 26
PathKind = Literal["gradual", "direct"]
_LOWEST, _SPAN, _CODES = -30.0, 50.0, 255
_KEPT_SHARDS = 8
Made = TypeVar("Made")


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


@dataclass(frozen=True, kw_only=True, slots=True)
class FrozenEncoders:
    """The encoders of some networks, run where and as precisely as their weights are kept.

    at_once: frames a call; it changes memory, not the result. All give float32, on the device of the weights.
    """

    networks: Networks
    at_once: int = 14

    def target(self, frames: Tensor) -> Posterior:
        """Target latents of frames [N, 3, H, W] in [-1, 1], not scaled."""
        parts = self._parts(self.networks.target_encoder, frames)
        return Posterior(*(torch.cat([getattr(p, name).float() for p in parts]) for name in ("mean", "log_variance")))

    def condition(self, frames: Tensor) -> Tensor:
        """Condition latents [N, C, h, w] of frames with their noise, not scaled."""
        return torch.cat([part.mean.float() for part in self._parts(self.networks.condition_encoder, frames)])

    def splat(self, splats: Tensor | None) -> Tensor | None:
        """Condition channels [N, C + 1, h, w] of what `splat_of` gave; None for None."""
        return None if splats is None else splat_channels(splats, self.condition)

    def tokens(self, frames: Tensor) -> Tensor | None:
        """Image tokens [N, D] of clean frames; None for a model without an image tower."""
        tower = self.networks.image_encoder
        if tower is None:
            return None
        pixels = [clip_pixels(part, tower.config.image_size) for part in frames.split(self.at_once)]
        return torch.cat([tokens.float() for part in pixels for tokens in self._parts(tower, part)])

    def _parts(self, encoder: Callable[[Tensor], Made], frames: Tensor) -> list[Made]:
        assert isinstance(encoder, nn.Module), "weights say where and how precisely they compute"
        return [encoder(part) for part in frames.to(next(encoder.parameters())).split(self.at_once)]


def encoder_parts(networks: Networks) -> dict[str, nn.Module]:
    """The frozen encoders by what they encode."""
    parts = {
        "target": networks.target_encoder,
        "condition": networks.condition_encoder,
        "image": networks.image_encoder,
    }
    return {name: part for name, part in parts.items() if part is not None}


def encoders_digest(networks: Networks) -> str:
    """Names the weights of the frozen encoders, whatever type they are kept in."""
    states = {name: part.state_dict() for name, part in encoder_parts(networks).items()}
    return weights_digest({f"{part}.{name}": value.float() for part in states for name, value in states[part].items()})


def autoencoder_digest(networks: Networks) -> str:
    """Names the weights that encode and decode."""
    parts = (networks.target_encoder, networks.condition_encoder, networks.decoder)
    return weights_digest(
        {f"{i}.{name}": value for i, part in enumerate(parts) for name, value in part.state_dict().items()}
    )


@dataclass(frozen=True, order=True, slots=True)
class ClipPlace:
    """A clip within a scene: frames start, start + stride, ..."""

    start: int
    stride: int


class ClipPlan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The clips that training takes from a scene.

    clip_frames: T. strides: in frames of the scene. paths: gradual reaches the goal at T - 1, direct stands there.
    Source: Generative Camera Dolly, ParallelDomain-4D, as released.
    """

    clip_frames: int = 14
    strides: tuple[int, ...] = (1, 2)
    paths: tuple[PathKind, ...] = ("gradual", "direct")

    def times(self, place: ClipPlace) -> range:
        """The frames of a clip."""
        return range(place.start, place.start + self.clip_frames * place.stride, place.stride)

    def position(self, path: PathKind, index: int) -> int:
        """Where on the path the camera of a clip's frame `index` is, 0 (source) .. T - 1 (goal)."""
        return index if path == "gradual" else self.clip_frames - 1

    def clips(self, frames: int, there: Collection[int]) -> list[ClipPlace]:
        """All clips of a scene of `frames` frames, of which those in `there` can be had; ordered by stride, start."""
        places = [
            ClipPlace(start, stride)
            for stride in self.strides
            for start in range(frames - (self.clip_frames - 1) * stride - 1)
        ]
        return [place for place in places if all(time in there for time in self.times(place))]

    def pairs(self, frames: int, there: Collection[int]) -> list[tuple[int, int]]:
        """The (time, position) of every target picture those clips need, each once, in order."""
        return sorted(
            {
                (time, self.position(path, index))
                for place in self.clips(frames, there)
                for index, time in enumerate(self.times(place))
                for path in self.paths
            }
        )


class CacheIdentity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What every shard of a cache was made with; another identity is another cache.

    encoders: digest of the frozen weights. dtype: they computed in. pictures: the set and its rendering. fps: of the
    scenes, before any stride.
    copies: differently noised source latents a frame. augmentation: strength of that noise, on pixels in [-1, 1].
    height, width: pixels.
    scale: of target latents, applied when read. emphasis: whether class emphasis maps are kept (semantic targets).
    splat: whether the source's points are, and where their depth is from.
    """

    encoders: str
    dtype: str
    pictures: str
    fps: float
    plan: ClipPlan
    copies: int
    augmentation: float
    seed: int
    height: int
    width: int
    scale: float
    emphasis: bool = False
    splat: SplatDepth = "none"


class SceneShard(Shard, frozen=True, kw_only=True):
    """One scene. frames: time steps of the scene. times: those that are in. missing: the others that were wanted, with
    the reason. seconds: it took, encoding and rendering."""

    frames: int
    times: tuple[int, ...]
    missing: dict[str, str]
    seconds: float


class CacheIndex(Index, frozen=True, kw_only=True):
    """The index of a cache. scenes: by name, in order."""

    identity: CacheIdentity
    scenes: dict[str, SceneShard] = msgspec.field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, slots=True)
class EncodedRows:
    """N frames, encoded, float32; None for what the model or the data does without.

    source: [N, C, h, w], not scaled. target: [N, C, h, w], scaled. tokens: [N, D] of the image tower. emphasis:
    [N, 1, h, w], see `class_emphasis`. motion: [N], how far the camera goes. camera: [N, K], what steers the model.
    splat: [N, C + 1, h, w], see `splat_channels`.
    """

    source: Tensor
    target: Tensor
    tokens: Tensor | None = None
    emphasis: Tensor | None = None
    motion: Tensor | None = None
    camera: Tensor | None = None
    splat: Tensor | None = None


class CachedLatents:
    """An opened cache. Every shard's SHA-256 is checked when it is first read; some shards stay in memory."""

    def __init__(self, folder: Path, index: CacheIndex) -> None:
        self.folder, self.index = folder, index
        self._shard = Recent(self._read, _KEPT_SHARDS)

    @classmethod
    def open(cls, folder: Path) -> "CachedLatents":
        """Raises DataError where there is no cache, RunError where its index cannot be read."""
        index = read_index(folder, CacheIndex)
        if index is None or not index.scenes:
            raise DataError(f"{folder} holds no cached scene; make them with `gcd-train cache DATA --weights W --out`")
        return cls(folder, index)

    @property
    def scenes(self) -> Sequence[str]:
        """Names, in order."""
        return tuple(self.index.scenes)

    def clips(self, scene: str) -> list[ClipPlace]:
        """The clips of a scene whose frames are all there."""
        entry = self.index.scenes[scene]
        return self.index.identity.plan.clips(entry.frames, set(entry.times))

    def drawn_place(self, draws: Draws) -> tuple[str, ClipPlace]:
        """A random clip as training takes it: scene, then stride, then start, each alike likely.

        Raises: DataError if 100 scenes in a row have no complete clip.
        """
        for _ in range(100):
            scene = self.scenes[int(draws.below(len(self.scenes), 1))]
            clips = self.clips(scene)
            strides = sorted({clip.stride for clip in clips})
            if strides:
                stride = strides[int(draws.below(len(strides), 1))]
                able = [clip for clip in clips if clip.stride == stride]
                return scene, able[int(draws.below(len(able), 1))]
        raise DataError(f"{self.folder}: 100 scenes in a row have no complete clip; see `missing` in its index.json")

    def clip(self, scene: str, place: ClipPlace, path: PathKind, draws: Draws | None = None) -> EncodedRows:
        """The frames of a clip, on the CPU.

        draws: chooses each frame's noise copy, and a sample of the target's posterior;
        None: the first copy and the mean. Raises: DataError for a clip that is not there or a damaged shard.
        """
        identity = self.index.identity
        plan = identity.plan
        if path not in plan.paths or place not in self.clips(scene):
            raise DataError(f"{self.folder} has no {path} clip of {scene} at {place}; it was cached for {plan}")
        tensors, times = self._shard(scene), torch.tensor(plan.times(place))
        n = torch.searchsorted(tensors["times"].long(), times)
        where = {(time, position): row for row, (time, position) in enumerate(tensors["pairs"].tolist())}
        r = torch.tensor([where[time, plan.position(path, i)] for i, time in enumerate(times.tolist())])
        copies = torch.zeros_like(n) if draws is None else draws.below(identity.copies, len(n))
        return EncodedRows(
            source=tensors["source"][n, copies].float(),
            target=self._target(tensors, r, draws),
            tokens=tensors["tokens"][n].float() if "tokens" in tensors else None,
            emphasis=tensors["emphasis"][r].float() if "emphasis" in tensors else None,
            splat=tensors["splat"][r].float() if "splat" in tensors else None,
        )

    def _read(self, scene: str) -> dict[str, Tensor]:
        return open_shard(self.folder, self.index.scenes[scene], "run the same `gcd-train cache` again")

    def _target(self, tensors: dict[str, Tensor], rows: Tensor, draws: Draws | None) -> Tensor:
        mean = tensors["target_mean"][rows].float()
        if draws is not None:
            posterior = Posterior(mean, log_variance_of(tensors["target_log_variance"][rows]))
            mean = posterior.sample(draws.normal(*mean.shape))
        return mean * self.index.identity.scale


def log_variance_codes(log_variance: Tensor) -> Tensor:
    """Log-variances -30..20 as u8."""
    return ((log_variance - _LOWEST) * (_CODES / _SPAN)).round().clamp(0, _CODES).to(torch.uint8)


def log_variance_of(codes: Tensor) -> Tensor:
    """Inverse of `log_variance_codes`, float32; off by 0.1 at most."""
    return codes.float() * (_SPAN / _CODES) + _LOWEST
