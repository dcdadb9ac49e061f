"""The live model, frame by frame: see, remember, splat, paint; and every pixel says which.

frame -> depth, classes -> points (and those of earlier frames) -> splat -> paint -> picture + visibility
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gcd_model.errors import OptionError, ShapeError
from gcd_model.geometry import Intrinsics, invert_rigid, require_rigid
from gcd_model.live.config import SIZE_FACTOR, SKY_M, LiveConfig
from gcd_model.live.depth_net import DepthNet, depth_inputs, pixel_rays, plane_depth, read_depth
from gcd_model.live.ego_motion import EgoMotion
from gcd_model.live.familiarity import Familiarity
from gcd_model.live.paint_net import Painted, PaintNet, Seen, camera_features, filled, seen_of
from gcd_model.live.seen_world import SeenWorld
from gcd_model.live.splat import Splat, Surfels, splat, unproject
from gcd_model.live.sweep import Reference, References, sweep_costs

PAINTED, SEEN_BEFORE, SEEN_NOW = 0, 1, 2
"""Visibility of a pixel."""
COVERED = 0.5
"""A pixel that points cover by less than this share counts as painted, whatever the network says."""
_MOVABLE = ("car", "truck", "cyclist", "person", "own_car", "robot", "object")


def movable_classes(config: LiveConfig) -> Tensor:
    """Classes of which nothing that was painted is carried to the next frame: nobody knows where it goes. bool [K]."""
    return torch.tensor([entry.name in _MOVABLE for entry in config.classes])


class LiveNetworks(nn.Module):
    """All weights of the live model."""

    def __init__(self, config: LiveConfig) -> None:
        super().__init__()
        self.config = config
        self.depth = DepthNet(config.depth, len(config.classes))
        self.paint = PaintNet(config.paint, len(config.classes))
        self.familiarity = Familiarity(config.depth.widths[0])


@dataclass(frozen=True, kw_only=True, slots=True)
class Floor:
    """The plane on which the source camera's carrier stands: its normal in camera axes, float32 [3], towards the
    camera, and the camera's height over it in metres.
    """

    up: Tensor
    height_m: float


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameGeometry:
    """What a source frame shows: metres [H, W] (0: hole, SKY_M: sky), labels uint8 [H, W], static bool [H, W].

    ood: how unlike its training it looks to the depth network, 0 to 1; see `Familiarity`. spread: [H, W], see
    `DepthReading`; None for depth from elsewhere.
    """

    metres: Tensor
    labels: Tensor
    static: Tensor
    ood: float
    spread: Tensor | None = None


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


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SeenFrame:
    """What is known once a source frame was taken in; views are painted from it and change nothing of it.

    points: this frame's and the remembered ones, in the world. now: stamp of this frame's. lens, floor: of the source.
    begins: nothing of an earlier frame holds. world_from_source, lost: see `LiveFrame`.
    """

    geometry: FrameGeometry
    points: Surfels
    now: float
    lens: Intrinsics
    floor: Floor | None
    world_from_source: Tensor
    begins: bool
    lost: str | None


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

    The state is what was seen and what was painted; `reset` drops both, and so does another lens. `see` has the first,
    a `Painter` the second: one thread may see the next frame while another paints this one.
    """

    def __init__(self, networks: LiveNetworks, *, steps: int | None = None, seed: int = 0) -> None:
        """steps, seed: see `Painter`."""
        self._networks, self._config = networks.eval(), networks.config
        self._painter = Painter(networks, steps=steps, seed=seed)
        self._device = next(networks.parameters()).device
        config = networks.config
        self._world = SeenWorld(
            classes=len(config.classes),
            capacity=config.memory,
            oldest_frames=config.memory_frames or float("inf"),
            device=self._device,
        )
        self._ego, self._references = EgoMotion(), References()
        self._lens: Intrinsics | None = None
        self._begins = True

    def reset(self) -> None:
        """Forget all that was seen and painted."""
        self._world.reset()
        self._ego.reset()
        self._references.reset()
        self._begins = True

    @torch.inference_mode()
    def look(
        self,
        frame: Tensor,
        lens: Intrinsics,
        *,
        depth: Tensor | None = None,
        floor: Floor | None = None,
        reference: Reference | None = None,
    ) -> FrameGeometry:
        """Depth, classes and motion of one frame; leaves the state alone.

        Args: see `step`. reference: an earlier frame, see `sweep_costs`.
        """
        picture = self._checked(frame, lens)
        ground = torch.zeros(lens.height, lens.width) if floor is None else plane_depth(lens, floor.up, floor.height_m)
        rays = pixel_rays(lens, self._device)
        inputs = depth_inputs(picture[None], rays[None], ground[None].to(self._device))
        output = self._networks.depth(inputs, sweep_costs(picture, lens, reference, self._config.depth)[None])
        reading = read_depth(output, self._config.depth)
        labels = _likeliest(output.classes[0])
        metres = reading.metres[0] if depth is None else _taken(depth, reading.metres[0], lens)
        static = output.moves[0] < 0
        ood = float(self._networks.familiarity.score(output.summary, reading.entropy)[0])
        spread = reading.spread[0] if depth is None else None
        return FrameGeometry(metres=metres, labels=labels, static=static, ood=ood, spread=spread)

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
        """One frame of every view: `see`, then `Painter.paint`."""
        seen = self.see(frame, lens=lens, depth=depth, odometry=odometry, floor=floor, geometry=geometry)
        views = self._painter.paint(seen, poses, target_lens)
        return LiveFrame(views=views, geometry=seen.geometry, world_from_source=seen.world_from_source, lost=seen.lost)

    @torch.inference_mode()
    def see(
        self,
        frame: Tensor,
        *,
        lens: Intrinsics,
        depth: Tensor | None = None,
        odometry: Tensor | None = None,
        floor: Floor | None = None,
        geometry: FrameGeometry | None = None,
    ) -> SeenFrame:
        """Take in one frame: its depth, its motion, and what is still known of those before.

        Args:
            frame: float32 [3, H, W], RGB in [-1, 1]; H and W multiples of 32.
            lens: of the source; 40 to 120 degrees across were trained.
            depth: [H, W] metres, 0 or not finite where unknown, instead of the depth network's.
            odometry: world_from_source [4, 4] of any world that stays the same from frame to frame; None: from the
                pictures.
            floor: where the declared mount has the ground. geometry: what the frame shows, if that is known.
        Raises:
            ShapeError: frame, depth and lens differ in size, or the size is no multiple of 32.
        """
        picture = self._checked(frame, lens)
        if lens != self._lens:  # another camera, or another size of its pictures
            self.reset()
            self._lens = lens
        motion = self._ego.follow(picture, lens, odometry)
        if motion.lost:
            self._world.reset()
            self._references.reset()
        pose = motion.world_from_camera
        if geometry is None:
            geometry = self.look(frame, lens, depth=depth, floor=floor, reference=self._references.chosen(pose))
        self._ego.settle(geometry.metres, geometry.static, geometry.spread)
        self._references.add(picture, pose, geometry.metres)
        self._world.look(picture, geometry.metres, geometry.labels, geometry.static, lens, pose)
        begins, self._begins = self._begins or motion.lost, False
        return SeenFrame(
            geometry=geometry,
            points=self._world.points,
            now=self._world.now,
            lens=lens,
            floor=floor,
            world_from_source=pose,
            begins=begins,
            lost=motion.reason,
        )

    def _checked(self, frame: Tensor, lens: Intrinsics) -> Tensor:
        if frame.shape != (3, lens.height, lens.width) or lens.height % SIZE_FACTOR or lens.width % SIZE_FACTOR:
            raise ShapeError(
                f"a frame must be [3, H, W] of its lens's size ({lens.height} x {lens.width}), in multiples of "
                f"{SIZE_FACTOR}, got {list(frame.shape)}"
            )
        return frame.to(self._device, torch.float32)


class Painter:
    """Paints views of seen frames, one frame after the other; the state is what was painted."""

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
    def paint(
        self, frame: SeenFrame, poses: Sequence[Tensor], target_lens: Intrinsics | None = None
    ) -> tuple[ViewFrame, ...]:
        """One frame of every view.

        Args:
            poses: source_from_target [4, 4] of each view, metres. target_lens: of the views; None: the source's.
        Raises:
            PoseError.
        """
        lens = frame.lens if target_lens is None else target_lens
        self._painted = [] if frame.begins else self._painted[: len(poses)]
        targets = [frame.world_from_source @ require_rigid(each, "a target pose") for each in poses]
        seen = [self._seen(i, target, lens, frame) for i, target in enumerate(targets)]
        return tuple(self._view(i, each, targets[i], lens) for i, each in enumerate(seen))

    def _seen(self, index: int, target: Tensor, lens: Intrinsics, frame: SeenFrame) -> Seen:
        """What is known of a view: its splat, what was painted a frame ago, its rays and its floor."""
        source, classes = frame.world_from_source, len(self._config.classes)
        carried: Splat | None = None
        if index < len(self._painted) and len(self._painted[index]):
            carried = splat(self._painted[index], target, lens, classes, 0.0)
        ground = torch.zeros(lens.height, lens.width)
        if frame.floor is not None:
            ground = _floor_of(frame.floor, invert_rigid(target) @ source, lens)
        rays = pixel_rays(lens, self._device)
        camera = camera_features((invert_rigid(source) @ target)[None])[0]
        shown = splat(frame.points, target, lens, classes, frame.now)
        return seen_of(shown, carried, rays, ground.to(self._device), camera.to(self._device))

    def _view(self, index: int, seen: Seen, target: Tensor, lens: Intrinsics) -> ViewFrame:
        """Paint, read off, and remember what was painted."""
        base = filled(seen)
        painted = self._networks.paint.first_step(seen, base, self._config.sigma_max)
        labels = _likeliest(painted.classes[0])
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
        visibility = torch.where(covered, _likeliest(chances), PAINTED).to(torch.uint8)
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


def _likeliest(chances: Tensor) -> Tensor:
    """Of K choices [K, H, W]: uint8 [H, W]. (`max` is four times as fast as `argmax` here.)"""
    return chances.max(dim=0).indices.to(torch.uint8)


def _taken(depth: Tensor, learned: Tensor, lens: Intrinsics) -> Tensor:
    """Depth from elsewhere: bad numbers are holes, a hole in what the network calls sky is sky. Raises ShapeError."""
    if depth.shape != (lens.height, lens.width):
        raise ShapeError(f"depth must be [{lens.height}, {lens.width}] as its frame, got {list(depth.shape)}")
    metres = torch.where(depth.isfinite() & (depth > 0), depth, 0.0).float()
    metres = metres.to(learned.device)
    return torch.where((metres == 0) & (learned >= SKY_M), SKY_M, metres)


def _floor_of(floor: Floor, target_from_source: Tensor, lens: Intrinsics) -> Tensor:
    """Depth of the floor in a target camera: [H, W]; 0 where it is below the floor, too."""
    turn, move = target_from_source[:3, :3].float(), target_from_source[:3, 3].float()
    up = turn @ floor.up
    height = floor.height_m - float(up @ move)
    return plane_depth(lens, up, height) if height > 0 else torch.zeros(lens.height, lens.width)
