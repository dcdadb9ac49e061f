"""Poses, spherical cameras, camera paths and the pinhole: plain geometry, no network."""

from gcd_model.geometry.mount import CameraMount
from gcd_model.geometry.orbit import Orbit
from gcd_model.geometry.pinhole import Intrinsics, center_crop_box
from gcd_model.geometry.pose import (
    RIGID_TOLERANCE,
    invert_rigid,
    look_at,
    pose_from_axes,
    relative_pose,
    require_rigid,
)
from gcd_model.geometry.spherical import (
    LOOK_AT,
    DeltaFit,
    Spherical,
    SphericalDelta,
    from_pose,
    nearest_delta,
    sphere_poses,
    to_pose,
)
from gcd_model.geometry.trajectory import (
    DRIVING_GOAL_POSITION,
    DRIVING_GOAL_TARGET,
    DRIVING_SOURCE_POSITION,
    DRIVING_SOURCE_TARGET,
    Interpolation,
    Trajectory,
    driving_trajectory,
    fitted_trajectory,
    motion_bucket,
    path_progress,
    pose_trajectory,
    spherical_trajectory,
)

__all__ = [
    "DRIVING_GOAL_POSITION",
    "DRIVING_GOAL_TARGET",
    "DRIVING_SOURCE_POSITION",
    "DRIVING_SOURCE_TARGET",
    "LOOK_AT",
    "RIGID_TOLERANCE",
    "CameraMount",
    "DeltaFit",
    "Interpolation",
    "Intrinsics",
    "Orbit",
    "Spherical",
    "SphericalDelta",
    "Trajectory",
    "center_crop_box",
    "driving_trajectory",
    "fitted_trajectory",
    "from_pose",
    "invert_rigid",
    "look_at",
    "motion_bucket",
    "nearest_delta",
    "path_progress",
    "pose_from_axes",
    "pose_trajectory",
    "relative_pose",
    "require_rigid",
    "sphere_poses",
    "spherical_trajectory",
    "to_pose",
]
