"""From the world to what is drawn: the camera's pinhole and the sun's parallel light, as OpenGL's clip space."""

import math

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.description import Extent


def clip_from_camera(hfov_deg: float, aspect: float, extent: Extent) -> NDArray[np.float64]:
    """From camera axes (x right, y down, z ahead) to OpenGL's clip space: [4, 4]. aspect: width over height."""
    near, far = extent.near_m, extent.far_m
    focal = 1 / math.tan(math.radians(hfov_deg) / 2)
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = focal, -focal * aspect
    matrix[2, 2] = (far + near) / (far - near)
    matrix[2, 3] = -2 * far * near / (far - near)
    matrix[3, 2] = 1
    return matrix


def sunlight_from_world(sun_to: NDArray[np.float64], focus: NDArray[np.float64], extent: Extent) -> NDArray[np.float64]:
    """Orthographic view along the sunlight around `focus`, snapped to whole shadow pixels against flicker: [4, 4].

    sun_to: [3], unit vector. focus: [3], metres.
    """
    aside = [0.0, 0.0, 1.0] if abs(sun_to[2]) < 0.99 else [1.0, 0.0, 0.0]  # any axis that is not the sun's
    right = np.cross(aside, sun_to)
    right /= np.linalg.norm(right)
    up = np.cross(sun_to, right)
    turn = np.stack([right, up, sun_to])
    radius = extent.shadow_radius_m
    pixel = 2 * radius / extent.shadow_pixels
    centre = np.round(turn @ focus / pixel) * pixel
    matrix = np.eye(4)
    matrix[:2, :3] = turn[:2] / radius
    matrix[:2, 3] = -centre[:2] / radius
    matrix[2, :3] = -turn[2] / extent.shadow_depth_m
    matrix[2, 3] = centre[2] / extent.shadow_depth_m
    return matrix
