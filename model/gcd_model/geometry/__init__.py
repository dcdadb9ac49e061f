"""Poses, spherical cameras, camera paths and the pinhole: plain geometry, no network. All of both chapters."""

from gcd_model.geometry.paths import *  # noqa: F403
from gcd_model.geometry.pose import *  # noqa: F403
