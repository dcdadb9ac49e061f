"""Clips of a cache, as the trainer takes them."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from gcd_model.vae import Posterior
from gcd_train.datasets.picture_files import read
from gcd_train.datasets.skips import FileFault
from gcd_train.errors import DataError
from gcd_train.latent_cache.index import CacheIndex, digest, read_index
from gcd_train.latent_cache.plan import ClipPlace, PathKind
from gcd_train.latent_cache.shard import log_variance_of
from gcd_train.training.draws import Draws


@dataclass(frozen=True, kw_only=True, slots=True)
class CachedRows:
    """T frames of a clip: source [T, C, h, w], not scaled; target [T, C, h, w], scaled; half, the source at half size
    as uint8, empty where it was not kept; frame_numbers 0..T-1."""

    source: Tensor
    target: Tensor
    half: Tensor
    frame_numbers: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class CachedClip:
    """One clip of T frames, float32 on the CPU.

    tokens: [T, D] or None. emphasis: [T, 1, h, w] or None.
    fps: of the clip, after the stride.
    """

    rows: CachedRows
    tokens: Tensor | None
    emphasis: Tensor | None
    fps: float
    scene: str
    place: ClipPlace
    path: PathKind


class CachedLatents:
    """An opened cache. Every shard's SHA-256 is checked when it is first read; `keep` shards stay in memory."""

    def __init__(self, folder: Path, index: CacheIndex, keep: int = 8) -> None:
        self.folder, self.index, self._keep = folder, index, keep
        self._kept: OrderedDict[str, dict[str, Tensor]] = OrderedDict()

    @classmethod
    def open(cls, folder: Path | str, keep: int = 8) -> "CachedLatents":
        """Raises DataError where there is no cache, RunError where its index cannot be read."""
        index = read_index(Path(folder))
        if index is None or not index.scenes:
            raise DataError(f"{folder} holds no cached scene; make them with `gcd-train cache DATA --weights W --out`")
        return cls(Path(folder), index, keep)

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

    def clip(self, scene: str, place: ClipPlace, path: PathKind, draws: Draws | None = None) -> CachedClip:
        """The tensors of a clip.

        draws: chooses each frame's noise copy, and a sample of the target's posterior where both moments were kept;
        None: the first copy and the mean. Raises: DataError for a clip that is not there or a damaged shard.
        """
        plan, tensors = self.index.identity.plan, self._shard(scene)
        if path not in plan.paths or place not in self.clips(scene):
            raise DataError(f"{self.folder} has no {path} clip of {scene} at {place}; it was cached for {plan}")
        times = torch.tensor(plan.times(place))
        n = torch.searchsorted(tensors["times"].long(), times)
        where = {(time, position): row for row, (time, position) in enumerate(tensors["pairs"].tolist())}
        r = torch.tensor([where[time, plan.position(path, i)] for i, time in enumerate(times.tolist())])
        copies = torch.zeros_like(n) if draws is None else draws.below(self.index.identity.copies, len(n))
        rows = CachedRows(
            source=tensors["source"][n, copies].float(),
            target=self._target(tensors, r, draws),
            half=tensors["half"][n] if "half" in tensors else torch.zeros(len(n), 3, 0, 0, dtype=torch.uint8),
            frame_numbers=torch.arange(len(n)),
        )
        tokens = tensors["tokens"][n].float() if "tokens" in tensors else None
        emphasis = tensors["emphasis"][r].float() if "emphasis" in tensors else None
        return CachedClip(
            rows=rows,
            tokens=tokens,
            emphasis=emphasis,
            fps=self.index.identity.fps / place.stride,
            scene=scene,
            place=place,
            path=path,
        )

    def _target(self, tensors: dict[str, Tensor], rows: Tensor, draws: Draws | None) -> Tensor:
        mean = tensors["target_mean"][rows].float()
        if draws is not None and "target_log_variance" in tensors:
            posterior = Posterior(mean, log_variance_of(tensors["target_log_variance"][rows]))
            mean = posterior.sample(draws.normal(*mean.shape))
        return mean * self.index.identity.scale

    def _shard(self, scene: str) -> dict[str, Tensor]:
        if scene not in self.index.scenes:
            raise DataError(f"{self.folder} has no scene {scene!r}; it has {len(self.scenes)}, first {self.scenes[0]}")
        if scene not in self._kept:
            self._kept[scene] = self._read(scene)
            while len(self._kept) > self._keep:
                self._kept.popitem(last=False)
        self._kept.move_to_end(scene)
        return self._kept[scene]

    def _read(self, scene: str) -> dict[str, Tensor]:
        entry = self.index.scenes[scene]
        path = self.folder / entry.file
        try:
            content = read(path, entry.bytes)
            if digest(content) != entry.sha256:
                raise DataError(f"{path} is damaged: its SHA-256 is not the one it was written with; {_AGAIN}")
            return load(content)
        except (SafetensorError, FileFault) as error:
            raise DataError(f"{path} cannot be read ({error}); {_AGAIN}") from error


_AGAIN = "run the same `gcd-train cache` again, it makes this scene anew"
