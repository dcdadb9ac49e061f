"""Batches of the diffusion objective: from a run's own latents, from samples of a data set, or from a latent cache.

Each clip has its own camera, rate and motion. From samples, the frozen networks run on every batch: with fresh
augmentation noise, and targets drawn from their posterior. From latents and a cache they never run.
"""

import time
from collections.abc import Sequence

import torch
from torch import Tensor

from gcd_model.conditioning import micro_conditioning
from gcd_model.config import ModelConfig
from gcd_model.geometry import Trajectory
from gcd_model.networks import Networks
from gcd_model.weights.card import Family
from gcd_train.data.cache import CachedLatents, FrozenEncoders, PathKind, encoders_digest
from gcd_train.data.latents import LatentClips
from gcd_train.data.loader import SampleLoader
from gcd_train.data.sample import Samples, to_network
from gcd_train.errors import DataError, RecipeError
from gcd_train.recipe import UNetRecipe
from gcd_train.recipe_data import LoaderRecipe
from gcd_train.training.losses import COLOUR_WEIGHTS, class_emphasis
from gcd_train.training.objective import Batch, drop_streams
from gcd_train.training.setup import Conditioner, Draws, Precision


@torch.no_grad()
def encode_frames(
    networks: Networks, recipe: UNetRecipe, source: Tensor, target: Tensor, draws: Draws
) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
    """What the frozen networks make of frames [N, 3, H, W] in [-1, 1].

    The augmentation is noise on the pixels that the condition encoder sees, and on nothing else; the image tower sees
    clean frames.

    Returns: scaled target latents, source latents, image tokens [N, D] and the class emphasis of the targets, or None.
    Source: Generative Camera Dolly, as released.
    """
    encoders = FrozenEncoders(networks=networks)
    noisy = source + recipe.augmentation * draws.normal(*source.shape)
    posterior = encoders.target(target)
    latents = posterior.sample(draws.normal(*posterior.mean.shape)) * networks.config.vae.scale
    by_colour, size = COLOUR_WEIGHTS[recipe.loss.class_weights], (latents.shape[-2], latents.shape[-1])
    emphasis = class_emphasis(target, by_colour, size) if by_colour else None
    return latents, encoders.condition(noisy), encoders.tokens(source), emphasis


class EncodedBatches:
    """Batches of what the latents stage wrote."""

    def __init__(self, clips: LatentClips, config: ModelConfig, recipe: UNetRecipe, precision: Precision) -> None:
        self._clips, self._recipe, self._precision = clips, recipe, precision
        self._conditioner = Conditioner(config, recipe, precision)

    def batch(self, draws: Draws, count: int, *, single: bool = False) -> Batch:
        """See BatchSource."""
        meta = self._clips.meta
        clips = draws.below(meta.clips, count)
        frames = draws.below(meta.frames, count) if single else torch.arange(meta.frames).repeat(count)
        per_clip = 1 if single else meta.frames
        flip = draws.below(meta.flips, count).bool()
        rows = self._clips.rows(
            clips.repeat_interleave(per_clip), frames, flip.repeat_interleave(per_clip), self._precision.device
        )
        source = self._precision.frames(rows.source)
        condition, _ = drop_streams(source, None, per_clip, draws, self._recipe)
        return Batch(
            target=self._precision.frames(rows.target),
            condition=condition,
            vector=self._conditioner.vector(rows.motion),
            tokens=None,
            emphasis=rows.emphasis,
            frames=per_clip,
            camera=rows.control,
            ids=self._clips.names(clips),
        )


class SampleBatches:
    """A `BatchSource` of whole clips. Batch n, by `Draws.number`, always has the same samples.

    samples: `ViewPairs`, `LeRobotPairs`, or a set of clips. family: says what the network is told of a camera's way.
    turns: see `SampleLoader`.
    """

    def __init__(
        self,
        samples: Samples,
        networks: Networks,
        recipe: UNetRecipe,
        family: Family,
        precision: Precision,
        loader: LoaderRecipe = LoaderRecipe(),  # noqa: B008  it is frozen
        seed: int = 0,
        turns: Sequence[int] = (0,),
    ) -> None:
        self._networks, self._precision, self._recipe = networks, precision, recipe
        self._conditioner = Conditioner(networks.config, recipe, precision, family)
        self._loader = SampleLoader(samples, seed, loader, turns, recipe.parts)

    def batch(self, draws: Draws, count: int, *, single: bool = False) -> Batch:
        """See BatchSource. Raises DataError if samples cannot be read or do not fit the model."""
        assert not single, "the recipe refuses it"
        loaded = self._loader.batch(draws.number, count)
        samples, config, recipe = loaded.samples, self._networks.config, self._recipe
        given = list(samples.source.shape[1:4])
        wanted = [config.frames, config.height, config.width]
        if given != wanted:
            raise DataError(f"samples must be T, H, W = {wanted} for this model, got {given}")
        frames, paths = config.frames, samples.paths
        pictures = self._frames(samples.source), self._frames(samples.target)
        target, source, tokens, emphasis = encode_frames(self._networks, recipe, *pictures, draws)
        condition, tokens = drop_streams(self._precision.frames(source), tokens, frames, draws, recipe)
        cameras = [camera for path in paths if (camera := self._conditioner.camera(path)) is not None]
        vectors = [self._vector(float(fps), path) for fps, path in zip(samples.fps, paths, strict=True)]
        names = zip(samples.scenes, loaded.numbers, strict=True)
        return Batch(
            target=self._precision.frames(target),
            condition=condition,
            vector=torch.stack(vectors).repeat_interleave(frames, dim=0).to(self._precision.device),
            tokens=tokens,
            emphasis=emphasis,
            frames=frames,
            camera=torch.cat(cameras).to(self._precision.device) if cameras else None,
            ids=tuple(f"{scene} (sample {number})" for scene, number in names),
            wait_s=loaded.wait_s,
        )

    def _frames(self, clips: Tensor) -> Tensor:
        """u8 [B, T, H, W, 3] -> float32 [B*T, 3, H, W] in [-1, 1], on the device."""
        there = clips.to(self._precision.device, non_blocking=True)
        return self._precision.frames(to_network(there.flatten(0, 1)))

    def _vector(self, fps: float, path: Trajectory) -> Tensor:
        """Micro-conditioning of a clip, [V]."""
        recipe, width = self._recipe, self._networks.config.unet.vector_width
        motion = recipe.motion_bucket if path.delta is None else self._conditioner.motion(path)
        return micro_conditioning(fps, motion, recipe.augmentation, width)


class CachedBatches:
    """A `BatchSource` of whole clips: noise copy of every frame, posterior sample and dropout drawn anew each time.

    The frame rate of a clip is its own, after the stride; the recipe's `fps` is not used.
    Raises RecipeError unless the cache was made with these networks' encoders.
    """

    def __init__(
        self,
        cache: CachedLatents,
        networks: Networks,
        recipe: UNetRecipe,
        precision: Precision,
        path: PathKind,
    ) -> None:
        kept, given = cache.index.identity.encoders, encoders_digest(networks)
        if kept != given:
            raise RecipeError(
                f"{cache.folder} was made with other encoders ({kept}) than the run's ({given}); give the same "
                "model.weights, or make the cache anew"
            )
        self._cache, self._config, self._precision, self._recipe = cache, networks.config, precision, recipe
        self._path: PathKind = path

    def batch(self, draws: Draws, count: int, *, single: bool = False) -> Batch:
        """See BatchSource."""
        assert not single, "the recipe refuses it"
        started = time.perf_counter()
        on_cpu = Draws(int(draws.below(2**31, 1)), "latent cache", 0, torch.device("cpu"))
        clips = [self._cache.clip(*self._cache.drawn_place(on_cpu), self._path, on_cpu) for _ in range(count)]
        wait_s = time.perf_counter() - started
        source = self._precision.frames(self._joined([clip.source for clip in clips]))
        tokens = self._joined_if([clip.tokens for clip in clips])
        condition, tokens = drop_streams(source, tokens, self._config.frames, draws, self._recipe)
        by_class, width = self._recipe.loss.class_weights != "none", self._config.unet.vector_width
        motion, noise = self._recipe.motion_bucket, self._recipe.augmentation
        vectors = [micro_conditioning(clip.fps, motion, noise, width) for clip in clips]
        return Batch(
            target=self._precision.frames(self._joined([clip.target for clip in clips])),
            condition=condition,
            vector=torch.stack(vectors).repeat_interleave(self._config.frames, dim=0).to(self._precision.device),
            tokens=tokens,
            emphasis=self._joined_if([clip.emphasis for clip in clips]) if by_class else None,
            frames=self._config.frames,
            ids=tuple(f"{clip.scene} from {clip.place.start} by {clip.place.stride}" for clip in clips),
            wait_s=wait_s,
        )

    def _joined(self, rows: Sequence[Tensor]) -> Tensor:
        return torch.cat(list(rows)).to(self._precision.device)

    def _joined_if(self, rows: Sequence[Tensor | None]) -> Tensor | None:
        there = [row for row in rows if row is not None]
        return self._joined(there) if len(there) == len(rows) else None
