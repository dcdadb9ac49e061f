"""Batches of the diffusion objective from a latent cache, without a single run of the frozen encoders."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gcd_model import ModelConfig
from gcd_model.conditioning import micro_conditioning
from gcd_train.batches import Conditioner
from gcd_train.draws import Draws
from gcd_train.errors import RecipeError
from gcd_train.latent_cache.plan import PathKind
from gcd_train.latent_cache.reader import CachedClip, CachedLatents
from gcd_train.objective import Batch, drop
from gcd_train.precision import Precision
from gcd_train.recipe import UNetRecipe


class CachedBatches:
    """A `BatchSource` of whole clips: noise copy of every frame, posterior sample and dropout drawn anew each time.

    The frame rate a clip is told is its own, after the stride; the recipe's `fps` is not used.
    Raises RecipeError for single frames, or another augmentation than the cache was made with.
    """

    def __init__(
        self, cache: CachedLatents, config: ModelConfig, recipe: UNetRecipe, precision: Precision, path: PathKind
    ) -> None:
        kept = cache.index.identity
        if recipe.image_share or recipe.loss.class_map:
            raise RecipeError("a latent cache has whole clips and no class map; set image_share, class_map to 0")
        if recipe.augmentation != kept.augmentation:
            raise RecipeError(
                f"the recipe's unet.augmentation is {recipe.augmentation:g}, {cache.folder} was made with "
                f"{kept.augmentation:g}; change the recipe, or make the cache anew"
            )
        if (config.frames, config.height, config.width) != (kept.plan.clip_frames, kept.height, kept.width):
            raise RecipeError(
                f"{cache.folder} holds clips of {kept.plan.clip_frames} frames of {kept.width}x{kept.height}, the "
                f"model takes {config.frames} of {config.width}x{config.height}; make a cache with its weights"
            )
        self._cache, self._config, self._recipe, self._precision = cache, config, recipe, precision
        self._path: PathKind = path
        self._conditioner = Conditioner(config, recipe, precision)

    def single_frames(self, draws: Draws, count: int) -> Batch:
        """Not offered; refused when this was made."""
        raise RecipeError("a latent cache has whole clips only; set image_share to 0")

    def whole_clips(self, draws: Draws, count: int) -> Batch:
        """See BatchSource."""
        on_cpu = Draws(int(draws.below(2**31, 1)), "latent cache", 0, torch.device("cpu"))
        clips = [self._cache.clip(*self._cache.drawn_place(on_cpu), self._path, on_cpu) for _ in range(count)]
        source, half, numbers = (
            self._joined([getattr(clip.rows, name) for clip in clips]) for name in ("source", "half", "frame_numbers")
        )
        condition = self._conditioner.channels(source, half.float() / 127.5 - 1, numbers)
        tokens = self._joined_if([clip.tokens for clip in clips])
        return Batch(
            target=self._precision.frames(self._joined([clip.rows.target for clip in clips])),
            condition=drop(condition, draws, self._recipe.dropout),
            vector=torch.cat([self._vector(clip) for clip in clips]).to(self._precision.device),
            tokens=None if tokens is None else drop(tokens, draws, self._recipe.dropout),
            classes=None,
            emphasis=self._joined_if([clip.emphasis for clip in clips]),
            frames=self._config.frames,
        )

    def _vector(self, clip: CachedClip) -> Tensor:
        """Micro-conditioning of a clip's frames, [T, V]."""
        recipe, width = self._recipe, self._config.unet.vector_width
        vector = micro_conditioning(clip.fps, recipe.motion_bucket, recipe.augmentation, width)
        return vector.expand(self._config.frames, -1)

    def _joined(self, rows: Sequence[Tensor]) -> Tensor:
        return torch.cat(list(rows)).to(self._precision.device)

    def _joined_if(self, rows: Sequence[Tensor | None]) -> Tensor | None:
        there = [row for row in rows if row is not None]
        return self._joined(there) if len(there) == len(rows) else None
