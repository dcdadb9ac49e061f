"""A dynamic scene as Gaussians that six planes of features move, learnt from videos.

After Wu et al. 2024, "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_train.evaluation.hexplane import HexPlanes
from gcd_train.evaluation.per_scene import (
    Background,
    Camera,
    Drawing,
    PerScene,
    SceneBounds,
    Shown,
    linear,
    narrowed,
)
from gcd_train.evaluation.rasteriser import Gaussians, Picture, has_gsplat, rasterised, rotations

_DEPTHS = 64  # tried along a ray for a first point
_ALIKE = 0.05  # difference of colours, in [0, 1], that is none
_UNSEEN = 0.3  # difference of colours that a place counts as which no other view sees
_FIRST_OPACITY = 0.1  # as in 3DGS
_LARGEST = 0.3  # deviation of a Gaussian, as a share of how far it is from the middle of the scene
_RATES = {  # of the first update; of means in halves of the cube
    "means": 1e-3,
    "quaternions": 0.0015,
    "scales": 0.006,
    "opacities": 0.015,
    "colours": 0.006,
    "planes": 0.05,
    "heads": 0.01,
    "background": 0.01,
}
_FALLING = {"means": 0.01}  # rate at the end, as a share of the first; of all others a tenth, as HexPlane's
_MOVING, _RISING = ("planes", "heads"), 0.1  # whose rates rise after the warm-up, and in what share of the updates
_SHRUNK = 0.47  # logarithm of 1.6, by which halves are smaller, as in 3DGS


def first_points(
    pictures: Sequence[Shown], bounds: SceneBounds, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Points [N, 3], metres, with colours [N, 3]: for pixels at random, where the other views look most alike.

    Of several places along a ray that is the one whose colour, in the pictures of the same moment that see it, differs
    least from the pixel's; one at random where no other picture does. Of twice as many pixels those stay that are alike
    in the fewest places: the sky is so everywhere, and would fill the air. It stands in for structure from motion.
    """
    points, colours, unsure = list[Tensor](), list[Tensor](), list[Tensor]()
    each = -(-2 * count // len(pictures))
    for picture, camera in pictures:
        chosen = torch.randint(picture[0].numel(), (each,), generator=generator)
        rays, own = camera.rays()[chosen], picture.flatten(1).T[chosen]
        steps = (torch.arange(_DEPTHS) + torch.rand(each, _DEPTHS, generator=generator)) / _DEPTHS
        distances = bounds.half_m * (bounds.begin + (bounds.reach - bounds.begin) * steps)
        places = rays[:, None, :3] + distances[..., None] * rays[:, None, 3:6]
        unlike, seen = torch.zeros_like(distances), torch.zeros_like(distances)
        for other, its in pictures:
            if its.time == camera.time and its is not camera:
                there, colour = _looked_up(places, other, its)
                seen += there
                unlike += there * (colour - own[:, None]).abs().mean(dim=-1)
        noise = 1e-3 * torch.rand(unlike.shape, generator=generator)
        least, best = (torch.where(seen > 0, unlike / seen.clamp(min=1.0), _UNSEEN) + noise).min(dim=1)
        points.append(places[torch.arange(each), best])
        colours.append(own)
        alike = unlike <= (least[:, None] + _ALIKE) * seen  # and so is what no other picture shows
        unsure.append(alike.float().mean(dim=1) + noise[:, 0])  # at random where as many are alike
    kept = torch.cat(unsure).argsort()[:count]
    return torch.cat(points)[kept], torch.cat(colours)[kept]


def _looked_up(places: Tensor, picture: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Whether a picture shows the places [P, D, 3], and its colours there, [P, D, 3]."""
    pose, lens = camera.world_from_camera.float(), camera.lens
    x, y, z = ((places - pose[:3, 3]) @ pose[:3, :3]).unbind(dim=-1)
    ahead = z.clamp(min=1e-3)
    u, v = lens.fx * x / ahead + lens.cx, lens.fy * y / ahead + lens.cy
    at = torch.stack([2.0 * u / lens.width - 1.0, 2.0 * v / lens.height - 1.0], dim=-1)
    there = (z > 1e-3) & (at.abs() < 1.0).all(dim=-1)
    return there, F.grid_sample(picture[None], at[None], align_corners=False)[0].permute(1, 2, 0)


class MovedGaussians(nn.Module):
    """Gaussians as they are at no particular time, and what moves, turns and stretches them.

    rest: means [N, 3], metres, quaternions [N, 4], logarithms of the scales [N, 3], logits of opacities [N, 1] and of
    colours [N, 3], which do not depend on the direction they are seen from. Before training nothing moves.
    least: the smallest deviation, as a share of half the cube.
    Source: Wu et al. 2024 (4D-GS), section 4. Opacities change, too, so that what moves far between two frames can
    fade here and appear there; that is ours.
    """

    def __init__(
        self,
        points: Tensor,
        colours: Tensor,
        bounds: SceneBounds,
        *,
        frames: int,
        features: int,
        side: int,
        hidden: int,
        least: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.bounds, self.least_m = bounds, least * bounds.half_m
        apart = torch.cdist(points, points).topk(4, largest=False).values[:, 1:].mean(dim=1)
        ones = points.new_ones(len(points), 1)
        rest = {
            "means": points,
            "quaternions": ones * points.new_tensor([1.0, 0.0, 0.0, 0.0]),
            "scales": (0.5 * apart.clamp(min=1e-3 * bounds.half_m)).log()[:, None].expand(-1, 3),
            "opacities": ones * torch.tensor(_FIRST_OPACITY).logit(),
            "colours": colours.clamp(0.02, 0.98).logit(),
        }
        self.rest = nn.ParameterDict({name: nn.Parameter(value.clone()) for name, value in rest.items()})
        self.planes = HexPlanes(features=features, side=side, moments=frames, generator=generator)
        self.trunk = linear(3 * features, hidden, generator)
        heads = [linear(hidden, outputs, generator) for outputs in (3, 4, 3, 1)]
        for each in heads:
            nn.init.zeros_(each.weight)
        self.heads = nn.ModuleList(heads)
        self.background = Background(generator)

    def forward(self, time: float | None) -> Gaussians:
        """At a time, -1 first frame, 1 last; None for as they are at rest."""
        rest = self.rest
        means, quaternions, scales, opacities = (rest[name] for name in ("means", "quaternions", "scales", "opacities"))
        if time is not None:
            place = self.bounds.to_planes(means.detach())
            features = self.trunk(self.planes(torch.cat([place, place.new_full((len(place), 1), time)], dim=1))).relu()
            moved, turned, stretched, thickened = (each(features) for each in self.heads)
            means, quaternions = means + self.bounds.half_m * moved, quaternions + turned
            scales, opacities = scales + stretched, opacities + thickened
        return Gaussians(
            means=means,
            quaternions=quaternions,
            scales=((2.0 * scales).exp() + self.least_m**2).sqrt(),
            opacities=opacities[:, 0].sigmoid(),
            colours=rest["colours"].sigmoid(),
        )

    def seen(self, camera: Camera, time: float | None) -> tuple[Tensor, Picture]:
        """The picture of a camera, [3, H, W], before its background; and what it is made of."""
        drawn = rasterised(self(time), camera)
        behind = self.background(camera.rays().to(drawn.passed.device)[:, 3:6]).view_as(drawn.colours)
        return (drawn.colours + drawn.passed[..., None] * behind).permute(2, 0, 1), drawn


@dataclass(frozen=True, kw_only=True)
class GaussianSplatting(PerScene):
    """4D-GS with so many input views; see PerScene.

    updates: steps of the optimiser, a picture each. still: share of them before anything moves (warm-up). small: share
    of them with pictures of half the size.
    points, most: Gaussians at first and at the end. every: updates from one densification to the next, until `dense`,
    a share of all; what does not show is taken away to the end. thinnest: opacity below which it does not.
    least: the smallest deviation, as a share of half the cube. features, side: channels and cells of the planes.
    hidden: width of the heads. smoothness: weight of the planes' squared differences between neighbouring cells.
    The defaults are the best of those tried on other scenes with four views, in HexPlane's time: so few views cannot
    settle more Gaussians, or faster ones.
    Source: Wu et al. 2024 (4D-GS); as a baseline, Van Hoorick et al. 2024 (GCD), section 5.
    """

    stem = "4dgs"
    updates: int = 1500
    still: float = 0.25
    small: float = 0.4
    points: int = 500
    most: int = 500
    every: int = 100
    dense: float = 0.6
    thinnest: float = 0.02
    least: float = 0.01
    features: int = 8
    side: int = 24
    hidden: int = 32
    smoothness: float = 0.001

    @property
    def details(self) -> dict[str, str]:
        """See Predictor; with what draws."""
        return {**super().details, "rasteriser": "gsplat" if has_gsplat(self.place) else "torch"}

    def learn(self, pictures: Sequence[Shown], bounds: SceneBounds, frames: int) -> Drawing:
        """See PerScene."""
        generator = torch.Generator().manual_seed(self.seed)
        scene = self.scene(*first_points(pictures, bounds, self.points, generator), bounds, frames, generator)
        optimiser, order = self.optimiser(scene), list[int]()
        smaller = [narrowed(picture, camera, max(1, camera.lens.width // 2)) for picture, camera in pictures]
        pulled, times = (torch.zeros(self.points, device=self.place) for _ in range(2))
        for number in range(self.updates):
            done = number / self.updates
            risen = min(max((done - self.still) / _RISING, 0.0), 1.0)
            for group in optimiser.param_groups:
                fallen = group["first"] * _FALLING.get(group["name"], 0.1) ** done
                group["lr"] = fallen * (risen if group["name"] in _MOVING else 1.0)
            order = order or torch.randperm(len(pictures), generator=generator).tolist()
            picture, camera = (smaller if done < self.small else pictures)[order.pop()]
            made, drawn = scene.seen(camera, None if done < self.still else camera.time)
            drawn.centres.retain_grad()
            loss = F.l1_loss(made, picture.to(self.place))
            if risen:  # before, the planes are to stay as they are
                loss = loss + risen * self.smoothness * scene.planes.roughness()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            if drawn.centres.grad is not None:  # some are in the picture
                pull = drawn.centres.grad.view(-1, 2).norm(dim=1)
                pulled, times = pulled + pull, times + (pull > 0)
            if (number + 1) % self.every == 0:
                most = self.most if done < self.dense else 0
                self.renew(scene, optimiser, pulled / times.clamp(min=1.0), most, generator)
                pulled, times = (torch.zeros(len(scene.rest["means"]), device=self.place) for _ in range(2))
        return partial(self._draw, scene.eval())

    def _draw(self, scene: MovedGaussians, camera: Camera) -> Tensor:
        return scene.seen(camera, camera.time)[0].clamp(0.0, 1.0)

    def scene(
        self, points: Tensor, colours: Tensor, bounds: SceneBounds, frames: int, generator: torch.Generator
    ) -> MovedGaussians:
        """Before training. points: [N, 3], metres; colours: [N, 3] in [0, 1]; frames: T of the clip."""
        return MovedGaussians(
            points,
            colours,
            bounds,
            frames=frames,
            features=self.features,
            side=self.side,
            hidden=self.hidden,
            least=self.least,
            generator=generator,
        ).to(self.place)

    def optimiser(self, scene: MovedGaussians) -> torch.optim.Adam:
        """A group for each kind of a Gaussian's values, and for planes, heads and background."""
        groups = {name: [value] for name, value in scene.rest.items()}
        groups["planes"] = list(scene.planes.parameters())
        groups["heads"] = [*scene.trunk.parameters(), *scene.heads.parameters()]
        groups["background"] = list(scene.background.parameters())
        rates = {**_RATES, "means": _RATES["means"] * scene.bounds.half_m}
        named = [{"name": name, "params": values, "first": rates[name]} for name, values in groups.items()]
        return torch.optim.Adam(named, lr=0.0, eps=1e-15, betas=(0.9, 0.99))

    @torch.no_grad()
    def renew(
        self, scene: MovedGaussians, optimiser: torch.optim.Adam, pull: Tensor, most: int, generator: torch.Generator
    ) -> None:
        """Take away what shows at no time or is too large; double what pictures pull at most, of large ones as halves.

        pull: [N], mean length of the gradient of a Gaussian's place in the pictures. most: Gaussians, then.
        Source: Kerbl et al. 2023 (3DGS), section 5.2. That an eighth is doubled, in place of a threshold, is ours.
        """
        rest, scales = scene.rest, scene.rest["scales"].exp()
        far = (rest["means"] - scene.bounds.centre.to(self.place)).norm(dim=1).clamp(min=scene.bounds.half_m)
        moments = torch.linspace(-1.0, 1.0, scene.planes.time.shape[2]).tolist()
        shown = torch.stack([scene(time).opacities for time in moments]).amax(dim=0)
        stay = (shown > self.thinnest) & (scales.amax(dim=1) < _LARGEST * far)
        kept = stay.nonzero()[:, 0]
        doubled = kept[pull[kept].topk(min(len(kept) // 8, max(most - len(kept), 0))).indices]
        large = torch.zeros_like(stay).index_fill(0, doubled, True) & (scales.amax(dim=1) > scales.amax(dim=1).median())
        aside = (
            torch.randn(len(stay), 3, 1, generator=generator).to(self.place) * scales[..., None] * large[:, None, None]
        )
        aside = (rotations(rest["quaternions"]) @ aside)[..., 0]
        rest["scales"][large] -= _SHRUNK
        rows, side = torch.cat([kept, doubled]), torch.ones(len(kept) + len(doubled), 1, device=self.place)
        side[len(kept) :] = -1.0
        for group in optimiser.param_groups:
            if group["name"] in rest:
                old = rest[group["name"]]
                value = old[rows] + (side * aside[rows] if group["name"] == "means" else 0.0)
                group["params"] = [nn.Parameter(value)]
                rest[group["name"]] = group["params"][0]
                moments = optimiser.state.pop(old, {})
                for name in moments.keys() & {"exp_avg", "exp_avg_sq"}:
                    moments[name] = moments[name][rows] * (side > 0)  # a twin begins anew
                optimiser.state[group["params"][0]] = moments
