"""What a network looks like: frozen descriptions, one constant per named set-up.

These travel as JSON in the metadata of our own weight files, hence `msgspec.Struct`.
"""

from typing import Literal

import msgspec

from gcd_model.errors import OptionError

CameraControl = Literal["spherical", "relative_pose", "none"]

CAMERA_FEATURES: dict[CameraControl, int] = {"spherical": 13, "relative_pose": 12, "none": 0}
"""Numbers per frame that describe the camera to the network."""


def _require_multiple(what: str, width: int, of: str, divisor: int) -> None:
    if width % divisor:
        raise OptionError(f"{what} is {width} wide, which is no multiple of {of} = {divisor}")


class UNetConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shape of the video U-Net.

    condition_channels: channels joined to the noisy latents: the source latents, then any extra ones.
    attention: for each level, shallowest first, whether it has transformers; the middle always has one.
    context_width: width of the image token; None leaves cross-attention out.
    vector_width: width of the micro-conditioning vector. camera_width: of the camera vector, 0 for none.
    """

    latent_channels: int = 4
    condition_channels: int = 4
    width: int = 320
    multipliers: tuple[int, ...] = (1, 2, 4, 4)
    attention: tuple[bool, ...] = (True, True, True, False)
    blocks_per_level: int = 2
    embedding_width: int = 1280
    head_width: int = 64
    context_width: int | None = 1024
    vector_width: int = 768
    camera_width: int = 128
    norm_groups: int = 32

    def __post_init__(self) -> None:
        if len(self.attention) != len(self.multipliers):
            raise OptionError(f"attention names {len(self.attention)} levels, multipliers {len(self.multipliers)}")
        if self.vector_width % 3:
            raise OptionError(
                f"vector_width holds fps, motion and augmentation: {self.vector_width} is no multiple of 3"
            )
        for multiplier in self.multipliers:
            _require_multiple("a U-Net level", self.width * multiplier, "norm_groups", self.norm_groups)
        for multiplier, attends in zip(self.multipliers, self.attention, strict=True):
            if attends or multiplier == self.multipliers[-1]:
                _require_multiple("an attention level", self.width * multiplier, "head_width", self.head_width)

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
    """

    latent_channels: int = 4
    width: int = 128
    multipliers: tuple[int, ...] = (1, 2, 4, 4)
    blocks_per_level: int = 2
    norm_groups: int = 32
    scale: float = 0.18215
    shared: bool = False

    def __post_init__(self) -> None:
        _require_multiple("the VAE", self.width, "norm_groups", self.norm_groups)

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of each level."""
        return tuple(self.width * multiplier for multiplier in self.multipliers)

    @property
    def down_factor(self) -> int:
        """Pixels per latent along each side."""
        return 2 ** (len(self.multipliers) - 1)


class ImageEncoderConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shape of the CLIP image tower; the defaults are ViT-H/14."""

    image_size: int = 224
    patch: int = 14
    width: int = 1280
    layers: int = 32
    heads: int = 16
    hidden_width: int = 5120
    output_width: int = 1024

    def __post_init__(self) -> None:
        _require_multiple("the image tower", self.width, "heads", self.heads)

    @property
    def tokens(self) -> int:
        """Patches and the class token."""
        return (self.image_size // self.patch) ** 2 + 1


class SamplingConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the checkpoint is meant to be sampled (EDM schedule, guidance of the first and the last frame)."""

    steps: int = 25
    sigma_max: float = 700.0
    sigma_min: float = 0.002
    rho: float = 7.0
    guidance: tuple[float, float] = (1.0, 1.5)


class ModelConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All networks of one checkpoint.

    frames: T. height, width: the trained size in pixels.
    image_encoder: None for a model without image token.
    """

    frames: int = 14
    height: int = 256
    width: int = 384
    camera: CameraControl = "spherical"
    unet: UNetConfig = UNetConfig()
    vae: VAEConfig = VAEConfig()
    image_encoder: ImageEncoderConfig | None = ImageEncoderConfig()
    sampling: SamplingConfig = SamplingConfig()

    def __post_init__(self) -> None:
        if (self.camera == "none") != (self.unet.camera_width == 0):
            raise OptionError(f"camera control {self.camera!r} contradicts camera_width {self.unet.camera_width}")
        token = None if self.image_encoder is None else self.image_encoder.output_width
        if token != self.unet.context_width:
            raise OptionError(f"the image tower gives width {token}, the U-Net wants {self.unet.context_width}")
        if self.unet.latent_channels != self.vae.latent_channels:
            raise OptionError(f"latent channels: U-Net {self.unet.latent_channels}, VAE {self.vae.latent_channels}")
        if self.extra_condition_channels < 0:
            raise OptionError(f"condition_channels must hold {self.vae.latent_channels} source latent channels")

    @property
    def size_factor(self) -> int:
        """Height and width in pixels must be multiples of this."""
        return self.vae.down_factor * self.unet.size_factor

    @property
    def extra_condition_channels(self) -> int:
        """Condition channels beyond the source latents."""
        return self.unet.condition_channels - self.vae.latent_channels


SVD_14 = ModelConfig()
"""Stable Video Diffusion, 14 frames, as Generative Camera Dolly finetunes it on Kubric-4D."""

SMALL = ModelConfig(
    height=128,
    width=192,
    unet=UNetConfig(
        width=32,
        multipliers=(1, 2, 3),
        attention=(False, True, True),
        blocks_per_level=1,
        embedding_width=128,
        head_width=32,
        context_width=64,
        vector_width=96,
        camera_width=32,
        norm_groups=8,
    ),
    vae=VAEConfig(width=16, multipliers=(1, 2, 3, 3), blocks_per_level=1, norm_groups=8),
    image_encoder=ImageEncoderConfig(
        image_size=56, patch=14, width=64, layers=2, heads=2, hidden_width=128, output_width=64
    ),
    sampling=SamplingConfig(steps=2),
)
"""The same model at widths a CPU runs in a second: for the demo until trained weights ship, and for tests."""
