"""The stages that only small models of our own have: autoencoder, encoded clips."""

import msgspec

from gcd_train.recipe.optimiser import EmaRecipe, OptimiserRecipe
from gcd_train.recipe.values import Budget, Count, NotNegative, Share


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
