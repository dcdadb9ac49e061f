"""Batches of the diffusion objective from a latent cache, without a single run of the frozen encoders."""

import time
from collections.abc import Sequence

import torch
from torch import Tensor

from gcd_model import ModelConfig
from gcd_model.conditioning import micro_conditioning
from gcd_model.networks import Networks
from gcd_train.errors import RecipeError
from gcd_train.latent_cache.encoders import encoders_digest
from gcd_train.latent_cache.plan import PathKind
from gcd_train.latent_cache.reader import CachedClip, CachedLatents
from gcd_train.recipe import UNetRecipe
from gcd_train.training.draws import Draws
from gcd_train.training.objective import Batch, drop_streams
from gcd_train.training.setup import Precision


class CachedBatches:
    """A `BatchSource` of whole clips: noise copy of every frame, posterior sample and dropout drawn anew each time.

    The frame rate a clip is told is its own, after the stride; the recipe's `fps` is not used.
    Raises RecipeError for what a cache does not have: single frames, a camera to steer,
    another augmentation, size or path than it was made with, or class emphasis where it was made in colour.
    """

    def __init__(
        self, cache: CachedLatents, config: ModelConfig, recipe: UNetRecipe, precision: Precision, path: PathKind
    ) -> None:
        require_cached(cache, config, recipe, path)
        self._cache, self._config, self._recipe, self._precision = cache, config, recipe, precision
        self._path: PathKind = path

    def require_encoders(self, networks: Networks) -> None:
        """Raises RecipeError unless the cache was made with these networks' encoders."""
        kept, given = self._cache.index.identity.encoders, encoders_digest(networks)
        if kept != given:
            raise RecipeError(
                f"{self._cache.folder} was made with other encoders ({kept}) than the run's ({given}); give the same "
                "model.weights, or make the cache anew"
            )

    def single_frames(self, draws: Draws, count: int) -> Batch:
        """Not offered; refused when this was made."""
        raise RecipeError("a latent cache has whole clips only; set image_share to 0")

    def whole_clips(self, draws: Draws, count: int) -> Batch:
        """See BatchSource."""
        started = time.perf_counter()
        on_cpu = Draws(int(draws.below(2**31, 1)), "latent cache", 0, torch.device("cpu"))
        clips = [self._cache.clip(*self._cache.drawn_place(on_cpu), self._path, on_cpu) for _ in range(count)]
        wait_s = time.perf_counter() - started
        source = self._precision.frames(self._joined([clip.rows.source for clip in clips]))
        tokens = self._joined_if([clip.tokens for clip in clips])
        condition, tokens = drop_streams(source, tokens, self._config.frames, draws, self._recipe)
        by_class = self._recipe.loss.class_weights != "none"
        return Batch(
            target=self._precision.frames(self._joined([clip.rows.target for clip in clips])),
            condition=condition,
            vector=torch.cat([self._vector(clip) for clip in clips]).to(self._precision.device),
            tokens=tokens,
            emphasis=self._joined_if([clip.emphasis for clip in clips]) if by_class else None,
            frames=self._config.frames,
            ids=tuple(f"{clip.scene} from {clip.place.start} by {clip.place.stride}" for clip in clips),
            wait_s=wait_s,
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


def require_cached(cache: CachedLatents, config: ModelConfig, recipe: UNetRecipe, path: PathKind) -> None:
    """Raises RecipeError for what model or recipe want and the cache does not have."""
    kept = cache.index.identity
    if recipe.image_share:
        raise RecipeError("a latent cache has whole clips only; set image_share to 0")
    if config.camera != "none":
        raise RecipeError("a latent cache is of one path; take a model without camera control")
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
    if path not in kept.plan.paths:
        raise RecipeError(f"{cache.folder} holds {' and '.join(kept.plan.paths)} clips, the recipe wants {path} ones")
    if recipe.loss.class_weights != "none" and not kept.emphasis:
        raise RecipeError(f"{cache.folder} holds no class emphasis; make it with `gcd-train cache --semantic`")
