"""What the live trainings learn from: single frames for depth, short runs of frames for paint, all drawn by number."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from gcd_model.geometry import Intrinsics
from gcd_model.live.config import LiveConfig
from gcd_model.live.depth_net import pixel_rays, plane_depth
from gcd_train.live.clips import LiveClip, clip_paths, read_clip

Random = np.random.Generator
Record = TypeVar("Record")
Batch = TypeVar("Batch")
PART_SEED = 1_000_003
"""Between the seeds of the batches of one update."""
_TARGET_SHARE = 0.25  # of the pictures that depth learns from: targets see the world from above
_NO_MOUNT, _EXACT_MOUNT = 0.35, 0.35
_HEIGHT_SPREAD, _TILT_SPREAD_DEG = 0.05, 0.7  # of the other mounts that are declared


@dataclass(frozen=True, kw_only=True, slots=True)
class Pictures:
    """N pictures of cameras and the truth about them.

    video: float32 [N, 3, H, W] in [-1, 1]. metres: float32 [N, H, W]. labels: int64 [N, H, W]. moves: float32
    [N, H, W]. lenses: N. ups: N normals of the floor in camera axes, [3]. heights_m: N, of the cameras over it.
    """

    video: Tensor
    metres: Tensor
    labels: Tensor
    moves: Tensor
    lenses: tuple[Intrinsics, ...]
    ups: tuple[Tensor, ...]
    heights_m: tuple[float, ...]

    @property
    def rays(self) -> Tensor:
        """[N, 2, H, W]."""
        return torch.stack([lens_rays(lens) for lens in self.lenses])

    def ground(self, random: Random | None = None, *, whole: bool = False) -> Tensor:
        """Depth of the floor, [N, H, W]; with `random`, of floors as people declare them: inexact, or not at all.

        whole: one declaration for all pictures, which one camera took.
        """
        rows: list[Tensor] = []
        salt = None if random is None else int(random.integers(2**31))
        for lens, up, height in zip(self.lenses, self.ups, self.heights_m, strict=True):
            drawn = None if salt is None else np.random.default_rng(salt) if whole else random
            declared = (up, height) if drawn is None else _declared(up, height, drawn)
            empty = torch.zeros(lens.height, lens.width)
            rows.append(empty if declared is None else plane_depth(lens, *declared))
        return torch.stack(rows)


@lru_cache(maxsize=4096)
def lens_rays(lens: Intrinsics) -> Tensor:
    """`pixel_rays`, kept."""
    return pixel_rays(lens)


def _declared(up: Tensor, height: float, random: Random) -> tuple[Tensor, float] | None:
    drawn = random.random()
    if drawn < _NO_MOUNT:
        return None
    if drawn < _NO_MOUNT + _EXACT_MOUNT:
        return up, height
    tilt = torch.from_numpy(random.normal(size=3) * np.radians(_TILT_SPREAD_DEG)).float()
    turned = up + torch.linalg.cross(tilt, up)
    return turned / turned.norm(), height * float(np.exp(random.normal() * _HEIGHT_SPREAD))


def pictures_of(clip: LiveClip, camera: str) -> Pictures:
    """All frames that were read of a clip, as "source" or "target" sees them."""
    arrays = {name.removeprefix(f"{camera}."): array for name, array in clip.arrays.items() if name.startswith(camera)}
    n, height, width = arrays["labels"].shape
    lens = Intrinsics.from_hfov(clip.hfov_deg(camera), width, height)
    poses = arrays["pose"]
    floor = float(clip.facts["floor_z_m"])
    return Pictures(
        video=to_video(arrays["rgb"]),
        metres=torch.from_numpy(clip.depth(camera)),
        labels=torch.from_numpy(arrays["labels"].astype(np.int64)),
        moves=torch.from_numpy(arrays["moves"].astype(np.float32)),
        lenses=(lens,) * n,
        ups=tuple(torch.from_numpy(pose[2, :3].copy()).float() for pose in poses),
        heights_m=tuple(max(float(pose[2, 3]) - floor, 0.05) for pose in poses),
    )


def to_video(rgb: NDArray[np.uint8]) -> Tensor:
    """u8 [N, H, W, 3] -> float32 [N, 3, H, W] in [-1, 1]."""
    return torch.from_numpy(rgb).permute(0, 3, 1, 2).float() / 127.5 - 1


class FrameBatches:
    """Batches of single frames of many clips; the number of the update decides which."""

    def __init__(self, paths: Sequence[Path], size: int, seed: int) -> None:
        self._paths, self._size, self._seed = list(paths), size, seed

    def batch(self, update: int) -> tuple[Pictures, Tensor, Random]:
        """Pictures, float32 [N, H, W] declared ground, and the generator for what else is drawn of them."""
        random = np.random.default_rng([self._seed, update])
        made: list[Pictures] = []
        for _ in range(self._size):
            path = self._paths[int(random.integers(len(self._paths)))]
            frame = int(random.integers(14))
            camera = "target" if random.random() < _TARGET_SHARE else "source"
            made.append(pictures_of(read_clip(path, slice(frame, frame + 1)), camera))
        together = augmented(joined(made), random)
        return together, together.ground(random), random


def joined(parts: Sequence[Pictures]) -> Pictures:
    """Pictures of several clips as one batch."""
    return Pictures(
        video=torch.cat([part.video for part in parts]),
        metres=torch.cat([part.metres for part in parts]),
        labels=torch.cat([part.labels for part in parts]),
        moves=torch.cat([part.moves for part in parts]),
        lenses=sum((part.lenses for part in parts), ()),
        ups=sum((part.ups for part in parts), ()),
        heights_m=sum((part.heights_m for part in parts), ()),
    )


def augmented(pictures: Pictures, random: Random) -> Pictures:
    """Mirrored or not, and seen by a camera of another exposure, colour, noise and focus."""
    video = pictures.video
    mirrored = [random.random() < 0.5 for _ in pictures.lenses]
    flip = torch.tensor(mirrored)[:, None, None]
    n = len(mirrored)

    def turned(x: Tensor) -> Tensor:
        return torch.where(flip if x.ndim == 3 else flip[:, None], x.flip(-1), x)

    return Pictures(
        video=other_camera(turned(video), random, n),
        metres=turned(pictures.metres),
        labels=turned(pictures.labels),
        moves=turned(pictures.moves),
        lenses=pictures.lenses,
        ups=tuple(
            up * torch.tensor([-1.0, 1.0, 1.0]) if m else up for up, m in zip(pictures.ups, mirrored, strict=True)
        ),
        heights_m=pictures.heights_m,
    )


def other_camera(video: Tensor, random: Random, n: int) -> Tensor:
    """Exposure, gamma, white balance, noise and blur of N cameras, [N, 3, H, W] in [-1, 1]; one in four as it is."""

    def drawn(spread: float, channels: int = 1) -> Tensor:
        wide = random.normal(size=(n, channels, 1, 1)) * spread * (random.random((n, 1, 1, 1)) < 0.75)
        return torch.from_numpy(wide).float()

    levels = ((video + 1) / 2).clamp(0, 1) ** drawn(0.25).exp()
    levels = (levels * (drawn(0.15) + drawn(0.07, 3)).exp() + drawn(0.03)).clamp(0, 1)
    blur = torch.from_numpy(random.random((n, 1, 1, 1)) * (random.random((n, 1, 1, 1)) < 0.3)).float()
    soft = torch.nn.functional.avg_pool2d(levels, 3, 1, 1, count_include_pad=False)
    levels = torch.lerp(levels, soft, blur)
    noise = torch.from_numpy(random.standard_normal(levels.shape, np.float32))
    return (levels * 2 - 1 + noise * drawn(0.04).abs()).clamp(-1, 1)


def class_weights(paths: Sequence[Path], config: LiveConfig, power: float, sample: int = 48) -> Tensor:
    """Weights of the classes in a loss, [K]: a power of how much of the pictures they fill, 1 for a mean pixel.

    sample: so many evenly chosen clips are looked at.
    """
    classes = len(config.classes)
    counts = np.ones(classes)
    for path in list(paths)[:: max(len(paths) // sample, 1)][:sample]:
        labels: NDArray[Any] = read_clip(path, slice(0, 1)).arrays["source.labels"]
        counts += np.bincount(labels.ravel(), minlength=classes)
    shares = torch.from_numpy(counts / counts.sum()).float()
    weights = shares.clamp(min=1e-4) ** power
    return weights / (weights * shares).sum()


def on(device: torch.device, record: Record) -> Record:
    """Records with their tensors, and those of the records in them, on a device."""
    if isinstance(record, Tensor):
        return cast("Record", record.to(device, non_blocking=True))
    if isinstance(record, tuple):
        return cast("Record", tuple(on(device, each) for each in cast("tuple[Any, ...]", record)))
    if not is_dataclass(record):
        return record
    moved = {f.name: on(device, getattr(record, f.name)) for f in fields(record)}
    return cast("Record", replace(record, **moved))  # pyright: ignore[reportArgumentType]


class Ahead(Generic[Batch]):
    """Batches by number, made in order by other processes before they are asked for; without workers, when they are."""

    def __init__(self, batch: Callable[[int], Batch], workers: int) -> None:
        self._batch, self._workers = batch, workers
        self._next, self._made = -1, iter(cast("list[Batch]", []))

    def __call__(self, update: int) -> Batch:
        """The batch of an update. Asked for out of order, the processes begin anew."""
        if self._workers == 0:
            return self._batch(update)
        if update != self._next:
            numbers = _Numbered(self._batch, update)
            self._made = iter(DataLoader(numbers, batch_size=None, num_workers=self._workers, prefetch_factor=4))
        self._next = update + 1
        return next(self._made)


class _Numbered(IterableDataset[Any]):
    """Batches from a number on; of W workers, worker w makes every W-th."""

    def __init__(self, batch: Callable[[int], Any], first: int) -> None:
        self._batch, self._first = batch, first

    def __iter__(self) -> Iterator[Any]:
        torch.set_num_threads(1)
        worker = get_worker_info()
        own, count = (0, 1) if worker is None else (worker.id, worker.num_workers)
        number = self._first + own
        while True:
            yield self._batch(number)
            number += count


def training_paths(folder: Path) -> list[Path]:
    """The clips of a data folder that may be learned from: scenes below a million. Raises DataError."""
    return [path for path in clip_paths(folder) if int(path.stem.split("-")[0]) < 1_000_000]
