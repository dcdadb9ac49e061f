"""Clips as the U-Net needs them, encoded once: shards of consecutive clips, see `store`; resumable.

source      float16 [N, F, T, C, h, w]      clean condition latents, plain and (F = 2) mirrored
target      float16 [N, F, T, C, h, w]      target latents, as the U-Net works on them
motion      float32 [N]                     the number that says how far the camera goes
control     float32 [N, F, T, K]            camera features, where the model is steered
emphasis    float16 [N, T, 1, h, w]         how much more a class counts, see `class_emphasis`
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeAlias

import msgspec
import torch
from torch import Tensor

from gcd_train.data.store import Index, Shard, map_shard, read_index
from gcd_train.errors import RunError


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
        """Map the arrays. Raises RunError if the folder is unfinished or damaged."""
        meta = read_index(folder, LatentsMeta)
        if meta is None or not meta.sensitivity:
            raise RunError(f"{folder} holds no finished latents; run `gcd-train train ... --stage latents`")
        return cls(meta, [map_shard(folder, shard) for shard in meta.shards])

    def resident(self, device: torch.device) -> Self:
        """The same, held in the device's memory."""
        names = self._shards[0]
        return type(self)(self.meta, [{name: torch.cat([s[name] for s in self._shards]).to(device) for name in names}])

    def rows(self, clips: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device) -> LatentRows:
        """The frames (clips[i], frames[i]), mirrored where the flag says so; all int64 or bool [N] on the CPU."""

        def at(name: str, *index: Tensor) -> Tensor | None:
            if name not in self._shards[0]:
                return None

            def rows(part: int, numbers: Tensor, which: Tensor) -> tuple[Tensor]:
                values = self._shards[part][name]
                return (values[tuple(each.to(values.device) for each in (numbers, *(i[which] for i in index)))],)

            return _gathered(self._ends, clips, rows)[0].to(device)

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


class LatentVideos:
    """Both sides of all pairs of some folders of latents; see `sample.VideoClips` for what they stand for.

    scale: what the U-Net works on is this times what the condition encoder gives; see gcd_model.config.VAEConfig.
    Both sides must have been encoded alike: by one autoencoder, without augmentation, targets as their mean.
    """

    def __init__(self, parts: Sequence[LatentClips], scale: float) -> None:
        self._parts, self._scale = tuple(parts), scale
        metas = [part.meta for part in parts]
        self._ends = torch.tensor([2 * meta.clips for meta in metas]).cumsum(0)
        sensitivities = zip(*(meta.sensitivity for meta in metas), strict=True)
        self.meta = msgspec.structs.replace(
            metas[0],
            seeds=tuple(seed for meta in metas for seed in meta.seeds for _ in range(2)),
            sensitivity=tuple(sum(row) / len(metas) for row in sensitivities),
        )

    def rows(self, clips: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device) -> LatentRows:
        """The frames (clips[i], frames[i]) and, as their source, the first frame of the same video; see `LatentClips`.

        clips: int64 [N], video 2n is the source's side of pair n, 2n + 1 the target's.
        """

        def rows(part: int, videos: Tensor, which: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            latents, flip = self._parts[part], mirrored[which]
            now = latents.rows(videos // 2, frames[which], flip, device)
            first = latents.rows(videos // 2, torch.zeros_like(videos), flip, device)
            of_target = (videos % 2).bool().to(device)[:, None, None, None]
            source = torch.where(of_target, first.target / self._scale, first.source)
            return source, torch.where(of_target, now.target, now.source * self._scale), now.motion

        source, target, motion = _gathered(self._ends, clips, rows)
        return LatentRows(source=source, target=target, motion=motion, control=None, emphasis=None)

    def names(self, clips: Tensor) -> tuple[str, ...]:
        """What the videos are called in messages: the seed of their pair, and its side."""
        numbers = clips.tolist()
        return tuple(f"clip {self.meta.seeds[n]}, its {'target' if n % 2 else 'source'}" for n in numbers)


EncodedClips: TypeAlias = LatentClips | LatentVideos
"""Clips as the U-Net learns from them."""


def _gathered(
    ends: Tensor, clips: Tensor, rows: Callable[[int, Tensor, Tensor], tuple[Tensor, ...]]
) -> tuple[Tensor, ...]:
    """Rows of clips that lie in several parts, in the order of `clips`.

    ends: behind the last clip of each part. rows: of a part, by the clips' numbers in it and their places in `clips`.
    """
    part_of = torch.bucketize(clips, ends, right=True)
    parts: list[int] = part_of.unique().tolist()
    places = [(part_of == part).nonzero()[:, 0] for part in parts]
    firsts = [int(ends[part - 1]) if part else 0 for part in parts]
    made = [rows(part, clips[at] - first, at) for part, first, at in zip(parts, firsts, places, strict=True)]
    if len(made) == 1:
        return made[0]
    order = torch.cat(places).argsort()
    return tuple(torch.cat(each)[order.to(each[0].device)] for each in zip(*made, strict=True))
