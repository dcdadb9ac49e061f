"""Shapes of the networks the paper uses, and how they are sampled."""

from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

from gcd_model.errors import OptionError

Width: TypeAlias = Annotated[int, Meta(ge=1, le=1 << 16)]
Few: TypeAlias = Annotated[int, Meta(ge=1, le=256)]
"""Limits for configs that files state: a network is built from them before a single weight is compared."""


def require_multiple(what: str, width: int, of: str, divisor: int) -> None:
    """Raises OptionError unless `width` is a multiple of `divisor`; `what` and `of` are their names in the message."""
    if width % divisor:
        raise OptionError(f"{what} is {width} wide, which is no multiple of {of} = {divisor}")


class UNetConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shape of the video U-Net.

    condition_channels: channels joined to the noisy latents: the source latents, then any extra ones.
    attention: for each level, shallowest first, whether it has transformers; the middle always has one.
    context_width: width of the image token; None leaves cross-attention out.
    vector_width: width of the micro-conditioning vector. camera_width: of the camera vector, 0 for none.
    """

    latent_channels: Width = 4
    condition_channels: Width = 4
    width: Width = 320
    multipliers: Annotated[tuple[Few, ...], Meta(min_length=1, max_length=8)] = (1, 2, 4, 4)
    attention: Annotated[tuple[bool, ...], Meta(max_length=8)] = (True, True, True, False)
    blocks_per_level: Few = 2
    embedding_width: Width = 1280
    head_width: Width = 64
    context_width: Width | None = 1024
    vector_width: Width = 768
    camera_width: Annotated[int, Meta(ge=0, le=1 << 16)] = 128
    norm_groups: Width = 32

    def __post_init__(self) -> None:
        if len(self.attention) != len(self.multipliers):
            raise OptionError(f"attention names {len(self.attention)} levels, multipliers {len(self.multipliers)}")
        if self.vector_width % 3:
            raise OptionError(
                f"vector_width holds fps, motion and augmentation: {self.vector_width} is no multiple of 3"
            )
        for multiplier in self.multipliers:
            require_multiple("a U-Net level", self.width * multiplier, "norm_groups", self.norm_groups)
        for multiplier, attends in zip(self.multipliers, self.attention, strict=True):
            if attends or multiplier == self.multipliers[-1]:
                require_multiple("an attention level", self.width * multiplier, "head_width", self.head_width)

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of each level."""
        return tuple(self.width * multiplier for multiplier in self.multipliers)

    @property
    def size_factor(self) -> int:
        """Latent height and width must be multiples of this."""
        return 2 ** (len(self.multipliers) - 1)


class VAEConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shape of the autoencoders.

    shared: one encoder serves condition and target frames, and it has the 1x1 quant convolution.
    Otherwise two encoders exist: the condition encoder (with quant convolution) and the target encoder (without).
    scale: latents the U-Net works on are this times what the target encoder gives.
    patch: pixels along each side that become channels before the first and after the last layer; 1 as published.
    linear: a linear map from each block of down_factor x down_factor pixels to its latent, and one back, beside the
        convolutions; ours, so that a small autoencoder starts from principal components instead of from nothing.
    """

    latent_channels: Width = 4
    width: Width = 128
    multipliers: Annotated[tuple[Few, ...], Meta(min_length=1, max_length=8)] = (1, 2, 4, 4)
    blocks_per_level: Few = 2
    norm_groups: Width = 32
    scale: float = 0.18215
    shared: bool = False
    patch: Few = 1
    linear: bool = False

    def __post_init__(self) -> None:
        require_multiple("the VAE", self.width, "norm_groups", self.norm_groups)
        if self.patch < 1:
            raise OptionError(f"the VAE's patch must be at least 1 pixel, got {self.patch}")

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of each level."""
        return tuple(self.width * multiplier for multiplier in self.multipliers)

    @property
    def down_factor(self) -> int:
        """Pixels per latent along each side."""
        return self.patch * 2 ** (len(self.multipliers) - 1)


class ImageEncoderConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shape of the CLIP image tower; the defaults are ViT-H/14."""

    image_size: Width = 224
    patch: Width = 14
    width: Width = 1280
    layers: Few = 32
    heads: Width = 16
    hidden_width: Width = 5120
    output_width: Width = 1024

    def __post_init__(self) -> None:
        require_multiple("the image tower", self.width, "heads", self.heads)

    @property
    def tokens(self) -> int:
        """Patches and the class token."""
        return (self.image_size // self.patch) ** 2 + 1


class SamplingConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the checkpoint is meant to be sampled (EDM schedule, guidance of the first and the last frame).

    shared_noise: one draw serves all frames of a clip, which keeps a small network from flickering.
    augmentation: strength of the noise on the source frames the VAE sees, where the caller names none.
    """

    steps: Annotated[int, Meta(ge=1, le=1000)] = 25
    sigma_max: float = 700.0
    sigma_min: float = 0.002
    rho: float = 7.0
    guidance: tuple[float, float] = (1.0, 1.5)
    shared_noise: bool = False
    augmentation: float = 0.02
