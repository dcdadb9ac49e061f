"""Point clouds of several depth cameras, drawn as another camera sees them: no cache, no float64, no GPU needed."""

from gcd_train.pointcloud.project import SplatOptions, planar_from_distance, unproject
from gcd_train.pointcloud.published import (
    depth_visibility,
    fill_holes,
    published_picture,
    published_tensor,
    render_lens,
    visibility,
)
from gcd_train.pointcloud.splat import Splatted, splat

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
