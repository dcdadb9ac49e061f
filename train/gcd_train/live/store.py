"""What the live trainings draw their batches from: frames of many files by number, on the training's device.

Without a GPU frames are read from disk as they are drawn. With one every file is read once and stays in the GPU's
memory as bytes, 5 MB a clip: for a batch nothing but numbers goes there.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.errors import DataError
from gcd_train.live.clips import Array, LiveClip, clip_paths, read_clip, tensor_of
from gcd_train.live.draws import Poses

_log = logging.getLogger(__name__)
CAMERAS = ("source", "target")
_PIXELS = tuple(f"{camera}.{name}" for camera in CAMERAS for name in ("rgb", "depth", "labels", "moves"))
_SHARE = 0.45
"""Of the GPU's free memory, for one shelf."""
Numbers = NDArray[np.int64]
Read = Callable[[Path, slice, Sequence[str]], dict[str, Array]]
Room = Callable[[int], int]
"""How many files of so many bytes are kept."""


def room_on(device: torch.device) -> Room | None:
    """In a GPU's memory; None for other devices: there files are read from disk."""
    if device.type != "cuda":
        return None
    return lambda size: int(torch.cuda.mem_get_info(device)[0] * _SHARE) // size


class Shelf:
    """Arrays [T, ...] of files that all have the same shapes, by number of file and frame."""

    def __init__(self, read: Read, names: Sequence[str], device: torch.device, room: Room | None) -> None:
        """read: some frames of some arrays of a file. names: of all that will be asked for. room: None to keep none."""
        self._read, self._names, self._device, self._room = read, names, device, room
        self._paths: list[Path] = []
        self._kept: dict[str, Tensor] = {}
        self._most = 0

    def add(self, path: Path) -> bool:
        """Take in a file, as the next number; False where there is no room for it."""
        if self._room is not None:
            arrays = {name: tensor_of(array) for name, array in self._read(path, slice(None), self._names).items()}
            if not self._kept:
                self._most = self._room(sum(array.nbytes for array in arrays.values()))
                self._kept = {
                    name: torch.empty(self._most, *array.shape, dtype=array.dtype, device=self._device)
                    for name, array in arrays.items()
                }
            if len(self._paths) >= self._most:
                return False
            for name, array in arrays.items():
                self._kept[name][len(self._paths)] = array
        self._paths.append(path)
        return True

    def take(self, files: Numbers, frames: Numbers, names: Sequence[str]) -> dict[str, Tensor]:
        """A frame of each of N files, on the device: [N, ...] by name, see `tensor_of`."""
        if self._kept:
            at = tuple(torch.from_numpy(each).to(self._device) for each in (files, frames))
            return {name: self._kept[name][at] for name in names}
        rows = [self._read(self._paths[i], slice(t, t + 1), names) for i, t in zip(files, frames, strict=True)]
        return {name: torch.cat([tensor_of(row[name]) for row in rows]).to(self._device) for name in names}


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """A clip's "source" or "target". poses: world_from_camera [T, 4, 4], metres. floor_z_m: of its world."""

    lens: Intrinsics
    poses: Poses
    floor_z_m: float


class TrainingClips:
    """The clips of a folder that may be learned from, by number."""

    def __init__(self, folder: Path, device: torch.device) -> None:
        """Raises DataError if there are none."""
        self._folder, self.device = folder, device
        self._shelf = Shelf(_read_pixels, (*_PIXELS, "target.visibility"), device, room_on(device))
        self._full = False
        self.paths: list[Path] = []
        self._cameras: dict[str, list[Camera]] = {camera: [] for camera in CAMERAS}
        self.grow()

    def grow(self) -> None:
        """Take in what was added to the folder since."""
        known = set(self.paths)
        for path in training_paths(self._folder):
            if path in known or self._full:
                continue
            if not self._shelf.add(path):
                _log.warning("the GPU's memory is full with %d clips; the others are left out", len(self.paths))
                self._full = True
                continue
            clip = read_clip(path, names=[f"{camera}.pose" for camera in CAMERAS])
            size = read_clip(path, slice(0, 1), ["source.labels"]).arrays["source.labels"].shape[1:]
            for camera, listed in self._cameras.items():
                listed.append(camera_of(clip, camera, size))
            self.paths.append(path)

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def frames(self) -> int:
        """T."""
        return len(self._cameras["source"][0].poses)

    def cameras(self, camera: str, clips: Numbers) -> list[Camera]:
        """ "source" or "target" of each of N clips."""
        return [self._cameras[camera][i] for i in clips]

    def take(self, clips: Numbers, frames: Numbers, names: Sequence[str]) -> dict[str, Tensor]:
        """See `Shelf.take`."""
        return self._shelf.take(clips, frames, names)


def camera_of(clip: LiveClip, name: str, size: Sequence[int]) -> Camera:
    """ "source" or "target" of a clip whose pictures have that height and width."""
    height, width = size
    lens = Intrinsics.from_hfov(clip.hfov_deg(name), width, height)
    return Camera(lens=lens, poses=clip.arrays[f"{name}.pose"], floor_z_m=float(clip.facts["floor_z_m"]))


def _read_pixels(path: Path, frames: slice, names: Sequence[str]) -> dict[str, Array]:
    return read_clip(path, frames, names).arrays


def training_paths(folder: Path) -> list[Path]:
    """The clips of a data folder that may be learned from: scenes below a million. Raises DataError."""
    paths = [path for path in clip_paths(folder) if int(path.stem.split("-")[0]) < 1_000_000]
    if not paths:
        raise DataError(f"{folder} holds held-out scenes alone; film some below seed 1000000 to learn from")
    return paths
