"""What networks look like: frozen descriptions, and one constant for each named set-up.

These travel as JSON in the metadata of our own weight files, hence `msgspec.Struct`.
"""

from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta
from msgspec.structs import replace

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

    condition_channels: channels that are joined to the noisy latents: the source latents, then a splat's, see
        `with_splat`.
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


# --- all networks of one checkpoint ----------------------------------------------------------------------------------


CameraControl = Literal["spherical", "relative_pose", "none"]

Prediction = Literal["v", "x0"]
"""What the U-Net's output stands for: the published v, or the clean latents themselves."""

SplatDepth = Literal["none", "given", "estimated"]
"""Whether a model is shown the source's points from the view's camera, and where their depth is from."""

CAMERA_FEATURES: dict[CameraControl, int] = {"spherical": 13, "relative_pose": 12, "none": 0}
"""Numbers per frame that describe the camera to the network."""


class SemanticClass(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One entry of a class map's ontology; its id is its place in the list. colour: RGB, 0-255."""

    name: str
    colour: tuple[int, int, int]

    def __post_init__(self) -> None:
        if not all(0 <= channel <= 255 for channel in self.colour):
            raise OptionError(f"the colour of {self.name!r} must be RGB within 0-255, got {self.colour}")


def require_ontology(what: str, classes: tuple[SemanticClass, ...]) -> None:
    """Raises OptionError unless pixels can be told apart by these classes: 2 to 256 of them, no colour twice."""
    if not 2 <= len(classes) <= 256:
        raise OptionError(f"{what} takes 2 to 256 classes, got {len(classes)}")
    if len({entry.colour for entry in classes}) < len(classes):
        raise OptionError(f"{what} must give every class a colour of its own")


class ModelConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All networks of one checkpoint.

    frames: T. height, width: the trained size in pixels.
    image_encoder: None for a model without image token.
    semantic_classes: the colours a semantic model paints its pictures in, by class id; views then come with class maps.
        Empty where nobody named them.
    splat: ours; what the view's camera sees of the source's points is a condition beside the source latents, with the
        clip's depth ("given") or, where it has none, with the packaged live model's ("estimated").
    prediction, vae.patch, vae.linear, sampling.shared_noise: ours, for small models; as they are here the model is the
        paper's.
    """

    frames: Annotated[int, Meta(ge=1, le=1000)] = 14
    height: Annotated[int, Meta(ge=1, le=1 << 14)] = 256
    width: Annotated[int, Meta(ge=1, le=1 << 14)] = 384
    camera: CameraControl = "spherical"
    unet: UNetConfig = UNetConfig()
    vae: VAEConfig = VAEConfig()
    image_encoder: ImageEncoderConfig | None = ImageEncoderConfig()
    sampling: SamplingConfig = SamplingConfig()
    splat: SplatDepth = "none"
    prediction: Prediction = "v"
    semantic_classes: tuple[SemanticClass, ...] = ()

    def __post_init__(self) -> None:
        if (self.camera == "none") != (self.unet.camera_width == 0):
            raise OptionError(f"camera control {self.camera!r} contradicts camera_width {self.unet.camera_width}")
        token = None if self.image_encoder is None else self.image_encoder.output_width
        if token != self.unet.context_width:
            raise OptionError(f"the image tower gives width {token}, the U-Net wants {self.unet.context_width}")
        if self.unet.latent_channels != self.vae.latent_channels:
            raise OptionError(f"latent channels: U-Net {self.unet.latent_channels}, VAE {self.vae.latent_channels}")
        latents = self.vae.latent_channels
        if self.unet.condition_channels != (latents if self.splat == "none" else 2 * latents + 1):
            raise OptionError(
                f"condition_channels must be {latents} of the source latents and {latents + 1} of a splat, got "
                f"{self.unet.condition_channels} with splat = {self.splat!r}"
            )
        if self.semantic_classes:
            require_ontology("semantic_classes", self.semantic_classes)

    @property
    def size_factor(self) -> int:
        """Height and width in pixels must be multiples of this."""
        return self.vae.down_factor * self.unet.size_factor

    @property
    def is_ours(self) -> bool:
        """Whether any of the switches is on that the paper's model does not have."""
        vae = self.vae
        return self.prediction != "v" or vae.patch > 1 or vae.linear or self.sampling.shared_noise


def with_splat(config: ModelConfig, splat: SplatDepth) -> ModelConfig:
    """The same model with a splat, or without: latents of the picture of its points, and how much they cover."""
    channels = config.vae.latent_channels
    unet = replace(config.unet, condition_channels=channels if splat == "none" else 2 * channels + 1)
    return replace(config, splat=splat, unet=unet)


# --- named set-ups ---------------------------------------------------------------------------------------------------


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
"""The same model at widths a CPU runs in a second: for `random:FAMILY`, and for tests."""

DRIVING_CLASSES = (
    SemanticClass(name="sky", colour=(122, 176, 230)),
    SemanticClass(name="road", colour=(92, 88, 104)),
    SemanticClass(name="lane_marking", colour=(246, 240, 196)),
    SemanticClass(name="pavement", colour=(214, 140, 190)),
    SemanticClass(name="terrain", colour=(150, 196, 104)),
    SemanticClass(name="building", colour=(156, 110, 84)),
    SemanticClass(name="vegetation", colour=(36, 112, 62)),
    SemanticClass(name="pole", colour=(232, 196, 40)),
    SemanticClass(name="car", colour=(38, 76, 214)),
    SemanticClass(name="truck", colour=(16, 186, 196)),
    SemanticClass(name="cyclist", colour=(158, 40, 150)),
    SemanticClass(name="person", colour=(226, 44, 52)),
    SemanticClass(name="own_car", colour=(255, 128, 16)),
)
"""Ontology of our procedural driving world, by id."""

PLAIN_SMALL = ModelConfig(
    height=128,
    width=192,
    camera="none",
    unet=replace(
        SMALL.unet,
        latent_channels=12,
        condition_channels=12,
        width=48,
        attention=(False, False, True),
        embedding_width=192,
        head_width=48,
        context_width=None,
        camera_width=0,
    ),
    vae=replace(
        SMALL.vae,
        latent_channels=12,
        width=32,
        multipliers=(1, 2, 3),
        scale=1.0,
        shared=True,
        patch=2,
        linear=True,
    ),
    image_encoder=None,
    sampling=SamplingConfig(
        steps=4, sigma_max=80.0, sigma_min=0.3, guidance=(1.0, 1.0), shared_noise=True, augmentation=0.0
    ),
    prediction="x0",
)
"""The paper's model at widths that are trained on a CPU in hours: for studies of its findings, and for tests. Ours are
x0-prediction, one noise for all frames and the autoencoder. It takes no camera command: one path."""
