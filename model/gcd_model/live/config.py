"""What the live model's networks are built from."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gcd_model.config import SemanticClass
from gcd_model.live.ontology import LIVE_CLASSES

Widths = tuple[int, int, int]
"""Channels at a quarter, an eighth and a sixteenth of the picture's size."""


class DepthConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The depth network. bins are even in the logarithm from nearest_m to farthest_m; the last one is the sky."""

    widths: Widths = (48, 96, 160)
    fine_width: int = 24
    bins: Annotated[int, Meta(ge=4)] = 32
    nearest_m: float = 0.25
    farthest_m: float = 256.0


class PaintConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The paint network. embedding_width: of the noise level."""

    widths: Widths = (56, 104, 160)
    fine_width: int = 16
    embedding_width: int = 128


class LiveConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The live model.

    height, width: of the training; any multiples of 32 work. frames: of a window. memory: remembered surfels at most.
    memory_frames: for how long. steps, sigma_max, sigma_min: of the paint sampler; one step paints the mean.
    """

    kind: Literal["live"] = "live"
    frames: int = 14
    height: int = 128
    width: int = 192
    classes: tuple[SemanticClass, ...] = LIVE_CLASSES
    depth: DepthConfig = DepthConfig()
    paint: PaintConfig = PaintConfig()
    memory: Annotated[int, Meta(ge=0)] = 60_000
    memory_frames: Annotated[int, Meta(ge=0)] = 50
    steps: Annotated[int, Meta(ge=1)] = 1
    sigma_max: float = 80.0
    sigma_start: float = 2.0
    sigma_min: float = 0.05
    spread_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
