"""What a network looks like: frozen descriptions, one constant per named set-up.

These travel as JSON in the metadata of our own weight files, hence `msgspec.Struct`.
Longer than other files so that all that a weight file can say about its networks stands in one place.
"""

from typing import Literal

import msgspec

from gcd_model.errors import OptionError

CameraControl = Literal["spherical", "relative_pose", "none"]

Prediction = Literal["v", "x0"]
"""What the U-Net's output stands for: the published v, or the clean latents themselves."""

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
    patch: pixels along each side that become channels before the first and after the last layer; 1 as published.
    linear: a linear map from each block of down_factor x down_factor pixels to its latent, and one back, beside the
        convolutions; ours, so that a small autoencoder starts from principal components instead of from nothing.
    """

    latent_channels: int = 4
    width: int = 128
    multipliers: tuple[int, ...] = (1, 2, 4, 4)
    blocks_per_level: int = 2
    norm_groups: int = 32
    scale: float = 0.18215
    shared: bool = False
    patch: int = 1
    linear: bool = False

    def __post_init__(self) -> None:
        _require_multiple("the VAE", self.width, "norm_groups", self.norm_groups)
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
    """How the checkpoint is meant to be sampled (EDM schedule, guidance of the first and the last frame).

    shared_noise: one draw serves all frames of a clip, which keeps a small network from flickering.
    augmentation: strength of the noise on the source frames the VAE sees, where the caller names none.
    """

    steps: int = 25
    sigma_max: float = 700.0
    sigma_min: float = 0.002
    rho: float = 7.0
    guidance: tuple[float, float] = (1.0, 1.5)
    shared_noise: bool = False
    augmentation: float = 0.02


class SemanticClass(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One entry of a class map's ontology; its id is its place in the list. colour: RGB, 0-255."""

    name: str
    colour: tuple[int, int, int]

    def __post_init__(self) -> None:
        if not all(0 <= channel <= 255 for channel in self.colour):
            raise OptionError(f"the colour of {self.name!r} must be RGB within 0-255, got {self.colour}")


class ClassHeadConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A class map beside the picture. Ours, not the paper's.

    width: hidden channels. upscale: class logits per latent along each side.
    """

    classes: tuple[SemanticClass, ...]
    width: int = 96
    upscale: int = 4
    norm_groups: int = 8

    def __post_init__(self) -> None:
        if not 2 <= len(self.classes) <= 256 or self.upscale < 1:
            raise OptionError(
                f"a class head takes 2 to 256 classes and an upscale of 1 or more, got {len(self.classes)} classes "
                f"and upscale {self.upscale}"
            )
        _require_multiple("the class head", self.width, "norm_groups", self.norm_groups)


class PlaneWarpConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The source as the target camera would see it if the world were made of known planes. Ours, not the paper's.

    hfov_deg: horizontal field of view of the trained source camera and of the target camera, degrees.
    position: trained mount of the source camera, which looks level along +x, metres in the vehicle's frame.
    side_walls_m: distances of wall pairs y = +-d. front_walls_m: of walls x = d. Both metres.
    """

    hfov_deg: float = 85.0
    position: tuple[float, float, float] = (1.6, 0.0, 1.55)
    side_walls_m: tuple[float, ...] = (5.5, 8.0, 11.0, 15.0)
    front_walls_m: tuple[float, ...] = (8.0, 12.0, 18.0, 27.0, 45.0)

    def __post_init__(self) -> None:
        if not 0.0 < self.hfov_deg < 180.0:
            raise OptionError(f"a horizontal field of view must lie between 0 and 180 degrees, got {self.hfov_deg:g}")
        if not all(distance > 0.0 for distance in (*self.side_walls_m, *self.front_walls_m)):
            raise OptionError("walls must stand at positive distances in metres")

    @property
    def layers(self) -> int:
        """Number of warps: ground, infinity, side wall pairs, front walls."""
        return 2 + len(self.side_walls_m) + len(self.front_walls_m)


class PlaneMixConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A small network that chooses, pixel by pixel, between warps and the decoded picture. Ours, not the paper's.

    width: hidden channels. dilations: of its residual blocks, one each.
    """

    width: int = 64
    dilations: tuple[int, ...] = (1, 2, 4, 1)
    norm_groups: int = 8

    def __post_init__(self) -> None:
        _require_multiple("the plane mix", self.width, "2 * norm_groups", 2 * self.norm_groups)


def warp_channels(config: PlaneWarpConfig | None, down_factor: int) -> int:
    """Condition channels the plane warps fill on a latent grid `down_factor` times coarser than the picture.

    Source and ground warp at half size, infinity and side walls at quarter size, all with pixels moved into channels,
    and 4 numbers of the ray; 0 without warps.
    """
    if config is None:
        return 0
    half, quarter = (down_factor // 2) ** 2, (down_factor // 4) ** 2
    return 3 * (2 * half + (1 + len(config.side_walls_m)) * quarter) + 4


class ModelConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All networks of one checkpoint.

    frames: T. height, width: the trained size in pixels.
    image_encoder: None for a model without image token.
    prediction, plane_warp, plane_mix, class_head, vae.patch, vae.linear, sampling.shared_noise: ours, for small models;
        as they are here the model is the paper's.
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
            or self.sampling.shared_noise
        )

    @property
    def extra_condition_channels(self) -> int:
        """Condition channels beyond the source latents and the plane warps: the caller brings them."""
        own = self.vae.latent_channels + warp_channels(self.plane_warp, self.vae.down_factor)
        return self.unet.condition_channels - own


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

DRIVING_SMALL = ModelConfig(
    height=128,
    width=192,
    camera="none",
    unet=UNetConfig(
        latent_channels=12,
        condition_channels=12 + warp_channels(PlaneWarpConfig(), 8),
        width=48,
        multipliers=(1, 2, 3),
        attention=(False, False, True),
        blocks_per_level=1,
        embedding_width=192,
        head_width=48,
        context_width=None,
        vector_width=96,
        camera_width=0,
        norm_groups=8,
    ),
    vae=VAEConfig(
        latent_channels=12,
        width=32,
        multipliers=(1, 2, 3),
        blocks_per_level=1,
        norm_groups=8,
        scale=1.0,
        shared=True,
        patch=2,
        linear=True,
    ),
    image_encoder=None,
    sampling=SamplingConfig(
        steps=1, sigma_max=80.0, sigma_min=0.6, guidance=(1.0, 1.0), shared_noise=True, augmentation=0.0
    ),
    prediction="x0",
    plane_warp=PlaneWarpConfig(),
    plane_mix=PlaneMixConfig(),
    class_head=ClassHeadConfig(classes=DRIVING_CLASSES),
)
"""A top-down view of the road at widths that are trained on a CPU in hours; with all switches that are ours."""
