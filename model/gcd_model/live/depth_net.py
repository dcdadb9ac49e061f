"""How far everything is, what it is, and whether it moves: from a picture, an earlier one, the lens and the mount.

Depth is a choice among bins that are even in log-depth, each with an offset: at an edge two peaks stand side by side
and the likelier one is taken, never their mean. Where a mount is declared, one gate a pixel says "this is the ground":
then the bins, and the places within them, are those of the plane. Where the camera has moved, one number a pixel says
how far the plane sweep is trusted: bins that explain the earlier frame badly lose by it.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.geometry import Intrinsics
from gcd_model.live.blocks import FineHead, Trunk, layout, likeliest
from gcd_model.live.config import SKY_M, DepthConfig

INPUTS = 7
_FARTHEST_GROUND_M = 200.0
_GROUND_SCALE = 3.0  # of its log-depth, as an input
_GROUND_LOGIT = 8.0
"""How much a fully open gate adds to the bins of the ground."""
_GATE_AT_FIRST = -3.0
_TRUST, _TRUST_AT_FIRST, _DOUBT_PX = 4.0, -2.0, 5
"""What a difference of colour takes from a bin's logit where the sweep is trusted; a mean over so many half pixels."""
_OFFSET_REACH = 1.5
_SMOOTH_PX, _SMOOTH_SPREAD, _SMOOTH_ROUNDS = 2, 0.1, 2
"""Depth is averaged over so many pixels to each side, where it differs by about this share at most, so many times."""
SWEEP_SCALE = 2
"""Costs are worked out at half the size."""
_CONTRAST, _UNSEEN = 4.0, 1.0
_BEHIND_M = 0.02
_LEAST_SHARE = 1e-3
"""Of the mean variance of standardised features: less counts as this, or noise would decide."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthOutput:
    """What the network says of N pictures.

    logits: [N, B, H, W], the last bin is the sky. raw_offsets: [N, B - 1, H, W], see `offsets`. classes: [N, K, H, W],
    logits. moves: [N, H, W], logit of a thing in motion. ground: [N, 1, H, W], probability that the declared ground is
    seen. ground_place: [N, 1, H, W], where it is, in bins. summary: [N, 2 C], see `summary_of`.
    """

    logits: Tensor
    raw_offsets: Tensor
    classes: Tensor
    moves: Tensor
    ground: Tensor
    ground_place: Tensor
    summary: Tensor

    def offsets(self, bins: Tensor) -> Tensor:
        """Of the depth from the centres of some bins, int64 [N, M, H, W], in parts of a bin: [N, M, H, W]."""
        learned = self.raw_offsets.gather(1, bins).float().tanh() * _OFFSET_REACH
        plane = self.ground_place - bins
        return learned.lerp(plane.clamp(-_OFFSET_REACH, _OFFSET_REACH), self.ground * (plane.abs() < _OFFSET_REACH))


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthReading:
    """What is read off it. metres: [N, H, W], SKY_M for the sky.

    spread: [N, H, W], standard deviation of log-depth within the peak; errors are one to three times as large.
    entropy: [N], mean over pixels of the classes' entropy, in parts of its largest.
    """

    metres: Tensor
    spread: Tensor
    entropy: Tensor


class DepthNet(nn.Module):
    """See the module. Every output head is its own part of one fine head."""

    def __init__(self, config: DepthConfig, classes: int) -> None:
        super().__init__()
        self.config, self.classes = config, classes
        beside = (config.bins + 1) * (config.patch // SWEEP_SCALE) ** 2
        self.trunk = Trunk(INPUTS, config.widths, config.patch, mixers=config.mixers, beside=beside)
        outputs = 2 * config.bins - 1 + classes + 3
        self.head = FineHead(
            INPUTS, config.widths[0], config.fine_width, outputs, config.patch, half_width=config.half_width
        )

    def features(self, inputs: Tensor, sweep: Tensor | None = None) -> Tensor:
        """What the heads look at: [N, widths[0], H / patch, W / patch]. Args: see `forward`."""
        n, _, height, width = inputs.shape
        if sweep is None:
            sweep = inputs.new_zeros(n, self.config.bins + 1, height // SWEEP_SCALE, width // SWEEP_SCALE)
        return self.trunk(inputs, beside=sweep.to(inputs))

    def forward(self, inputs: Tensor, sweep: Tensor | None = None, pixels: Tensor | None = None) -> DepthOutput:
        """What is seen.

        Args:
            inputs: [N, 7, H, W], see `depth_inputs`. sweep: [N, bins + 1, H/2, W/2], see `sweep_costs`; None without
                earlier frames. pixels: [N, M], of these alone, as pictures of M x 1.
        """
        weight, bins = self.trunk.stem.weight, self.config.bins
        pictures = inputs.to(weight.dtype, memory_format=layout(inputs.device))
        features = self.features(pictures, sweep)
        made = self.head(pictures, features, pixels)
        logits, offsets, *others = made.split([bins, bins - 1, self.classes, 1, 1, 1], dim=1)
        logits, (classes, moves, gate, trust) = logits.float(), (each.float() for each in others)
        if sweep is not None:
            doubt = _doubt(sweep, inputs.shape[-1], pixels)
            logits = torch.addcmul(logits, F.softplus(trust + _TRUST_AT_FIRST), doubt, value=-_TRUST)
        ground = inputs[:, -2:]
        if pixels is not None:
            ground = ground.flatten(2).gather(2, pixels[:, None].expand(-1, 2, -1))[..., None]
        opened = torch.sigmoid(gate + _GATE_AT_FIRST) * ground[:, 1:]
        place = (ground[:, :1] * _GROUND_SCALE - first_bin(self.config)) / bin_width(self.config)
        around = place.floor() + torch.arange(2, device=place.device).view(1, 2, 1, 1)  # the bins next to it
        solid = (around >= 0) & (around < bins - 1)
        prior = _GROUND_LOGIT * opened * (1 - (place - around).abs()) * solid
        return DepthOutput(
            logits=logits.scatter_add(1, around.clamp(0, bins - 2).long(), prior),
            raw_offsets=offsets,
            classes=classes,
            moves=moves[:, 0],
            ground=opened,
            ground_place=place,
            summary=summary_of(features.detach()),
        )


def _doubt(sweep: Tensor, width: int, pixels: Tensor | None) -> Tensor:
    """How much worse than the best each bin explains the earlier frame, about each pixel: [N, B, H, W] or [N, B, M, 1].

    sweep: [N, B + 1, H/2, W/2]. width: W. pixels: [N, M], of these alone.
    """
    costs = sweep[:, :-1].contiguous(memory_format=layout(sweep.device))
    costs = F.avg_pool2d(costs, _DOUBT_PX, 1, _DOUBT_PX // 2, count_include_pad=False).contiguous()
    costs = costs - costs.amin(dim=1, keepdim=True)
    if pixels is None:
        return F.interpolate(costs, scale_factor=SWEEP_SCALE, mode="nearest")
    row, column = pixels // width // SWEEP_SCALE, pixels % width // SWEEP_SCALE
    place = (row * (width // SWEEP_SCALE) + column)[:, None].expand(-1, costs.shape[1], -1)
    return costs.flatten(2).gather(2, place)[..., None]


def depth_inputs(pictures: Tensor, rays: Tensor, ground_m: Tensor) -> Tensor:
    """What the network looks at.

    Args:
        pictures: [N, 3, H, W] in [-1, 1]. rays: [N, 2, H, W], x / z and y / z of each pixel.
        ground_m: [N, H, W], depth of the plane on which the camera's carrier stands; 0 where it is not seen, and
            everywhere without a declared mount.
    Returns:
        [N, 7, H, W].
    """
    known = ground_m > 0
    ground = torch.where(known, ground_m.clamp(0.05, _FARTHEST_GROUND_M), 1.0).log() / _GROUND_SCALE
    return torch.cat([pictures, rays, ground[:, None], known[:, None].to(pictures)], dim=1)


def plane_depth(rays: Tensor, up: Tensor, height_m: Tensor | float) -> Tensor:
    """Depth of a plane below each camera: float32 [..., H, W], 0 where no ray meets it.

    rays: [..., 2, H, W], see `Intrinsics.rays`. up: [..., 3], the plane's normal in camera axes, towards the camera.
    height_m: [...], of the camera over the plane.
    """
    x, y = rays.unbind(dim=-3)
    across, down, ahead = up[..., None, None].unbind(dim=-3)
    height = torch.as_tensor(height_m, dtype=rays.dtype, device=rays.device)[..., None, None]
    falling = -(across * x + down * y + ahead)  # metres down for each metre ahead
    return torch.where(falling > height / SKY_M, height / falling.clamp(min=1e-6), 0.0).float()


def first_bin(config: DepthConfig) -> float:
    """Log-depth of the nearest bin's centre."""
    return math.log(config.nearest_m) + bin_width(config) / 2


def bin_width(config: DepthConfig) -> float:
    """In log-depth."""
    return math.log(config.farthest_m / config.nearest_m) / (config.bins - 1)


def read_depth(output: DepthOutput, config: DepthConfig) -> DepthReading:
    """The likeliest peak of every pixel, a bin and its two neighbours, smoothed along surfaces."""
    probability = output.logits.softmax(dim=1)
    solid = probability[:, :-1]  # without the sky
    mass = solid.clone()
    mass[:, 1:] += solid[:, :-1]
    mass[:, :-1] += solid[:, 1:]
    best, peak = mass.amax(dim=1), likeliest(mass, dim=1).long()  # [N, H, W]
    around = peak[:, None] + torch.arange(-1, 2, device=peak.device).view(1, 3, 1, 1)
    inside = ((around >= 0) & (around < config.bins - 1)).to(solid.dtype)
    around = around.clamp(0, config.bins - 2)
    weight = solid.gather(1, around) * inside
    places = first_bin(config) + (around + output.offsets(around)) * bin_width(config)
    weight = weight / weight.sum(dim=1, keepdim=True).clamp(min=1e-8)
    place = (places * weight).sum(dim=1)
    spread = ((places - place[:, None]).square() * weight).sum(dim=1).sqrt()
    sky = probability[:, -1] > best
    confidence = torch.maximum(best, probability[:, -1])
    metres, log = torch.where(sky, SKY_M, place.exp()), output.classes.log_softmax(dim=1)
    return DepthReading(
        metres=torch.where(sky, SKY_M, _smoothed(metres, confidence)),
        spread=spread,
        entropy=-(log.exp() * log).sum(dim=1).mean(dim=(1, 2)) / math.log(log.shape[1]),
    )


def _smoothed(metres: Tensor, confidence: Tensor) -> Tensor:
    """Averages of inverse depth, which is linear on planes, along rows and then columns; edges stay: [N, H, W]."""
    inverse = 1 / metres
    for _ in range(_SMOOTH_ROUNDS):
        for axis, sides in ((2, (_SMOOTH_PX, _SMOOTH_PX, 0, 0)), (1, (0, 0, _SMOOTH_PX, _SMOOTH_PX))):
            wide, sure = F.pad(torch.stack([inverse, confidence], dim=1), sides, mode="replicate").unbind(dim=1)
            log, size, share = wide.log().mul_(_SMOOTH_SPREAD**-1), wide.shape[axis], wide * sure
            total, weights = share.clone(), sure.clone()
            for step in range(1, _SMOOTH_PX + 1):  # every pixel and the one so many further, each as the other's
                one, other = ((axis, 0, size - step), (axis, step, size - step))
                near = (log.narrow(*other) - log.narrow(*one)).square_().mul_(-0.5).exp_()
                for here, there in ((one, other), (other, one)):
                    total.narrow(*here).addcmul_(near, share.narrow(*there))
                    weights.narrow(*here).addcmul_(near, sure.narrow(*there))
            inverse = (total / weights).narrow(axis, _SMOOTH_PX, size - 2 * _SMOOTH_PX)
    return 1 / inverse


# --- what the camera's own motion tells of depth: how well each depth explains an earlier frame ----------------------

# For every pixel and every bin of depth the earlier picture is looked up where that point would have been; at the right
# depth the colours agree. What moves by itself agrees nowhere, and so does what the earlier frame did not see.
# Source: the cost volume of Watson et al. 2021 (ManyDepth), with colours instead of features.


class Reference(NamedTuple):
    """An earlier frame of the same camera. picture: [3, H, W] in [-1, 1]. reference_from_camera: float64 [4, 4],
    metres."""

    picture: Tensor
    reference_from_camera: Tensor


def sweep_costs(picture: Tensor, lens: Intrinsics, reference: Reference | None, config: DepthConfig) -> Tensor:
    """`plane_sweep` of one picture [3, H, W], with an earlier one or none: [bins + 1, H/2, W/2]."""
    if reference is None:
        return picture.new_zeros(config.bins + 1, lens.height // SWEEP_SCALE, lens.width // SWEEP_SCALE)
    earlier = reference.picture.to(picture)
    lenses = torch.tensor([[lens.fx, lens.fy, lens.cx, lens.cy]], device=picture.device)
    return plane_sweep(picture[None], lenses, earlier[None], reference.reference_from_camera[None], config)[0]


def plane_sweep(
    pictures: Tensor, lenses: Tensor, earlier: Tensor, earlier_from_camera: Tensor, config: DepthConfig
) -> Tensor:
    """How much the colours of N pictures and of an earlier one of each differ, by depth: [N, bins + 1, H/2, W/2].

    pictures, earlier: [N, 3, H, W] in [-1, 1]. lenses: float32 [N, 4], fx, fy, cx, cy in pixels.
    earlier_from_camera: [N, 4, 4], metres. The last channel is 1: there is an earlier picture.
    """
    here, there = (F.avg_pool2d(each, SWEEP_SCALE) for each in (pictures, earlier))
    n, _, height, width = here.shape
    moves = earlier_from_camera.to(here.device)
    turn, step = moves[:, :3, :3].float(), moves[:, :3, 3].float()
    fx, fy, cx, cy = lenses.unbind(dim=1)
    into = torch.zeros_like(turn)  # pixels of a picture that reaches from -1 to 1
    into[:, 0, 0], into[:, 0, 2] = 2 * fx / (width * SWEEP_SCALE), 2 * cx / (width * SWEEP_SCALE) - 1
    into[:, 1, 1], into[:, 1, 2] = 2 * fy / (height * SWEEP_SCALE), 2 * cy / (height * SWEEP_SCALE) - 1
    into[:, 2, 2] = 1
    x = ((torch.arange(width, device=here.device) + 0.5) * SWEEP_SCALE - cx[:, None]) / fx[:, None]
    y = ((torch.arange(height, device=here.device) + 0.5) * SWEEP_SCALE - cy[:, None]) / fy[:, None]
    u, v = x[:, None].expand(n, height, width), y[:, :, None].expand(n, height, width)
    turned = into @ turn @ torch.stack([u, v, torch.ones_like(u)], dim=1).flatten(2)  # [N, 3, h*w], of points 1 m ahead
    steps = (torch.arange(config.bins - 1) + 0.5) / (config.bins - 1)
    inverse = torch.cat([(config.nearest_m / config.farthest_m) ** steps / config.nearest_m, torch.zeros(1)])  # 1 / m
    shifts = (into @ step[..., None]) * inverse.to(here.device)  # [N, 3, bins], the sky's last
    across, down, z = (turned[:, :, None] + shifts[..., None]).unbind(dim=1)  # [N, bins, h*w] each
    inside = (z > _BEHIND_M) & (across.abs() <= z) & (down.abs() <= z)
    place = torch.stack([across, down], dim=-1) / z.clamp(min=_BEHIND_M)[..., None]  # [N, bins, h*w, 2]
    looked_up = F.grid_sample(there, place, mode="bilinear", padding_mode="border", align_corners=False)
    difference = (looked_up - here.flatten(2)[:, :, None]).abs().mean(dim=1) * _CONTRAST  # [N, bins, h*w]
    costs = torch.where(inside, difference, _UNSEEN)
    return torch.cat([costs, torch.ones_like(costs[:, :1])], dim=1).view(n, -1, height, width)


# --- how unlike its training a picture looks: classes it is unsure of, features it never had -------------------------


def summary_of(features: Tensor) -> Tensor:
    """Means and standard deviations over the picture: [N, C, h, w] -> float32 [N, 2 C]."""
    flat = features.float().flatten(2)
    return torch.cat([flat.mean(dim=2), flat.std(dim=2, correction=0)], dim=1)


class Familiarity(nn.Module):
    """A Gaussian of the training's summaries. Mahalanobis distance of features: Lee et al. 2018."""

    mean: Tensor
    whiten: Tensor

    def __init__(self, channels: int) -> None:
        """channels: C of `summary_of`. Until `fit`, mean 0 and variance 1."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(2 * channels))
        self.register_buffer("whiten", torch.zeros(2 * channels, 2 * channels))
        self.whiten.view(-1)[:: 2 * channels + 1] = 1.0  # `eye` on the device "meta" imports torch's compiler, for 2 s

    def fit(self, summaries: Tensor) -> None:
        """summaries: [N, 2 C] of pictures of the training."""
        wide = summaries.double()
        spread = wide.std(dim=0).clamp(min=1e-6)
        values, vectors = torch.linalg.eigh(torch.cov(((wide - wide.mean(dim=0)) / spread).T))
        scale = values.clamp(min=_LEAST_SHARE).rsqrt()
        self.mean.copy_(wide.mean(dim=0))
        self.whiten.copy_(vectors * scale / spread[:, None])

    def score(self, summaries: Tensor, entropy: Tensor) -> Tensor:
        """0 to 1, low where the training was. summaries: [N, 2 C]. entropy: [N], of the classes, 0 to 1; -> [N]."""
        distance = ((summaries - self.mean.float()) @ self.whiten.float()).square().mean(dim=1)
        return 1 - torch.exp(-entropy * distance)
