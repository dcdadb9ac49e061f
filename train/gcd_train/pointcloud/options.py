"""What a point renderer can be told."""

import math
from dataclasses import dataclass

from gcd_train.errors import RecipeError


@dataclass(frozen=True, kw_only=True, slots=True)
class SplatOptions:
    """How points become a picture. The defaults weigh as published, on exact pinhole geometry.

    radius: each point also shows in the pixels from -(radius // 2) to (radius + 1) // 2 about its own, both ways: 0 its
        own alone, 1 also right, below and below right, 2 all eight neighbours. neighbour_share: of its weight there.
    sharpness: k of the soft depth test, weight = exp(-k (2 d / d_max - 1)), d the depth, d_max the picture's largest.
    far_from_m: where d_max reaches this, d is min(sqrt(depth), far_limit) and k is far_sharpness.
    nearest_m: what is not beyond this in front of the target camera is left out. farthest_m: a source depth beyond this
        is taken for unknown.
    negligible: relative weight below which a point is left out before colours are gathered; 0 keeps all.
    published: pixels are whole numbers without the half that leads to their middles, in the source as in the target,
        and what lies up to a pixel beyond the left or upper edge falls on it. For comparing with the published clouds
        only: it shifts pictures that differ in size by part of a pixel.
    compact: forget points outside the picture at once, which on a GPU means to wait for it; None does so on the CPU
        only.
    Raises RecipeError for numbers that mean nothing.
    Source: Generative Camera Dolly, point renderer as released.
    """

    radius: int = 1
    neighbour_share: float = 0.02
    sharpness: float = 512.0
    far_from_m: float = 64.0
    far_sharpness: float = 256.0
    far_limit: float = 32.0
    nearest_m: float = 0.1
    farthest_m: float = 30_000.0
    negligible: float = 4e-8
    published: bool = False
    compact: bool | None = None

    def __post_init__(self) -> None:
        if self.radius < 0:
            raise RecipeError(f"a splat radius must be a whole number of pixels from 0 up, got {self.radius}")
        if not 0.0 < self.neighbour_share <= 1.0:
            raise RecipeError(f"a neighbour's share must lie above 0 and up to 1, got {self.neighbour_share:g}")
        if not 0.0 <= self.negligible < 1.0:
            raise RecipeError(f"a negligible weight must lie from 0 up and below 1, got {self.negligible:g}")
        lengths = (self.sharpness, self.far_from_m, self.far_sharpness, self.far_limit, self.nearest_m, self.farthest_m)
        if not all(math.isfinite(number) and number > 0.0 for number in lengths):
            raise RecipeError(f"sharpness and distances of a splat must be positive and finite, got {self}")

    @property
    def pixel_centre(self) -> float:
        """What leads from a pixel's number to where its ray goes, pixels."""
        return 0.0 if self.published else 0.5

    @property
    def offsets(self) -> range:
        """The pixels a point shows in, counted from its own, in either direction."""
        return range(-(self.radius // 2), (self.radius + 1) // 2 + 1)
