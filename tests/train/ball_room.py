"""A world for point clouds that needs no renderer: a painted floor, painted balls and a dome, met by rays exactly."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics, sphere_poses
from gcd_train.data.sample import SceneView

Array = NDArray[np.float64]
DOME_M, FLOOR, DOME, BALL = 40.0, 24, 29, 5

RIG = [(90.0 * step, 45.0) for step in range(4)] + [(15.0 + 30.0 * step, 5.0) for step in range(12)]
"""Azimuth and elevation of Kubric-4D's sixteen cameras, degrees; all stand 15 m from (0, 0, 1)."""


@dataclass(frozen=True, kw_only=True)
class Ball:
    centre: Array
    radius: float
    tint: Array


def _balls() -> list[Ball]:
    random = np.random.default_rng(4)
    radii = random.uniform(0.5, 1.4, 10)
    return [
        Ball(centre=np.array([*random.uniform(-5, 5, 2), radius]), radius=radius, tint=random.uniform(0.2, 0.9, 3))
        for radius in radii
    ]


BALLS = _balls()


def rig_poses(angles: list[tuple[float, float]], radius_m: float = 15.0) -> Array:
    """world_from_camera [N, 4, 4]."""
    return sphere_poses(torch.tensor([[*each, radius_m] for each in angles], dtype=torch.float64)).numpy()


def meet(eye: Array, rays: Array) -> tuple[Array, NDArray[np.int64]]:
    """How many times its length each ray [..., 3] goes, and what it meets: 0 the dome, 1 the floor, from 2 on balls."""
    down = np.minimum(rays[..., 2], -1e-9)
    reach = [_sphere(eye, rays, np.zeros(3), DOME_M)[1], np.where(rays[..., 2] < -1e-9, -eye[2] / down, np.inf)]
    reach += [_sphere(eye, rays, ball.centre, ball.radius)[0] for ball in BALLS]
    return np.min(reach, axis=0), np.argmin(reach, axis=0)


def photograph(world_from_camera: Array, lens: Intrinsics) -> SceneView:
    """What a camera sees: one ray a pixel, through its middle."""
    u = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
    v = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
    right, down = np.meshgrid(u, v)
    rays = np.stack([right, down, np.ones_like(right)], -1) @ world_from_camera[:3, :3].T  # 1 m along the axis
    eye = world_from_camera[:3, 3]
    depth, met = meet(eye, rays)
    tints = np.stack([np.array([0.5, 0.6, 0.9]), np.array([0.6, 0.5, 0.4]), *[ball.tint for ball in BALLS]])
    waves = np.array([0.15, 0.9, *[2.0] * len(BALLS)])
    colour = _paint(eye + depth[..., None] * rays, tints[met], waves[met])
    return SceneView(
        rgb=np.clip(colour * 255, 0, 255).astype(np.uint8),
        depth=depth.astype(np.float32),
        classes=np.array([DOME, FLOOR, *[BALL] * len(BALLS)], np.uint8)[met],
        instances=np.maximum(met - 1, 0).astype(np.uint16),
        world_from_camera=world_from_camera,
        lens=lens,
    )


def _sphere(eye: Array, rays: Array, centre: Array, radius: float) -> tuple[Array, Array]:
    """Where rays enter and leave, inf where they pass by."""
    away = eye - centre
    a, b = (rays**2).sum(-1), rays @ away
    inner = b**2 - a * (away @ away - radius**2)
    root = np.sqrt(np.maximum(inner, 0.0))
    enters = np.where((inner > 0) & (-b - root > 0), (-b - root) / a, np.inf)
    return enters, np.where(inner > 0, (-b + root) / a, np.inf)


def _paint(points: Array, tint: Array, waves: Array) -> Array:
    along = points * waves[..., None]
    pattern = np.sin(along[..., 0] * 2) * np.sin(along[..., 1] * 2) * np.cos(along[..., 2])
    return tint * (1.0 + 0.4 * pattern[..., None])
