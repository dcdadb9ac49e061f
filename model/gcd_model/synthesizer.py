"""The door: `encode` a clip once, `render` it as other cameras would have seen it."""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import ParamSpec, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

from gcd_model.clip import Augmentation, Clip, View, nearest_classes
from gcd_model.conditioning import (
    Conditioning,
    SourceFeatures,
    micro_conditioning,
    splat_channels,
    splatted,
    with_unconditional,
)
from gcd_model.diffusion import RenderOptions, Schedule, unit_noise
from gcd_model.engines.torch import Engine, arrange
from gcd_model.errors import DeviceMemoryError, NonFiniteError, OptionError, ShapeError
from gcd_model.geometry import Intrinsics, Trajectory
from gcd_model.layers import prepare
from gcd_model.live.eyes import PlacedFrame, SeenFrame, estimated_depth, packaged_eyes
from gcd_model.networks import Networks
from gcd_model.traits import Traits
from gcd_model.vae import to_pixels

Given = ParamSpec("Given")
Made = TypeVar("Made")

_ENCODE_FRAMES = 2  # of a CPU, in one call of an encoder: the largest activations are per frame, so this bounds memory


class ViewSynthesizer(Protocol):
    """What the node knows of a model."""

    @property
    def traits(self) -> Traits:
        """Family, sizes, limits and identity of the weights."""
        ...

    def encode(self, clip: Clip, augmentation: Augmentation | None = None) -> SourceFeatures:
        """What the network needs to know of the source, computed once per clip."""
        ...

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        """The clip as cameras on `trajectories` would have seen it, all in one batch.

        Raises:
            ShapeError: a trajectory and the clip differ in length.
            Cancelled: `options.cancel` was set; noticed between two denoising steps.
            NonFiniteError: the result holds NaN or Inf. DeviceMemoryError: the device ran out of memory.
        """
        ...


@runtime_checkable
class FrameSynthesizer(ViewSynthesizer, Protocol):
    """A model that can work frame by frame."""

    def streaming(self) -> "FrameSynthesizer":
        """The same weights for clips of one frame, each of which goes on where the one before ended."""
        ...

    def reset(self) -> None:
        """Forget all frames: the next one is the first."""

    def see(self, features: SourceFeatures) -> Sequence[SeenFrame]:
        """What was encoded of a clip is looked at: the first third of `render`.

        The thirds keep their own state, so three threads may be at work on consecutive clips, each in their order.
        Raises: ShapeError: the features are another model's. DeviceMemoryError.
        """
        ...

    def place(self, seen: Sequence[SeenFrame], trajectories: Sequence[Trajectory]) -> Sequence[PlacedFrame]:
        """What is known of every view before anything is painted. Raises: ShapeError, DeviceMemoryError."""
        ...

    def paint(
        self, placed: Sequence[PlacedFrame], trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        """The views. trajectories: as placed. Raises: as `render`."""
        ...


def out_of_memory_is_our_error(method: Callable[Given, Made]) -> Callable[Given, Made]:
    """The method, with torch's out-of-memory error as DeviceMemoryError and the device's cache given back."""

    @wraps(method)
    def guarded(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        try:
            return method(*args, **kwargs)
        except torch.OutOfMemoryError as error:
            reason = str(error).splitlines()[0]
        torch.cuda.empty_cache()  # outside the handler: its traceback would keep tensors alive
        raise DeviceMemoryError(f"{reason} Render fewer views and samples at once, smaller frames, or use bfloat16")

    return guarded


# --- tensors on their way from a GPU to the host ---------------------------------------------------------------------


class Download:
    """A copy of a tensor on the host that may still be arriving.

    From a GPU it goes through pinned memory on a stream of its own; on a CPU it is the tensor itself.
    """

    def __init__(self, source: Tensor) -> None:
        """Begin, as soon as the device has made the tensor. It must not be written to any more."""
        self._held, self._arrived = source, None
        if not source.is_cuda:
            return
        side = torch.cuda.Stream(source.device)
        side.wait_stream(torch.cuda.current_stream(source.device))
        with torch.cuda.stream(side):
            self._held = torch.empty(source.shape, dtype=source.dtype, pin_memory=True)
            self._held.copy_(source, non_blocking=True)
            source.record_stream(side)  # or its memory could be given away before it is read
            self._arrived = torch.cuda.Event(blocking=True)
            self._arrived.record(side)

    def result(self) -> Tensor:
        """The copy, once it is there."""
        if self._arrived is not None:
            self._arrived.synchronize()
        return self._held


def whole_levels(pixels: Tensor) -> Tensor:
    """[0, 1] -> uint8 in 0..255, the nearest level."""
    return (pixels * 255).round().to(torch.uint8)


# --- the door ------------------------------------------------------------------------------------------------------


class Synthesizer:
    """A checkpoint ready to run.

    The U-Net and the encoders compute in the networks' own precision; the sampler state and the decoder in float32.
    """

    def __init__(self, networks: Networks, traits: Traits, engine: Engine | None = None) -> None:
        """engine: what computes the networks; torch itself where none is given."""
        self.networks, self.traits, self._config = networks, traits, networks.config
        networks.requires_grad_(False)
        prepare(networks)
        if engine is None and next(networks.unet.parameters()).device.type == "cpu":
            arrange(networks)
        self._engine = engine or Engine(networks)
        if traits.splat == "estimated":
            packaged_eyes(self._engine.like.device)  # now, not when the first clip comes

    @out_of_memory_is_our_error
    @torch.inference_mode()
    def encode(self, clip: Clip, augmentation: Augmentation | None = None) -> SourceFeatures:
        """See ViewSynthesizer. Frames are independent of each other here; any number of them may be given."""
        augmentation = augmentation or Augmentation()
        strength = self._config.sampling.augmentation if augmentation.strength is None else augmentation.strength
        self.traits.check_size(*clip.video.shape[-2:])
        noise, device = augmentation.noise, self._engine.like.device
        if noise is not None and noise.shape != clip.video.shape:
            raise ShapeError(f"augmentation noise must be {list(clip.video.shape)}, got {list(noise.shape)}")
        video = noisy = clip.video.to(device)
        if strength > 0:
            noise = unit_noise(tuple(video.shape), augmentation.seed, device=device) if noise is None else noise
            noisy = video + strength * noise.to(device)
        tokens = [self._engine.tokens(frames) for frames in video.split(self._at_once(video))]
        lens, metres = (None, None) if self.traits.splat == "none" else self._points(clip)
        return SourceFeatures(
            tokens=torch.cat([each for each in tokens if each is not None]) if self._config.image_encoder else None,
            latents=self._latents(noisy),
            fps=clip.fps,
            augmentation=strength,
            lens=lens,
            video=None if metres is None else video,
            metres=metres,
        )

    def _at_once(self, frames: Tensor) -> int:
        return _ENCODE_FRAMES if self._engine.like.device.type == "cpu" else len(frames)

    def _latents(self, frames: Tensor) -> Tensor:
        """Condition latents of frames, unscaled."""
        return torch.cat([self._engine.condition_mean(few) for few in frames.split(self._at_once(frames))])

    def _points(self, clip: Clip) -> tuple[Intrinsics, Tensor]:
        """Lens and depth [T, H, W] of the source's points. Raises OptionError where nobody says or estimates them."""
        traits, lens = self.traits, clip.lens
        if lens is None and traits.lens_deg is not None:
            height, width = clip.video.shape[-2:]
            lens = Intrinsics.from_hfov(traits.lens_deg[0], width, height)  # as trained
        if lens is None or (clip.depth is None and traits.splat == "given"):
            raise OptionError(
                f"{traits.name} is shown the source's points, and the clip has no {'depth' if lens else 'lens'}; give "
                "it, or take weights that do without"
            )
        device = self._engine.like.device
        return lens, (estimated_depth(clip.video.to(device), lens) if clip.depth is None else clip.depth.to(device))

    @out_of_memory_is_our_error
    @torch.inference_mode()
    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        options = RenderOptions() if options is None else options
        self.traits.check_lengths(features.frames, trajectories)
        given = options.motion_bucket
        buckets = [self.traits.motion_bucket(path) if given is None else given for path in trajectories]
        latents = self._denoise(features, trajectories, buckets, options)
        pictures, classes = self._decode(latents / self._config.vae.scale, as_levels=options.whole_levels)
        return [
            View(
                samples=samples,
                latents=own,
                trajectory=path,
                motion_bucket=bucket,
                classes=ids,
                uncertainty_scale=self.traits.uncertainty_scale,
            )
            for samples, own, path, bucket, ids in zip(
                pictures, latents.cpu(), trajectories, buckets, classes, strict=True
            )
        ]

    def _denoise(
        self,
        features: SourceFeatures,
        trajectories: Sequence[Trajectory],
        buckets: Sequence[float],
        options: RenderOptions,
    ) -> Tensor:
        """Scaled latents, [V, S, T, C, h, w]; rows of the batch are ordered view by view, sample by sample."""
        config, samples, views, like = self._config, options.samples, len(trajectories), self._engine.like
        schedule = Schedule.of(config, options)
        width, strength = config.unet.vector_width, features.augmentation
        vectors = [micro_conditioning(features.fps, bucket, strength, width) for bucket in buckets]
        cameras = [self._engine.camera(path) for path in trajectories]
        cameras = [each.repeat(samples, 1) for each in cameras if each is not None]
        unconditional, rows = schedule.branches == 2, views * samples
        conditions = [self._condition(features, path).repeat(samples, 1, 1, 1) for path in trajectories]
        given = Conditioning(
            vector=torch.cat([vector.expand(samples * config.frames, -1) for vector in vectors]).to(like),
            camera=torch.cat(cameras) if cameras else None,
            tokens=None if features.tokens is None else with_unconditional(features.tokens, rows, unconditional),
            latents=with_unconditional(torch.cat(conditions), 1, unconditional),
        )
        noise = self._noise(tuple(features.latents.shape[1:]), options)
        latents = self._engine.sample(schedule.start(noise.to(like.device), views), given, schedule, options)
        if not latents.isfinite().all():
            raise NonFiniteError(
                f"{self.traits.name} produced NaN or Inf in the latents (precision {self.traits.precision}, seed "
                f"{options.seed}); try --dtype float32, and look at the weights with `gcd-node weights inspect`"
            )
        return latents.unflatten(0, (views, samples))

    def _condition(self, features: SourceFeatures, path: Trajectory) -> Tensor:
        """What joins the noisy latents of a view, [T, C', h, w]: the source's latents, then a splat's."""
        video, metres, lens = features.video, features.metres, features.lens
        if video is None or metres is None or lens is None:
            return features.latents
        seen = splat_channels(splatted(video, metres, lens, path), self._latents)
        return torch.cat([features.latents, seen], dim=1)

    def _noise(self, each: tuple[int, ...], options: RenderOptions) -> Tensor:
        """Unit noise the sampling starts from, [S, T, C, h, w]; the same for every view, and if shared every frame."""
        samples, frames, given = options.samples, self._config.frames, options.initial_noise
        if given is None:
            shape = (1 if self._config.sampling.shared_noise else frames, *each)
            draws = [unit_noise(shape, options.seed, 1 + s).expand(frames, *each) for s in range(samples)]
            return torch.stack(draws)
        given = given[None] if given.ndim == 4 else given
        if tuple(given.shape) != (samples, frames, *each):
            raise OptionError(f"initial noise must be {[samples, frames, *each]}, got {list(given.shape)}")
        return given.float()

    def _decode(self, latents: Tensor, *, as_levels: bool) -> tuple[list[Tensor], list[Tensor] | list[None]]:
        """Of every view pixels [S, T, 3, H, W] and class ids, on the CPU. latents: [V, S, T, C, h, w], unscaled.

        One clip at a time; while one is decoded, the one before it arrives.
        """
        painted, finite = self.traits.painted_classes, list[Tensor]()
        pictures, classes = list[Download](), list[Download]()
        for clip in latents.flatten(0, 1):
            decoded = self._engine.decode(clip)
            finite.append(decoded.isfinite().all())
            pixels = to_pixels(decoded)
            if painted:
                classes.append(Download(nearest_classes(pixels, painted)))
            pictures.append(Download(whole_levels(pixels) if as_levels else pixels))
        if not all(each.item() for each in finite):
            raise NonFiniteError(f"{self.traits.name} decoded to NaN or Inf; the weights are damaged")
        views, samples = latents.shape[:2]

        def by_view(clips: list[Download]) -> list[Tensor]:
            rows = [clips[v * samples : (v + 1) * samples] for v in range(views)]
            return [torch.stack([each.result() for each in row]) for row in rows]

        return by_view(pictures), by_view(classes) if painted else [None] * views
