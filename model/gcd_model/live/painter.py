"""Views of what was seen and placed: painted where nothing was seen, and every pixel says which."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_model.live.blocks import likeliest
from gcd_model.live.config import SKY_M, LiveConfig
from gcd_model.live.depth_net import plane_depth
from gcd_model.live.eyes import Floor, PlacedFrame
from gcd_model.live.paint_net import Painted, Seen, camera_features, filled, seen_of
from gcd_model.live.splat import Surfels, splat, unproject
from gcd_model.networks import LiveNetworks

PAINTED, SEEN_BEFORE, SEEN_NOW = 0, 1, 2
"""Visibility of a pixel."""
COVERED = 0.5
"""A pixel that points cover by less than this share counts as painted, whatever the network says."""
_MOVABLE = ("car", "truck", "cyclist", "person", "own_car", "robot", "object")


def movable_classes(config: LiveConfig) -> Tensor:
    """Classes of which nothing that was painted is carried to the next frame: nobody knows where it goes. bool [K]."""
    return torch.tensor([entry.name in _MOVABLE for entry in config.classes])


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewFrame:
    """One frame of one view.

    picture: [3, H, W] in [-1, 1]. classes: uint8 [H, W]. visibility: uint8 [H, W], 2 seen now, 1 seen before, 0
    painted. inverse_depth: [H, W], 1 / m, 0 for the sky. log_variance: [H, W], of the truth about the mean, for colours
    in [0, 1].
    """

    picture: Tensor
    classes: Tensor
    visibility: Tensor
    inverse_depth: Tensor
    log_variance: Tensor


class Painter:
    """Paints views of placed frames, one frame after the other; the state is what was painted."""

    def __init__(self, networks: LiveNetworks, *, steps: int, seed: int = 0) -> None:
        """steps: of the paint sampler; one paints the mean, several draw with `seed`."""
        self._networks, self._config, self._steps, self._seed = networks.eval(), networks.config, steps, seed
        self._device = next(networks.parameters()).device
        self._movable = movable_classes(networks.config).to(self._device)
        self._painted: dict[int, Surfels] = {}  # by view

    @torch.inference_mode()
    def paint(self, frame: PlacedFrame) -> tuple[ViewFrame, ...]:
        """One frame of every view."""
        views = range(len(frame.targets))
        self._painted = {i: each for i, each in self._painted.items() if i in views and not frame.seen.begins}
        known = [self._known(i, frame) for i in views]
        return tuple(self._view(i, known[i], frame.targets[i], frame.lens) for i in views)

    def _known(self, index: int, frame: PlacedFrame) -> Seen:
        """What is known of a view: its splat, what was painted a frame ago, its rays and its floor."""
        target, source, lens = frame.targets[index], frame.seen.world_from_source, frame.lens
        painted, carried = self._painted.get(index), None
        if painted is not None and len(painted):
            carried = splat(painted, target, lens, len(self._config.classes), 0.0)
        rays = lens.rays(self._device)
        ground = torch.zeros_like(rays[0])
        if frame.seen.floor is not None:
            ground = _floor_of(frame.seen.floor, invert_rigid(target) @ source, rays)
        camera = camera_features((invert_rigid(source) @ target)[None])[0]
        return seen_of(frame.splats[index], carried, rays, ground, camera.to(self._device))

    def _view(self, index: int, seen: Seen, target: Tensor, lens: Intrinsics) -> ViewFrame:
        """Paint, read off, and remember what was painted."""
        base = filled(seen)
        painted = self._networks.paint.first_step(seen, base, self._config.sigma_max)
        labels = likeliest(painted.classes[0])
        covered = seen.coverage[0] >= COVERED
        share = seen.now_share[0]  # what no point of this frame, or none of an earlier one, shows cannot be seen so
        never = torch.full_like(share, -torch.inf)
        chances = torch.stack(
            [
                painted.seen[0, PAINTED],
                torch.where(share < 0.999, painted.seen[0, SEEN_BEFORE], never),
                torch.where(share > 0, painted.seen[0, SEEN_NOW], never),
            ]
        )
        visibility = torch.where(covered, likeliest(chances), PAINTED).to(torch.uint8)
        metres = painted.log_depth[0].exp()
        picture = self._drawn(painted, seen, base)[0].clamp(-1, 1)
        if self._config.carry_painted:
            keep = (visibility == PAINTED) & ~self._movable[labels.long()]
            self._painted[index] = unproject(metres, picture, labels, lens, target, 0.0, painted=True, keep=keep)
        shift = torch.tensor(self._config.spread_shift, device=self._device)[visibility.long()]
        return ViewFrame(
            picture=picture,
            classes=labels,
            visibility=visibility,
            inverse_depth=torch.where(metres < SKY_M / 2, 1 / metres.clamp(min=1e-3), 0.0),
            log_variance=painted.log_variance[0] + shift - 2 * torch.log(torch.tensor(2.0)),
        )

    def _drawn(self, painted: Painted, seen: Seen, base: Tensor) -> Tensor:
        """The picture: the mean with its detail, or a draw of several steps where nothing was seen."""
        if self._steps == 1:
            return painted.picture
        levels = torch.logspace(
            float(torch.log10(torch.tensor(self._config.sigma_start))),
            float(torch.log10(torch.tensor(self._config.sigma_min))),
            self._steps - 1,
        )
        noise = torch.randn(base.shape, generator=torch.Generator().manual_seed(self._seed)).to(base)
        x = painted.mean + levels[0] * noise
        for i, sigma in enumerate(levels):
            at = sigma.expand(len(base)).to(base)
            clean = self._networks.paint.denoised(seen, base, x, at)
            after = levels[i + 1] if i + 1 < len(levels) else torch.zeros(())
            x = clean + (x - clean) * (after / sigma)
        unseen = (1 - seen.coverage)[:, None]
        return painted.mean + unseen * (x - painted.mean)


def _floor_of(floor: Floor, target_from_source: Tensor, rays: Tensor) -> Tensor:
    """Depth of the floor in a target camera: [H, W]; 0 where it is below the floor, too. rays: of `lens.rays`."""
    turn, move = target_from_source[:3, :3].float(), target_from_source[:3, 3].float()
    up = turn @ floor.up
    height = floor.height_m - float(up @ move)
    return plane_depth(rays, up.to(rays.device), height) if height > 0 else torch.zeros_like(rays[0])
