"""The stages that only small models of our own have: autoencoder, encoded clips, plane mix."""

import msgspec

from gcd_train.recipe.optimiser import EmaRecipe, OptimiserRecipe
from gcd_train.recipe.values import Budget, Count, NotNegative, Positive, Share


class VAERecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The autoencoder, on crops of source and target frames.

    pool: clips to learn from, drawn once and kept decoded in memory (2 MB each at 192x128).
    crop: pixels a side. clips, frames: crops a batch, consecutive frames of each.
    image_share: share of the budget with as many unrelated crops instead, the decoder's temporal layers left out.
    gradient, ssim, kl: weights of the gradient L1, of 1 - SSIM and of the Kullback-Leibler term beside the L1.
    normalise_at: share of the budget after which mean and spread of the latents are folded into the weights.
    """

    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None = None
    pool: Count = 800
    crop: Count = 64
    clips: Count = 8
    frames: Count = 4
    image_share: Share = 0.0
    gradient: NotNegative = 0.7
    ssim: NotNegative = 0.15
    kl: NotNegative = 1e-4
    normalise_at: Share = 0.6


class LatentsRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Every clip encoded once, so that the U-Net need not.

    limit: clips to take, all that are there if left out; fixed when the stage starts.
    flip: encode the mirrored clips, too. augmentation: strength of the noise on the source frames (pixels in [-1, 1]).
    sample: draw targets from the posterior instead of taking its mean.
    """

    limit: Count | None = None
    flip: bool = True
    augmentation: NotNegative = 0.0
    sample: bool = False


class DecoderRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The plane-mix decoder, on frozen predictions of the U-Net.

    clips: how many clips to predict beforehand. batch: frames a batch, drawn as runs of `run` consecutive frames.
    gradient, ssim, energy: weights beside the L1; energy asks for as much drawn in each cell of 8 pixels, see
    `picture_losses.energy_l1`. class_map: weight of the refined class map's cross-entropy.
    finetune_vae: train the autoencoder's decoder, too, at vae_rate times the rate; wants a run above 1.
    imitate: weight of how far (L1 and gradients) it is from what was decoded beforehand; for a decoder that takes
    another's place.
    """

    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None = None
    clips: Count = 400
    batch: Count = 8
    run: Count = 1
    gradient: NotNegative = 0.4
    ssim: NotNegative = 0.4
    energy: NotNegative = 0.0
    class_map: NotNegative = 0.1
    class_power: NotNegative = 0.35
    finetune_vae: bool = False
    vae_rate: Positive = 0.1
    imitate: NotNegative = 0.0

    def __post_init__(self) -> None:
        if self.batch % self.run:
            raise ValueError(f"a batch of {self.batch} frames cannot be drawn as runs of {self.run}")
        if self.finetune_vae and self.run == 1:
            raise ValueError("finetune_vae decodes clips, also across frames: give a run above 1")
        if self.imitate and not self.finetune_vae:
            raise ValueError("imitate is for a decoder that learns: set finetune_vae, or leave imitate out")
