"""How the paint network learns: the mean of every pixel, its spread, its class and depth, and what was seen of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import EllipsisType

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.geometry import Intrinsics
from gcd_model.live.config import LiveConfig
from gcd_model.live.depth_net import plane_depth
from gcd_model.live.paint_net import SIGMA_DATA, Painted, PaintNet, Seen, camera_features, filled
from gcd_model.live.splat import splat, unproject
from gcd_model.live.view import movable_classes
from gcd_train.live.batches import Ahead, Random, class_weights, lens_rays, on, to_video
from gcd_train.live.clips import LiveClip, read_clip
from gcd_train.live.inputs import read_inputs
from gcd_train.live.look import picture, write_rows
from gcd_train.loop import Progress, StepLoss
from gcd_train.picture_losses import gradient_l1
from gcd_train.schedule import ParameterGroup

_CLASS_POWER = -0.45
_NEVER_WEIGHT = 0.5
"""Of a never-seen pixel beside a seen one: nobody can know it."""
_SQUARE, _ABSOLUTE, _GRADIENT, _SPREAD, _CLASS, _DEPTH, _SEEN = 40.0, 4.0, 2.0, 2.0, 0.3, 0.2, 0.15
_MEAN_ALONE = 0.5
"""Share of the training in which nothing but the mean of single frames is learned, which is what takes longest."""
_DENOISING_SHARE = 0.3
"""Of the updates after that: they teach draws of several steps."""
_SEEN_DENOISED = 0.25
"""Weight of a seen pixel beside a never-seen one there."""
VIEW_ARRAYS = ("source.pose", *(f"target.{name}" for name in ("pose", "rgb", "depth", "labels", "visibility")))
"""What is read of a clip."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Views:
    """N target views: what is seen of them and the truth.

    target: [N, 3, H, W] in [-1, 1]. labels: int64, log_depth: float32, visibility: int64, [N, H, W]. poses: N of
    world_from_target [4, 4]. lenses: N.
    """

    seen: Seen
    target: Tensor
    labels: Tensor
    log_depth: Tensor
    visibility: Tensor
    poses: tuple[Tensor, ...]
    lenses: tuple[Intrinsics, ...]


def views_of(clip: LiveClip, inputs: dict[str, Tensor], *, ground: bool) -> Views:
    """The frames that were read of a clip, with what is seen of them."""
    labels = torch.from_numpy(clip.arrays["target.labels"].astype(np.int64))
    n, height, width = labels.shape
    lens = Intrinsics.from_hfov(clip.hfov_deg("target"), width, height)
    poses = clip.arrays["target.pose"]
    floor = float(clip.facts["floor_z_m"])
    grounds = [
        plane_depth(lens, torch.from_numpy(pose[2, :3].copy()).float(), max(float(pose[2, 3]) - floor, 0.05))
        if ground
        else torch.zeros(height, width)
        for pose in poses
    ]
    empty = torch.zeros(n, height, width)
    seen = Seen(
        **inputs,
        painted=torch.zeros(n, 3, height, width),
        painted_coverage=empty,
        rays=lens_rays(lens).expand(n, -1, -1, -1),
        ground_m=torch.stack(grounds),
        camera=camera_features(torch.from_numpy(np.linalg.inv(clip.arrays["source.pose"]) @ poses)),
    )
    return Views(
        seen=seen,
        target=to_video(clip.arrays["target.rgb"]),
        labels=labels,
        log_depth=torch.from_numpy(clip.depth("target")).log(),
        visibility=torch.from_numpy(clip.arrays["target.visibility"].astype(np.int64)),
        poses=tuple(torch.from_numpy(pose) for pose in poses),
        lenses=(lens,) * n,
    )


def together(parts: Sequence[Views]) -> Views:
    """Views of several clips as one batch."""
    names = Seen.__dataclass_fields__
    seen = Seen(**{name: torch.cat([getattr(part.seen, name) for part in parts]) for name in names})
    return Views(
        seen=seen,
        target=torch.cat([part.target for part in parts]),
        labels=torch.cat([part.labels for part in parts]),
        log_depth=torch.cat([part.log_depth for part in parts]),
        visibility=torch.cat([part.visibility for part in parts]),
        poses=sum((part.poses for part in parts), ()),
        lenses=sum((part.lenses for part in parts), ()),
    )


def frame_of(views: Views, index: Tensor) -> Views:
    """Some of the views."""
    names = Seen.__dataclass_fields__
    numbers = index.tolist()
    return Views(
        seen=Seen(**{name: getattr(views.seen, name)[index] for name in names}),
        target=views.target[index],
        labels=views.labels[index],
        log_depth=views.log_depth[index],
        visibility=views.visibility[index],
        poses=tuple(views.poses[i] for i in numbers),
        lenses=tuple(views.lenses[i] for i in numbers),
    )


class ViewBatches:
    """Batches of target views; the number of the update decides which.

    inputs: folders of `make_inputs`; of those that have a clip one is drawn. carried: share of the views that see what
    was painted a frame before.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        inputs: Sequence[Path],
        config: LiveConfig,
        size: int,
        seed: int,
        carried: float = 0.35,
    ) -> None:
        self._config, self._size, self._seed, self._carried = config, size, seed, carried
        places = [
            (path, [p for folder in inputs if (p := folder / path.parent.name / path.name).exists()]) for path in paths
        ]
        self._clips = [(path, there) for path, there in places if there]

    def __len__(self) -> int:
        return len(self._clips)

    def batch(self, update: int) -> tuple[Views | None, Views, Random]:
        """N views; before them the frames before of the first of them, which see what was painted there.

        And the generator for what else is drawn.
        """
        random = np.random.default_rng([self._seed, update])
        carried = int(random.binomial(self._size, self._carried))
        made = [self._views(random, 2 if i < carried else 1) for i in range(self._size)]
        before = [frame_of(views, torch.tensor([0])) for views in made[:carried]]
        now = [*(frame_of(views, torch.tensor([1])) for views in made[:carried]), *made[carried:]]
        return together(before) if before else None, together(now), random

    def _views(self, random: Random, count: int) -> Views:
        """Frames in a row of some clip."""
        path, there = self._clips[int(random.integers(len(self._clips)))]
        first = int(random.integers(self._config.frames + 1 - count))
        cut = slice(first, first + count)
        inputs = read_inputs(there[int(random.integers(len(there)))], cut, len(self._config.classes))
        views = views_of(read_clip(path, cut, VIEW_ARRAYS), inputs, ground=random.random() < 0.6)
        return _other_look(views, random)


def _other_look(views: Views, random: Random) -> Views:
    """Exposure, gamma and white balance, the same for what is seen and for the truth."""
    gamma, gain = (
        np.exp(random.normal() * 0.2),
        np.exp(random.normal() * 0.12 + random.normal(size=(1, 3, 1, 1)) * 0.05),
    )
    scale = torch.from_numpy(np.asarray(gain, np.float32))

    def look(x: Tensor) -> Tensor:
        return ((((x + 1) / 2).clamp(0, 1) ** float(gamma)) * scale).clamp(0, 1) * 2 - 1

    colour = look(views.seen.colour) * (views.seen.coverage > 0)[:, None]
    return replace(views, seen=replace(views.seen, colour=colour), target=look(views.target))


def mirrored(views: Views) -> Views:
    """All of it seen in a mirror. Poses are not: carry what was painted before."""
    seen = views.seen
    fixed = ("rays", "camera")
    turned = {name: getattr(seen, name).flip(-1) for name in Seen.__dataclass_fields__ if name not in fixed}
    # x becomes -x in both cameras: rotation entries that mix x with another axis change sign, and so does the move in x
    signs = torch.tensor([1.0, -1, -1, -1, 1, 1, -1, 1, 1, -1, 1, 1], device=seen.camera.device)
    return replace(
        views,
        seen=Seen(**turned, rays=seen.rays, camera=seen.camera * signs),
        target=views.target.flip(-1),
        labels=views.labels.flip(-1),
        log_depth=views.log_depth.flip(-1),
        visibility=views.visibility.flip(-1),
    )


@torch.no_grad()
def carry(painted: Painted, before: Views, now: Views, movable: Tensor) -> Views:
    """`now` with what was painted in the frames before of the first of its views, moved into their cameras."""
    colours, coverages = now.seen.painted.clone(), now.seen.painted_coverage.clone()
    labels = painted.classes.argmax(1)
    for i, (pose, lens) in enumerate(zip(before.poses, before.lenses, strict=True)):
        keep = (before.seen.coverage[i] < 0.5) & ~movable[labels[i]]
        surfels = unproject(
            painted.log_depth[i].exp(),
            painted.picture[i].clamp(-1, 1),
            labels[i].to(torch.uint8),
            lens,
            pose,
            0.0,
            painted=True,
            keep=keep,
        )
        moved = splat(surfels, now.poses[i], now.lenses[i], painted.classes.shape[1], 0.0)
        colours[i], coverages[i] = moved.colour, moved.coverage
    return replace(now, seen=replace(now.seen, painted=colours, painted_coverage=coverages))


class PaintTask:
    """Trains a PaintNet's first step on target views."""

    def __init__(
        self,
        net: PaintNet,
        config: LiveConfig,
        batches: Sequence[ViewBatches],
        paths: Sequence[Path],
        held_out: "HeldOutViews",
        workers: int = 0,
    ) -> None:
        """batches: of the parts of an update. workers: processes that read them."""
        self._net, self._config, self._held_out = net, config, held_out
        self._network: nn.Module = net
        self._device, self._batches = next(net.parameters()).device, [Ahead(each.batch, workers) for each in batches]
        self.class_weights = class_weights(paths, config, _CLASS_POWER).to(self._device)
        self._movable = movable_classes(config).to(self._device)

    @property
    def module(self) -> nn.Module:
        """The network."""
        return self._net

    def compute_through(self, network: nn.Module) -> None:
        """See SharedTask."""
        self._network = network

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """All weights but those of the detail."""
        trained = [p for name, p in self._net.named_parameters() if not name.startswith("detail.")]
        return [ParameterGroup(parameters=trained)]

    def step_loss(self, progress: Progress) -> StepLoss:
        """Of one batch of views."""
        before, now, random = on(self._device, self._batches[progress.part](progress.updates))
        later = progress.share >= _MEAN_ALONE
        if before is not None and later:
            with torch.no_grad():
                painted = self._first_step(before.seen, self._net)
            now = carry(painted, before, now, self._movable)
        if random.random() < 0.5:
            now = mirrored(now)
        self._net.train()
        if later and random.random() < _DENOISING_SHARE:
            parts = {"denoising": self._denoising(now, random)}
        else:
            row, column = random.integers(2, size=2).tolist()
            parts = self.losses(
                self._first_step(now.seen, self._network), now, (..., slice(row, None, 2), slice(column, None, 2))
            )
        total = torch.stack(list(parts.values())).sum()
        return StepLoss(total=total, parts=parts, frames=len(now.poses))

    def _first_step(self, seen: Seen, network: nn.Module) -> Painted:
        with torch.autocast(self._device.type, dtype=torch.bfloat16):
            return network(seen, filled(seen), self._config.sigma_max, detail=False)

    def _denoising(self, views: Views, random: Random) -> Tensor:
        """Weighted as in Karras et al. 2022, Table 1, from the levels that the sampler visits."""
        low, high = np.log(self._config.sigma_min), np.log(self._config.sigma_start)
        sigma = torch.from_numpy(np.exp(random.uniform(low, high, len(views.poses)))).float().to(self._device)
        noise = torch.from_numpy(random.standard_normal(tuple(views.target.shape), np.float32)).to(self._device)
        noisy = views.target + sigma[:, None, None, None] * noise
        with torch.autocast(self._device.type, dtype=torch.bfloat16):
            clean = self._network(views.seen, filled(views.seen), sigma, noisy)
        scale = (sigma**2 + SIGMA_DATA**2) / (sigma * SIGMA_DATA) ** 2
        weight = torch.where(views.visibility > 0, _SEEN_DENOISED, 1.0) * scale[:, None, None]
        return ((clean - views.target).square().mean(dim=1) * weight).mean()

    def losses(self, made: Painted, views: Views, some: tuple[EllipsisType | slice, ...] = (...,)) -> dict[str, Tensor]:
        """Weighted parts of the loss. some: the pixels from which all but the colours' are computed."""
        seen = (views.visibility > 0).float()
        error = made.mean - views.target
        weight = seen + (1 - seen) * _NEVER_WEIGHT
        square = error.square().mean(dim=1)
        mask = seen[:, None]
        gradient = gradient_l1(made.mean * mask, views.target * mask)
        # the spread learns of the mean, the mean nothing of it; times its own variance its gradient stays bounded
        fixed, log_variance = square.detach()[some], made.log_variance[some].clamp(-9, 3)
        variance = log_variance.exp()
        spread = variance.detach() * (fixed * (-log_variance).exp() + log_variance)
        return {
            "square": _SQUARE * (square * weight).mean(),
            "absolute": _ABSOLUTE * (error.abs().mean(dim=1) * weight).mean(),
            "gradient": _GRADIENT * gradient,
            "spread": _SPREAD * spread.mean(),
            "class": _CLASS * F.cross_entropy(made.classes[some], views.labels[some], self.class_weights),
            "depth": _DEPTH * ((made.log_depth - views.log_depth)[some].abs().clamp(max=3.0)).mean(),
            "seen": _SEEN * F.cross_entropy(made.seen[some], views.visibility[some]),
        }

    def after_update(self, progress: Progress) -> bool:
        """Nothing to do."""
        _ = progress
        return False

    @torch.no_grad()
    def measure(self, picture: Path) -> dict[str, float]:
        """On held-out views, without what was painted before."""
        self._net.eval()
        return self._held_out.measure(self._net, self._config, picture)


class HeldOutViews:
    """Some frames of held-out clips, opened once."""

    def __init__(
        self, paths: Sequence[Path], inputs: Path, config: LiveConfig, frames: Sequence[int] = (5, 9, 13)
    ) -> None:
        self._views: list[Views] = []
        for path in paths:
            place = inputs / path.parent.name / path.name
            for t in frames:
                cut = slice(t, t + 1)
                inputs_there = read_inputs(place, cut, len(config.classes))
                views = views_of(read_clip(path, cut, VIEW_ARRAYS), inputs_there, ground=True)
                self._views.append(views)

    def on(self, device: torch.device) -> Iterator[Views]:
        """One by one."""
        return (on(device, views) for views in self._views)

    def measure(self, net: PaintNet, config: LiveConfig, sheet: Path) -> dict[str, float]:
        """PSNR of base and mean, of seen and never-seen pixels, mIoU, and IoU of the three states."""
        sums = {"base": 0.0, "mean": 0.0, "seen": 0.0, "never": 0.0}
        counts = {"seen": 0.0, "never": 0.0}
        k = len(config.classes)
        confusion, states = torch.zeros(k * k), torch.zeros(9)
        rows: list[list[Tensor]] = []
        device = next(net.parameters()).device
        for i, held in enumerate(self._views):
            views = on(device, held)
            base = filled(views.seen)
            cpu = torch.device("cpu")
            made = on(cpu, net.first_step(views.seen, base, config.sigma_max))
            views, base = held, base.cpu()
            square = ((made.mean.clamp(-1, 1) - views.target) / 2).square().mean(dim=1)
            never = views.visibility == 0
            sums["base"] += float(((base.clamp(-1, 1) - views.target) / 2).square().mean())
            sums["mean"] += float(square.mean())
            for name, mask in (("seen", ~never), ("never", never)):
                sums[name] += float(square[mask].sum())
                counts[name] += float(mask.sum())
            confusion += torch.bincount((views.labels * k + made.classes.argmax(1)).flatten(), minlength=k * k)
            states += torch.bincount((views.visibility * 3 + made.seen.argmax(1)).flatten(), minlength=9)
            if i % max(len(self._views) // 10, 1) == 0:
                rows.append([picture(x[0]) for x in (views.seen.colour, base, made.mean, made.picture, views.target)])
        write_rows(rows, sheet)
        n = len(self._views)
        iou, occurs = _iou(confusion.view(k, k))
        state_iou, _ = _iou(states.view(3, 3))
        names = [entry.name for entry in config.classes]
        return {
            "psnr_base": _psnr(sums["base"] / n),
            "psnr": _psnr(sums["mean"] / n),
            "psnr_seen": _psnr(sums["seen"] / max(counts["seen"], 1.0)),
            "psnr_never": _psnr(sums["never"] / max(counts["never"], 1.0)),
            "miou": float(iou[occurs].mean()),
            **{f"iou_{names[c]}": float(iou[c]) for c in (7, 8, 10, 11) if occurs[c]},
            **{f"iou_{name}": float(state_iou[s]) for s, name in enumerate(("painted", "before", "now"))},
        }


def _iou(confusion: Tensor) -> tuple[Tensor, Tensor]:
    inside = confusion.diagonal()
    union = confusion.sum(0) + confusion.sum(1) - inside
    return inside / union.clamp(min=1), confusion.sum(1) > 0


def _psnr(square: float) -> float:
    return -10 * float(np.log10(max(square, 1e-10)))
