"""Views of what was seen and placed: painted where nothing was seen, and every pixel says which."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.errors import OptionError
from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_model.live.blocks import likeliest
from gcd_model.live.config import SKY_M, LiveConfig
from gcd_model.live.depth_net import pixel_rays, plane_depth
from gcd_model.live.eyes import Eyes, Floor, FrameGeometry
from gcd_model.live.memory import PlacedFrame, seen_world
from gcd_model.live.paint_net import Painted, Seen, camera_features, filled, seen_of
from gcd_model.live.splat import Splat, Surfels, splat, unproject
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

    def __init__(self, networks: LiveNetworks, *, steps: int | None = None, seed: int = 0) -> None:
        """steps: of the paint sampler, None as the weights say; one paints the mean, several draw with `seed`."""
        self._networks, self._config, self._seed = networks.eval(), networks.config, seed
        self._steps = networks.config.steps if steps is None else steps
        if self._steps < 1:
            raise OptionError(f"the paint sampler takes at least one step, got {steps}")
        self._device = next(networks.parameters()).device
        self._movable = movable_classes(networks.config).to(self._device)
        self._painted: list[Surfels] = []

    @torch.inference_mode()
    def paint(self, frame: PlacedFrame) -> tuple[ViewFrame, ...]:
        """One frame of every view."""
        self._painted = [] if frame.seen.begins else self._painted[: len(frame.targets)]
        known = [self._known(i, frame) for i in range(len(frame.targets))]
        return tuple(self._view(i, each, frame.targets[i], frame.lens) for i, each in enumerate(known))

    def _known(self, index: int, frame: PlacedFrame) -> Seen:
        """What is known of a view: its splat, what was painted a frame ago, its rays and its floor."""
        target, source, lens = frame.targets[index], frame.seen.world_from_source, frame.lens
        carried: Splat | None = None
        if index < len(self._painted) and len(self._painted[index]):
            carried = splat(self._painted[index], target, lens, len(self._config.classes), 0.0)
        rays = pixel_rays(lens, self._device)
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
            self._carry(
                index, metres, picture, labels, (visibility == PAINTED) & ~self._movable[labels.long()], target, lens
            )
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

    def _carry(
        self,
        index: int,
        metres: Tensor,
        picture: Tensor,
        labels: Tensor,
        keep: Tensor,
        target: Tensor,
        lens: Intrinsics,
    ) -> None:
        surfels = unproject(metres, picture, labels, lens, target, 0.0, painted=True, keep=keep)
        self._painted[index:] = [surfels] if index >= len(self._painted) else [surfels, *self._painted[index + 1 :]]


def _floor_of(floor: Floor, target_from_source: Tensor, rays: Tensor) -> Tensor:
    """Depth of the floor in a target camera: [H, W]; 0 where it is below the floor, too. rays: see `pixel_rays`."""
    turn, move = target_from_source[:3, :3].float(), target_from_source[:3, 3].float()
    up = turn @ floor.up
    height = floor.height_m - float(up @ move)
    return plane_depth(rays, up.to(rays.device), height) if height > 0 else torch.zeros_like(rays[0])


# --- the three steps at once, frame by frame -------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveFrame:
    """What became of a source frame. world_from_source: [4, 4], the world begins as a frame's camera.

    lost: why the memory was dropped before this frame, or None.
    """

    views: tuple[ViewFrame, ...]
    geometry: FrameGeometry
    world_from_source: Tensor
    lost: str | None


class LiveView:
    """Views of one camera's video, one frame at a time; a window is its frames one by one.

    Not thread-safe. The state is what was seen and what was painted; `reset` drops both, and so does another lens.
    """

    def __init__(self, networks: LiveNetworks, *, steps: int | None = None, seed: int = 0) -> None:
        """steps, seed: see `Painter`."""
        self.eyes = Eyes(networks)
        self._world = seen_world(networks.config, next(networks.parameters()).device)
        self._painter = Painter(networks, steps=steps, seed=seed)

    def reset(self) -> None:
        """Forget all that was seen and painted."""
        self.eyes.reset()

    def step(
        self,
        frame: Tensor,
        poses: Sequence[Tensor],
        *,
        lens: Intrinsics,
        depth: Tensor | None = None,
        odometry: Tensor | None = None,
        floor: Floor | None = None,
        geometry: FrameGeometry | None = None,
        target_lens: Intrinsics | None = None,
    ) -> LiveFrame:
        """One frame of every view.

        Args:
            frame, lens, depth, odometry, floor, geometry: see `Eyes.see`. poses, target_lens: see `SeenWorld.place`.
        Raises:
            ShapeError, PoseError: see there.
        """
        seen = self.eyes.see(frame, lens=lens, depth=depth, odometry=odometry, floor=floor, geometry=geometry)
        views = self._painter.paint(self._world.place(seen, poses, target_lens))
        return LiveFrame(views=views, geometry=seen.geometry, world_from_source=seen.world_from_source, lost=seen.lost)
