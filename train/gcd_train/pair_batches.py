"""Batches of the diffusion objective from samples of a data set: each clip is told its own camera, rate and motion."""

import torch
from torch import Tensor

from gcd_model import Family
from gcd_model.conditioning import micro_conditioning, relative_pose_features, spherical_features
from gcd_model.config import ModelConfig
from gcd_model.geometry import SphericalDelta, motion_bucket
from gcd_model.networks import Networks
from gcd_train.datasets.clip_source import to_network
from gcd_train.datasets.view_pairs import PairBatch
from gcd_train.errors import DataError, RecipeError
from gcd_train.pixel_encoding import encode_frames
from gcd_train.recipe import UNetRecipe
from gcd_train.recipe_data import LoaderRecipe
from gcd_train.sample_loader import LoadedBatch, SampleLoader, Samples
from gcd_train.training.draws import Draws
from gcd_train.training.objective import Batch, drop_streams
from gcd_train.training.setup import Precision


class PairBatches:
    """A `BatchSource` of whole clips. Batch n, by `Draws.number`, always has the same samples.

    samples: `ViewPairs`, `LeRobotPairs`. family: says what the network is told of a camera's way.
    Raises RecipeError for single frames: those learn from pairs of clips.
    """

    def __init__(
        self,
        samples: Samples,
        networks: Networks,
        recipe: UNetRecipe,
        family: Family,
        precision: Precision,
        loader: LoaderRecipe,
        seed: int,
    ) -> None:
        if recipe.image_share:
            raise RecipeError("samples of a data set are whole clips; set image_share to 0")
        if networks.config.extra_condition_channels:
            raise RecipeError("no data here has further condition channels; take a base without them")
        self._networks, self._recipe, self._family, self._precision = networks, recipe, family, precision
        self._loader = SampleLoader(samples, seed, loader)

    def single_frames(self, draws: Draws, count: int) -> Batch:
        """Not offered; refused when this was made."""
        raise RecipeError("samples of a data set are whole clips; set image_share to 0")

    def whole_clips(self, draws: Draws, count: int) -> Batch:
        """See BatchSource. Raises DataError if samples cannot be read or do not fit the model."""
        return self.batch(self._loader.batch(draws.number, count), draws)

    def batch(self, loaded: LoadedBatch, draws: Draws) -> Batch:
        """The batch of some samples."""
        samples, config, recipe = loaded.samples, self._networks.config, self._recipe
        clips, frames = require_size(samples, config)
        encoded = encode_frames(
            self._networks, recipe, self._frames(samples.source), self._frames(samples.target), draws
        )
        condition, tokens = drop_streams(self._precision.frames(encoded.source), encoded.tokens, frames, draws, recipe)
        camera = camera_features(samples, config)
        told = [self._vector(samples, clip) for clip in range(clips)]
        names = zip(samples.scenes, loaded.numbers, strict=True)
        return Batch(
            target=self._precision.frames(encoded.target),
            condition=condition,
            vector=torch.stack(told).repeat_interleave(frames, dim=0).to(self._precision.device),
            tokens=tokens,
            emphasis=encoded.emphasis,
            frames=frames,
            camera=None if camera is None else camera.to(self._precision.device),
            ids=tuple(f"{scene} (sample {number})" for scene, number in names),
            wait_s=loaded.wait_s,
        )

    def _frames(self, clips: Tensor) -> Tensor:
        """u8 [B, T, H, W, 3] -> float32 [B*T, 3, H, W] in [-1, 1], on the device."""
        there = clips.to(self._precision.device, non_blocking=True)
        return self._precision.frames(to_network(there.flatten(0, 1)))

    def _vector(self, samples: PairBatch, clip: int) -> Tensor:
        """Micro-conditioning of a clip, [V]."""
        motion = told_motion(samples, clip, self._family, self._recipe)
        width = self._networks.config.unet.vector_width
        return micro_conditioning(float(samples.fps[clip]), motion, self._recipe.augmentation, width)


def told_motion(samples: PairBatch, clip: int, family: Family, recipe: UNetRecipe) -> float:
    """The number that tells the network how far a clip's camera goes, worked out as it will be in use.

    From the whole way in azimuth and elevation, and the family's largest; the recipe's constant for a family without.
    """
    if family.motion_bucket is not None or family.limits is None or samples.deltas is None:
        return recipe.motion_bucket
    azimuth_deg, elevation_deg, radius_m = samples.deltas[clip, -1].tolist()
    return motion_bucket(
        SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m),
        max_azimuth_deg=family.limits.azimuth_deg,
        max_elevation_deg=family.limits.elevation_deg,
    )


def camera_features(samples: PairBatch, config: ModelConfig) -> Tensor | None:
    """What the model is steered by, [B*T, F]; None for a model without camera control.

    Raises: DataError for a model steered by angles where the samples' cameras have none.
    """
    if config.camera == "none":
        return None
    if config.camera == "relative_pose":
        return relative_pose_features(samples.source_from_target.flatten(0, 1))
    if samples.deltas is None:
        raise DataError(
            "the model is steered by angles and radius, and these cameras are not on a sphere; take a recipe with "
            'model.camera "relative_pose" or "none"'
        )
    return spherical_features(samples.deltas.flatten(0, 1))


def require_size(samples: PairBatch, config: ModelConfig) -> tuple[int, int]:
    """Clips and frames of a clip. Raises DataError unless samples are as long and large as the model takes them."""
    clips, *given = samples.source.shape[:4]
    wanted = [config.frames, config.height, config.width]
    if given != wanted:
        raise DataError(f"samples must be T, H, W = {wanted} for this model, got {given}")
    return clips, config.frames
