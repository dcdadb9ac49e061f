"""All networks of one checkpoint in one description: what travels as JSON in the metadata of our weight files."""

from typing import Literal

import msgspec

from gcd_model.config.networks import ImageEncoderConfig, SamplingConfig, UNetConfig, VAEConfig
from gcd_model.config.switches import (
    ClassHeadConfig,
    PlaneMixConfig,
    PlaneWarpConfig,
    SemanticClass,
    require_ontology,
    warp_channels,
)
from gcd_model.errors import OptionError

CameraControl = Literal["spherical", "relative_pose", "none"]

Prediction = Literal["v", "x0"]
"""What the U-Net's output stands for: the published v, or the clean latents themselves."""

CAMERA_FEATURES: dict[CameraControl, int] = {"spherical": 13, "relative_pose": 12, "none": 0}
"""Numbers per frame that describe the camera to the network."""


class ModelConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All networks of one checkpoint.

    frames: T. height, width: the trained size in pixels.
    image_encoder: None for a model without image token.
    semantic_classes: the colours a semantic model paints its pictures in, by class id; views then come with class maps.
        Empty where nobody named them. Not together with a class head, which makes class maps of its own.
    prediction, plane_warp, plane_mix, class_head, vae.patch, vae.linear, vae.coarse, sampling.shared_noise: ours, for
        small models; as they are here the model is the paper's.
    """

    frames: int = 14
    height: int = 256
    width: int = 384
    camera: CameraControl = "spherical"
    unet: UNetConfig = UNetConfig()
    vae: VAEConfig = VAEConfig()
    image_encoder: ImageEncoderConfig | None = ImageEncoderConfig()
    sampling: SamplingConfig = SamplingConfig()
    prediction: Prediction = "v"
    plane_warp: PlaneWarpConfig | None = None
    plane_mix: PlaneMixConfig | None = None
    class_head: ClassHeadConfig | None = None
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
        self._require_room_for_warps()
        self._require_one_ontology()

    def _require_room_for_warps(self) -> None:
        if self.plane_warp is None:
            if self.plane_mix is not None:
                raise OptionError("plane_mix chooses between warps: it needs plane_warp")
            return
        if self.vae.down_factor % 4:
            raise OptionError(f"plane_warp needs 4, 8, ... pixels per latent, the VAE has {self.vae.down_factor}")
        if self.extra_condition_channels != 0:
            wanted = self.vae.latent_channels + warp_channels(self.plane_warp, self.vae.down_factor)
            raise OptionError(
                f"with plane_warp condition_channels must be {wanted}, got {self.unet.condition_channels}"
            )

    def _require_one_ontology(self) -> None:
        if not self.semantic_classes:
            return
        if self.class_head is not None:
            raise OptionError("a model paints its classes or has a class head, not both: leave semantic_classes out")
        require_ontology("semantic_classes", self.semantic_classes)

    @property
    def size_factor(self) -> int:
        """Height and width in pixels must be multiples of this."""
        return self.vae.down_factor * self.unet.size_factor

    @property
    def is_ours(self) -> bool:
        """Whether any of the switches is on that the paper's model does not have."""
        return (
            self.prediction != "v"
            or self.plane_warp is not None
            or self.class_head is not None
            or self.vae.patch > 1
            or self.vae.linear
            or self.vae.left_out > 0
            or self.sampling.shared_noise
        )

    @property
    def extra_condition_channels(self) -> int:
        """Condition channels beyond the source latents and the plane warps: the caller brings them."""
        own = self.vae.latent_channels + warp_channels(self.plane_warp, self.vae.down_factor)
        return self.unet.condition_channels - own
