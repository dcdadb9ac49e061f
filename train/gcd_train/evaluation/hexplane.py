"""A dynamic scene as six planes of features, learnt from videos and drawn from other cameras, in plain torch.

After Cao and Johnson 2023, "HexPlane: A Fast Representation for Dynamic Scenes".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_train.evaluation.per_scene import Background, Camera, Drawing, PerScene, SceneBounds, Shown, head, linear

SPACE = ((0, 1), (0, 2), (1, 2))
TIME = ((2, 3), (1, 3), (0, 3))
"""Planes xy, xz and yz; each meets a plane of time: zt, yt and xt."""


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

    def forward(self, points: Tensor) -> Tensor:
        """points: [P, 4], x y z t, each in [-1, 1] -> [P, 3 C]."""
        pairs = sampled(self.space, points[:, SPACE]) * sampled(self.time, points[:, TIME])  # [3, C, P]
        return pairs.flatten(0, 1).T

    def roughness(self) -> Tensor:
        """Mean squared difference between neighbouring cells, over both directions of all planes (total variation)."""
        steps = [table.diff(dim=axis) for table in (self.space, self.time) for axis in (2, 3)]
        return torch.stack([(step**2).mean() for step in steps if step.numel()]).sum()

    @torch.no_grad()
    def refine(self, side: int) -> None:
        """Give the planes more cells along the axes of space; what they hold between the old cells stays."""
        for name, rows in (("space", side), ("time", self.time.shape[2])):
            table: Tensor = getattr(self, name)
            finer = F.interpolate(table, size=(rows, side), mode="bilinear", align_corners=True)
            setattr(self, name, nn.Parameter(finer))


def sampled(planes: Tensor, at: Tensor) -> Tensor:
    """Bilinear values. planes: [3, C, rows, columns]; at: [P, 3, 2], column and row in [-1, 1] -> [3, C, P].

    -1 and 1 are the middles of the first and the last cell.
    """
    grid = at.transpose(0, 1)[:, None]  # [3, 1, P, 2]
    return F.grid_sample(planes, grid, align_corners=True, padding_mode="border")[:, :, 0]


_THIN = -1.0  # added to the density, so that space is a fog at first that lets half of the light pass


class HexField(nn.Module):
    """Six planes and two small heads, before a background that stands still, smooth but for its horizon.

    Colour does not depend on the direction that it is seen from.
    bounds: the part of the world that the planes cover. frames: T of the clip, a row of the time planes each.
    generator: of the first weights, on the CPU.
    Source: Cao and Johnson 2023 (HexPlane), section 3.3; without view directions, which few views cannot settle.
    """

    def __init__(
        self, bounds: SceneBounds, frames: int, *, features: int, side: int, hidden: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.bounds = bounds
        self.planes = HexPlanes(features=features, side=side, moments=frames, generator=generator)
        self.trunk = linear(3 * features, hidden, generator)
        self.density_head = linear(hidden, 1, generator)
        self.colour_head = head(hidden, hidden, 3, generator)
        self.background = Background(generator)

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


# Weight that every stretch of a ray gets before samples are drawn, so that no surface is missed for good.
_SPREAD = 0.01


def render(
    field: HexField, rays: Tensor, *, coarse: int, fine: int, generator: torch.Generator | None = None
) -> Tensor:
    """Colours of rays, [P, 3] in [0, 1], with gradients to the field.

    Args:
        rays: float32 [P, 7]: origin and direction of length 1 in the world, metres; time, -1 first frame, 1 last.
        coarse, fine: samples that look for surfaces, and samples there that make the colour.
        generator: moves the samples at random; None leaves them in the middle of their stretches.
    Source: Mildenhall et al. 2020 (NeRF), sections 4 and 5.2, with one field for both passes.
    """
    even = torch.linspace(0.0, 1.0, coarse + 1, device=rays.device).expand(len(rays), -1)
    with torch.no_grad():
        searched = _jittered(even, generator)
        edges = resampled(searched, _shares(field, rays, searched)[1], fine, generator)
    features, share = _shares(field, rays, edges)
    passed = 1.0 - share.sum(dim=1, keepdim=True)
    seen = (share[..., None] * field.colour(features).view(*share.shape, 3)).sum(dim=1)
    return seen + passed * field.background(rays[:, 3:6])


def _shares(field: HexField, rays: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
    """Features in the middle of stretches, [P * N, D], and what each adds to the light of its ray, [P, N].

        w_i = exp(-sum over j < i of tau_j) (1 - exp(-tau_i))

    What is left to 1 comes from the background. tau: density times length, nearest first.
    Source: Mildenhall et al. 2020 (NeRF), equation 3.
    """
    bounds = field.bounds
    distances = (bounds.begin + (bounds.reach - bounds.begin) * edges) * bounds.half_m
    middle = (distances[:, 1:] + distances[:, :-1]) / 2.0
    points = rays[:, None, :3] + middle[..., None] * rays[:, None, 3:6]
    features = field(points.flatten(0, 1), rays[:, 6:].expand_as(middle).flatten())
    optical_depth = field.density(features).view_as(middle) * distances.diff(dim=-1)
    before = optical_depth.cumsum(dim=-1) - optical_depth
    return features, (-before).exp() * -torch.expm1(-optical_depth)


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


_RAYS_AT_ONCE = 4096  # drawn together without gradients: 4096 rays of 48 samples with 48 features are 38 MB


@dataclass(frozen=True, kw_only=True)
class HexPlane(PerScene):
    """HexPlane with so many input views; see PerScene.

    updates, rays: steps of the optimiser, and rays in each; the time of a clip is about their product.
    coarse, fine: samples along a ray that look for surfaces, and that are learnt from.
    features: channels of each plane. hidden: width of the heads.
    sides: cells along each axis of space, coarse to fine; each has its equal share of the updates.
    plane_rate, head_rate: learning rates of the first update; both fall to a tenth.
    smoothness: weight of the squared differences between neighbouring cells.
    Source: Cao and Johnson 2023 (HexPlane); as a baseline, Van Hoorick et al. 2024 (GCD), section 5.
    """

    stem = "hexplane"
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

    def learn(self, pictures: Sequence[Shown], bounds: SceneBounds, frames: int) -> Drawing:
        """See PerScene."""
        generator = torch.Generator().manual_seed(self.seed)
        rays = torch.cat([camera.rays() for _, camera in pictures]).to(self.place)
        colours = torch.cat([picture.flatten(1).T for picture, _ in pictures]).to(self.place)
        field = HexField(
            bounds, frames, features=self.features, side=self.sides[0], hidden=self.hidden, generator=generator
        ).to(self.place)
        heads = [weight for name, weight in field.named_parameters() if not name.startswith("planes.")]
        done = 0
        for stage, side in enumerate(self.sides, start=1):
            field.planes.refine(side)
            rates = (self.plane_rate, self.head_rate)
            groups = [{"params": list(field.planes.parameters())}, {"params": heads}]
            optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99))
            end = self.updates * stage // len(self.sides)
            for number in range(done, end):
                for group, rate in zip(optimiser.param_groups, rates, strict=True):
                    group["lr"] = rate * 0.1 ** (number / self.updates)  # to a tenth at the end
                chosen = torch.randint(len(colours), (self.rays,), generator=generator).to(self.place)
                made = render(field, rays[chosen], coarse=self.coarse, fine=self.fine, generator=generator)
                error = F.mse_loss(made, colours[chosen])
                optimiser.zero_grad(set_to_none=True)
                (error + self.smoothness * field.planes.roughness()).backward()
                optimiser.step()
            done = end
        return partial(self._draw, field.eval())

    def _draw(self, field: HexField, camera: Camera) -> Tensor:
        some = camera.rays().split(_RAYS_AT_ONCE)
        rows = [render(field, rays.to(self.place), coarse=self.coarse, fine=self.fine) for rays in some]
        return torch.cat(rows).T.unflatten(1, (camera.lens.height, camera.lens.width))
