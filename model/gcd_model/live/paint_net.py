"""From what was seen of a view to the whole view: a conditional denoiser that starts as the splat.

    D(x, sigma) = base + c_skip (x - base) + c_out F(c_in (x - base), c_noise; conditions)

`base` is the splat with its holes filled from around, so an untrained network shows the splat. One step from the
highest noise level paints the mean of what could be there; several steps draw from it. Classes, depth, visibility and
spread come from the first step, at the highest level, and from heads that no adversary ever trains.
Source: Karras et al. 2022, Eq. 7, about the base instead of zero; c_noise as in Stable Video Diffusion.
"""

from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.layers import embedding_mlp, sinusoid
from gcd_model.live.blocks import FineHead, Trunk, in_planes, layout, likeliest
from gcd_model.live.config import PaintConfig
from gcd_model.live.splat import Splat

SIGMA_DATA = 0.3
"""Standard deviation of a true view about the base, in [-1, 1]."""
_VOTE_CHANNELS = 4
_CAMERA_FEATURES = 12
INPUTS = (3 + 5 + _VOTE_CHANNELS) + (3 + 1) + (2 + 2) + 3 + 3
"""Channels: colour, coverage, now, age, log-depth, known and classes of what is seen; what was painted; rays and
ground; noise; base."""
_AGE_FRAMES = 20.0
_VOTE_LOGITS = 6.0
"""How sure the class of a seen pixel is at first, as a difference of logits."""
_MEAN_DEPTH_LOG = 2.5  # of unseen pixels at first: 12 m
_LOG_VARIANCE = -3.0
_CELL_PX, _REACH, _ROUNDS, _LEAST_SURE = 4, 3, 2, 1e-4
"""Colours of classes are averages of cells of so many pixels, so many cells around, so many times."""
_SMOOTH = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
"""What is drawn in detail loses the grids that heads of patches like to draw."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Seen:
    """What is known of N views before anything is painted, all float32.

    colour: [N, 3, H, W] in [-1, 1]. coverage, now_share, age: [N, H, W] (age in frames). log_depth: [N, H, W], of
    metres; 0 where nothing is. votes: [N, K, H, W]. painted: [N, 3, H, W] and painted_coverage: [N, H, W], what was
    painted a frame ago. rays: [N, 2, H, W], x / z and y / z. ground_m: [N, H, W], depth of the floor, 0 without.
    camera: [N, 12], see `camera_features`.
    """

    colour: Tensor
    coverage: Tensor
    now_share: Tensor
    age: Tensor
    log_depth: Tensor
    votes: Tensor
    painted: Tensor
    painted_coverage: Tensor
    rays: Tensor
    ground_m: Tensor
    camera: Tensor


def camera_features(source_from_target: Tensor) -> Tensor:
    """The view's camera as the network is told it: float64 [N, 4, 4] -> float32 [N, 12].

    Rotation row by row, then the translation on a scale that is logarithmic beyond a metre.
    Source: the relative pose of Van Hoorick et al. 2024 (GCD), section 3.2; the scale is ours.
    """
    turn, move = source_from_target[:, :3, :3], source_from_target[:, :3, 3]
    return torch.cat([turn.flatten(1), move.asinh()], dim=1).float()


def seen_of(splat: Splat, painted: Splat | None, rays: Tensor, ground_m: Tensor, camera: Tensor) -> Seen:
    """One view: the seen surfels' splat and that of what was painted a frame ago. camera: [12]."""
    inverse = splat.inverse_depth
    empty = torch.zeros_like(splat.coverage)
    return Seen(
        colour=splat.colour[None],
        coverage=splat.coverage[None],
        now_share=splat.now_share[None],
        age=splat.age[None],
        log_depth=torch.where(inverse > 0, -inverse.clamp(min=1e-6).log(), 0.0)[None],
        votes=splat.votes[None],
        painted=torch.zeros_like(splat.colour)[None] if painted is None else painted.colour[None],
        painted_coverage=empty[None] if painted is None else painted.coverage[None],
        rays=rays[None],
        ground_m=ground_m[None],
        camera=camera[None],
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class Painted:
    """The first step's answer for N views.

    mean: [N, 3, H, W] in [-1, 1], the mean of what could be there. detail: [N, 3, H, W], what is added to it where
    nothing was seen, to look like one of the things that could be: the likeliest, see `crisp`, drawn out. classes:
    [N, K, H, W], logits. log_depth: [N, H, W]. log_variance: [N, H, W], of the truth about the mean, channel mean, for
    colours in [-1, 1]. seen: [N, 3, H, W], logits of never, before, now.
    """

    mean: Tensor
    detail: Tensor
    classes: Tensor
    log_depth: Tensor
    log_variance: Tensor
    seen: Tensor

    @property
    def picture(self) -> Tensor:
        """Mean and detail: [N, 3, H, W]."""
        return self.mean + self.detail


class PaintNet(nn.Module):
    """See the module."""

    def __init__(self, config: PaintConfig, classes: int) -> None:
        super().__init__()
        self.config, self.classes = config, classes
        head = partial(FineHead, INPUTS, config.widths[0], config.fine_width, patch=config.patch, zero=True)
        self.votes = nn.Conv2d(classes, _VOTE_CHANNELS, 1)
        self.noise_level = embedding_mlp(config.embedding_width, config.embedding_width, config.embedding_width)
        self.camera = embedding_mlp(_CAMERA_FEATURES, config.embedding_width, config.embedding_width)
        self.trunk = Trunk(INPUTS, config.widths, config.patch, embedding_width=config.embedding_width, stem_kernel=1)
        self.head = head(out_channels=3 + classes + 1 + 1 + 3, half_width=config.half_width)
        self.detail = head(out_channels=3, half_width=config.half_width)

    def inputs(self, seen: Seen, base: Tensor, noisy: Tensor | None) -> Tensor:
        """All channels, [N, INPUTS, H, W]."""
        known = (seen.coverage > 0).float()
        ground_known = (seen.ground_m > 0).float()
        ground = torch.where(seen.ground_m > 0, seen.ground_m.clamp(0.05, 200.0), 1.0).log() / 3.0
        facts = [
            seen.coverage,
            seen.now_share,
            seen.age.clamp(max=_AGE_FRAMES) / _AGE_FRAMES,
            seen.log_depth / 3.0,
            known,
        ]
        return (
            torch.cat(
                [
                    seen.colour,
                    torch.stack(facts, dim=1),
                    in_planes(self.votes, seen.votes.to(self.votes.weight.dtype)).float(),
                    seen.painted * seen.painted_coverage[:, None],
                    seen.painted_coverage[:, None],
                    seen.rays,
                    torch.stack([ground, ground_known], dim=1),
                    torch.zeros_like(base) if noisy is None else noisy,
                    base,
                ],
                dim=1,
            )
            .to(self.votes.weight.dtype)
            .contiguous(memory_format=layout(base.device))
        )

    def embedded(self, seen: Seen, sigma: Tensor) -> Tensor:
        """Noise levels [N] and where the cameras stand -> [N, E]."""
        dtype = self.votes.weight.dtype
        levels = self.noise_level(sinusoid(sigma.log() * 250.0, self.config.embedding_width).to(dtype))
        return levels + self.camera(seen.camera.to(dtype))

    def forward(
        self, seen: Seen, base: Tensor, sigma: float | Tensor, x: Tensor | None = None, *, detail: bool = True
    ) -> Painted | Tensor:
        """`denoised` with x, else `first_step`: what trainings call, so that processes can share them."""
        if x is None:
            return self.first_step(seen, base, float(sigma), detail=detail)
        return self.denoised(seen, base, x, torch.as_tensor(sigma))

    def first_step(self, seen: Seen, base: Tensor, sigma_max: float, *, detail: bool = True) -> Painted:
        """The answer from the highest noise level, where the noisy picture says nothing and is not shown.

        detail: False leaves the picture at its mean.
        """
        inputs = self.inputs(seen, base, None)
        sigma = base.new_full((len(base),), sigma_max)
        features = self.trunk(inputs, self.embedded(seen, sigma))
        mean, classes, log_depth, log_variance, state = (
            self.head(inputs, features).float().split([3, self.classes, 1, 1, 3], dim=1)
        )
        unseen = (1 - seen.coverage)[:, None]
        mean, classes = base + mean, classes + _VOTE_LOGITS * seen.votes
        added = torch.zeros_like(mean)
        if detail:
            drawn = _smooth(self.detail(inputs.detach(), features.detach()).float())
            added = (crisp(mean.detach(), classes.detach()) - mean.detach() + drawn) * unseen
        known = (seen.log_depth != 0) & (seen.coverage > 0)
        covered, now = (seen.coverage > 0.5).float(), (seen.now_share > 0.5).float()
        return Painted(
            mean=mean,
            detail=added,
            classes=classes,
            log_depth=log_depth[:, 0] + torch.where(known, seen.log_depth, _MEAN_DEPTH_LOG),
            log_variance=log_variance[:, 0] + _LOG_VARIANCE,
            seen=state + 4.0 * torch.stack([1 - covered, covered * (1 - now), covered * now], dim=1),  # as splatted
        )

    def denoised(self, seen: Seen, base: Tensor, x: Tensor, sigma: Tensor) -> Tensor:
        """D(x, sigma), [N, 3, H, W]; below the highest level. x: [N, 3, H, W], sigma: [N]."""
        variance = sigma**2 + SIGMA_DATA**2
        c_skip, c_out, c_in = SIGMA_DATA**2 / variance, sigma * SIGMA_DATA / variance.sqrt(), variance.rsqrt()
        away = x - base
        inputs = self.inputs(seen, base, c_in[:, None, None, None] * away)
        raw = self.head(inputs, self.trunk(inputs, self.embedded(seen, sigma)))[:, :3].float()
        scaled = c_skip[:, None, None, None] * away + c_out[:, None, None, None] * raw / SIGMA_DATA
        return base + scaled


def crisp(mean: Tensor, classes: Tensor) -> Tensor:
    """What a mean would look like if every pixel were of its likeliest class: [N, 3, H, W].

    Where a kerb may run here or there the mean is a mixture of road and pavement. So each class has a colour of its
    own, place by place, that of the cells around which are surely of it; between cells it is interpolated.
    mean: [N, 3, H, W]. classes: [N, K, H, W], logits.
    """
    n, count, height, width = classes.shape
    chances = classes.softmax(dim=1)
    cells = torch.cat([_cells(mean), _cells(chances)], dim=1)
    h, w = cells.shape[-2:]
    sure = cells[:, 3:].clamp(min=_LEAST_SURE).square().square().square()
    sums = torch.cat([cells[:, :3, None] * sure[:, None], sure[:, None]], dim=1).flatten(1, 2)  # [N, 4 K, h, w]
    for _ in range(_ROUNDS):
        sums = _summed(sums, 2 * _REACH + 1)
    sums = sums.view(n, 4, count * h * w)
    colours = sums[:, :3] / sums[:, 3:]
    # classes of single pixels do not count
    first = likeliest(_about(chances), dim=1).long().flatten(1) * (h * w)  # of the class's colours
    (top, down), (left, right) = (_between_cells(size, mean.device) for size in (height, width))
    made = torch.zeros_like(mean).flatten(2)
    for row, share_y in ((top, 1 - down), (top + 1, down)):
        for column, share_x in ((left, 1 - right), (left + 1, right)):
            place = first + (row[:, None] * w + column).flatten()
            made += colours.gather(2, place[:, None].expand(-1, 3, -1)) * (share_y[:, None] * share_x).flatten()
    return made.view_as(mean)


def _cells(x: Tensor) -> Tensor:
    """Means of [N, C, H, W]: [N, C, H / _CELL_PX, W / _CELL_PX]; down and then across takes a third of pooling."""
    return x.unflatten(2, (-1, _CELL_PX)).mean(dim=3).unflatten(3, (-1, _CELL_PX)).mean(dim=4)


def _about(x: Tensor) -> Tensor:
    """Over the eight places around each of [N, C, H, W] and itself; of many pixels slices are faster than `_summed`."""
    rows = x.clone()
    rows[..., 1:] += x[..., :-1]
    rows[..., :-1] += x[..., 1:]
    sums = rows.clone()
    sums[..., 1:, :] += rows[..., :-1, :]
    sums[..., :-1, :] += rows[..., 1:, :]
    return sums


def _summed(x: Tensor, side: int) -> Tensor:
    """Over squares about each place of [N, C, h, w]; pooling would take five times as long."""
    return F.conv2d(x, x.new_ones(x.shape[1], 1, side, side), padding=side // 2, groups=x.shape[1])


def _between_cells(size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """For each of so many pixels, the cell before it and how far it is on the way to the next one."""
    place = ((torch.arange(size, device=device) + 0.5) / _CELL_PX - 0.5).clamp(0, size // _CELL_PX - 1)
    cell = place.long().clamp(max=size // _CELL_PX - 2)
    return cell, place - cell


def _smooth(x: Tensor) -> Tensor:
    """[N, C, H, W], without what changes from pixel to pixel."""
    for axis, sides in ((3, (2, 2, 0, 0)), (2, (0, 0, 2, 2))):
        wide, size = F.pad(x, sides, mode="replicate"), x.shape[axis]
        x = torch.stack([share * wide.narrow(axis, i, size) for i, share in enumerate(_SMOOTH)]).sum(dim=0)
    return x


def filled(seen: Seen) -> Tensor:
    """Where denoising starts: the splat; beside it what was painted a frame ago; else the colours around, from afar.

    Returns:
        [N, 3, H, W] in [-1, 1].
    """
    unseen = 1 - seen.coverage
    painted = unseen * seen.painted_coverage
    weight = (seen.coverage + painted)[:, None]
    colour = seen.colour * seen.coverage[:, None] + seen.painted * painted[:, None]
    return colour + (1 - weight) * _pulled(colour, weight)


def _pulled(colour: Tensor, weight: Tensor) -> Tensor:
    """Colours, already weighted, spread into their holes from ever coarser pictures: [N, 3, H, W]."""
    sums = torch.cat([colour, weight], dim=1)
    levels = [sums]
    while min(sums.shape[-2:]) > 1:
        sums = F.avg_pool2d(sums, 2, ceil_mode=True)
        levels.append(sums)
    low = levels[-1]
    spread = low[:, :3] / low[:, 3:].clamp(min=1e-4)
    for level in reversed(levels[1:-1]):
        here = level[:, 3:].clamp(max=0.25) * 4  # a quarter covered is enough to go by
        spread = F.interpolate(spread, size=level.shape[-2:], mode="bilinear", align_corners=False)
        spread = here * level[:, :3] / level[:, 3:].clamp(min=1e-4) + (1 - here) * spread
    return F.interpolate(spread, size=colour.shape[-2:], mode="bilinear", align_corners=False)
