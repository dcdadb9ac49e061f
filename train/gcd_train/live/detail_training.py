"""How the live model learns to look like one of the things that could be, where nothing was seen.

A critic looks at patches of whole pictures and learns to tell true views from made ones; the detail head learns to
pass. Only the detail head learns here, on features that are held fixed: the mean, classes, depth, visibility and
spread stay as they were, to the last bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from gcd_model.live.config import LiveConfig
from gcd_model.live.depth_net import DepthNet, depth_inputs
from gcd_model.live.paint_net import Painted, PaintNet, Seen, filled
from gcd_model.live.painter import movable_classes
from gcd_train.live.batches import Ahead, autocast, on
from gcd_train.live.paint_training import HeldOutViews
from gcd_train.live.target_views import ViewBatches, Views, carried_through, mirrored
from gcd_train.training.loop import Progress, StepLoss
from gcd_train.training.optimiser import ParameterGroup

_FEATURES, _CRITIC, _ENERGY, _KEEP, _CLOSE = 1.0, 0.1, 0.5, 1.0, 0.3
_CRITIC_WIDTHS = (32, 64, 96)


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


class DetailAndCritic(nn.Module):
    """What this stage trains and saves."""

    def __init__(self, paint: PaintNet) -> None:
        super().__init__()
        self.detail, self.critic = paint.detail, Critic()


@dataclass(frozen=True, kw_only=True, slots=True)
class _Patches:
    """never: [N, 1, H, W], share of a pixel that nothing covers. patches: [N, 1, H/8, W/8], of the critic's."""

    never: Tensor
    patches: Tensor

    @classmethod
    def of(cls, seen: Seen) -> "_Patches":
        never = (1 - seen.coverage)[:, None]
        return cls(never=never, patches=F.avg_pool2d(never, 8))


class DetailTask:
    """Trains a PaintNet's detail head against a critic; both take a step an update."""

    def __init__(
        self,
        net: PaintNet,
        depth: DepthNet,
        config: LiveConfig,
        batches: ViewBatches,
        held_out: HeldOutViews,
        workers: int = 0,
    ) -> None:
        """workers: processes that read batches."""
        self._net, self._depth, self._config = net, depth.eval().requires_grad_(False), config
        self._held_out, self._batch = held_out, Ahead(batches.batch, workers)
        self._device = next(net.parameters()).device
        net.requires_grad_(False)
        net.detail.requires_grad_(True)
        self._trained = DetailAndCritic(net).to(self._device)
        self._movable = movable_classes(config).to(self._device)
        torch.manual_seed(0)
        self._random = nn.Sequential(
            nn.Conv2d(3, 32, 5, stride=2, padding=2), nn.LeakyReLU(0.2), nn.Conv2d(32, 48, 3, stride=2, padding=1),
            nn.LeakyReLU(0.2), nn.Conv2d(48, 64, 3, padding=1),
        ).requires_grad_(False).to(self._device)  # fmt: skip

    @property
    def module(self) -> nn.Module:
        """Detail head and critic."""
        return self._trained

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """The detail head, and the critic at twice its rate."""
        return [
            ParameterGroup(parameters=list(self._trained.detail.parameters())),
            ParameterGroup(parameters=list(self._trained.critic.parameters()), factor=2.0),
        ]

    def step_loss(self, progress: Progress) -> StepLoss:
        """Of the detail against the critic, and of the critic: their gradients do not meet."""
        before, now, random = on(self._device, self._batch(progress.updates))
        now = carried_through(self._first_step, before, now, self._movable, random)
        if random.random() < 0.5:
            now = mirrored(now)
        self._net.train()
        made = self._first_step(now.seen)
        parts = self._losses(made, now)
        return StepLoss(total=torch.stack(list(parts.values())).sum(), parts=parts, frames=len(now.poses))

    def _first_step(self, seen: Seen) -> Painted:
        with autocast(self._device):
            return self._net.first_step(seen, filled(seen), self._config.sigma_max)

    def _losses(self, made: Painted, views: Views) -> dict[str, Tensor]:
        where = _Patches.of(views.seen)
        picture = made.picture
        # seen pixels are the truth's in both, so that the critic has nothing else to go by
        fake = views.target + (picture - views.target) * where.never
        critic = self._trained.critic
        weight = where.patches / where.patches.mean().clamp(min=1e-3)
        true_score, fake_score = critic(views.target, where.never), critic(fake.detach(), where.never)
        telling = (F.relu(1 - true_score) * weight).mean() + (F.relu(1 + fake_score) * weight).mean()
        critic.requires_grad_(False)
        passing = -(critic(fake, where.never) * weight).mean()
        critic.requires_grad_(True)
        kept = views.seen.painted_coverage[:, None] * where.never
        return {
            "passing": _CRITIC * passing,
            "features": _FEATURES * self._feature_distance(fake, views, where),
            "energy": _ENERGY * _energy_distance(fake, views.target, where.never),
            "keep": _KEEP * ((picture - views.seen.painted).abs() * kept).mean(),
            "close": _CLOSE * (F.avg_pool2d(made.detail, 8).abs() * where.patches).mean(),
            "telling": telling,
        }

    def _feature_distance(self, fake: Tensor, views: Views, where: _Patches) -> Tensor:
        """Distance in features of the depth network, which knows targets too, and of a random network."""
        ground = torch.zeros_like(views.seen.ground_m)
        distance = torch.zeros((), device=self._device)
        with autocast(self._device):
            made, true = (self._depth.features(depth_inputs(x, views.seen.rays, ground)) for x in (fake, views.target))
            made_random, true_random = self._random(fake), self._random(views.target)
        for a, b in ((made, true), (made_random, true_random)):
            never = F.adaptive_avg_pool2d(where.never, (a.shape[-2], a.shape[-1]))
            scale = b.float().abs().mean().clamp(min=1e-3)
            distance = distance + ((a.float() - b.float()).abs() / scale * never).mean()
        return distance

    def after_update(self, progress: Progress) -> bool:
        """Nothing to do."""
        _ = progress
        return False

    @torch.no_grad()
    def measure(self, picture: Path) -> dict[str, float]:
        """As in the stage before, with the detail in the sheet."""
        self._net.eval()
        return self._held_out.measure(self._net, self._config, picture)


def _energy_distance(made: Tensor, true: Tensor, never: Tensor) -> Tensor:
    """How much is drawn in cells of 8 pixels, compared where nothing was seen."""
    return ((_energy(made) - _energy(true)).abs() * F.avg_pool2d(never, 8)).mean()


def _energy(x: Tensor) -> Tensor:
    across = F.pad(x[..., 1:] - x[..., :-1], (0, 1))
    down = F.pad(x[..., 1:, :] - x[..., :-1, :], (0, 0, 0, 1))
    return F.avg_pool2d((across.square() + down.square() + 1e-6).sqrt(), 8)
