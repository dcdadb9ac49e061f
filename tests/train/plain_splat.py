"""The published point renderer written down again, slowly: float64, loops over pixels and taps, weights as they
are printed and not relative to anything. What the fast one is held against."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView

Array = NDArray[np.float64]


def plain_splat(
    views: Sequence[SceneView], world_from_camera: Array, lens: Intrinsics, *, radius: int, published: bool = False
) -> tuple[Array, Array]:
    """Colour float64 [H, W, 3] in 0..1 and the sum of weights [H, W]."""
    half = 0.0 if published else 0.5
    points = np.concatenate([plain_points(view, half) for view in views])
    rgb = np.concatenate([view.rgb.reshape(-1, 3) for view in views]) / 255.0
    in_camera = (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    depth = in_camera[:, 2]
    with np.errstate(all="ignore"):
        u = lens.fx * in_camera[:, 0] / depth + lens.cx
        v = lens.fy * in_camera[:, 1] / depth + lens.cy
    known = np.isfinite(points).all(-1) & (depth > 0.1)
    place = np.stack([u, v], -1)
    place = np.trunc(place[known] + 0.5) if published else np.floor(place[known])
    inside = (place >= 0).all(-1) & (place[:, 0] < lens.width) & (place[:, 1] < lens.height)
    column, row = place[inside].astype(int).T
    depth, rgb = depth[known][inside], rgb[known][inside]
    summed, total = np.zeros((lens.height, lens.width, 3)), np.zeros((lens.height, lens.width))
    if len(depth):
        weights = _weights(depth)
        for down in range(-(radius // 2), (radius + 1) // 2 + 1):
            for right in range(-(radius // 2), (radius + 1) // 2 + 1):
                share = weights * (1.0 if (down, right) == (0, 0) else 0.02)
                y, x = row + down, column + right
                fits = (y >= 0) & (x >= 0) & (y < lens.height) & (x < lens.width)
                np.add.at(total, (y[fits], x[fits]), share[fits])
                np.add.at(summed, (y[fits], x[fits]), share[fits, None] * rgb[fits])
    return np.where(total[..., None] > 0, summed / np.where(total > 0, total, 1.0)[..., None], 0.0), total


def plain_points(view: SceneView, half: float) -> Array:
    """World points of a view, one pixel after another, NaN where the depth is none."""
    height, width = view.depth.shape
    points = np.full((height, width, 3), np.nan)
    for row in range(height):
        for column in range(width):
            z = float(view.depth[row, column])
            if 0.0 < z <= 30_000.0:
                x = (column + half - view.lens.cx) / view.lens.fx * z
                y = (row + half - view.lens.cy) / view.lens.fy * z
                points[row, column] = view.world_from_camera[:3, :3] @ [x, y, z] + view.world_from_camera[:3, 3]
    return points.reshape(-1, 3)


def _weights(depth: Array) -> Array:
    d_max = depth.max()
    if d_max < 64.0:
        return np.exp(-512.0 * (2.0 * depth / d_max - 1.0))
    d = np.minimum(np.sqrt(depth), 32.0)
    return np.exp(-256.0 * (2.0 * d / d.max() - 1.0))
