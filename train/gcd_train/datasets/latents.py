"""Clips as the U-Net needs them, encoded once: memory-mapped arrays in one folder.

meta.json       what is in it and how it was made; written last, so a folder without it is unfinished
source.npy      float16 [N, F, T, C, h, w]      clean condition latents, plain and (F = 2) mirrored
target.npy      float16 [N, F, T, C, h, w]      target latents, as the U-Net works on them
motion.npy      float32 [N]                     the number that tells how far the camera goes
control.npy     float32 [N, F, T, K]            camera features, where the model is steered
emphasis.npy    float16 [N, T, 1, h, w]         how much more a class counts, see `class_emphasis`
clips.json      while unfinished: how many clips are done
"""

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
