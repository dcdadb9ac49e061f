"""How long a scene is learnt, and in how much detail."""

from dataclasses import dataclass
from itertools import pairwise

from gcd_train.errors import RecipeError


@dataclass(frozen=True, kw_only=True, slots=True)
class HexPlaneSettings:
    """Everything that decides what is learnt of one clip, and what it costs.

    updates, rays: steps of the optimiser, and rays in each; the time of a clip is about their product.
    coarse, fine: samples along a ray that look for surfaces, and that are learnt from.
    features: channels of each plane. hidden: width of the heads.
    sides: cells along each axis of space, coarse to fine; each has its equal share of the updates.
    plane_rate, head_rate: learning rates of the first update; both fall to a tenth.
    smoothness: weight of the squared differences between neighbouring cells.
    picture_width: pictures are made this narrow, in pixels, before learning and drawing; views are scaled back up.
    """

    updates: int = 1000
    rays: int = 1024
    coarse: int = 48
    fine: int = 24
    features: int = 16
    hidden: int = 64
    sides: tuple[int, ...] = (24, 48, 96)
    plane_rate: float = 0.06
    head_rate: float = 0.01
    smoothness: float = 0.03
    picture_width: int = 192

    def __post_init__(self) -> None:
        counts = (self.updates, self.rays, self.features, self.hidden, self.picture_width)
        if min(counts) < 1 or min(self.coarse, self.fine) < 2:
            raise RecipeError(f"HexPlane wants counts above 0 and 2 samples or more along a ray, got {self}")
        if not self.sides or self.sides[0] < 2 or any(after <= before for before, after in pairwise(self.sides)):
            raise RecipeError(f"sides of the planes rise from 2 or more cells, got {self.sides}")
