"""From the pixels of one camera to the picture of another, in one step.

A pixel (u, v) at depth z falls at z (A (u, v, 1)) + b, with one matrix A and one vector b for the two cameras, so no
points in the world are ever stored.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.pointcloud.unproject import tangents

Doubles = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class PixelMap:
    """The map between two cameras.

        (x, y, ahead) = z (across[u] + along[v]) + offset,    target pixel = (x / ahead + cx, y / ahead + cy)

    across: [W, 3] and along: [H, 3], of the source's columns and rows. offset: [3], the source's camera itself.
    float64; x and y are counted from the target's principal point, where float32 will be finest.
    """

    across: Doubles
    along: Doubles
    offset: Doubles

    @classmethod
    def between(
        cls,
        world_from_source: Doubles,
        source: Intrinsics,
        world_from_target: Doubles,
        target: Intrinsics,
        pixel_centre: float,
    ) -> Self:
        """From a camera with the lens `source` to one with the lens `target`; poses are [4, 4], metres."""
        target_from_source = np.linalg.inv(world_from_target) @ world_from_source
        pixels_from_source = np.diag([target.fx, target.fy, 1.0]) @ target_from_source[:3]
        right, down = tangents(source, pixel_centre)
        return cls(
            across=right[:, None] * pixels_from_source[:, 0],
            along=down[:, None] * pixels_from_source[:, 1] + pixels_from_source[:, 2],
            offset=pixels_from_source[:, 3],
        )
