"""Which networks a run trains."""

from typing import Literal, TypeAlias

import msgspec

from gcd_model.config import CameraControl
from gcd_train.recipe.values import Count, Positive

TrainedPart: TypeAlias = Literal["all", "temporal", "lora"]


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
    scale: Positive | None = None
    shared: bool | None = None
    linear: bool | None = None


class LoraRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Low-rank adapters on the U-Net's attention and feed-forward layers; see gcd_train.lora.

    rank: inner width. alpha: the adapter counts alpha / rank times; left out, as much as rank.
    stem: train the U-Net's first convolution in full, too. camera: the camera embedder and its layers in the U-Net.
    """

    rank: Count = 32
    alpha: Positive | None = None
    stem: bool = False
    camera: bool = True


class ModelRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which networks: a named set-up, and what differs; where they start, and which part of them is trained.

    camera: how the network is steered; left out as the base has it, for the paper's networks as the family has it.
    prediction: what the network says, left out as the base has it; "v" is the paper's. steps: of the sampler that
    ships, left out as the base has it.
    weights: a weight file to start from, of any layout; left out, everything starts at random. scratch: take the
    autoencoder and the image tower from it alone; the U-Net and what steers it start at random. See gcd_train.start.
    train: what the U-Net stage trains: "all" of the U-Net and what steers it, as published; "temporal", of the U-Net
    only what works across frames; "lora", adapters as [model.lora] says. family: how it is used, see
    `gcd-train families`. frames, height, width: trained length and size in pixels, left out as the base has them.
    """

    base: Literal["plain-small", "svd-14", "small"] = "plain-small"
    camera: CameraControl | None = None
    prediction: Literal["v", "x0"] | None = None
    steps: Count | None = None
    weights: str | None = None
    scratch: bool = False
    train: TrainedPart = "all"
    lora: LoraRecipe = LoraRecipe()
    family: str = "driving"
    frames: Count | None = None
    height: Count | None = None
    width: Count | None = None
    unet: UNetChanges = UNetChanges()
    vae: VAEChanges = VAEChanges()

    def __post_init__(self) -> None:
        if self.train == "lora" and (self.weights is None or self.scratch):
            raise ValueError('model.train "lora" adds to a trained U-Net: give model.weights, and leave scratch out')
