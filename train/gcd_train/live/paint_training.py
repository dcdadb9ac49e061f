"""How the paint network learns: every pixel's mean, spread, class and depth and what was seen of it; then detail.

In the detail stage a critic looks at patches of whole pictures and learns to tell true views from made ones; the detail
head learns to pass. It alone learns there, on features that are held fixed: all else stays as it was, to the last bit.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import EllipsisType

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from gcd_model.live.config import LiveConfig
from gcd_model.live.depth_net import DepthNet, depth_inputs
from gcd_model.live.paint_net import SIGMA_DATA, Painted, PaintNet, Seen, filled
from gcd_model.live.synthesizer import movable_classes
from gcd_train.evaluation.metrics import class_iou, confusion_matrix
from gcd_train.live.batches import Random, autocast, class_figures, class_weights, generator_on, on
from gcd_train.live.clips import STATES
from gcd_train.live.views import ViewBatches, Views, carried_through, halved_views, mirrored, views_of
from gcd_train.training.loop import Progress, StepLoss, Task
from gcd_train.training.losses import gradient_l1, ssim
from gcd_train.training.monitor import write_sheet
from gcd_train.training.optimiser import ParameterGroup

_CLASS_POWER = -0.45
_NEVER_WEIGHT = 0.5
"""Of a never-seen pixel beside a seen one: nobody can know it."""
_SEEN_SQUARE, _SEEN_ABSOLUTE = 0.25, 2.0
"""Of a seen pixel beside others in these two: squares alone make it a blur of all places where it could be."""
_SQUARE, _ABSOLUTE, _STRUCTURE, _GRADIENT, _SPREAD, _CLASS, _DEPTH, _SEEN = 40.0, 4.0, 4.0, 2.0, 2.0, 0.3, 0.2, 0.15
_MEAN_ALONE = 0.5
"""Share of the training in which nothing but the mean of single frames is learned, which is what takes longest."""
_DENOISING_SHARE = 0.3
"""Of the updates after that: they teach draws of several steps."""
_DRAWS = 7_000_003  # seed of which updates these are
_SEEN_DENOISED = 0.25
"""Weight of a seen pixel beside a never-seen one there."""
_FEATURES, _CRITIC, _ENERGY, _KEEP, _CLOSE = 1.0, 0.1, 0.5, 1.0, 0.3
_CRITIC_WIDTHS = (32, 64, 96)


class _ViewTask(Task):
    """Trains some weights of a PaintNet, which is measured on held-out views without what was painted before."""

    def __init__(self, net: PaintNet, trained: nn.Module, config: LiveConfig, held_out: "HeldOutViews") -> None:
        super().__init__(trained)
        self._config, self._device = config, next(trained.parameters()).device
        self._net, self._held_out = net, held_out
        self._movable = movable_classes(config).to(self._device)

    def _views(
        self, batches: ViewBatches, update: int, first_step: Callable[[Seen], Painted] | None, *, small: bool = False
    ) -> tuple[Views, Random]:
        """A batch, mirrored or not. first_step: what is painted by it before is carried along."""
        before, now, random = batches.batch(update)
        if small:
            before, now = tuple(map(halved_views, before)), halved_views(now)
        if first_step is not None:
            now = carried_through(first_step, before, now, self._movable, random)
        self._net.train()
        return mirrored(now) if random.random() < 0.5 else now, random

    def _first_step(self, seen: Seen, network: nn.Module, *, detail: bool = False) -> Painted:
        with autocast(self._device):
            return network(seen, filled(seen), self._config.sigma_max, detail=detail)

    def measure(self, picture: Path) -> dict[str, float]:
        """See `HeldOutViews.measure`."""
        self._net.eval()
        return self._held_out.measure(self._net, self._config, picture)


class PaintTask(_ViewTask):
    """Trains a PaintNet's first step on target views."""

    def __init__(
        self,
        net: PaintNet,
        config: LiveConfig,
        batches: Sequence[ViewBatches],
        paths: Sequence[Path],
        held_out: "HeldOutViews",
        small_share: float,
    ) -> None:
        """batches: of the parts of an update. small_share: see LiveStage."""
        super().__init__(net, net, config, held_out)
        self._small_share, self._batches = small_share, batches
        self.class_weights = class_weights(paths, config, _CLASS_POWER).to(self._device)

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """All weights but those of the detail."""
        trained = [p for name, p in self._net.named_parameters() if not name.startswith("detail.")]
        return [ParameterGroup(parameters=trained)]

    def step_loss(self, progress: Progress) -> StepLoss:
        """Of one batch of views."""
        later, small = progress.share >= _MEAN_ALONE, progress.share < self._small_share
        carry = partial(self._first_step, network=self._net) if later else None
        now, random = self._views(self._batches[progress.part], progress.updates, carry, small=small)
        # the same for all parts of an update: processes average what they log by name
        if later and np.random.default_rng([_DRAWS, progress.updates]).random() < _DENOISING_SHARE:
            parts = {"denoising": self._denoising(now, random)}
        else:
            row, column = random.integers(2, size=2).tolist()
            parts = self.losses(
                self._first_step(now.seen, self.network), now, (..., slice(row, None, 2), slice(column, None, 2))
            )
        total = torch.stack(list(parts.values())).sum()
        return StepLoss(total=total, parts=parts, frames=len(now.poses))

    def _denoising(self, views: Views, random: Random) -> Tensor:
        """Weighted as in Karras et al. 2022, Table 1, from the levels that the sampler visits."""
        low, high = np.log(self._config.sigma_min), np.log(self._config.sigma_start)
        sigma = torch.from_numpy(np.exp(random.uniform(low, high, len(views.poses)))).float().to(self._device)
        generator = generator_on(self._device, random)
        noise = torch.randn(views.target.shape, generator=generator, device=self._device)
        noisy = views.target + sigma[:, None, None, None] * noise
        with autocast(self._device):
            clean = self.network(views.seen, filled(views.seen), sigma, noisy)
        scale = (sigma**2 + SIGMA_DATA**2) / (sigma * SIGMA_DATA) ** 2
        weight = torch.where(views.visibility > 0, _SEEN_DENOISED, 1.0) * scale[:, None, None]
        return ((clean - views.target).square().mean(dim=1) * weight).mean()

    def losses(self, made: Painted, views: Views, some: tuple[EllipsisType | slice, ...] = (...,)) -> dict[str, Tensor]:
        """Weighted parts of the loss. some: the pixels from which all but the colours' are computed."""
        seen = (views.visibility > 0).float()
        error = made.mean - views.target
        never = (1 - seen) * _NEVER_WEIGHT
        square = error.square().mean(dim=1)
        mask = seen[:, None]
        gradient = gradient_l1(made.mean * mask, views.target * mask)
        # the spread learns of the mean, the mean nothing of it; times its own variance its gradient stays bounded
        fixed, log_variance = square.detach()[some], made.log_variance[some].clamp(-9, 3)
        variance = log_variance.exp()
        spread = variance.detach() * (fixed * (-log_variance).exp() + log_variance)
        return {
            "square": _SQUARE * (square * (seen * _SEEN_SQUARE + never)).mean(),
            "absolute": _ABSOLUTE * (error.abs().mean(dim=1) * (seen * _SEEN_ABSOLUTE + never)).mean(),
            "structure": _STRUCTURE * (1 - ssim(views.target + error * mask, views.target)),
            "gradient": _GRADIENT * gradient,
            "spread": _SPREAD * spread.mean(),
            "class": _CLASS * F.cross_entropy(made.classes[some], views.labels[some], self.class_weights),
            "depth": _DEPTH * ((made.log_depth - views.log_depth)[some].abs().clamp(max=3.0)).mean(),
            "seen": _SEEN * F.cross_entropy(made.seen[some], views.visibility[some]),
        }


class Critic(nn.Module):
    """Patches of 34 pixels: true or made. Sees the picture and where it is painted."""

    def __init__(self) -> None:
        super().__init__()
        widths = (4, *_CRITIC_WIDTHS)
        self.layers = nn.ModuleList(
            [spectral_norm(nn.Conv2d(a, b, 4, stride=2, padding=1)) for a, b in pairwise(widths)]
        )
        self.last = spectral_norm(nn.Conv2d(widths[-1], 1, 3, padding=1))

    def forward(self, pictures: Tensor, never: Tensor) -> Tensor:
        """pictures: [N, 3, H, W], never: [N, 1, H, W] -> scores [N, 1, H/8, W/8]."""
        x = torch.cat([pictures, never], dim=1)
        for layer in self.layers:
            x = F.leaky_relu(layer(x), 0.2)
        return self.last(x)


class DetailTask(_ViewTask):
    """Trains a PaintNet's detail head against a critic; both take a step an update."""

    def __init__(
        self,
        net: PaintNet,
        depth: DepthNet,
        config: LiveConfig,
        batches: ViewBatches,
        held_out: "HeldOutViews",
    ) -> None:
        net.requires_grad_(False)
        net.detail.requires_grad_(True)
        self._critic = Critic()
        trained = nn.ModuleDict({"detail": net.detail, "critic": self._critic}).to(next(net.parameters()).device)
        super().__init__(net, trained, config, held_out)
        self._depth, self._batches = depth.eval().requires_grad_(False), batches
        torch.manual_seed(0)
        self._random = nn.Sequential(
            nn.Conv2d(3, 32, 5, stride=2, padding=2), nn.LeakyReLU(0.2), nn.Conv2d(32, 48, 3, stride=2, padding=1),
            nn.LeakyReLU(0.2), nn.Conv2d(48, 64, 3, padding=1),
        ).requires_grad_(False).to(self._device)  # fmt: skip

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """The detail head, and the critic at twice its rate."""
        return [
            ParameterGroup(parameters=list(self._net.detail.parameters())),
            ParameterGroup(parameters=list(self._critic.parameters()), factor=2.0),
        ]

    def step_loss(self, progress: Progress) -> StepLoss:
        """Of the detail against the critic, and of the critic: their gradients do not meet."""
        first_step = partial(self._first_step, network=self._net, detail=True)
        now, _ = self._views(self._batches, progress.updates, first_step)
        made = first_step(now.seen)
        parts = self._losses(made, now)
        return StepLoss(total=torch.stack(list(parts.values())).sum(), parts=parts, frames=len(now.poses))

    def _losses(self, made: Painted, views: Views) -> dict[str, Tensor]:
        never = (1 - views.seen.coverage)[:, None]  # share of a pixel that nothing covers
        patches = F.avg_pool2d(never, 8)  # as the critic sees them
        picture = made.picture
        # seen pixels are the truth's in both, so that the critic has nothing else to go by
        fake = views.target + (picture - views.target) * never
        critic = self._critic
        weight = patches / patches.mean().clamp(min=1e-3)
        true_score, fake_score = critic(views.target, never), critic(fake.detach(), never)
        telling = (F.relu(1 - true_score) * weight).mean() + (F.relu(1 + fake_score) * weight).mean()
        critic.requires_grad_(False)
        passing = -(critic(fake, never) * weight).mean()
        critic.requires_grad_(True)
        kept = views.seen.painted_coverage[:, None] * never
        return {
            "passing": _CRITIC * passing,
            "features": _FEATURES * self._feature_distance(fake, views, never),
            "energy": _ENERGY * ((_energy(fake) - _energy(views.target)).abs() * patches).mean(),
            "keep": _KEEP * ((picture - views.seen.painted).abs() * kept).mean(),
            "close": _CLOSE * (F.avg_pool2d(made.detail, 8).abs() * patches).mean(),
            "telling": telling,
        }

    def _feature_distance(self, fake: Tensor, views: Views, never: Tensor) -> Tensor:
        """Distance in features of the depth network, which knows targets too, and of a random network."""
        ground = torch.zeros_like(views.seen.ground_m)
        distance = torch.zeros((), device=self._device)
        with autocast(self._device):
            made, true = (self._depth.features(depth_inputs(x, views.seen.rays, ground)) for x in (fake, views.target))
            made_random, true_random = self._random(fake), self._random(views.target)
        for a, b in ((made, true), (made_random, true_random)):
            share = F.adaptive_avg_pool2d(never, (a.shape[-2], a.shape[-1]))
            scale = b.float().abs().mean().clamp(min=1e-3)
            distance = distance + ((a.float() - b.float()).abs() / scale * share).mean()
        return distance


def _energy(x: Tensor) -> Tensor:
    """How much is drawn in cells of 8 pixels: [N, 3, H / 8, W / 8]."""
    across = F.pad(x[..., 1:] - x[..., :-1], (0, 1))
    down = F.pad(x[..., 1:, :] - x[..., :-1, :], (0, 0, 0, 1))
    return F.avg_pool2d((across.square() + down.square() + 1e-6).sqrt(), 8)


class HeldOutViews:
    """Some frames of held-out clips, opened once."""

    def __init__(self, paths: Sequence[Path], inputs: Path) -> None:
        places = [(path, inputs / path.parent.name / path.name) for path in paths]
        self.views = [views_of(*place, slice(t, t + 1)) for place in places for t in (5, 9, 13)]

    def measure(self, net: PaintNet, config: LiveConfig, sheet: Path) -> dict[str, float]:
        """PSNR of base and mean, of seen and never-seen pixels, mIoU, and IoU of the three states."""
        errors = {name: list[Tensor]() for name in ("psnr_base", "psnr", "psnr_seen", "psnr_never")}
        k, cpu, device = len(config.classes), torch.device("cpu"), next(net.parameters()).device
        confusion, states = torch.zeros(k, k, dtype=torch.int64), torch.zeros(3, 3, dtype=torch.int64)
        rows: list[list[Tensor]] = []
        for i, views in enumerate(self.views):
            there = on(device, views)
            base = filled(there.seen)
            made, base = on(cpu, net.first_step(there.seen, base, config.sigma_max)), base.cpu()
            of_base, square = (
                ((each.clamp(-1, 1) - views.target) / 2).square().mean(dim=1) for each in (base, made.mean)
            )
            never = views.visibility == 0
            for each, values in zip(errors.values(), (of_base, square, square[~never], square[never]), strict=True):
                each.append(values.flatten())
            confusion += confusion_matrix(made.classes.argmax(1), views.labels, k)
            states += confusion_matrix(made.seen.argmax(1), views.visibility, 3)
            if i % max(len(self.views) // 10, 1) == 0:
                rows.append([x[0] for x in (views.seen.colour, base, made.mean, made.picture, views.target)])
        write_sheet(sheet, rows)
        return {
            **{name: _psnr(torch.cat(each)) for name, each in errors.items()},
            **class_figures(confusion, config.classes, (7, 8, 10, 11)),
            **{f"iou_{name}": float(iou) for name, iou in zip(STATES, class_iou(states), strict=True)},
        }


def _psnr(squares: Tensor) -> float:
    return -10 * float(np.log10(max(float(squares.sum()) / max(len(squares), 1), 1e-10)))
