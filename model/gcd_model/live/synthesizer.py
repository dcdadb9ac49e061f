"""The live model behind the door of all models: clips of T frames in, views of T frames out."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from gcd_model.clip import Augmentation, Clip, View
from gcd_model.conditioning import SourceFeatures, SourceGeometry
from gcd_model.diffusion import RenderOptions
from gcd_model.errors import Cancelled, NonFiniteError, ShapeError
from gcd_model.geometry import CameraMount, Intrinsics, Trajectory
from gcd_model.live.eyes import Eyes, Floor, SeenFrame
from gcd_model.live.memory import PlacedFrame, seen_world
from gcd_model.live.painter import COVERED, PAINTED, SEEN_NOW, Painter, ViewFrame
from gcd_model.live.splat import splat, unproject
from gcd_model.networks import LiveNetworks
from gcd_model.synthesizer import out_of_memory_is_our_error, whole_levels
from gcd_model.traits import Traits
from gcd_model.weights.card import Card
from gcd_model.weights.families import LIVE
from gcd_model.weights.save import write_safetensors

_SEED_STEP, _SEEDS = 0x9E3779B97F4A7C15, 1 << 63  # neighbouring seeds of samples would meet those of other windows


class LiveSynthesizer:
    """A ViewSynthesizer: `encode` keeps what is stated of the frames, `render` sees, places and paints one by one.

    Where a view stands is seen from the source camera of the same frame, which may move: `source_from_target[t]`. One
    that stands still is the case of all other models.
    """

    def __init__(self, networks: LiveNetworks, traits: Traits, *, carries: bool = False) -> None:
        """carries: every call goes on where the one before ended, instead of knowing nothing."""
        self._networks, self._traits, self._carries = networks.requires_grad_(False), traits, carries
        self._eyes, self._world = Eyes(networks), seen_world(networks.config, next(networks.parameters()).device)
        self._painters: list[Painter] = []
        self._drawn_with: tuple[int, int] | None = None

    @property
    def traits(self) -> Traits:
        """Family, sizes and identity of the weights."""
        return self._traits

    @property
    def networks(self) -> LiveNetworks:
        """The networks themselves, for measuring."""
        return self._networks

    def streaming(self) -> "LiveSynthesizer":
        """See FrameSynthesizer. A clip rendered frame by frame is the clip rendered as a whole."""
        return LiveSynthesizer(self._networks, self._traits.streaming(), carries=True)

    def reset(self) -> None:
        """See FrameSynthesizer."""
        self._eyes.reset()

    @out_of_memory_is_our_error
    def encode(
        self, clip: Clip, augmentation: Augmentation | None = None, extra: Tensor | None = None
    ) -> SourceFeatures:
        """See ViewSynthesizer. Nothing is worked out here: depth looks at earlier frames; any number may be given.

        The lens is the clip's, else of its mount's field of view, else of CameraMount()'s, 85 degrees. The ground is
        known where the clip states a mount. Augmentation is for diffusion models and means nothing here.
        Raises:
            OptionError: height or width is no multiple of 32. ShapeError: there are extra condition channels.
        """
        self._traits.check_size(*clip.video.shape[-2:])
        if extra is not None:
            raise ShapeError(f"{self._traits.name} wants no extra condition channels, got {extra.shape[1]}")
        stated = clip.depth is not None
        return SourceFeatures(
            tokens=None,
            latents=clip.video.new_zeros(clip.frames, 0, 1, 1),
            extra=None,
            fps=clip.fps,
            augmentation=0.0,
            video=clip.video,
            mount=clip.mount,
            geometry=SourceGeometry(
                metres=clip.video.new_zeros(clip.video[:, 0].shape) if clip.depth is None else clip.depth,
                stated=torch.full((clip.frames,), stated),
                odometry=clip.odometry,
                lens=lens_of(clip),
            ),
        )

    @out_of_memory_is_our_error
    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        """See ViewSynthesizer: `see`, `place`, `paint`. No frame before the first is known, unless `streaming`.

        Of the options, solver, guidance, motion number and initial noise mean something to diffusion models only.
        """
        self._require(features.frames, trajectories)
        return self._painted(self._placed(self._seen(features), trajectories), trajectories, options)

    @out_of_memory_is_our_error
    def see(self, features: SourceFeatures) -> tuple[SeenFrame, ...]:
        """See FrameSynthesizer."""
        return tuple(self._seen(features))

    @out_of_memory_is_our_error
    def place(self, seen: Sequence[SeenFrame], trajectories: Sequence[Trajectory]) -> tuple[PlacedFrame, ...]:
        """See FrameSynthesizer."""
        self._require(len(seen), trajectories)
        return tuple(self._placed(seen, trajectories))

    @out_of_memory_is_our_error
    def paint(
        self, placed: Sequence[PlacedFrame], trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        """See FrameSynthesizer.

        Several samples differ where several steps draw; one step paints the mean, the same every time.
        """
        return self._painted(placed, trajectories, options)

    def _require(self, length: int, trajectories: Sequence[Trajectory]) -> None:
        frames = self._traits.config.frames
        if not trajectories:
            raise ShapeError("at least one trajectory is wanted, got none")
        for each in (length, *(path.frames for path in trajectories)):
            if each != frames:
                raise ShapeError(f"{self._traits.name} works on {frames} frames, got {each}")

    def _seen(self, features: SourceFeatures) -> Iterator[SeenFrame]:
        """Frame by frame, each when it is asked for: what was seen is large."""
        video, geometry = features.video, features.geometry
        if video is None or geometry is None:
            raise ShapeError(
                f"{self._traits.name} needs points of the source, which these features lack; encode it here"
            )
        if not self._carries:
            self._eyes.reset()
        floor, odometry = _floor(features.mount), geometry.odometry
        for t, frame in enumerate(video):
            depth = geometry.metres[t] if bool(geometry.stated[t]) else None
            pose = None if odometry is None else odometry[t]
            yield self._eyes.see(frame, lens=geometry.lens, depth=depth, odometry=pose, floor=floor)

    def _placed(self, seen: Iterable[SeenFrame], trajectories: Sequence[Trajectory]) -> Iterator[PlacedFrame]:
        for t, frame in enumerate(seen):
            yield self._world.place(frame, [path.source_from_target[t] for path in trajectories])

    def _painted(
        self, placed: Iterable[PlacedFrame], trajectories: Sequence[Trajectory], options: RenderOptions | None
    ) -> list[View]:
        """`cancel` is asked between two frames."""
        options = RenderOptions() if options is None else options
        steps, frames = options.steps or self._traits.config.sampling.steps, self._traits.config.frames
        draws = options.samples if steps > 1 else 1
        if not self._carries or self._drawn_with != (steps, draws):
            self._painters = [Painter(self._networks, steps=steps, seed=seed) for seed in _seeds(options.seed, draws)]
            self._drawn_with = (steps, draws)
        made: list[list[tuple[ViewFrame, ...]]] = []  # by frame, then by draw
        scores: list[float] = []
        lost: list[str] = []
        for t, frame in enumerate(placed):
            if options.cancel is not None and options.cancel.is_set():
                raise Cancelled(f"stopped before frame {t} of {frames}, as was asked")
            made.append([painter.paint(frame) for painter in self._painters])
            scores.append(frame.seen.geometry.ood)
            lost += [] if frame.seen.lost is None else [frame.seen.lost]
            if options.progress is not None:
                options.progress(t + 1, frames)
        views = [self._joined(made, v, path, options) for v, path in enumerate(trajectories)]
        views = [replace(view, ood=sum(scores) / frames, lost=tuple(lost)) for view in views]
        if not all(map(_is_finite, views)):
            raise NonFiniteError(
                f"{self._traits.name} produced NaN or Inf; look at the weights with `gcd-node weights inspect`"
            )
        return views

    def _joined(
        self, made: list[list[tuple[ViewFrame, ...]]], number: int, path: Trajectory, options: RenderOptions
    ) -> View:
        """One view of all draws; what is no draw, such as depth, is the first one's."""
        draws = [[views[number] for views in frame] for frame in zip(*made, strict=True)]
        draws += draws[:1] * (options.samples - len(draws))
        pixels = torch.stack([torch.stack([(each.picture + 1) / 2 for each in frames]) for frames in draws])
        first = draws[0]
        return View(
            samples=(whole_levels(pixels) if options.whole_levels else pixels).cpu(),
            latents=torch.zeros(*pixels.shape[:2], 0, 1, 1),
            trajectory=path,
            motion_bucket=self._traits.motion_bucket(path) if options.motion_bucket is None else options.motion_bucket,
            classes=torch.stack([torch.stack([each.classes for each in frames]) for frames in draws]).cpu(),
            uncertainty_scale=self._traits.uncertainty_scale,
            visibility=torch.stack([each.visibility for each in first]).cpu(),
            inverse_depth=torch.stack([each.inverse_depth for each in first]).float().cpu(),
            log_variance=torch.stack([each.log_variance for each in first]).float().cpu(),
        )


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
    lens, here = lens_of(clip), torch.eye(4, dtype=torch.float64)
    labels = torch.zeros(lens.height, lens.width, dtype=torch.uint8)
    frames = zip(clip.video, clip.depth, path.source_from_target, strict=True)
    splats = [
        splat(unproject(metres, frame, labels, lens, here, 0.0), pose, lens, 1, 0.0) for frame, metres, pose in frames
    ]
    return torch.stack([torch.where(each.coverage >= COVERED, SEEN_NOW, PAINTED).to(torch.uint8) for each in splats])


def _floor(mount: CameraMount | None) -> Floor | None:
    """The ground that a camera on a vehicle knows."""
    if mount is None:
        return None
    return Floor(up=mount.vehicle_from_camera[2, :3].float(), height_m=mount.height_m)


def _seeds(seed: int, draws: int) -> list[int]:
    return [(seed + s * _SEED_STEP) % _SEEDS for s in range(draws)]


def _is_finite(view: View) -> bool:
    pictures = (view.samples, view.inverse_depth, view.log_variance)
    return math.isfinite(view.ood or 0.0) and all(bool(each.isfinite().all()) for each in pictures if each is not None)


def save_live(
    path: str | Path, networks: LiveNetworks, name: str, *, trained: bool = True, overwrite: bool = False
) -> None:
    """Write a live model as one of our files, in half precision.

    Raises: OptionError if `path` exists and `overwrite` is not set; CheckpointError if it cannot be written.
    """
    halves: dict[str, Tensor] = {name: weight.half() for name, weight in networks.state_dict().items()}
    card = Card(name=name, config=networks.config, family=LIVE.name, move_time=0, trained=trained)
    write_safetensors(Path(path), halves, card.to_metadata(), overwrite=overwrite)
