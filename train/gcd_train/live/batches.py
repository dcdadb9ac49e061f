"""What the live trainings learn from: single frames for depth, short runs of frames for paint, all drawn by number.

Which frames are drawn, and how they are changed, follows from the number of the update; the pixels are worked on where
the training runs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gcd_model.config import SemanticClass
from gcd_model.geometry import Intrinsics
from gcd_model.live.config import SKY_M, DepthConfig, LiveConfig
from gcd_model.live.depth_net import plane_depth, plane_sweep
from gcd_model.live.eyes import LONGEST, References
from gcd_model.loading import default_precision
from gcd_train.data.sample import to_network
from gcd_train.evaluation.metrics import class_iou
from gcd_train.live.clips import Cameras, LiveClip, TrainingClips, decode_depth, evenly, read_clip, tensor_of

Random = np.random.Generator
Record = TypeVar("Record")
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
_NEWS = 200
"""Updates after which the folder is asked for clips that were added."""
_AVERAGED = {"video", "earlier", "target", "coverage", "now_share", "age", "painted", "painted_coverage", "rays"}
_WHOLE = {"ups", "heights_m", "earlier_from_camera", "compared", "camera", "poses"}
"""Of a record of pictures or views: what is averaged at half the size, and what has no pixels."""
_MIRRORED = torch.diag(torch.tensor([-1.0, 1, 1, 1], dtype=torch.float64))


@dataclass(frozen=True, kw_only=True, slots=True)
class Pictures:
    """N pictures of cameras and the truth about them, on one device.

    video: float32 [N, 3, H, W] in [-1, 1]. metres: float32 [N, H, W]. labels: int64 [N, H, W]. moves: float32
    [N, H, W]. lenses: N. ups: [N, 3], normals of the floor in camera axes. heights_m: [N], of the cameras over it.
    earlier: [N, 3, H, W], earlier frames of the same cameras. earlier_from_camera: float64 [N, 4, 4]. compared: bool
    [N], whether there is an earlier frame at all.
    """

    video: Tensor
    metres: Tensor
    labels: Tensor
    moves: Tensor
    lenses: tuple[Intrinsics, ...]
    ups: Tensor
    heights_m: Tensor
    earlier: Tensor
    earlier_from_camera: Tensor
    compared: Tensor

    def sweeps(self, config: DepthConfig) -> Tensor:
        """[N, bins + 1, H/2, W/2], see `plane_sweep`; all zero without an earlier frame."""
        table = torch.tensor([[lens.fx, lens.fy, lens.cx, lens.cy] for lens in self.lenses]).to(self.video)
        costs = plane_sweep(self.video, table, self.earlier, self.earlier_from_camera, config)
        return costs * self.compared[:, None, None, None]

    @property
    def rays(self) -> Tensor:
        """[N, 2, H, W]."""
        return rays_of(self.lenses, self.video.device)

    def ground(self, random: Random | None = None, *, whole: bool = False) -> Tensor:
        """Depth of the floor, [N, H, W]; with `random`, of floors as people declare them: inexact, or not at all.

        whole: one declaration for all pictures, which one camera took.
        """
        ups, heights = self.ups, self.heights_m
        if random is None:
            return plane_depth(self.rays, ups, heights)
        n = 1 if whole else len(self.lenses)
        drawn = random.random((n, 1))
        inexact = drawn >= _NO_MOUNT + _EXACT_MOUNT
        tilt = on_device(random.normal(size=(n, 3)) * np.radians(_TILT_SPREAD_DEG) * inexact, ups)
        factor = on_device(np.exp(random.normal(size=n) * _HEIGHT_SPREAD * inexact[:, 0]), ups)
        turned = ups + torch.linalg.cross(tilt.expand_as(ups), ups)
        made = plane_depth(self.rays, turned / turned.norm(dim=1, keepdim=True), heights * factor)
        return made * on_device(drawn >= _NO_MOUNT, ups)[:, :, None]


def on_device(array: NDArray[Any] | Sequence[float], like: Tensor) -> Tensor:
    """Numbers of an array as `like` has them, and where."""
    return torch.from_numpy(np.asarray(array)).to(like)


_rays = lru_cache(maxsize=4096)(Intrinsics.rays)


def rays_of(lenses: Sequence[Intrinsics], device: torch.device) -> Tensor:
    """`Intrinsics.rays` of N lenses: [N, 2, H, W]."""
    return torch.stack([_rays(lens, device) for lens in lenses])


def pictures_of(clip: LiveClip) -> Pictures:
    """All source frames that were read of a clip, without earlier ones."""
    arrays = {name: tensor_of(array) for name, array in clip.arrays.items() if name.startswith("source")}
    return _pictures(arrays, "source", clip.cameras("source"))


def _pictures(arrays: dict[str, Tensor], name: str, cameras: Cameras) -> Pictures:
    """arrays: as a clip has them, of frames of N cameras."""
    video = to_network(arrays[f"{name}.rgb"])
    return Pictures(
        video=video,
        metres=decode_depth(arrays[f"{name}.depth"]),
        labels=arrays[f"{name}.labels"].long(),
        moves=arrays[f"{name}.moves"].float(),
        lenses=cameras.lenses,
        ups=on_device(cameras.poses[:, 2, :3].copy(), video),
        heights_m=on_device(cameras.heights_m, video),
        earlier=video,
        earlier_from_camera=torch.eye(4, dtype=torch.float64, device=video.device).expand(len(video), 4, 4),
        compared=torch.zeros(len(video), dtype=torch.bool, device=video.device),
    )


def with_true_references(clip: LiveClip) -> Pictures:
    """All source frames, each with the earlier one that a live view would compare it with, by true poses."""
    pictures, kept = pictures_of(clip), References()
    earlier, moves = pictures.earlier.clone(), pictures.earlier_from_camera.clone()
    compared = pictures.compared.clone()
    for t, (picture, pose) in enumerate(zip(pictures.video, clip.poses("source"), strict=True)):
        chosen = kept.chosen(pose)
        if chosen is not None:
            earlier[t], moves[t], compared[t] = chosen.picture, chosen.reference_from_camera, True
        kept.add(picture, pose, pictures.metres[t])
    return replace(pictures, earlier=earlier, earlier_from_camera=moves, compared=compared)


class FrameBatches:
    """Batches of single frames of many clips; the number of the update decides which."""

    def __init__(self, clips: TrainingClips, size: int, seed: int) -> None:
        self._clips, self._size, self._seed = clips, size, seed

    def batch(self, update: int) -> tuple[Pictures, Tensor, Random]:
        """Pictures, float32 [N, H, W] declared ground, and the generator for what else is drawn of them."""
        if update % _NEWS == 0:
            self._clips.grow()
        random = np.random.default_rng([self._seed, update])
        targets = int(random.binomial(self._size, _TARGET_SHARE))
        counts = {"source": self._size - targets, "target": targets}
        together = augmented(joined([self._drawn(name, n, random) for name, n in counts.items() if n]), random)
        return together, together.ground(random), random

    def _drawn(self, name: str, count: int, random: Random) -> Pictures:
        """Of "source" or "target", with earlier frames that are not too far away, by motion that is not quite right."""
        chosen, frames = random.integers((len(self._clips), self._clips.frames), size=(count, 2)).T
        before = frames - random.integers(1, _MOST_GAP + 1, size=count)
        compared = (before >= 0) & (random.random(count) < _REFERENCE_SHARE)
        before = before.clip(0)
        now, then = (self._clips.cameras(name, chosen, times) for times in (frames, before))
        names = [f"{name}.{array}" for array in ("rgb", "depth", "labels", "moves")]
        pictures = _pictures(self._clips.take(chosen, frames, names), name, now)
        far = torch.where(pictures.metres < SKY_M, pictures.metres, torch.nan).flatten(1)
        median = far.nanmedian(dim=1).values.nan_to_num(0.0).double()
        moves = on_device(np.linalg.inv(then.poses) @ now.poses, median)
        near = moves[:, :3, 3].norm(dim=1) <= 2 * LONGEST * median
        x, y, z = random.normal(size=(3, count)) * np.radians(_TURN_NOISE_DEG)
        one = np.ones(count)  # angles are so small that their first order is enough
        turned = on_device(np.array([[one, -z, y], [z, one, -x], [-y, x, one]]).transpose(2, 0, 1), median)
        shifted = on_device(random.normal(size=(count, 3)) * _MOVE_NOISE, median) * median[:, None]
        moves[:, :3] = torch.cat([moves[:, :3, :3] @ turned, moves[:, :3, 3:] + shifted[..., None]], dim=2)
        return replace(
            pictures,
            earlier=to_network(self._clips.take(chosen, before, names[:1])[names[0]]),
            earlier_from_camera=moves,
            compared=on_device(compared, near) & near,
        )


def augmented(pictures: Pictures, random: Random) -> Pictures:
    """Mirrored or not, and seen by a camera of another exposure, colour, noise and focus."""
    n, video = len(pictures.lenses), pictures.video
    flip = on_device(random.random(n) < 0.5, pictures.compared)

    def turned(x: Tensor) -> Tensor:
        return torch.where(flip.view(-1, *(1,) * (x.ndim - 1)), x.flip(-1), x)

    look, noise = other_camera(random, n, video), generator_on(video.device, random)
    mirror, moves = _MIRRORED.to(video.device), pictures.earlier_from_camera
    return replace(
        pictures,
        video=look(turned(video), noise),
        earlier=look(turned(pictures.earlier), noise),
        earlier_from_camera=torch.where(flip[:, None, None], mirror @ moves @ mirror, moves),
        metres=turned(pictures.metres),
        labels=turned(pictures.labels),
        moves=turned(pictures.moves),
        ups=torch.where(flip[:, None], pictures.ups * mirror.diagonal()[:3].to(video), pictures.ups),
    )


def generator_on(device: torch.device, random: Random) -> torch.Generator:
    """For what is drawn of every pixel."""
    return torch.Generator(device).manual_seed(int(random.integers(2**62)))


def other_camera(random: Random, n: int, like: Tensor) -> Callable[[Tensor, torch.Generator], Tensor]:
    """Exposure, gamma, white balance, noise and blur of N cameras, one in four as it is.

    What pictures [N, 3, H, W] in [-1, 1] look like through them; only the noise is drawn anew every time.
    """

    def drawn(spread: float, channels: int = 1) -> Tensor:
        wide = random.normal(size=(n, channels, 1, 1)) * spread * (random.random((n, 1, 1, 1)) < 0.75)
        return on_device(wide, like)

    gamma, gain = drawn(0.25).exp(), (drawn(0.15) + drawn(0.07, 3)).exp()
    offset, spread = drawn(0.03), drawn(0.04).abs()
    blur = on_device(random.random((n, 1, 1, 1)) * (random.random((n, 1, 1, 1)) < 0.3), like)

    def look(video: Tensor, generator: torch.Generator) -> Tensor:
        levels = (((video + 1) / 2).clamp(0, 1) ** gamma * gain + offset).clamp(0, 1)
        soft = avg_pool2d(levels, 3, 1, 1, count_include_pad=False)
        noise = torch.randn(levels.shape, generator=generator, device=levels.device)
        return (torch.lerp(levels, soft, blur) * 2 - 1 + noise * spread).clamp(-1, 1)

    return look


def class_weights(paths: Sequence[Path], config: LiveConfig, power: float) -> Tensor:
    """Weights of the classes in a loss, [K]: a power of how much of the pictures they fill, 1 for a mean pixel."""
    counts = np.ones(len(config.classes))
    for path in evenly(paths, _COUNTED):
        labels = read_clip(path, slice(0, 1), ["source.labels"]).arrays["source.labels"]
        counts += np.bincount(labels.ravel(), minlength=len(counts))
    shares = torch.from_numpy(counts / counts.sum()).float()
    weights = shares.clamp(min=1e-4) ** power
    return weights / (weights * shares).sum()


def class_figures(confusion: Tensor, classes: Sequence[SemanticClass], shown: Sequence[int]) -> dict[str, float]:
    """Mean IoU of the classes that occur in the truth, and that of some of them."""
    iou, occurs = class_iou(confusion), confusion.sum(1) > 0
    return {"miou": float(iou[occurs].mean()), **{f"iou_{classes[k].name}": float(iou[k]) for k in shown if occurs[k]}}


def autocast(device: torch.device) -> torch.autocast:
    """bfloat16 where the device is fast at it; other processors take seven times as long by it."""
    fast = default_precision(device, live=True) == "bfloat16"
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=fast)


def _mapped(change: Callable[..., Any], *records: Any) -> Any:
    """A record of what becomes of the tensors and tuples in records of one kind, and in the records in them."""
    if not is_dataclass(records[0]):
        return change(*records)
    made = {f.name: _mapped(change, *(getattr(each, f.name) for each in records)) for f in fields(records[0])}
    return replace(records[0], **made)  # pyright: ignore[reportArgumentType]


def halved(record: Record) -> Record:
    """Pictures or views at half the size: what can be averaged is; the rest is of one pixel of four."""

    def half(name: str, value: Any) -> Any:
        if name == "lenses":
            return tuple(lens.resized(lens.width // 2, lens.height // 2) for lens in value)
        if name in _AVERAGED:
            return avg_pool2d(value, 2)
        return halved(value) if is_dataclass(value) else value if name in _WHOLE else value[..., ::2, ::2]

    source: Any = record
    return replace(source, **{f.name: half(f.name, getattr(source, f.name)) for f in fields(source)})


def on(device: torch.device, record: Record) -> Record:
    """A record with its tensors on a device."""

    def moved(value: Any) -> Any:
        return value.to(device, non_blocking=True) if isinstance(value, Tensor) else value

    return _mapped(moved, record)


def joined(parts: Sequence[Record]) -> Record:
    """Records of pictures as one batch."""

    def together(*values: Any) -> Any:
        return torch.cat(values) if isinstance(values[0], Tensor) else tuple(chain(*values))

    return _mapped(together, *parts)


def frame_of(path: Path, t: int) -> Pictures:
    """Frame t of a clip's source alone, with its earlier one as `with_true_references` chooses it."""
    return _mapped(itemgetter(slice(-1, None)), with_true_references(read_clip(path, slice(t + 1))))
