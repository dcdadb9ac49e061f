"""A dynamic scene as six planes of features, learnt from videos and drawn from other cameras, in plain torch.

After Cao and Johnson 2023, "HexPlane: A Fast Representation for Dynamic Scenes".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.geometry import Intrinsics


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


_INNER = 0.5  # half a side of the box drawn to scale, as a share of the farthest camera's distance from its middle
# Where rays begin, as a share of the nearest camera's distance from the middle: pictures painted on the air in front of
# each camera explain all inputs and no other view.
_BEGIN = 0.3
# Where rays end, in halves of the cube beyond the middle as the farthest camera sees it: what lies farther off is seen
# by one camera only, and each would paint its whole picture there.
_END = 0.5
_PULL, _GUESS_M = 1e-3, 10.0  # for cameras with parallel axes: weight of a guess, and how far ahead it lies


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
        """The cube about the point with the least summed squared distance to the cameras' optical axes.

        Where all axes are parallel, that is the point on them 10 m ahead.

        Args:
            world_from_camera: float [M, 4, 4], input and wanted cameras, metres.
        """
        poses = world_from_camera.double()
        position, ahead = poses[:, :3, 3], poses[:, :3, 2]
        across = torch.eye(3, dtype=torch.float64) - ahead[:, :, None] * ahead[:, None, :]  # [M, 3, 3]
        guess = (position + _GUESS_M * ahead).mean(dim=0)
        left = across.sum(dim=0) + _PULL * torch.eye(3, dtype=torch.float64)
        centre = torch.linalg.solve(left, torch.einsum("mij,mj->i", across, position) + _PULL * guess)
        distances = (position - centre).norm(dim=-1)
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
_HARMONICS = 9
_HEIGHT_WAVES = (2.0, 4.0, 8.0, 16.0)  # over the vertical part of a direction, radians, for a sharp horizon all around
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
        self.trunk = _linear(3 * settings.features, settings.hidden, generator)
        self.density_head = _linear(settings.hidden, 1, generator)
        self.colour_head = _colour_head(settings.hidden, settings.hidden, generator)
        self.background_head = _colour_head(_HARMONICS + 2 * len(_HEIGHT_WAVES), _BACKGROUND_WIDTH, generator)

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


def _colour_head(inputs: int, width: int, generator: torch.Generator) -> nn.Sequential:
    return nn.Sequential(_linear(inputs, width, generator), nn.ReLU(), _linear(width, 3, generator))


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


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """Where and when a picture is taken.

    world_from_camera: float [4, 4], metres. time: -1 for the first frame of the clip, 1 for the last.
    """

    lens: Intrinsics
    world_from_camera: Tensor
    time: float

    def rays(self) -> Tensor:
        """Through the middle of every pixel, row by row, as `render` wants them."""
        u = (torch.arange(self.lens.width) + 0.5 - self.lens.cx) / self.lens.fx
        v = (torch.arange(self.lens.height) + 0.5 - self.lens.cy) / self.lens.fy
        down, right = torch.meshgrid(v, u, indexing="ij")
        ahead = F.normalize(torch.stack([right, down, torch.ones_like(right)], dim=-1).view(-1, 3), dim=-1)
        pose = self.world_from_camera.float()
        time = ahead.new_full((len(ahead), 1), self.time)
        return torch.cat([pose[:3, 3].expand(len(ahead), 3), ahead @ pose[:3, :3].T, time], dim=1)

    def narrowed(self, width: int) -> "Camera":
        """The camera of the same picture at most this wide."""
        if self.lens.width <= width:
            return self
        height = max(1, round(self.lens.height * width / self.lens.width))
        return replace(self, lens=self.lens.resized(width, height))


def learn(
    pictures: Sequence[tuple[Tensor, Camera]],
    bounds: SceneBounds,
    settings: HexPlaneSettings,
    *,
    frames: int,
    seed: int = 0,
    device: str = "auto",
) -> HexField:
    """The field that shows the pictures again.

    Args:
        pictures: of one scene, float32 [3, H, W] in [0, 1], with their cameras.
        frames: T of the clip. seed: of weights, rays and samples.
        device: "auto" (CUDA where there is one), or as torch names it; the field stays there.
    Returns:
        On the CPU the same field for the same pictures, settings, seed and number of threads.
    """
    auto = "cuda" if torch.cuda.is_available() else "cpu"
    place, generator = torch.device(auto if device == "auto" else device), torch.Generator().manual_seed(seed)
    narrow = [camera.narrowed(settings.picture_width) for _, camera in pictures]  # so that learning costs less
    rays = torch.cat([camera.rays() for camera in narrow]).to(place)
    sizes = [(camera.lens.height, camera.lens.width) for camera in narrow]
    shown = [F.interpolate(of[None], size=size, mode="area") for (of, _), size in zip(pictures, sizes, strict=True)]
    colours = torch.cat([each[0].flatten(1).T for each in shown]).to(place)
    field = HexField(bounds, frames, settings, generator).to(place)
    heads = [weight for name, weight in field.named_parameters() if not name.startswith("planes.")]
    done = 0
    for stage, side in enumerate(settings.sides, start=1):
        field.planes.refine(side)
        rates = (settings.plane_rate, settings.head_rate)
        groups = [{"params": list(field.planes.parameters())}, {"params": heads}]
        optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99))
        end = settings.updates * stage // len(settings.sides)
        for number in range(done, end):
            for group, rate in zip(optimiser.param_groups, rates, strict=True):
                group["lr"] = rate * 0.1 ** (number / settings.updates)  # to a tenth at the end
            chosen = torch.randint(len(colours), (settings.rays,), generator=generator).to(place)
            made = render(field, rays[chosen], coarse=settings.coarse, fine=settings.fine, generator=generator)
            error = F.mse_loss(made, colours[chosen])
            optimiser.zero_grad(set_to_none=True)
            (error + settings.smoothness * field.planes.roughness()).backward()
            optimiser.step()
        done = end
    return field.eval()


@torch.no_grad()
def draw(field: HexField, camera: Camera, settings: HexPlaneSettings) -> Tensor:
    """The picture of a camera, float32 [3, H, W] on the CPU, in [0, 1], in the size of its lens."""
    narrow = camera.narrowed(settings.picture_width)
    rays, rows = narrow.rays(), list[Tensor]()
    for start in range(0, len(rays), _RAYS_AT_ONCE):
        some = rays[start : start + _RAYS_AT_ONCE].to(field.planes.space.device)
        rows.append(render(field, some, coarse=settings.coarse, fine=settings.fine).cpu())
    picture, size = torch.cat(rows).T.reshape(3, narrow.lens.height, -1), (camera.lens.height, camera.lens.width)
    if narrow is camera:
        return picture
    return F.interpolate(picture[None], size=size, mode="bicubic", align_corners=False)[0].clamp(0.0, 1.0)
