"""Which networks a run trains."""

from typing import Literal

import msgspec

from gcd_train.recipe.values import Count


class UNetChanges(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What differs from the base model's U-Net; see gcd_model.config.UNetConfig. None keeps."""

    width: Count | None = None
    multipliers: tuple[int, ...] | None = None
    attention: tuple[bool, ...] | None = None
    blocks_per_level: Count | None = None
    embedding_width: Count | None = None
    head_width: Count | None = None


class VAEChanges(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What differs from the base model's autoencoder; see gcd_model.config.VAEConfig. None keeps."""

    width: Count | None = None
    multipliers: tuple[int, ...] | None = None
    blocks_per_level: Count | None = None


class ModelRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which networks: a named set-up, and what differs.

    prediction: what the network says, left out as the base has it; "v" is the paper's.
    weights: a weight file to start from; left out, everything starts at random. family: how it is used, see
    `gcd-train families`. frames, height, width: trained length and size in pixels, left out as the base has them.
    """

    base: Literal["driving-small", "svd-14", "small"] = "driving-small"
    prediction: Literal["v", "x0"] | None = None
    weights: str | None = None
    family: str = "driving"
    frames: Count | None = None
    height: Count | None = None
    width: Count | None = None
    unet: UNetChanges = UNetChanges()
    vae: VAEChanges = VAEChanges()
