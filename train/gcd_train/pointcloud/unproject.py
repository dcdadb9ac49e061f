"""From depth pictures to points in space."""

import math

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError
from gcd_train.pointcloud.options import SplatOptions

Floats = NDArray[np.float32]


def planar_from_distance(distance: Floats, lens: Intrinsics, *, published: bool = False) -> Floats:
    """Depth along the optical axis from the distance to the camera's centre.

        z = distance / |((u - cx) / fx, (v - cy) / fy, 1)|        through the middles of the pixels

    Args:
        distance: f32 [H, W], metres. lens: of the same picture, pixels.
        published: as released: tangents of angles that are evenly spaced from edge to edge instead. Exact in the centre
            and in the corners, up to 0.5 % off between (at 53 degrees).
    Returns:
        f32 [H, W], metres; whatever is not known stays as it is.
    Raises:
        DataError: the lens is another picture's.
    Source: Generative Camera Dolly, Kubric-4D; Kubric's depth is the distance.
    """
    _require_size(distance, lens)
    right, down = _tangents_of_even_angles(lens) if published else tangents(lens, 0.5)
    lengths = np.sqrt(1.0 + right[None, :] ** 2 + down[:, None] ** 2)  # [H, W]
    return distance / lengths.astype(np.float32)


def unproject(view: SceneView, *, published: bool = False) -> Floats:
    """The points a view sees.

    Args:
        view: with its depth. published: whole pixel numbers, without the half that leads to their middles.
    Returns:
        f32 [H, W, 3] in the world, metres; NaN where the depth is 0, not finite or absurd.
    Raises:
        DataError: depth and lens are of different sizes.
    """
    _require_size(view.depth, view.lens)
    right, down = tangents(view.lens, 0.0 if published else 0.5)
    known = np.where(is_known(view.depth, SplatOptions().farthest_m), view.depth, np.nan)
    turn, position = view.world_from_camera[:3, :3], view.world_from_camera[:3, 3]
    rays = turn[:, 0] * right[None, :, None] + turn[:, 1] * down[:, None, None] + turn[:, 2]  # [H, W, 3]
    return (known[..., None] * rays + position).astype(np.float32)


def is_known(depth: Floats, farthest_m: float) -> NDArray[np.bool_]:
    """Where a depth is one: positive, a number, and not beyond what any scene has."""
    return (depth > 0.0) & (depth <= farthest_m)


def tangents(lens: Intrinsics, pixel_centre: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far the rays of all columns go to the right, [W], and of all rows down, [H], for 1 ahead."""
    right = (np.arange(lens.width, dtype=np.float64) + pixel_centre - lens.cx) / lens.fx
    down = (np.arange(lens.height, dtype=np.float64) + pixel_centre - lens.cy) / lens.fy
    return right, down


def _tangents_of_even_angles(lens: Intrinsics) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    across, along = math.radians(lens.hfov_deg) / 2, math.radians(lens.vfov_deg) / 2
    right = np.linspace(-across, across, lens.width, dtype=np.float64)
    down = np.linspace(-along, along, lens.height, dtype=np.float64)
    return np.tan(right), np.tan(down)


def _require_size(depth: Floats, lens: Intrinsics) -> None:
    if depth.shape != (lens.height, lens.width):
        raise DataError(
            f"a depth picture must be of its lens's size, {lens.width} x {lens.height}, got {list(depth.shape)[::-1]}; "
            "resize the lens with the picture"
        )
