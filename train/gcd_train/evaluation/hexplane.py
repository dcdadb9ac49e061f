"""A dynamic scene as six planes of features, in plain torch.

After Cao and Johnson 2023, "HexPlane: A Fast Representation for Dynamic Scenes".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn


@dataclass(frozen=True, kw_only=True, slots=True)
class HexPlaneSettings:
    """Everything that decides what is learnt of one clip, and what it costs.

    updates, rays: steps of the optimiser, and rays in each; the time of a clip is about their product.
    coarse, fine: samples along a ray that look for surfaces, and that are learnt from.
    features: channels of each plane. hidden: width of the heads.
    sides: cells along each axis of space, coarse to fine; each has its equal share of the updates.
    plane_rate, head_rate: learning rates of the first update; both fall to a tenth.
    smoothness: weight of the squared differences between neighbouring cells.
    picture_width: pictures are made this narrow, in pixels, before learning and drawing; views are scaled back up.
    """

    updates: int = 1000
    rays: int = 1024
    coarse: int = 48
    fine: int = 24
    features: int = 16
    hidden: int = 64
    sides: tuple[int, ...] = (24, 48, 96)
    plane_rate: float = 0.06
    head_rate: float = 0.01
    smoothness: float = 0.03
    picture_width: int = 192


_INNER = 0.5
"""Half a side of the box drawn to scale, as a share of the farthest camera's distance from its middle."""
_BEGIN = 0.3
"""Where rays begin, as a share of the nearest camera's distance from the middle. Pictures painted on the air in front
of each camera explain all inputs and no other view."""
_END = 0.5
"""Where rays end, in halves of the cube beyond the middle as the farthest camera sees it. What lies farther off is seen
by one camera only, and with many cameras around a scene each would paint its whole picture there."""
_PULL = 1e-3
"""Weight of a guess, against one camera's axis, for cameras that look along parallel lines."""
_GUESS_M = 10.0
"""How far ahead of cameras with parallel axes the guess lies."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneBounds:
    """A cube that is drawn to scale; all of space around it is squeezed into a shell of its own thickness.

    centre: float32 [3], world, metres. half_m: half a side of the cube. begin, reach: distances along a ray, in halves,
    between which there is something to see; beyond there is a background.
    """

    centre: Tensor
    half_m: float
    begin: float
    reach: float

    @classmethod
    def around(cls, world_from_camera: Tensor) -> "SceneBounds":
        """The cube where the cameras look.

        Args:
            world_from_camera: float [M, 4, 4], input and wanted cameras, metres.
        """
        poses = world_from_camera.double()
        centre = nearest_to_axes(poses)
        distances = (poses[:, :3, 3] - centre).norm(dim=-1)
        half_m = max(float(distances.max()) * _INNER, 1e-3)
        nearest, farthest = (float(distance) / half_m for distance in (distances.min(), distances.max()))
        return cls(centre=centre.float(), half_m=half_m, begin=nearest * _BEGIN, reach=farthest + _END)

    def to_planes(self, points: Tensor) -> Tensor:
        """World points [..., 3], metres, in the planes' coordinates, within [-1, 1].

            x within the cube, (2 - 1 / |x|) x / |x| outside, |x| the largest coordinate; then halved

        Source: Barron et al. 2022 (Mip-NeRF 360), equation 10, with the largest norm so that the result fills a cube.
        """
        scaled = (points - self.centre.to(points.device)) / self.half_m
        size = scaled.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
        return scaled * (2.0 - 1.0 / size) / size / 2.0

    def to_distance(self, place: Tensor) -> Tensor:
        """How far along a ray, metres, for places in [0, 1], evenly."""
        return (self.begin + (self.reach - self.begin) * place) * self.half_m


def nearest_to_axes(world_from_camera: Tensor) -> Tensor:
    """The point with the least summed squared distance to the optical axes, float64 [3].

    Args:
        world_from_camera: float64 [M, 4, 4]. Where all axes are parallel, the point on them 10 m ahead.
    """
    position, ahead = world_from_camera[:, :3, 3], world_from_camera[:, :3, 2]
    across = torch.eye(3, dtype=torch.float64) - ahead[:, :, None] * ahead[:, None, :]  # [M, 3, 3]
    guess = (position + _GUESS_M * ahead).mean(dim=0)
    left = across.sum(dim=0) + _PULL * torch.eye(3, dtype=torch.float64)
    right = torch.einsum("mij,mj->i", across, position) + _PULL * guess
    return torch.linalg.solve(left, right)


SPACE = ((0, 1), (0, 2), (1, 2))
"""Planes xy, xz and yz; each meets the plane of time below it."""
TIME = ((2, 3), (1, 3), (0, 3))
"""Planes zt, yt and xt."""


class HexPlanes(nn.Module):
    """Features at a point of space and time: bilinear in six planes, multiplied in pairs that share no axis.

        f(x, y, z, t) = [XY(x, y) ZT(z, t), XZ(x, z) YT(y, t), YZ(y, z) XT(x, t)]

    The linear layer that comes next sums over the pairs with weights of its own.
    space: [3, C, S, S], time: [3, C, T, S]; the second axis of a pair runs down the rows.
    Source: Cao and Johnson 2023 (HexPlane), equation 5 and section 3.3 (multiply, then concatenate).
    """

    def __init__(self, *, features: int, side: int, moments: int, generator: torch.Generator) -> None:
        super().__init__()
        space = 0.1 + 0.4 * torch.rand(3, features, side, side, generator=generator)
        self.space = nn.Parameter(space)
        self.time = nn.Parameter(torch.ones(3, features, moments, side))  # nothing moves until pictures say so

    @property
    def features(self) -> int:
        """Numbers at a point: three pairs of C."""
        return 3 * self.space.shape[1]

    def forward(self, points: Tensor) -> Tensor:
        """points: [P, 4], x y z t, each in [-1, 1] -> [P, 3 C]."""
        pairs = sampled(self.space, points[:, SPACE]) * sampled(self.time, points[:, TIME])  # [3, C, P]
        return pairs.flatten(0, 1).T

    def roughness(self) -> Tensor:
        """Mean squared difference between neighbouring cells, over both directions of all planes (total variation)."""
        return torch.stack(
            [
                (table.diff(dim=axis) ** 2).mean()
                for table in (self.space, self.time)
                for axis in (2, 3)
                if table.shape[axis] > 1
            ]
        ).sum()

    @torch.no_grad()
    def refine(self, side: int) -> None:
        """Give the planes more cells along the axes of space; what they hold between the old cells stays."""
        moments = self.time.shape[2]
        self.space = nn.Parameter(_resized(self.space, side, side))
        self.time = nn.Parameter(_resized(self.time, moments, side))


def sampled(planes: Tensor, at: Tensor) -> Tensor:
    """Bilinear values. planes: [3, C, rows, columns]; at: [P, 3, 2], column and row in [-1, 1] -> [3, C, P].

    -1 and 1 are the middles of the first and the last cell.
    """
    grid = at.transpose(0, 1)[:, None]  # [3, 1, P, 2]
    return F.grid_sample(planes, grid, align_corners=True, padding_mode="border")[:, :, 0]


def _resized(planes: Tensor, rows: int, columns: int) -> Tensor:
    return F.interpolate(planes, size=(rows, columns), mode="bilinear", align_corners=True)


_THIN = -1.0
"""Added to the density before it is made positive, so that space is a fog at first that lets half of the light pass."""
_HARMONICS = 9
_HEIGHT_WAVES = (2.0, 4.0, 8.0, 16.0)
"""Waves over the vertical part of a direction, in radians of phase, for a sharp horizon all around."""

_BACKGROUND_WIDTH = 32


class HexField(nn.Module):
    """Six planes and two small heads, before a background that stands still, smooth but for its horizon.

    Colour does not depend on the direction that it is seen from.
    bounds: the part of the world that the planes cover. frames: T of the clip, a row of the time planes each.
    generator: of the first weights, on the CPU.
    Source: Cao and Johnson 2023 (HexPlane), section 3.3; without view directions, which few views cannot settle.
    """

    def __init__(
        self, bounds: SceneBounds, frames: int, settings: HexPlaneSettings, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.bounds = bounds
        self.planes = HexPlanes(features=settings.features, side=settings.sides[0], moments=frames, generator=generator)
        self.trunk = _linear(self.planes.features, settings.hidden, generator)
        self.density_head = _linear(settings.hidden, 1, generator)
        self.colour_head = nn.Sequential(
            _linear(settings.hidden, settings.hidden, generator),
            nn.ReLU(),
            _linear(settings.hidden, 3, generator),
        )
        self.background_head = nn.Sequential(
            _linear(_HARMONICS + 2 * len(_HEIGHT_WAVES), _BACKGROUND_WIDTH, generator),
            nn.ReLU(),
            _linear(_BACKGROUND_WIDTH, 3, generator),
        )

    def forward(self, points: Tensor, times: Tensor) -> Tensor:
        """What the heads read. points: [P, 3], world, metres; times: [P], -1 first frame, 1 last -> [P, D]."""
        place = torch.cat([self.bounds.to_planes(points), times[:, None]], dim=-1)
        return self.trunk(self.planes(place)).relu()

    def density(self, features: Tensor) -> Tensor:
        """[P, D] -> [P], optical depth in a metre, 0 or more."""
        raw = self.density_head(features)[:, 0]
        return nn.functional.softplus(raw + _THIN) / self.bounds.half_m

    def colour(self, features: Tensor) -> Tensor:
        """[P, D] -> [P, 3], RGB in [0, 1]."""
        return self.colour_head(features).sigmoid()

    def background(self, directions: Tensor) -> Tensor:
        """RGB in [0, 1] of what lies behind everything, by the direction [P, 3] of length 1, z up in the world."""
        x, y, z = directions.unbind(dim=-1)
        harmonics = [torch.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]
        heights = [wave(rate * z) for rate in _HEIGHT_WAVES for wave in (torch.sin, torch.cos)]
        return self.background_head(torch.stack([*harmonics, *heights], dim=-1)).sigmoid()


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A layer whose first weights depend on the generator alone."""
    layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
        layer.bias.zero_()
    return layer


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

    def __getitem__(self, chosen: Tensor | slice) -> "Rays":
        return Rays(origins=self.origins[chosen], directions=self.directions[chosen], times=self.times[chosen])

    @classmethod
    def together(cls, some: Sequence["Rays"]) -> "Rays":
        """All of them."""
        return cls(
            origins=torch.cat([each.origins for each in some]),
            directions=torch.cat([each.directions for each in some]),
            times=torch.cat([each.times for each in some]),
        )


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
