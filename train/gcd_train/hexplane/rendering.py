"""Colours of rays through a field: samples where there may be a surface, and the light that reaches the camera."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_train.hexplane.field import HexField

_SPREAD = 0.01
"""Weight that every stretch of a ray gets before samples are drawn, so that no surface is missed for good."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Rays:
    """P rays. origins: [P, 3] and directions: [P, 3] of length 1, world, metres. times: [P], -1 first frame, 1 last."""

    origins: Tensor
    directions: Tensor
    times: Tensor

    def to(self, device: torch.device | str) -> "Rays":
        """The same rays on a device of torch."""
        return Rays(origins=self.origins.to(device), directions=self.directions.to(device), times=self.times.to(device))


def render(field: HexField, rays: Rays, *, coarse: int, fine: int, generator: torch.Generator | None = None) -> Tensor:
    """Colours of rays, [P, 3] in [0, 1], with gradients to the field.

    Args:
        coarse, fine: samples that look for surfaces, and samples there that make the colour.
        generator: moves the samples at random; None leaves them in the middle of their stretches.
    Source: Mildenhall et al. 2020 (NeRF), sections 4 and 5.2, with one field for both passes.
    """
    even = torch.linspace(0.0, 1.0, coarse + 1, device=rays.origins.device).expand(len(rays.origins), -1)
    with torch.no_grad():
        searched = _jittered(even, generator)
        features, lengths = _along(field, rays, searched)
        found = weights(field.density(features).view_as(lengths) * lengths)
        edges = resampled(searched, found, fine, generator)
    features, lengths = _along(field, rays, edges)
    share = weights(field.density(features).view_as(lengths) * lengths)
    passed = 1.0 - share.sum(dim=1, keepdim=True)
    seen = (share[..., None] * field.colour(features).view(*share.shape, 3)).sum(dim=1)
    return seen + passed * field.background(rays.directions)


def weights(optical_depth: Tensor) -> Tensor:
    """What each stretch adds to the light of a ray; what is left to 1 comes from the background.

        w_i = exp(-sum over j < i of tau_j) (1 - exp(-tau_i))

    Args:
        optical_depth: tau, [P, N], density times length, nearest first.
    Source: Mildenhall et al. 2020 (NeRF), equation 3.
    """
    before = optical_depth.cumsum(dim=-1) - optical_depth
    return (-before).exp() * -torch.expm1(-optical_depth)


def resampled(edges: Tensor, share: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """Edges of `count` stretches that each hold an equal part of the weights, [P, count + 1].

    Args:
        edges: [P, N + 1], rising; the first and the last stay. share: [P, N], weights of the stretches between them.
        generator: moves the inner edges at random; None leaves them even.
    """
    padded = share + _SPREAD
    rising = torch.cat([torch.zeros_like(padded[:, :1]), padded.cumsum(dim=-1)], dim=-1)
    rising = rising / rising[:, -1:]
    wanted = torch.linspace(0.0, 1.0, count + 1, device=edges.device).expand(len(edges), -1)
    wanted = _jittered(wanted, generator).contiguous()
    after = torch.searchsorted(rising, wanted, right=True).clamp(1, edges.shape[1] - 1)
    low, high = rising.gather(1, after - 1), rising.gather(1, after)
    left, right = edges.gather(1, after - 1), edges.gather(1, after)
    return torch.lerp(left, right, ((wanted - low) / (high - low).clamp(min=1e-9)).clamp(0.0, 1.0))


def _jittered(edges: Tensor, generator: torch.Generator | None) -> Tensor:
    """Inner edges moved by up to half a stretch each way; the ends stay."""
    if generator is None:
        return edges
    step = 1.0 / (edges.shape[1] - 1)
    moved = torch.rand(edges.shape, generator=generator, device=generator.device).to(edges.device) - 0.5
    moved[:, 0] = moved[:, -1] = 0.0
    return edges + step * moved


def _along(field: HexField, rays: Rays, edges: Tensor) -> tuple[Tensor, Tensor]:
    """Features in the middle of stretches, [P * N, D], and the stretches' lengths in metres, [P, N]."""
    distances = field.bounds.to_distance(edges)
    middle = (distances[:, 1:] + distances[:, :-1]) / 2.0
    points = rays.origins[:, None] + middle[..., None] * rays.directions[:, None]
    times = rays.times[:, None].expand_as(middle)
    return field(points.flatten(0, 1), times.flatten()), distances.diff(dim=-1)
