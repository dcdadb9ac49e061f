"""The live model behind the door of all models: clips of T frames in, views of T frames out.

Painted where nothing was seen, and every pixel says which.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from gcd_model.clip import Augmentation, Clip, View
from gcd_model.conditioning import SourceFeatures, splatted
from gcd_model.diffusion import RenderOptions, watched
from gcd_model.errors import NonFiniteError, ShapeError
from gcd_model.geometry import CameraMount, Intrinsics, Trajectory, invert_rigid
from gcd_model.live.blocks import likeliest
from gcd_model.live.config import SIZE_FACTOR, SKY_M, LiveConfig
from gcd_model.live.depth_net import plane_depth
from gcd_model.live.eyes import Eyes, Floor, PlacedFrame, SeenFrame, SeenWorld
from gcd_model.live.paint_net import Painted, Seen, camera_features, filled, seen_of
from gcd_model.live.splat import Surfels, splat, unproject
from gcd_model.networks import LiveNetworks
from gcd_model.synthesizer import out_of_memory_is_our_error, whole_levels
from gcd_model.traits import Traits
from gcd_model.weights.card import LIVE, Card
from gcd_model.weights.save import write_safetensors

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
        return tuple(self._view(i, known[i], frame.targets[i], frame.lenses[i]) for i in views)

    def _known(self, index: int, frame: PlacedFrame) -> Seen:
        """What is known of a view: its splat, what was painted a frame ago, its rays and its floor."""
        target, source, lens = frame.targets[index], frame.seen.world_from_source, frame.lenses[index]
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


# --- the door ------------------------------------------------------------------------------------------------------

_SEED_STEP, _SEEDS = 0x9E3779B97F4A7C15, 1 << 63  # neighbouring seeds of samples would meet those of other windows


class LiveSynthesizer:
    """A ViewSynthesizer: `encode` keeps what is stated of the frames, `render` sees, places and paints one by one.

    Where a view stands is seen from the source camera of the same frame, which may move: `source_from_target[t]`. One
    that stands still is the case of all other models.
    """

    def __init__(self, networks: LiveNetworks, traits: Traits, *, carries: bool = False) -> None:
        """carries: every call goes on where the one before ended, instead of knowing nothing."""
        self.networks, self.traits, self._carries = networks.requires_grad_(False), traits, carries
        self._eyes, self._world = Eyes(networks), SeenWorld(networks.config, next(networks.parameters()).device)
        self._painters: list[Painter] = []
        self._drawn_with: tuple[int, int] | None = None

    def streaming(self) -> "LiveSynthesizer":
        """See FrameSynthesizer. A clip rendered frame by frame is the clip rendered as a whole."""
        return LiveSynthesizer(self.networks, self.traits.streaming(), carries=True)

    def reset(self) -> None:
        self._eyes.reset()

    @out_of_memory_is_our_error
    def encode(self, clip: Clip, augmentation: Augmentation | None = None) -> SourceFeatures:
        """See ViewSynthesizer. Nothing is worked out here: depth looks at earlier frames; any number may be given.

        The lens is the clip's, else of its mount's field of view, else of CameraMount()'s, 85 degrees. The ground is
        known where the clip states a mount. Augmentation is for diffusion models and means nothing here.
        Raises: OptionError: height or width is no multiple of 32.
        """
        self.traits.check_size(*clip.video.shape[-2:])
        return SourceFeatures(
            tokens=None,
            latents=clip.video.new_zeros(clip.frames, 0, 1, 1),
            fps=clip.fps,
            augmentation=0.0,
            mount=clip.mount,
            lens=lens_of(clip),
            video=clip.video,
            metres=clip.video.new_zeros(clip.video[:, 0].shape) if clip.depth is None else clip.depth,
            stated=torch.full((clip.frames,), clip.depth is not None),
            odometry=clip.odometry,
        )

    @out_of_memory_is_our_error
    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        """See ViewSynthesizer: `see`, `place`, `paint`. No frame before the first is known, unless `streaming`.

        Of the options, solver, guidance, motion number and initial noise mean something to diffusion models only.
        """
        self.traits.check_lengths(features.frames, trajectories)
        return self.paint(self._placed(self._seen(features), trajectories), trajectories, options)

    @out_of_memory_is_our_error
    def see(self, features: SourceFeatures) -> tuple[SeenFrame, ...]:
        return tuple(self._seen(features))

    @out_of_memory_is_our_error
    def place(self, seen: Sequence[SeenFrame], trajectories: Sequence[Trajectory]) -> tuple[PlacedFrame, ...]:
        self.traits.check_lengths(len(seen), trajectories)
        return tuple(self._placed(seen, trajectories))

    def _seen(self, features: SourceFeatures) -> Iterator[SeenFrame]:
        """Frame by frame, each when it is asked for: what was seen is large."""
        video, metres, stated, lens = features.video, features.metres, features.stated, features.lens
        if video is None or metres is None or stated is None or lens is None:
            raise ShapeError(
                f"{self.traits.name} needs points of the source, which these features lack; encode it here"
            )
        if not self._carries:
            self._eyes.reset()
        floor, mount, odometry = None, features.mount, features.odometry
        if mount is not None:
            floor = Floor(up=mount.vehicle_from_camera[2, :3].float(), height_m=mount.height_m)
        for t, frame in enumerate(video):
            depth = metres[t] if bool(stated[t]) else None
            pose = None if odometry is None else odometry[t]
            yield self._eyes.see(frame, lens=lens, depth=depth, odometry=pose, floor=floor)

    def _placed(self, seen: Iterable[SeenFrame], trajectories: Sequence[Trajectory]) -> Iterator[PlacedFrame]:
        lenses = [None if path.lens is None else _padded(path.lens) for path in trajectories]
        for t, frame in enumerate(seen):
            yield self._world.place(frame, [path.source_from_target[t].cpu() for path in trajectories], lenses)

    @out_of_memory_is_our_error
    def paint(
        self, placed: Iterable[PlacedFrame], trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        """See FrameSynthesizer; `cancel` is asked between two frames.

        Several samples differ where several steps draw; one step paints the mean, the same every time.
        """
        options, frames = RenderOptions() if options is None else options, self.traits.config.frames
        steps = options.steps or self.traits.config.sampling.steps
        draws = options.samples if steps > 1 else 1
        if not self._carries or self._drawn_with != (steps, draws):
            seeds = [(options.seed + s * _SEED_STEP) % _SEEDS for s in range(draws)]
            self._painters = [Painter(self.networks, steps=steps, seed=seed) for seed in seeds]
            self._drawn_with = (steps, draws)
        made: list[list[tuple[ViewFrame, ...]]] = []  # by frame, then by draw
        scores: list[float] = []
        lost: list[str] = []
        placed = iter(placed)
        for _ in watched(frames, options):
            frame = next(placed)
            made.append([painter.paint(frame) for painter in self._painters])
            scores.append(frame.seen.geometry.ood)
            lost += [] if frame.seen.lost is None else [frame.seen.lost]
        ood = sum(scores) / frames
        views = [
            self._joined([[views[v] for views in frame] for frame in zip(*made, strict=True)], path, options, ood, lost)
            for v, path in enumerate(trajectories)
        ]
        if not math.isfinite(ood) or not all(map(_is_finite, views)):
            raise NonFiniteError(
                f"{self.traits.name} produced NaN or Inf; look at the weights with `gcd-node weights inspect`"
            )
        return views

    def _joined(
        self, draws: list[list[ViewFrame]], path: Trajectory, options: RenderOptions, ood: float, lost: list[str]
    ) -> View:
        """One view of all draws, frame by frame each; what is no draw, such as depth, is the first one's."""
        draws += draws[:1] * (options.samples - len(draws))
        inside = ... if path.lens is None else (..., slice(path.lens.height), slice(path.lens.width))

        def joined(name: str) -> Tensor:
            return torch.stack([getattr(each, name)[inside] for each in draws[0]])

        pixels = torch.stack([torch.stack([(each.picture[inside] + 1) / 2 for each in frames]) for frames in draws])
        return View(
            samples=(whole_levels(pixels) if options.whole_levels else pixels).cpu(),
            latents=torch.zeros(*pixels.shape[:2], 0, 1, 1),
            trajectory=path,
            motion_bucket=self.traits.motion_bucket(path) if options.motion_bucket is None else options.motion_bucket,
            classes=torch.stack([torch.stack([each.classes[inside] for each in frames]) for frames in draws]).cpu(),
            uncertainty_scale=self.traits.uncertainty_scale,
            visibility=joined("visibility").cpu(),
            inverse_depth=joined("inverse_depth").float().cpu(),
            log_variance=joined("log_variance").float().cpu(),
            ood=ood,
            lost=tuple(lost),
        )


def _padded(lens: Intrinsics) -> Intrinsics:
    """Of the next larger picture that the networks take; what was added is at its right and lower edges."""
    width, height = (-(-side // SIZE_FACTOR) * SIZE_FACTOR for side in (lens.width, lens.height))
    return replace(lens, width=width, height=height)


def lens_of(clip: Clip) -> Intrinsics:
    """The lens that a clip's pictures are taken to be of; see `LiveSynthesizer.encode`."""
    if clip.lens is not None:
        return clip.lens
    height, width = clip.video.shape[-2:]
    return Intrinsics.from_hfov((clip.mount or CameraMount()).hfov_deg, width, height)


@torch.inference_mode()
def visibility_of(clip: Clip, path: Trajectory) -> Tensor:
    """What of a view the source camera sees in the same frame, for models that do not tell: `View.visibility`.

    No network, and so no memory: which things stand still is not known, and what moved on was not seen where it was.
    A view has the clip's lens, see `lens_of`. The path counts in the units of the clip's depth.
    Returns:
        uint8 [T, H, W], SEEN_NOW or PAINTED.
    Raises:
        ShapeError: the clip has no depth, or the path another length.
    """
    if clip.depth is None or path.frames != clip.frames:
        found = "no depth" if clip.depth is None else f"{path.frames} poses for {clip.frames} frames"
        raise ShapeError(f"what a view sees follows from depth and a pose for every frame, got {found}")
    coverage = splatted(clip.video, clip.depth, lens_of(clip), path)[:, 3]
    return torch.where(coverage >= COVERED, SEEN_NOW, PAINTED).to(torch.uint8)


def _is_finite(view: View) -> bool:
    pictures = (view.samples, view.inverse_depth, view.log_variance)
    return all(bool(each.isfinite().all()) for each in pictures if each is not None)


def save_live(path: str | Path, networks: LiveNetworks, name: str, *, overwrite: bool = False) -> None:
    """Write a live model as one of our files, in half precision.

    Raises: OptionError if `path` exists and `overwrite` is not set; CheckpointError if it cannot be written.
    """
    halves: dict[str, Tensor] = {name: weight.half() for name, weight in networks.state_dict().items()}
    card = Card(name=name, config=networks.config, family=LIVE, move_time=0)
    write_safetensors(Path(path), halves, card.to_metadata(), overwrite=overwrite)
