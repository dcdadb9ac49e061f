"""Live clips on disk, and what the trainings draw from them by number.

A data folder holds `<world>/<seed>-<clip>.safetensors`, one file a clip, whole or not there:

    {source,target}.rgb      u8  [T, H, W, 3]     {source,target}.depth   u16 [T, H, W], see `decode_depth`
    {source,target}.labels   u8  [T, H, W]        {source,target}.instances u8 [T, H, W], 0 where nothing is counted
    {source,target}.moves    u8  [T, H, W], 1 where the thing moved since the frame before or moves until the next
    target.visibility        u8  [T, H, W]: 2 seen now, 1 seen before, 0 never seen
    {source,target}.pose     f64 [T, 4, 4], world_from_camera, metres

and in its metadata the lenses, the frame rate, the world, the height of its floor and the scene's facts.
"""

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_model.live.config import LIVE_CLASSES, SKY_M
from gcd_model.small_files import decode_json
from gcd_train.errors import DataError

_log = logging.getLogger(__name__)
CAMERAS: tuple[str, ...] = ("source", "target")
NEVER, BEFORE, NOW = 0, 1, 2
STATES = ("painted", "before", "now")
"""Values of the visibility, and what views call them."""
_HELD_OUT_SEED = 1_000_000
"""Scenes from here on are not learned from."""
_NEAREST_M, _CODES = 0.02, 65534
_SPAN = float(np.log(SKY_M / _NEAREST_M))
_SHARE = 0.45
"""Of the GPU's free memory, for one shelf."""
Array = NDArray[Any]
Poses = NDArray[np.float64]
Numbers = NDArray[np.int64]
Item = TypeVar("Item")
Read = Callable[[Path, slice, Sequence[str]], dict[str, Array]]
"""Some frames of some arrays of a file."""
Room = Callable[[int], int]
"""How many files of so many bytes are kept."""


def encode_depth(metres: Array) -> Array:
    """Depth in metres as u16 on a logarithmic scale, steps of 0.02 %; 0 stands for the sky."""
    code = 1 + np.log(np.clip(metres, _NEAREST_M, SKY_M) / _NEAREST_M) * ((_CODES - 1) / _SPAN)
    return np.where(metres > 0, np.rint(code), 0).astype(np.uint16)


def tensor_of(array: Array) -> Tensor:
    """The same numbers; of 16-bit codes, for which torch has few operations, the same bits."""
    return torch.from_numpy(array.view(np.int16) if array.dtype == np.uint16 else array)


def decode_depth(code: Tensor) -> Tensor:
    """Metres along the optical axis, float32, of codes as `tensor_of` gives them; SKY_M for the sky."""
    code = code.int() & 0xFFFF
    metres = _NEAREST_M * torch.exp((code - 1) * (_SPAN / (_CODES - 1)))
    return torch.where(code > 0, metres, SKY_M)


@dataclass(frozen=True, kw_only=True, slots=True)
class Cameras:
    """N cameras. poses: world_from_camera [N, 4, 4], metres. heights_m: [N], over the floor, at least 5 cm."""

    lenses: tuple[Intrinsics, ...]
    poses: Poses
    heights_m: Poses


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveClip:
    """A clip as it was filmed; arrays by the names in the module's docstring. facts: see there."""

    name: str
    arrays: dict[str, Array]
    facts: dict[str, Any]

    def lens(self, camera: str) -> Intrinsics:
        """Of "source" or "target"; its pictures or labels have to be read."""
        pictures = self.arrays[f"{camera}.rgb"] if f"{camera}.rgb" in self.arrays else self.arrays[f"{camera}.labels"]
        height, width = pictures.shape[1:3]
        return Intrinsics.from_hfov(float(self.facts[f"{camera}_hfov_deg"]), width, height)

    def cameras(self, name: str) -> Cameras:
        """ "source" or "target" in every frame, as `lens`."""
        poses = self.arrays[f"{name}.pose"]
        heights_m = np.maximum(poses[:, 2, 3] - float(self.facts["floor_z_m"]), 0.05)
        return Cameras(lenses=(self.lens(name),) * len(poses), poses=poses, heights_m=heights_m)

    def poses(self, camera: str) -> Tensor:
        """world_from_camera, float64 [T, 4, 4]."""
        return torch.from_numpy(self.arrays[f"{camera}.pose"])

    def depth(self, camera: str) -> Tensor:
        """float32 [T, H, W], metres; SKY_M for the sky."""
        return decode_depth(tensor_of(self.arrays[f"{camera}.depth"]))


def clip_paths(folder: Path) -> list[Path]:
    """All clips of a data folder, in order. Raises DataError if there are none."""
    paths = sorted(folder.glob("*/*.safetensors"))
    if not paths:
        raise DataError(
            f"{folder} holds no live clips, or is not there; make some with `gcd-train generate live {folder}`"
        )
    return paths


def training_paths(folder: Path) -> list[Path]:
    """The clips of a data folder that may be learned from: scenes below a million. Raises DataError."""
    paths = [path for path in clip_paths(folder) if int(path.stem.split("-")[0]) < _HELD_OUT_SEED]
    if not paths:
        raise DataError(f"{folder} holds held-out scenes alone; film some below seed {_HELD_OUT_SEED} to learn from")
    return paths


def evenly(items: Sequence[Item], most: int) -> Sequence[Item]:
    """At most so many of them, evenly chosen."""
    return items[:: max(len(items) // most, 1)][:most]


def read_clip(path: Path, frames: slice = slice(None), names: Collection[str] | None = None) -> LiveClip:
    """Some frames of a clip; of some arrays, see the module. Raises DataError for a file that is no live clip."""
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        with safe_open(path, framework="numpy") as file:
            facts = decode_json(file.metadata()["facts"], dict[str, Any])
            wanted = file.keys() if names is None else names
            arrays = {name: file.get_slice(name)[frames] for name in wanted}
    except Exception as error:  # safetensors and json raise kinds of their own
        raise DataError(f"{path} is no live clip ({error}); film it again") from error
    if any(int(array.max()) >= len(LIVE_CLASSES) for name, array in arrays.items() if name.endswith("labels")):
        raise DataError(f"{path} holds class ids beyond {len(LIVE_CLASSES) - 1}; film it again with this version")
    return LiveClip(name=f"{path.parent.name}/{path.stem}", arrays=arrays, facts=facts)


# --- what batches are drawn from -------------------------------------------------------------------------------------


def room_on(device: torch.device) -> Room | None:
    """In a GPU's memory; None for other devices: there files are read from disk."""
    if device.type != "cuda":
        return None
    return lambda size: int(torch.cuda.mem_get_info(device)[0] * _SHARE) // size


class Shelf:
    """Arrays [T, ...] of files that all have the same shapes, by number of file and frame.

    Without a GPU frames are read from disk as they are drawn. With one every file is read once and stays in the GPU's
    memory as bytes, 5 MB a clip: for a batch nothing but numbers goes there.
    """

    def __init__(self, read: Read, names: Sequence[str], device: torch.device, room: Room | None) -> None:
        """names: of all that will be asked for. room: None to keep none."""
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


class TrainingClips:
    """The clips of a folder that may be learned from, by number, on a device."""

    def __init__(self, folder: Path, device: torch.device) -> None:
        """Raises DataError if there are none."""
        self._folder, self.device, self._full = folder, device, False
        names = [f"{camera}.{name}" for camera in CAMERAS for name in ("rgb", "depth", "labels", "moves")]
        names.append("target.visibility")
        self._shelf = Shelf(lambda path, t, some: read_clip(path, t, some).arrays, names, device, room_on(device))
        self.take = self._shelf.take
        self.paths: list[Path] = []
        self._cameras: list[dict[str, Cameras]] = []
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
            clip = read_clip(path, names=[f"{name}.pose" for name in CAMERAS])
            clip.arrays.update(read_clip(path, slice(0, 1), [f"{name}.labels" for name in CAMERAS]).arrays)
            self._cameras.append({name: clip.cameras(name) for name in CAMERAS})
            self.paths.append(path)

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def frames(self) -> int:
        """T."""
        return len(self._cameras[0]["source"].poses)

    def cameras(self, name: str, clips: Numbers, frames: Numbers) -> Cameras:
        """ "source" or "target" of each of N clips, each at a frame."""
        some = [(self._cameras[i][name], t) for i, t in zip(clips, frames, strict=True)]
        return Cameras(
            lenses=tuple(each.lenses[t] for each, t in some),
            poses=np.stack([each.poses[t] for each, t in some]),
            heights_m=np.array([each.heights_m[t] for each, t in some]),
        )
