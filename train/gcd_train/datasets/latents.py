"""Clips as the U-Net needs them, encoded once: memory-mapped arrays in one folder.

meta.json       what is in it and how it was made; written last, so a folder without it is unfinished
source.npy      float16 [N, F, T, C, h, w]      clean condition latents, plain and (F = 2) mirrored
target.npy      float16 [N, F, T, C, h, w]      target latents, as the U-Net works on them
motion.npy      float32 [N]                     the number that tells how far the camera goes
control.npy     float32 [N, F, T, K]            camera features, where the model is steered
half.npy        uint8   [N, T, 3, H/2, W/2]     where the model warps: see `WarpPictures`
ground.npy      uint8   [N, T, 3, H/2, W/2]
distant.npy     uint8   [N, T, Q, 3, H/4, W/4]
rays.npy        float16 [N, T, 4, h, w]
classes.npy     uint8   [N, T, h*u, w*u]        majority class of each cell of the class head's grid
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

from gcd_model.plane_warp import WarpPictures, mirrored
from gcd_train.errors import RunError

_PICTURES = ("half", "ground", "distant")
_GREY, _BYTES = 128, 127.0  # mid grey, which stands for "nothing known", is kept exactly


class LatentsMeta(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is in a folder of latents.

    identity: the autoencoder and the options it was made with. seeds: of the N clips. flips: F.
    distant: Q, 0 for a model that does not warp. control: K, 0 for a model that is not steered.
    class_upscale: u, 0 without class maps. emphasis: whether classes count unequally.
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
    distant: int
    control: int
    class_upscale: int
    emphasis: bool
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
        grid, each = (self.height, self.width), (self.clips, self.frames)
        latents = (self.clips, self.flips, self.frames, self.channels, *grid)
        shapes: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
            "source": (latents, np.float16),
            "target": (latents, np.float16),
            "motion": ((self.clips,), np.float32),
        }
        if self.control:
            shapes["control"] = ((self.clips, self.flips, self.frames, self.control), np.float32)
        if self.distant:
            half, quarter = ((self.picture_height // by, self.picture_width // by) for by in (2, 4))
            shapes["half"] = shapes["ground"] = ((*each, 3, *half), np.uint8)
            shapes["distant"] = ((*each, self.distant, 3, *quarter), np.uint8)
            shapes["rays"] = ((*each, 4, *grid), np.float16)
        if self.class_upscale:
            shapes["classes"] = ((*each, *self.class_grid), np.uint8)
        if self.emphasis:
            shapes["emphasis"] = ((*each, 1, *grid), np.float16)
        return shapes


@dataclass(frozen=True, kw_only=True, slots=True)
class LatentRows:
    """Some frames. Each row is one frame, mirrored or not.

    source, target: float32 [N, C, h, w]. motion: float32 [N]. control: float32 [N, K], None where nobody steers.
    pictures: float32, None for a model that does not warp. classes: int64 [N, H', W'] or None.
    emphasis: float32 [N, 1, h, w] or None.
    """

    source: Tensor
    target: Tensor
    motion: Tensor
    control: Tensor | None
    pictures: WarpPictures | None
    classes: Tensor | None
    emphasis: Tensor | None


def picture_bytes(pictures: WarpPictures) -> dict[str, Tensor]:
    """The arrays they are kept in, by name: pictures as uint8, mid grey as 128; rays float16."""
    rows = {name: (getattr(pictures, name) * _BYTES).round() + _GREY for name in _PICTURES}
    return {**{name: row.clamp(0, 255).to(torch.uint8) for name, row in rows.items()}, "rays": pictures.rays.half()}


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
        side, control, emphasis = flip.long(), self._arrays.get("control"), self._arrays.get("emphasis")
        return LatentRows(
            source=self._arrays["source"][n, side, t].to(device).float(),
            target=self._arrays["target"][n, side, t].to(device).float(),
            motion=self._arrays["motion"][n].to(device),
            control=None if control is None else control[n, side, t].to(device),
            pictures=self._pictures(n, t, flip, device),
            classes=self.classes(clips, frames, mirrored, device),
            emphasis=None if emphasis is None else _mirrored(emphasis[n, t], flip).to(device).float(),
        )

    def names(self, clips: Tensor) -> tuple[str, ...]:
        """What the clips are called in messages: their seeds."""
        return tuple(f"clip {self.meta.seeds[number]}" for number in clips.tolist())

    def _pictures(self, clips: Tensor, frames: Tensor, flip: Tensor, device: torch.device) -> WarpPictures | None:
        if not self.meta.distant:
            return None
        rows = {name: _from_bytes(self._arrays[name][clips, frames].to(device)) for name in _PICTURES}
        plain = WarpPictures(**rows, rays=self._arrays["rays"][clips, frames].to(device).float())
        return _looked_at(plain, flip.to(device))

    def classes(self, clips: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device) -> Tensor | None:
        """Class maps of the frames (clips[i], frames[i]), int64 [N, H', W']; None without any."""
        maps = self._arrays.get("classes")
        if maps is None:
            return None
        chosen = maps[clips.to(maps.device), frames.to(maps.device)]
        return _mirrored(chosen, mirrored.to(maps.device)).to(device).long()


def _looked_at(plain: WarpPictures, flip: Tensor) -> WarpPictures:
    """Mirrored where the flag says so."""
    if not flip.any():
        return plain
    other = mirrored(plain)
    names = (*_PICTURES, "rays")
    return WarpPictures(**{name: _either(flip, getattr(other, name), getattr(plain, name)) for name in names})


def _from_bytes(rows: Tensor) -> Tensor:
    return rows.float().sub_(_GREY).div_(_BYTES)


def _mirrored(rows: Tensor, flags: Tensor) -> Tensor:
    return _either(flags, rows.flip(-1), rows)


def _either(flags: Tensor, first: Tensor, second: Tensor) -> Tensor:
    return torch.where(flags.view(-1, *[1] * (first.ndim - 1)), first, second)
