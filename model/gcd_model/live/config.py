"""What the live model's networks are built from."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gcd_model.config import DRIVING_CLASSES, CameraControl, SamplingConfig, SemanticClass, require_ontology
from gcd_model.errors import OptionError

Widths = Annotated[tuple[Annotated[int, Meta(ge=8, le=4096, multiple_of=8)], ...], Meta(min_length=2, max_length=4)]
"""Channels of the levels, each of half the size of the one before."""
SKY_M = 1000.0
"""Where the sky is put: no step of a robot moves it by a pixel."""
SIZE_FACTOR = 32
"""Height and width of pictures must be multiples of this."""
_Side = Annotated[int, Meta(ge=SIZE_FACTOR, le=8192, multiple_of=SIZE_FACTOR)]
_Sigma = Annotated[float, Meta(ge=1e-4, le=1e4)]
_MOST_PIXELS = 2**22
_Channels = Annotated[int, Meta(ge=8, le=4096)]
_HalfWidth = Annotated[int, Meta(ge=0, le=4096, multiple_of=8)]

LIVE_CLASSES = (
    *DRIVING_CLASSES,
    SemanticClass(name="background", colour=(176, 168, 158)),
    SemanticClass(name="table", colour=(196, 142, 92)),
    SemanticClass(name="robot", colour=(70, 70, 78)),
    SemanticClass(name="object", colour=(238, 92, 120)),
)
"""Ids of class maps: the driving world's thirteen, then what stands around a stage or a table."""


class DepthConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The depth network. bins are even in the logarithm from nearest_m to farthest_m; the last one is the sky.

    patch: side of the trunk's patches in pixels. mixers: transformer layers on its coarsest level. half_width:
    channels of the head at half the size, 0 for none.
    """

    patch: Literal[2, 4] = 4
    widths: Widths = (64, 128, 192)
    mixers: Annotated[int, Meta(ge=0, le=64)] = 2
    fine_width: _Channels = 24
    half_width: _HalfWidth = 32
    bins: Annotated[int, Meta(ge=4, le=1024)] = 32
    nearest_m: Annotated[float, Meta(ge=1e-3, le=100)] = 0.25
    farthest_m: Annotated[float, Meta(le=SKY_M)] = 256.0

    def __post_init__(self) -> None:
        if not self.farthest_m > self.nearest_m:
            raise OptionError(f"depth goes from near to far, got {self.nearest_m:g} to {self.farthest_m:g} m")


class PaintConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The paint network; see DepthConfig. embedding_width: of the noise level."""

    patch: Literal[2, 4] = 4
    widths: Widths = (56, 104, 160)
    fine_width: _Channels = 16
    half_width: _HalfWidth = 24
    embedding_width: _Channels = 128


class LiveConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The live model.

    height, width: of the training; any multiples of 32 work. frames: of a window. memory: remembered surfels at most.
    memory_frames: for how long. steps, sigma_max, sigma_min: of the paint sampler; one step paints the mean.
    carry_painted: what was painted is seen again in the next frame, as painted, so that it stays put.
    ood_threshold: a source whose `View.ood` is above it shows another world than the training's.
    """

    kind: Literal["live"] = "live"
    frames: Annotated[int, Meta(ge=1, le=1000)] = 14
    height: _Side = 128
    width: _Side = 192
    classes: tuple[SemanticClass, ...] = LIVE_CLASSES
    depth: DepthConfig = DepthConfig()
    paint: PaintConfig = PaintConfig()
    memory: Annotated[int, Meta(ge=0, le=10_000_000)] = 60_000
    memory_frames: Annotated[int, Meta(ge=0)] = 50
    steps: Annotated[int, Meta(ge=1, le=50)] = 1
    sigma_max: _Sigma = 80.0
    sigma_start: _Sigma = 2.0
    sigma_min: _Sigma = 0.05
    carry_painted: bool = True
    spread_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ood_threshold: Annotated[float, Meta(ge=0, le=1)] = 0.35

    def __post_init__(self) -> None:
        require_ontology("the live model", self.classes)
        if self.height * self.width > _MOST_PIXELS:
            raise OptionError(f"pictures have at most {_MOST_PIXELS} pixels, got {self.height} x {self.width}")

    @property
    def size_factor(self) -> int:
        """Height and width in pixels must be multiples of this."""
        return SIZE_FACTOR

    @property
    def camera(self) -> CameraControl:
        """How the views' camera is told."""
        return "relative_pose"

    @property
    def sampling(self) -> SamplingConfig:
        """How it paints, in the words of the diffusion models: no guidance, no noise on the source."""
        return SamplingConfig(
            steps=self.steps,
            sigma_max=self.sigma_max,
            sigma_min=self.sigma_min,
            guidance=(1.0, 1.0),
            shared_noise=True,
            augmentation=0.0,
        )


LIVE_TINY = LiveConfig(
    height=64,
    width=96,
    depth=DepthConfig(widths=(8, 16, 16), mixers=1, fine_width=8, half_width=8, bins=8),
    paint=PaintConfig(widths=(8, 16, 16), fine_width=8, half_width=8, embedding_width=16),
    memory=20_000,
)
"""For tests, and for random weights."""
