"""Batches of the diffusion objective: from encoded clips, or from pixels with fresh noise each time."""

from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model import ModelConfig
from gcd_model.conditioning import micro_conditioning
from gcd_model.image_encoder import clip_pixels
from gcd_model.networks import Networks
from gcd_train.datasets.clip_source import ClipSource, to_network
from gcd_train.datasets.latents import LatentClips, LatentRows
from gcd_train.draws import Draws
from gcd_train.errors import DataError, RecipeError
from gcd_train.losses import PARALLEL_DOMAIN_WEIGHTS, class_emphasis
from gcd_train.model_setup import path_warps
from gcd_train.objective import Batch, drop
from gcd_train.precision import Precision
from gcd_train.recipe import UNetRecipe


class BatchSource(Protocol):
    """Where batches come from."""

    def single_frames(self, draws: Draws, count: int) -> Batch:
        """`count` frames of random clips."""
        ...

    def whole_clips(self, draws: Draws, count: int) -> Batch:
        """`count` random clips."""
        ...


class Conditioner:
    """Condition channels and vectors of frames, as the synthesizer would make them."""

    def __init__(self, config: ModelConfig, recipe: UNetRecipe, precision: Precision) -> None:
        if config.camera != "none" or config.extra_condition_channels:
            raise RecipeError("this trainer teaches models with one fixed view and no further condition channels")
        self._precision, self._warps = precision, path_warps(config, precision.device)
        self._vector = micro_conditioning(
            recipe.fps, recipe.motion_bucket, recipe.augmentation, config.unet.vector_width
        ).to(precision.device)

    def vector(self, rows: int) -> Tensor:
        """[N, V]."""
        return self._vector.expand(rows, -1)

    def channels(self, latents: Tensor, half: Tensor, frame_numbers: Tensor) -> Tensor:
        """Source latents [N, C, h, w] and, for a model that warps, the warps of the source at half size."""
        if self._warps is None:
            return self._precision.frames(latents)
        doubled = F.interpolate(half, scale_factor=2.0, mode="nearest")  # halving averages it back exactly
        return self._precision.frames(torch.cat([latents, self._warps.channels(doubled, frame_numbers)], dim=1))


class EncodedBatches:
    """Batches of what the latents stage wrote."""

    def __init__(self, clips: LatentClips, config: ModelConfig, recipe: UNetRecipe, precision: Precision) -> None:
        self._clips, self._recipe, self._precision = clips, recipe, precision
        self._conditioner = Conditioner(config, recipe, precision)

    def single_frames(self, draws: Draws, count: int) -> Batch:
        """See BatchSource."""
        return self._batch(
            draws, draws.below(self._clips.meta.clips, count), draws.below(self._clips.meta.frames, count), 1
        )

    def whole_clips(self, draws: Draws, count: int) -> Batch:
        """See BatchSource."""
        frames = self._clips.meta.frames
        return self._batch(
            draws, draws.below(self._clips.meta.clips, count), torch.arange(frames).repeat(count), frames
        )

    def _batch(self, draws: Draws, clips: Tensor, frames: Tensor, per_clip: int) -> Batch:
        mirrored = draws.below(self._clips.meta.flips, clips.shape[0]).bool()
        rows = self._clips.rows(
            clips.repeat_interleave(per_clip), frames, mirrored.repeat_interleave(per_clip), self._precision.device
        )
        return Batch(
            target=self._precision.frames(rows.target),
            condition=drop(self.condition(rows), draws, self._recipe.dropout),
            vector=self._conditioner.vector(rows.target.shape[0]),
            tokens=None,
            classes=rows.classes,
            emphasis=None,
            frames=per_clip,
        )

    def vector(self, rows: int) -> Tensor:
        """Micro-conditioning, [N, V]."""
        return self._conditioner.vector(rows)

    def condition(self, rows: LatentRows) -> Tensor:
        """Condition channels [N, C', h, w] of some frames."""
        half = rows.half.float() / 127.5 - 1
        return self._conditioner.channels(rows.source, half, rows.frame_numbers)


class PixelBatches:
    """Whole clips encoded anew each time: fresh augmentation noise, targets drawn from the posterior, image tokens."""

    def __init__(self, clips: ClipSource, networks: Networks, recipe: UNetRecipe, precision: Precision) -> None:
        if recipe.image_share or recipe.loss.class_map:
            raise RecipeError(
                'unet.source "pixels" takes whole clips and no class map; set image_share, class_map to 0'
            )
        self._clips, self._networks, self._recipe, self._precision = clips, networks, recipe, precision
        self._conditioner = Conditioner(networks.config, recipe, precision)

    def single_frames(self, draws: Draws, count: int) -> Batch:
        """Not offered; refused when this was made."""
        raise RecipeError('unet.source "pixels" takes whole clips only; set image_share to 0')

    def whole_clips(self, draws: Draws, count: int) -> Batch:
        """See BatchSource."""
        pairs = [self._clips.rgb(number) for number in draws.below(len(self._clips), count).tolist()]
        config = self._networks.config
        wanted = (config.frames, config.height, config.width)
        for given in {pair[0].shape[:3] for pair in pairs} - {wanted}:
            raise DataError(f"clips must be T, H, W = {wanted} for this model, got {given}; generate them anew")
        source, target = (
            self._precision.frames(torch.cat([to_network(pair[side]) for pair in pairs])) for side in (0, 1)
        )
        frames = source.shape[0] // count
        return self.batch(source, target, frames, draws)

    @torch.no_grad()
    def batch(self, source: Tensor, target: Tensor, frames: int, draws: Draws) -> Batch:
        """A batch of given frames [N, 3, H, W] in [-1, 1], time fastest."""
        networks, dropout = self._networks, self._recipe.dropout
        noisy = source + self._recipe.augmentation * draws.normal(*source.shape)
        posterior = networks.target_encoder(target)
        latents = posterior.sample(draws.normal(*posterior.mean.shape)) * networks.config.vae.scale
        numbers = torch.arange(frames, device=source.device).repeat(source.shape[0] // frames)
        condition = self._conditioner.channels(networks.condition_encoder(noisy).mean, F.avg_pool2d(source, 2), numbers)
        tokens = self._tokens(source)
        by_colour = self._recipe.loss.class_weights == "parallel-domain"
        size = (latents.shape[-2], latents.shape[-1])
        return Batch(
            target=latents,
            condition=drop(condition, draws, dropout),
            vector=self._conditioner.vector(source.shape[0]),
            tokens=None if tokens is None else drop(tokens, draws, dropout),
            classes=None,
            emphasis=class_emphasis(target, PARALLEL_DOMAIN_WEIGHTS, size) if by_colour else None,
            frames=frames,
        )

    def _tokens(self, source: Tensor) -> Tensor | None:
        tower = self._networks.image_encoder
        return None if tower is None else tower(clip_pixels(source, tower.config.image_size))
