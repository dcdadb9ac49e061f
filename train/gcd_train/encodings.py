"""The clips of a run, encoded once: where they lie, what they belong to, and how the U-Net reads them."""

from dataclasses import dataclass
from pathlib import Path

from gcd_model import Family, ModelConfig
from gcd_model.networks import Networks, weights_digest
from gcd_train.datasets.clip_source import ClipSource
from gcd_train.datasets.latents import EncodedClips, LatentClips, LatentVideos
from gcd_train.errors import RunError
from gcd_train.recipe import LatentsRecipe, Recipe
from gcd_train.stages.latents import LatentsJob, encode_clips
from gcd_train.stop import StopSignal
from gcd_train.training.batches import Conditioner
from gcd_train.training.losses import COLOUR_WEIGHTS
from gcd_train.training.setup import Precision, digest_of


@dataclass(frozen=True, kw_only=True, slots=True)
class Encodings:
    """Folders of latents, one for each set of clips.

    sets: of clips, one, or the pairs that a run takes as videos. folder: of the run's latents. shared: a folder that
    several runs share, where each set lies under the name of what it belongs to; None for the run's own.
    as_videos: whether both sides of the pairs count as videos.
    """

    recipe: Recipe
    config: ModelConfig
    family: Family
    precision: Precision
    sets: tuple[ClipSource, ...]
    as_videos: bool
    folder: Path
    shared: Path | None
    stop: StopSignal

    def encode(self, networks: Networks) -> None:
        """Write what is not there yet. Raises Interrupted, DataError, RunError, see `encode_clips`."""
        for clips in self.sets:
            encode_clips(self._job(networks, clips))

    def opened(self, networks: Networks) -> EncodedClips:
        """What the U-Net learns from. Raises RunError for latents of another autoencoder, or unfinished ones."""
        if not self.as_videos:
            return self.pairs(networks)
        return LatentVideos([self._opened(networks, clips) for clips in self.sets], self.config.vae.scale)

    def pairs(self, networks: Networks) -> LatentClips:
        """The latents of the one set there is. Raises RunError as `opened`."""
        (clips,) = self.sets
        return self._opened(networks, clips)

    def _opened(self, networks: Networks, clips: ClipSource) -> LatentClips:
        identity = self._identity(networks, clips)
        place = self._place(identity)
        latents = LatentClips.open(place)
        if latents.meta.identity != identity:
            raise RunError(
                f"{place} was made by another autoencoder, of other clips or with other options than this run's; "
                "delete it and run the latents stage again"
            )
        return latents.resident(self.precision.device) if self.recipe.compute.resident else latents

    def _job(self, networks: Networks, clips: ClipSource) -> LatentsJob:
        recipe, identity = self.recipe, self._identity(networks, clips)
        return LatentsJob(
            folder=self._place(identity),
            networks=networks,
            clips=clips,
            recipe=self._latents,
            precision=self.precision,
            seed=recipe.seed,
            conditioner=Conditioner(self.config, recipe.unet, self.precision, self.family),
            class_weights=COLOUR_WEIGHTS[recipe.unet.loss.class_weights],
            identity=identity,
            stop=self.stop,
        )

    def _place(self, identity: str) -> Path:
        if self.shared is not None:
            return self.shared / identity
        return self.folder if len(self.sets) == 1 else self.folder / identity

    def _identity(self, networks: Networks, clips: ClipSource) -> str:
        recipe, config, family = self.recipe, self.config, self.family
        told_by_path = family.motion_bucket is None and family.limits is not None
        motion = family.name if told_by_path else None  # families told the recipe's number write the same latents
        steered = (config.camera, motion, recipe.unet.motion_bucket)
        told = digest_of(self._latents, recipe.seed, clips.origin, steered, recipe.unet.loss.class_weights)
        return f"{autoencoder_digest(networks)}-{told}"

    @property
    def _latents(self) -> LatentsRecipe:
        assert self.recipe.latents is not None, "clips are encoded only if the recipe has the table"
        return self.recipe.latents


def autoencoder_digest(networks: Networks) -> str:
    """Names the weights that encode and decode."""
    parts = (networks.target_encoder, networks.condition_encoder, networks.decoder)
    return weights_digest(
        {f"{i}.{name}": value for i, part in enumerate(parts) for name, value in part.state_dict().items()}
    )
