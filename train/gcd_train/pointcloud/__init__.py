"""Point clouds of several depth cameras, drawn as another camera sees them: no cache, no float64, no GPU needed."""

from gcd_train.pointcloud.holes import fill_holes
from gcd_train.pointcloud.options import SplatOptions
from gcd_train.pointcloud.published import published_picture, published_tensor, render_lens
from gcd_train.pointcloud.splat import Splatted, splat
from gcd_train.pointcloud.unproject import planar_from_distance, unproject
from gcd_train.pointcloud.visibility import depth_visibility, visibility

__all__ = [
    "SplatOptions",
    "Splatted",
    "depth_visibility",
    "fill_holes",
    "planar_from_distance",
    "published_picture",
    "published_tensor",
    "render_lens",
    "splat",
    "unproject",
    "visibility",
]
