"""All networks of one checkpoint in one description: what travels as JSON in the metadata of our weight files."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gcd_model.config.networks import ImageEncoderConfig, SamplingConfig, UNetConfig, VAEConfig
from gcd_model.errors import OptionError

CameraControl = Literal["spherical", "relative_pose", "none"]

Prediction = Literal["v", "x0"]
"""What the U-Net's output stands for: the published v, or the clean latents themselves."""

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
        if self.unet.condition_channels < self.vae.latent_channels:
            raise OptionError(f"condition_channels must hold {self.vae.latent_channels} source latent channels")
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

    @property
    def extra_condition_channels(self) -> int:
        """Condition channels beyond the source latents: the caller brings them."""
        return self.unet.condition_channels - self.vae.latent_channels
