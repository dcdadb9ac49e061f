"""The source as the target camera would see it if the world were made of known planes. Ours, not the paper's.

Who knows how the source camera stands above the ground knows where in its picture a point of the ground, or of an
upright plane, would be. No depth is estimated: each plane gives one layer, and networks choose. `vehicle` has walls
along and across a road, `stage` upright planes about the point that orbiting cameras look at.
"""

from gcd_model.plane_warp.grids import Grids, PlaneWarps, warp
from gcd_model.plane_warp.path import PathWarpCache, PathWarps, clip_warps, plane_warp, source_mount
from gcd_model.plane_warp.pictures import WarpPictures, channels_of, mirrored
from gcd_model.plane_warp.stage import orbit_mount
from gcd_model.plane_warp.vehicle import trained_mount

__all__ = [
    "Grids",
    "PathWarpCache",
    "PathWarps",
    "PlaneWarps",
    "WarpPictures",
    "channels_of",
    "clip_warps",
    "mirrored",
    "orbit_mount",
    "plane_warp",
    "source_mount",
    "trained_mount",
    "warp",
]
