"""The diffusion stage: batches, noise levels, loss."""

from typing import Literal

import msgspec

from gcd_train.recipe.optimiser import EmaRecipe, OptimiserRecipe
from gcd_train.recipe.values import Budget, Count, NotNegative, Positive, Share


class NoiseRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Noise levels, one a clip: log-normal, or the fixed one with probability `fixed_share`.

    shared: share of the noise's variance that the frames of a clip have in common.
    """

    log_mean: float = 1.0
    log_std: NotNegative = 1.6
    fixed_share: Share = 0.0
    fixed_sigma: Positive = 80.0
    shared: Share = 0.0


class LossRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The diffusion loss and, for a model with a class head, its cross-entropy.

    weight_limit: upper bound of the noise level's weight (s^2 + 1) / s^2.
    focal: keep the hardest elements of a frame; focal_fraction of them from update focal_steps on.
    class_weights: emphasis by colour in semantic pictures. sensitivity: weigh latent channels by what the decoder
    makes of them. class_map: weight of the class head's cross-entropy; its class weights are frequency^-class_power.
    class_from_sigma: the class head learns from noise levels of at least this.
    """

    weight_limit: Positive | None = None
    focal: bool = True
    focal_steps: Count = 5000
    focal_fraction: Share = 0.1
    class_weights: Literal["none", "parallel-domain"] = "none"
    sensitivity: bool = False
    class_map: NotNegative = 0.0
    class_power: NotNegative = 0.35
    class_from_sigma: NotNegative = 0.0


class UNetRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The U-Net and the class head.

    source: "latents" reads what the latents stage wrote, "pixels" encodes every batch anew with fresh noise.
    image_share: share of the budget with single frames, the temporal layers left out; then whole clips.
    image_batch: frames of such a batch. clip_batch: clips of a batch. accumulate: batches an update.
    dropout: probability, for each frame and each stream by itself, that the network sees zeros.
    augmentation: noise strength on source frames, what the network is told and, with "pixels", what it gets.
    fps, motion_bucket: what the network is told.
    """

    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None = None
    source: Literal["latents", "pixels"] = "latents"
    image_share: Share = 0.0
    image_batch: Count = 16
    clip_batch: Count = 3
    accumulate: Count = 1
    noise: NoiseRecipe = NoiseRecipe()
    loss: LossRecipe = LossRecipe()
    dropout: Share = 0.1
    augmentation: NotNegative = 0.02
    fps: Positive = 10.0
    motion_bucket: float = 127.0
