"""What the live trainings learn from: single frames for depth, short runs of frames for paint, all drawn by number."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from gcd_model.geometry import Intrinsics
from gcd_model.live.config import SKY_M, DepthConfig, LiveConfig
from gcd_model.live.depth_net import Reference, pixel_rays, plane_depth, sweep_costs
from gcd_model.live.eyes import LONGEST, References
from gcd_model.loading import default_precision
from gcd_train.live.clips import LiveClip, clip_paths, evenly, read_clip
from gcd_train.live.draws import Poses
from gcd_train.training.loop import Progress

Random = np.random.Generator
Record = TypeVar("Record")
Batch = TypeVar("Batch")
PART_SEED = 1_000_003
"""Between the seeds of the batches of one update."""
_MOST_GAP, _REFERENCE_SHARE = 6, 0.85
"""Frames between a picture and the earlier one it is compared with; how often there is such a one."""
_TURN_NOISE_DEG, _MOVE_NOISE = 0.03, 0.001
"""Errors of the motion between two frames; of the move in parts of the median depth."""
_TARGET_SHARE = 0.25  # of the pictures that depth learns from: targets see the world from above
_NO_MOUNT, _EXACT_MOUNT = 0.35, 0.35
_COUNTED = 48  # clips that say how common classes are
_HEIGHT_SPREAD, _TILT_SPREAD_DEG = 0.05, 0.7  # of the other mounts that are declared


@dataclass(frozen=True, kw_only=True, slots=True)
class Pictures:
    """N pictures of cameras and the truth about them.

    video: float32 [N, 3, H, W] in [-1, 1]. metres: float32 [N, H, W]. labels: int64 [N, H, W]. moves: float32
    [N, H, W]. lenses: N. ups: N normals of the floor in camera axes, [3]. heights_m: N, of the cameras over it.
    references: N earlier frames of the same cameras, None where there is none.
    """

    video: Tensor
    metres: Tensor
    labels: Tensor
    moves: Tensor
    lenses: tuple[Intrinsics, ...]
    ups: tuple[Tensor, ...]
    heights_m: tuple[float, ...]
    references: tuple[Reference | None, ...]

    def sweeps(self, config: DepthConfig) -> Tensor:
        """[N, bins + 1, H/2, W/2], see `sweep_costs`."""
        each = zip(self.video, self.lenses, self.references, strict=True)
        return torch.stack([sweep_costs(picture, lens, reference, config) for picture, lens, reference in each])

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
    """All frames that were read of a clip, as "source" or "target" sees them, without references."""
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
        references=(None,) * n,
    )


def to_video(rgb: NDArray[np.uint8]) -> Tensor:
    """u8 [N, H, W, 3] -> float32 [N, 3, H, W] in [-1, 1]."""
    return torch.from_numpy(rgb).permute(0, 3, 1, 2).float() / 127.5 - 1


def with_true_references(clip: LiveClip, camera: str) -> Pictures:
    """All frames of a clip, each with the earlier one that a live view would compare it with, by true poses."""
    pictures = pictures_of(clip, camera)
    kept, references = References(), []
    for picture, pose, metres in zip(pictures.video, clip.arrays[f"{camera}.pose"], pictures.metres, strict=True):
        world_from_camera = torch.from_numpy(pose)
        references.append(kept.chosen(world_from_camera))
        kept.add(picture, world_from_camera, metres)
    return replace(pictures, references=tuple(references))


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
            names = [f"{camera}.{name}" for name in ("rgb", "depth", "labels", "moves", "pose")]
            clip = read_clip(path, slice(frame, frame + 1), names)
            earlier = frame - int(random.integers(1, _MOST_GAP + 1))
            pictures = pictures_of(clip, camera)
            if earlier >= 0 and random.random() < _REFERENCE_SHARE:
                before = read_clip(path, slice(earlier, earlier + 1), names[:1] + names[-1:])
                pictures = _compared(pictures, before, clip.arrays[names[-1]][0], camera, random)
            made.append(pictures)
        together = augmented(joined(made), random)
        return together, together.ground(random), random


def _compared(pictures: Pictures, before: LiveClip, pose: Poses, camera: str, random: Random) -> Pictures:
    """One picture with an earlier one, unless that is too far away; the motion between them is not quite right."""
    move = torch.from_numpy(np.linalg.inv(before.arrays[f"{camera}.pose"][0]) @ pose)
    near = pictures.metres[pictures.metres < SKY_M]
    median = float(near.median()) if near.numel() else 0.0
    if float(move[:3, 3].norm()) > 2 * LONGEST * median:
        return pictures
    turn = torch.from_numpy(random.normal(size=3) * np.radians(_TURN_NOISE_DEG))
    move[:3, :3] = move[:3, :3] @ torch.linalg.matrix_exp(_cross(turn))
    move[:3, 3] += torch.from_numpy(random.normal(size=3) * _MOVE_NOISE * median)
    reference = Reference(picture=to_video(before.arrays[f"{camera}.rgb"])[0], reference_from_camera=move)
    return replace(pictures, references=(reference,))


def _cross(turn: Tensor) -> Tensor:
    """[3] -> [3, 3], the matrix of the cross product."""
    x, y, z = turn.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


def halved(pictures: Pictures) -> Pictures:
    """The same at half the size: colours are averages, what cannot be averaged is of one pixel of four."""
    return replace(
        pictures,
        video=avg_pool2d(pictures.video, 2),
        metres=pictures.metres[:, ::2, ::2],
        labels=pictures.labels[:, ::2, ::2],
        moves=pictures.moves[:, ::2, ::2],
        lenses=tuple(lens.resized(lens.width // 2, lens.height // 2) for lens in pictures.lenses),
        references=tuple(
            None if each is None else replace(each, picture=avg_pool2d(each.picture, 2)) for each in pictures.references
        ),
    )


def augmented(pictures: Pictures, random: Random) -> Pictures:
    """Mirrored or not, and seen by a camera of another exposure, colour, noise and focus."""
    video = pictures.video
    mirrored = [random.random() < 0.5 for _ in pictures.lenses]
    flip = torch.tensor(mirrored)[:, None, None]
    n = len(mirrored)

    def turned(x: Tensor) -> Tensor:
        return torch.where(flip if x.ndim == 3 else flip[:, None], x.flip(-1), x)

    look = other_camera(random, n)
    flipped = torch.diag(torch.tensor([-1.0, 1, 1, 1], dtype=torch.float64))
    earlier = [video[i] if each is None else each.picture for i, each in enumerate(pictures.references)]
    seen_earlier = look(turned(torch.stack(earlier)), random)
    return replace(
        pictures,
        video=look(turned(video), random),
        references=tuple(
            None
            if each is None
            else Reference(
                picture=seen_earlier[i],
                reference_from_camera=flipped @ each.reference_from_camera @ flipped
                if mirrored[i]
                else each.reference_from_camera,
            )
            for i, each in enumerate(pictures.references)
        ),
        metres=turned(pictures.metres),
        labels=turned(pictures.labels),
        moves=turned(pictures.moves),
        ups=tuple(
            up * torch.tensor([-1.0, 1.0, 1.0]) if m else up for up, m in zip(pictures.ups, mirrored, strict=True)
        ),
    )


def other_camera(random: Random, n: int) -> Callable[[Tensor, Random], Tensor]:
    """Exposure, gamma, white balance, noise and blur of N cameras, one in four as it is.

    What pictures [N, 3, H, W] in [-1, 1] look like through them; only the noise is drawn anew every time.
    """

    def drawn(spread: float, channels: int = 1) -> Tensor:
        wide = random.normal(size=(n, channels, 1, 1)) * spread * (random.random((n, 1, 1, 1)) < 0.75)
        return torch.from_numpy(wide).float()

    gamma, gain, offset, spread = (
        drawn(0.25).exp(),
        (drawn(0.15) + drawn(0.07, 3)).exp(),
        drawn(0.03),
        drawn(0.04).abs(),
    )
    blur = torch.from_numpy(random.random((n, 1, 1, 1)) * (random.random((n, 1, 1, 1)) < 0.3)).float()

    def look(video: Tensor, random: Random) -> Tensor:
        levels = (((video + 1) / 2).clamp(0, 1) ** gamma * gain + offset).clamp(0, 1)
        soft = avg_pool2d(levels, 3, 1, 1, count_include_pad=False)
        noise = torch.from_numpy(random.standard_normal(levels.shape, np.float32))
        return (torch.lerp(levels, soft, blur) * 2 - 1 + noise * spread).clamp(-1, 1)

    return look


def class_weights(paths: Sequence[Path], config: LiveConfig, power: float) -> Tensor:
    """Weights of the classes in a loss, [K]: a power of how much of the pictures they fill, 1 for a mean pixel."""
    classes = len(config.classes)
    counts = np.ones(classes)
    for path in evenly(paths, _COUNTED):
        labels: NDArray[Any] = read_clip(path, slice(0, 1)).arrays["source.labels"]
        counts += np.bincount(labels.ravel(), minlength=classes)
    shares = torch.from_numpy(counts / counts.sum()).float()
    weights = shares.clamp(min=1e-4) ** power
    return weights / (weights * shares).sum()


def autocast(device: torch.device) -> torch.autocast:
    """bfloat16 where the device is fast at it; other processors take seven times as long by it."""
    fast = default_precision(device, live=True) == "bfloat16"
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=fast)


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


def joined(parts: Sequence[Record]) -> Record:
    """Records of pictures or views as one batch."""
    first: Any = parts[0]
    if isinstance(first, Tensor):
        return cast("Record", torch.cat(cast("list[Tensor]", parts)))
    if isinstance(first, tuple):
        return cast("Record", tuple(chain(*cast("list[tuple[Any, ...]]", parts))))
    together = {f.name: joined([getattr(part, f.name) for part in parts]) for f in fields(first)}
    return replace(first, **together)


def some_of(batch: Record, cut: slice) -> Record:
    """Some pictures or views of a record of them."""
    if isinstance(batch, Tensor | tuple):
        return cast("Record", batch[cut])
    taken = {f.name: some_of(getattr(batch, f.name), cut) for f in fields(cast("Any", batch))}
    return replace(cast("Any", batch), **taken)


class LiveTask:
    """What all stages' tasks have in common; see SharedTask."""

    def __init__(self, net: nn.Module, config: LiveConfig) -> None:
        self.module = net
        self._network, self._config, self._device = net, config, next(net.parameters()).device

    def compute_through(self, network: nn.Module) -> None:
        """See SharedTask."""
        self._network = network

    def after_update(self, progress: Progress) -> bool:
        """Nothing to do."""
        _ = progress
        return False


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
