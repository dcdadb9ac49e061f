"""Cameras as the published metadata tells them: quaternions, and Blender's axes (x right, y up, looking along -z)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics

Doubles = NDArray[np.float64]

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def blender_pose(world_from_camera: Doubles) -> Doubles:
    """[..., 4, 4] with x right, y down, z ahead as a pose with Blender's axes; its own inverse."""
    return world_from_camera @ _FLIP


def quaternions(turns: Doubles) -> Doubles:
    """Rotation matrices [..., 3, 3] as unit quaternions w, x, y, z [..., 4], w >= 0; inverse of `rotations`.

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix, so no case is singular.
    Source: Bar-Itzhack 2000, version 1.
    """
    m = np.asarray(turns, np.float64)
    k = np.empty((*m.shape[:-2], 4, 4))
    trace = np.trace(m, axis1=-2, axis2=-1)
    k[..., 0, 0] = trace
    k[..., 1:, 1:] = m + np.swapaxes(m, -1, -2) - trace[..., None, None] * np.eye(3)
    axial = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
    k[..., 0, 1:], k[..., 1:, 0] = axial, axial
    largest = np.linalg.eigh(k)[1][..., -1]
    return np.where(largest[..., :1] < 0, -largest, largest)


def ray_lengths(lens: Intrinsics) -> NDArray[np.float32]:
    """[H, W]: distance to the camera centre over depth along the axis, for the middle of every pixel."""
    x = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
    y = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
    return np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2).astype(np.float32)


@dataclass(frozen=True, kw_only=True, slots=True)
class Seen:
    """Where points fall in a picture. at: [..., 2], x and y as shares of width and height. ahead: [...], metres."""

    at: Doubles
    ahead: Doubles


def project(points: Doubles, world_from_camera: Doubles, lens: Intrinsics) -> Seen:
    """World points [T, ..., 3] as a camera with poses [T, 4, 4] sees them; what is behind it gets odd places."""
    camera_from_world = np.linalg.inv(world_from_camera)
    turn, shift = camera_from_world[:, :3, :3], camera_from_world[:, :3, 3]
    flat = points.reshape(len(points), -1, 3)
    local = np.einsum("tij,tnj->tni", turn, flat) + shift[:, None]
    ahead = local[..., 2]
    depth = np.where(np.abs(ahead) < 1e-9, 1e-9, ahead)
    x = (lens.fx * local[..., 0] / depth + lens.cx) / lens.width
    y = (lens.fy * local[..., 1] / depth + lens.cy) / lens.height
    shape = points.shape[:-1]
    return Seen(at=np.stack([x, y], -1).reshape(*shape, 2), ahead=ahead.reshape(shape))
