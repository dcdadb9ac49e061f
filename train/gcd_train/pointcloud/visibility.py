"""What of a target picture the source camera saw too."""

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.errors import DataError
from gcd_train.pointcloud.options import SplatOptions
from gcd_train.pointcloud.pixel_map import Doubles, PixelMap
from gcd_train.pointcloud.published import published_tensor
from gcd_train.pointcloud.unproject import Floats

_BLACK = 1e-7
_KERNEL, _SIGMA = 3, 0.75
_NEAREST_M = 0.1  # in front of the source camera


def visibility(
    source: SceneView,
    world_from_camera: Doubles,
    lens: Intrinsics,
    *,
    width: int = 384,
    height: int = 256,
    options: SplatOptions | None = None,
) -> NDArray[np.bool_]:
    """Where the source view alone, drawn as another camera sees it, shows anything: the published rule.

    Whether the target shows the same thing there is not asked, and what is black counts as hidden.

    Args:
        source: with depth. world_from_camera, lens, width, height, options: see published_tensor().
    Returns:
        bool [height, width]; the complement counts as occluded.
    Source: Generative Camera Dolly, evaluation as released: holes are filled over 3 pixels, not 21.
    """
    shown = published_tensor(
        [source],
        world_from_camera,
        lens,
        width=width,
        height=height,
        options=options,
        kernel=_KERNEL,
        sigma=_SIGMA,
    )
    return (shown.sum(-1) > _BLACK).numpy()


def depth_visibility(
    source: SceneView, target_depth: Floats, world_from_camera: Doubles, lens: Intrinsics, *, tolerance: float = 0.02
) -> NDArray[np.bool_]:
    """Where the source camera saw the very surface that the target shows.

    Each target pixel is looked up in the source's depth: at one of the four pixels around, or between them, where
    inverse depth is interpolated, as planes have it.

    Args:
        source: with depth. target_depth: f32 [H, W], planar, metres, 0 where nothing is known.
        world_from_camera, lens: of the target. tolerance: share of the depth by which the two may differ.
    Returns:
        bool [H, W]; False where either depth is not known.
    Raises:
        DataError: the target's depth and lens are of different sizes.
    """
    if target_depth.shape != (lens.height, lens.width):
        raise DataError(
            f"the target's depth must be {lens.width} x {lens.height} as its lens says, got {target_depth.shape[::-1]}"
        )
    pixels = PixelMap.between(world_from_camera, lens, source.world_from_camera, source.lens, 0.5)
    rays = pixels.across[None] + pixels.along[:, None]  # [H, W, 3]
    x, y, ahead = np.moveaxis(target_depth[..., None] * rays + pixels.offset, -1, 0)
    met = (target_depth > 0.0) & (ahead > _NEAREST_M)
    column = x / np.where(met, ahead, 1.0) + source.lens.cx
    row = y / np.where(met, ahead, 1.0) + source.lens.cy
    met &= (column >= 0) & (column < source.lens.width) & (row >= 0) & (row < source.lens.height)
    agrees = np.zeros(met.shape, np.bool_)
    agrees[met] = _agrees(source.depth, column[met], row[met], ahead[met], tolerance)
    return agrees


def _agrees(depth: Floats, column: Doubles, row: Doubles, wanted: Doubles, tolerance: float) -> NDArray[np.bool_]:
    """[M]: whether a depth picture has the wanted depths at these places, counted from its corner."""
    left, top = np.floor(column - 0.5).astype(np.intp), np.floor(row - 0.5).astype(np.intp)
    right_share, lower_share = column - 0.5 - left, row - 0.5 - top
    found = np.zeros(len(wanted), np.bool_)
    inverse, weight = np.zeros(len(wanted)), np.zeros(len(wanted))
    for right in (0, 1):
        for lower in (0, 1):
            at = np.clip(top + lower, 0, depth.shape[0] - 1), np.clip(left + right, 0, depth.shape[1] - 1)
            near = depth[at].astype(np.float64)
            share = np.abs(1 - right - right_share) * np.abs(1 - lower - lower_share) * (near > 0)
            inverse += share / np.where(near > 0, near, 1.0)
            weight += share
            found |= np.abs(near - wanted) <= tolerance * wanted
    between = weight / np.where(inverse > 0, inverse, 1.0)
    return found | ((inverse > 0) & (np.abs(between - wanted) <= tolerance * wanted))
