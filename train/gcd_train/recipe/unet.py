"""The diffusion stage: batches, noise levels, loss."""

from typing import Literal, TypeAlias

import msgspec

from gcd_train.recipe.optimiser import EmaRecipe, OptimiserRecipe
from gcd_train.recipe.values import Budget, Count, NotNegative, Positive, Share

FocalBlendName: TypeAlias = Literal["released", "plain"]
ClassWeightsName: TypeAlias = Literal["none", "parallel-domain", "driving"]


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
    """The diffusion loss.

    weight_limit: upper bound of the noise level's weight (s^2 + 1) / s^2.
    focal: keep the hardest elements of a frame; focal_fraction of them from update focal_steps on.
    focal_blend: "released" counts the hardest 0.9 and all 0.1, class weights half before and half after the choice;
    "plain" is the mean of the hardest of the class-weighted error, as the paper describes it.
    class_weights: emphasis by colour in semantic pictures, persons 7 times and vehicles 3 times, in the colours of
    ParallelDomain-4D or of our driving world. sensitivity: weigh latent channels by what the decoder
    makes of them.
    """

    weight_limit: Positive | None = None
    focal: bool = True
    focal_steps: Count = 5000
    focal_fraction: Share = 0.1
    focal_blend: FocalBlendName = "released"
    class_weights: ClassWeightsName = "none"
    sensitivity: bool = False


class UNetRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The U-Net.

    source: "latents" reads what the latents stage wrote, "pixels" encodes every batch anew with fresh noise, "cache"
    reads a latent cache (`gcd-train cache`).
    image_share: share of the budget with single frames, the temporal layers left out; then whole clips.
    image_batch: frames of such a batch. clip_batch: clips computed at once. accumulate: so many times, for one update;
    or batch: clips of one update altogether, a multiple of clip_batch.
    dropout: probability that the network sees zeros in place of what it is given of the source's pictures: latents
    and image token. dropout_per: drawn for each frame, as released, or once a clip. dropout_joint: one draw for both
    streams, instead of one each as released.
    augmentation: noise strength on source frames, what the network is told and, with "pixels", what it gets.
    fps, motion_bucket: what the network is told where the clip or its camera path does not say it.
    late_noise: noise levels from the share `late_from` of the budget on, so that a network that first learned one step
    also learns several.
    """

    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None = None
    source: Literal["latents", "pixels", "cache"] = "latents"
    image_share: Share = 0.0
    image_batch: Count = 16
    clip_batch: Count = 3
    accumulate: Count = 1
    batch: Count | None = None
    noise: NoiseRecipe = NoiseRecipe()
    late_noise: NoiseRecipe | None = None
    late_from: Share = 1.0
    loss: LossRecipe = LossRecipe()
    dropout: Share = 0.1
    dropout_per: Literal["frame", "clip"] = "frame"
    dropout_joint: bool = False
    augmentation: NotNegative = 0.02
    fps: Positive = 10.0
    motion_bucket: float = 127.0

    def __post_init__(self) -> None:
        if self.batch is None:
            return
        if self.batch % self.clip_batch:
            raise ValueError(f"a batch of {self.batch} clips is no multiple of clip_batch, {self.clip_batch}")
        if self.accumulate != 1:
            raise ValueError("an update's clips are told by batch or by accumulate: give one of them")

    def noise_at(self, share: float) -> NoiseRecipe:
        """The noise levels when that share of the budget is used."""
        return self.noise if self.late_noise is None or share < self.late_from else self.late_noise

    @property
    def parts(self) -> int:
        """Batches of `clip_batch` clips that make one update."""
        return self.accumulate if self.batch is None else self.batch // self.clip_batch
