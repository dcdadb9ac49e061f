"""Heights over the floor as a view sees them: a picture of what `gcd-node synthesize` wrote with `--depth`.

    python tools/height_picture.py OUT --hfov-deg 68 --frames 0,6,13 --picture heights.png

The floor is the plane on which most points of the last frame lie. Painted pixels are hatched. Prints the highest point
of each frame that is no speck. It shows depth alone, so a picture of it gives nobody's video away.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import hatched

Array = NDArray[np.float64]
_NEAR_FLOOR_M, _ROUNDS = 0.03, 400
_TALLEST_M, _SPECK_PX = 2.0, 40


def points_of(inverse: Array, hfov_deg: float) -> Array:
    """[H, W] of 1 / m -> [H, W, 3] metres in the camera's axes; NaN where nothing is."""
    height, width = inverse.shape
    focal = width / 2 / np.tan(np.radians(hfov_deg / 2))
    v, u = np.mgrid[:height, :width] + 0.5
    z = np.where(inverse > 1e-3, 1 / np.maximum(inverse, 1e-3), np.nan)
    return np.stack([(u - width / 2) / focal * z, (v - height / 2) / focal * z, z], axis=-1)


def floor_of(points: Array) -> tuple[Array, float]:
    """The commonest plane of points [N, 3]: its normal towards the camera and the camera's height over it."""
    random = np.random.default_rng(0)
    best, most = (np.array([0.0, -1.0, 0.0]), 1.0), 0
    for _ in range(_ROUNDS):
        a, b, c = points[random.integers(len(points), size=3)]
        normal = np.cross(b - a, c - a)
        if (size := float(np.linalg.norm(normal))) < 1e-6:
            continue
        normal *= -np.sign(normal @ a) / size
        count = int((np.abs((points - a) @ normal) < _NEAR_FLOOR_M).sum())
        if count > most:
            best, most = (normal, float(-normal @ a)), count
    return best


def heights_of(points: Array, floor: tuple[Array, float]) -> Array:
    """Of points [H, W, 3] over the floor, metres."""
    return points @ floor[0] + floor[1]


def shown(heights: Array, visibility: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours from blue, the floor, to red, two metres; what is painted is hatched: [H, W, 3] RGB."""
    level = np.nan_to_num(np.clip(heights / _TALLEST_M, 0, 1) * 255).astype(np.uint8)
    coloured = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    coloured[~np.isfinite(heights)] = 60
    return hatched(coloured[None], visibility[None])[0]


def highest(heights: Array, seen: NDArray[np.bool_]) -> float:
    """What at least so many seen pixels reach."""
    there = np.sort(heights[seen & np.isfinite(heights)])
    return float(there[-_SPECK_PX]) if len(there) >= _SPECK_PX else float("nan")


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="Heights over the floor as a view sees them.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--hfov-deg", type=float, required=True, help="of the view")
    parser.add_argument("--frames", default="0,6,13")
    parser.add_argument("--picture", type=Path, required=True)
    options = parser.parse_args()
    view = np.load(options.folder / "view.npz")
    inverse, visibility = view["inverse_depth"].astype(np.float64), view["visibility"]
    tiles = []
    for t in map(int, options.frames.split(",")):
        points, seen = points_of(inverse[t], options.hfov_deg), visibility[t] == 2
        heights = heights_of(points, floor_of(points[seen & np.isfinite(points[..., 2])]))
        print(f"frame {t}: highest {highest(heights, seen):.2f} m over the floor, seen {seen.mean():.0%}")
        tiles.append(shown(heights, visibility[t]))
    cv2.imwrite(str(options.picture), np.ascontiguousarray(np.concatenate(tiles, axis=1)[..., ::-1]))


if __name__ == "__main__":
    main()
