"""A wall and a table full of shapes, seen from known poses with exact depth."""

import math
from functools import cache
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model import Intrinsics, SeenFrame
from gcd_model.live.eyes import FrameGeometry

LENS = Intrinsics.from_hfov(60.0, 192, 128)
_FINE = 500  # texture pixels a metre
HERE = np.eye(4)


def moved(right: float = 0.0, ahead: float = 0.0, yaw_deg: float = 0.0) -> NDArray[np.float64]:
    """world_from_camera, metres."""
    pose, yaw = np.eye(4), math.radians(yaw_deg)
    pose[0, 0] = pose[2, 2] = math.cos(yaw)
    pose[0, 2], pose[2, 0] = math.sin(yaw), -math.sin(yaw)
    pose[0, 3], pose[2, 3] = right, ahead
    return pose


@cache
def _texture(seed: int) -> NDArray[Any]:
    random, side = np.random.default_rng(seed), 4 * _FINE
    texture = np.full((side, side, 3), 128, np.uint8)
    for _ in range(900):
        (x, y), size = random.integers(0, side, 2).tolist(), int(random.integers(8, 70))
        cv2.rectangle(texture, (x, y), (x + size, y + size), random.integers(0, 256, 3).tolist(), -1)
    return texture


def shot(pose: NDArray[np.float64], arm: int = -1, seed: int = 0) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Picture and depth. arm: column of a striped bar half a metre away; none below 0. seed: of another room."""
    rays = np.concatenate([LENS.rays().numpy(), np.ones((1, LENS.height, LENS.width))]).transpose(1, 2, 0)
    rays = rays @ pose[:3, :3].T
    wall, table = (1.8 - pose[2, 3]) / rays[..., 2], (0.35 - pose[1, 3]) / np.maximum(rays[..., 1], 1e-6)
    depth, on_table = np.minimum(wall, table), table < wall
    point = pose[:3, 3] + rays * depth[..., None]
    across, along = point[..., 0], np.where(on_table, point[..., 2], point[..., 1])
    place = [((each + 2) * _FINE).astype(np.float32) for each in (across, along)]
    seen = [cv2.remap(_texture(10 * seed + k), *place, cv2.INTER_AREA) for k in (0, 1)]
    picture = np.where(on_table[..., None], seen[0], seen[1])
    if arm >= 0:
        picture[:, arm : arm + 24] = np.arange(LENS.height)[:, None, None] // 9 % 2 * 200
        depth[:, arm : arm + 24] = 0.5
    return cv2.GaussianBlur(picture, (3, 3), 0.6).astype(np.uint8), depth.astype(np.float32)


def seen(pose: NDArray[np.float64], arm: int = -1, seed: int = 0) -> SeenFrame:
    """As the live model looks at a frame with depth."""
    picture, depth = shot(pose, arm, seed)
    labels, static = torch.zeros(depth.shape, dtype=torch.uint8), torch.ones(depth.shape, dtype=torch.bool)
    geometry = FrameGeometry(metres=torch.from_numpy(depth), labels=labels, static=static, ood=0.0)
    video = torch.from_numpy(picture).permute(2, 0, 1).float() / 127.5 - 1
    return SeenFrame(
        picture=video, geometry=geometry, lens=LENS, floor=None, world_from_source=torch.eye(4), begins=True, lost=None
    )
