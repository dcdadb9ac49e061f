"""Encoded pairs as videos: nothing is encoded anew for a network that continues a picture."""

from collections.abc import Sequence

import msgspec
import torch
from torch import Tensor

from gcd_train.datasets.latents import LatentClips, LatentRows, LatentsMeta


class LatentVideos:
    """Both sides of all pairs of some folders of latents; see `videos.VideoClips` for what they stand for.

    scale: what the U-Net works on is this times what the condition encoder gives; see gcd_model.config.VAEConfig.
    Both sides must have been encoded alike: by one autoencoder, without augmentation, targets as their mean.
    """

    def __init__(self, parts: Sequence[LatentClips], scale: float) -> None:
        self._parts, self._scale = tuple(parts), scale
        self._ends = torch.tensor([2 * part.meta.clips for part in self._parts]).cumsum(0)
        self.meta = _joined([part.meta for part in self._parts])

    def rows(self, clips: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device) -> LatentRows:
        """The frames (clips[i], frames[i]) and, as their source, the first frame of the same video; see `LatentClips`.

        clips: int64 [N], video 2n is the source's side of pair n, 2n + 1 the target's.
        """
        part_of = torch.bucketize(clips, self._ends, right=True)
        places = [(part_of == part).nonzero()[:, 0] for part in range(len(self._parts))]
        made = [
            self._some(part, self._within(part, clips[place]), frames[place], mirrored[place], device)
            for part, place in enumerate(places)
            if len(place)
        ]
        order = torch.cat(places).argsort().to(device)
        source, target, motion = (torch.cat(rows)[order] for rows in zip(*made, strict=True))
        return LatentRows(source=source, target=target, motion=motion, control=None, emphasis=None)

    def names(self, clips: Tensor) -> tuple[str, ...]:
        """What the videos are called in messages: the seed of their pair, and its side."""
        part_of = torch.bucketize(clips, self._ends, right=True)
        return tuple(
            self._name(int(part), int(self._within(int(part), clip))) for part, clip in zip(part_of, clips, strict=True)
        )

    def _name(self, part: int, clip: int) -> str:
        return f"clip {self._parts[part].meta.seeds[clip // 2]}, its {'target' if clip % 2 else 'source'}"

    def _within(self, part: int, clips: Tensor) -> Tensor:
        return clips - (self._ends[part] - 2 * self._parts[part].meta.clips)

    def _some(
        self, part: int, videos: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Source, target and motion number of rows that lie in one folder."""
        latents, pairs = self._parts[part], videos // 2
        now = latents.rows(pairs, frames, mirrored, device)
        first = latents.rows(pairs, torch.zeros_like(frames), mirrored, device)
        of_target = (videos % 2).bool().to(device)[:, None, None, None]
        source = torch.where(of_target, first.target / self._scale, first.source)
        return source, torch.where(of_target, now.target, now.source * self._scale), now.motion


def _joined(metas: Sequence[LatentsMeta]) -> LatentsMeta:
    """What there is in all folders; each of them counts alike for the channels' sensitivity."""
    rows = zip(*(meta.sensitivity for meta in metas), strict=True)
    return msgspec.structs.replace(
        metas[0],
        seeds=tuple(seed for meta in metas for seed in meta.seeds for _ in range(2)),
        control=0,
        emphasis=False,
        sensitivity=tuple(sum(row) / len(metas) for row in rows),
    )
