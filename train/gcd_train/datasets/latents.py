"""Clips as the U-Net needs them, encoded once: memory-mapped arrays in one folder.

meta.json       what is in it and how it was made; written last, so a folder without it is unfinished
source.npy      float16 [N, F, T, C, h, w]      clean condition latents, plain and (F = 2) mirrored
target.npy      float16 [N, F, T, C, h, w]      target latents, as the U-Net works on them
motion.npy      float32 [N]                     the number that tells how far the camera goes
control.npy     float32 [N, F, T, K]            camera features, where the model is steered
emphasis.npy    float16 [N, T, 1, h, w]         how much more a class counts, see `class_emphasis`
clips.json      while unfinished: how many clips are done
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self

import msgspec
import numpy as np
import torch
from torch import Tensor

from gcd_model.small_files import read_json
from gcd_train.array_files import ARRAY_FAULTS, map_npy
from gcd_train.errors import RunError

MOST_META = 1 << 26
"""Bytes of `meta.json`, which names every clip."""


class LatentsMeta(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is in a folder of latents.

    identity: the autoencoder and the options it was made with. seeds: of the N clips. flips: F.
    control: K, 0 for a model that is not steered. emphasis: whether classes count unequally.
    sensitivity: what a unit change of each latent channel does to the decoded picture, one on average.
    mean, std: of each target channel.
    """

    identity: str
    seeds: tuple[int, ...]
    frames: int
    flips: int
    channels: int
    height: int
    width: int
    control: int
    emphasis: bool
    sensitivity: tuple[float, ...] = ()
    mean: tuple[float, ...] = ()
    std: tuple[float, ...] = ()

    @property
    def clips(self) -> int:
        """N."""
        return len(self.seeds)

    @property
    def shapes(self) -> dict[str, tuple[tuple[int, ...], type[np.generic]]]:
        """Shape and type of each array file."""
        grid, each = (self.height, self.width), (self.clips, self.frames)
        latents = (self.clips, self.flips, self.frames, self.channels, *grid)
        shapes: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
            "source": (latents, np.float16),
            "target": (latents, np.float16),
            "motion": ((self.clips,), np.float32),
        }
        if self.control:
            shapes["control"] = ((self.clips, self.flips, self.frames, self.control), np.float32)
        if self.emphasis:
            shapes["emphasis"] = ((*each, 1, *grid), np.float16)
        return shapes


@dataclass(frozen=True, kw_only=True, slots=True)
class LatentRows:
    """Some frames. Each row is one frame, mirrored or not.

    source, target: float32 [N, C, h, w]. motion: float32 [N]. control: float32 [N, K], None where nobody steers.
    emphasis: float32 [N, 1, h, w] or None.
    """

    source: Tensor
    target: Tensor
    motion: Tensor
    control: Tensor | None
    emphasis: Tensor | None


class EncodedClips(Protocol):
    """Clips as the U-Net learns from them. `LatentClips` and `LatentVideos` are two."""

    meta: LatentsMeta

    def rows(self, clips: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device) -> LatentRows:
        """The frames (clips[i], frames[i]), mirrored where the flag says so; all int64 or bool [N] on the CPU."""
        ...

    def names(self, clips: Tensor) -> tuple[str, ...]:
        """What the clips are called in messages."""
        ...


class LatentClips:
    """An opened folder of latents."""

    def __init__(self, meta: LatentsMeta, arrays: dict[str, Tensor]) -> None:
        self.meta, self._arrays = meta, arrays

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Map the arrays. Raises RunError if the folder is unfinished or damaged."""
        try:
            meta = read_json(folder / "meta.json", LatentsMeta, MOST_META)
            mapped = {name: map_npy(folder / f"{name}.npy") for name in meta.shapes}
        except ARRAY_FAULTS as error:
            raise RunError(
                f"{folder} holds no finished latents ({error}); run `gcd-train train ... --stage latents`"
            ) from error
        for name, (shape, kind) in meta.shapes.items():
            if mapped[name].shape != shape or mapped[name].dtype != kind:
                raise RunError(f"{folder / name}.npy has another shape than meta.json says; delete the folder")
        return cls(meta, {name: torch.from_numpy(array) for name, array in mapped.items()})

    def resident(self, device: torch.device) -> Self:
        """The same, held in the device's memory."""
        return type(self)(self.meta, {name: array.to(device) for name, array in self._arrays.items()})

    def rows(self, clips: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device) -> LatentRows:
        """The frames (clips[i], frames[i]), mirrored where the flag says so; all int64 or bool [N] on the CPU."""
        kept = self._arrays["source"].device
        n, t, flip = clips.to(kept), frames.to(kept), mirrored.to(kept)
        side, control, emphasis = flip.long(), self._arrays.get("control"), self._arrays.get("emphasis")
        return LatentRows(
            source=self._arrays["source"][n, side, t].to(device).float(),
            target=self._arrays["target"][n, side, t].to(device).float(),
            motion=self._arrays["motion"][n].to(device),
            control=None if control is None else control[n, side, t].to(device),
            emphasis=None if emphasis is None else _mirrored(emphasis[n, t], flip).to(device).float(),
        )

    def names(self, clips: Tensor) -> tuple[str, ...]:
        """What the clips are called in messages: their seeds."""
        return tuple(f"clip {self.meta.seeds[number]}" for number in clips.tolist())


def _mirrored(rows: Tensor, flags: Tensor) -> Tensor:
    return torch.where(flags.view(-1, *[1] * (rows.ndim - 1)), rows.flip(-1), rows)


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
