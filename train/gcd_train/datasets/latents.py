"""Clips as the U-Net needs them, encoded once: memory-mapped arrays in one folder.

meta.json       what is in it and how it was made; written last, so a folder without it is unfinished
source.npy      float16 [N, F, T, C, h, w]   clean condition latents, plain and (F = 2) mirrored
target.npy      float16 [N, F, T, C, h, w]   target latents, as the U-Net works on them
half.npy        uint8   [N, T, 3, H/2, W/2]  the source at half size, for the warp channels
classes.npy     uint8   [N, T, h*u, w*u]     majority class of each cell of the class head's grid
clips.json      while unfinished: how many clips are done
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
import torch
from torch import Tensor

from gcd_train.errors import RunError


class LatentsMeta(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is in a folder of latents.

    identity: the autoencoder and the options it was made with. seeds: of the N clips. flips: F.
    class_counts: pixels of each class over all class maps; empty without any.
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
    picture_height: int
    picture_width: int
    class_upscale: int
    class_counts: tuple[int, ...] = ()
    sensitivity: tuple[float, ...] = ()
    mean: tuple[float, ...] = ()
    std: tuple[float, ...] = ()

    @property
    def clips(self) -> int:
        """N."""
        return len(self.seeds)

    @property
    def class_grid(self) -> tuple[int, int]:
        """Height and width of the class maps; (0, 0) without any."""
        return self.class_upscale * self.height, self.class_upscale * self.width

    @property
    def shapes(self) -> dict[str, tuple[tuple[int, ...], type[np.generic]]]:
        """Shape and type of each array file."""
        latents = (self.clips, self.flips, self.frames, self.channels, self.height, self.width)
        half = (self.clips, self.frames, 3, self.picture_height // 2, self.picture_width // 2)
        shapes: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
            "source": (latents, np.float16),
            "target": (latents, np.float16),
            "half": (half, np.uint8),
        }
        if self.class_upscale:
            shapes["classes"] = ((self.clips, self.frames, *self.class_grid), np.uint8)
        return shapes


@dataclass(frozen=True, kw_only=True, slots=True)
class LatentRows:
    """Some frames. Each row is one frame, mirrored or not.

    source, target: float32 [N, C, h, w]. half: uint8 [N, 3, H/2, W/2]. classes: int64 [N, H', W'] or None.
    frame_numbers: int64 [N].
    """

    source: Tensor
    target: Tensor
    half: Tensor
    classes: Tensor | None
    frame_numbers: Tensor


class LatentClips:
    """An opened folder of latents."""

    def __init__(self, meta: LatentsMeta, arrays: dict[str, Tensor]) -> None:
        self.meta, self._arrays = meta, arrays

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Map the arrays. Raises RunError if the folder is unfinished or damaged."""
        try:
            meta = msgspec.json.decode((folder / "meta.json").read_bytes(), type=LatentsMeta)
            mapped = {name: np.load(folder / f"{name}.npy", mmap_mode="c") for name in meta.shapes}
        except (OSError, ValueError, msgspec.DecodeError) as error:
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
        half = self._arrays["half"][n, t]
        return LatentRows(
            source=self._arrays["source"][n, flip.long(), t].to(device).float(),
            target=self._arrays["target"][n, flip.long(), t].to(device).float(),
            half=_mirrored(half, flip).to(device),
            classes=self.classes(clips, frames, mirrored, device),
            frame_numbers=frames.to(device),
        )

    def classes(self, clips: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device) -> Tensor | None:
        """Class maps of the frames (clips[i], frames[i]), int64 [N, H', W']; None without any."""
        maps = self._arrays.get("classes")
        if maps is None:
            return None
        chosen = maps[clips.to(maps.device), frames.to(maps.device)]
        return _mirrored(chosen, mirrored.to(maps.device)).to(device).long()


def _mirrored(rows: Tensor, flags: Tensor) -> Tensor:
    return torch.where(flags.view(-1, *[1] * (rows.ndim - 1)), rows.flip(-1), rows)
