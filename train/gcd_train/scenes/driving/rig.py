"""The nineteen cameras of ParallelDomain-4D on their vehicle: poses that never change in its frame."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.geometry import (
    DRIVING_GOAL_POSITION,
    DRIVING_GOAL_TARGET,
    DRIVING_SOURCE_POSITION,
    DRIVING_SOURCE_TARGET,
    look_at,
)
from gcd_train.scenes.description import Floats, Point, upright

_SIDE_YAW_DEG, _SIDE_M = 60.0, 0.25
_SURROUND: tuple[tuple[float, float, float, float, float], ...] = (
    (-4.0, 0.0, 4.6, 0.0, 42.0),
    (2.0, 3.5, 4.6, -45.0, 42.0),
    (-4.0, 0.0, 4.6, 0.0, 12.0),
    (2.0, 0.0, 4.6, -45.0, 42.0),
    (-10.0, -3.5, 10.0, 0.0, 12.0),
    (-4.0, 3.5, 4.6, 0.0, 12.0),
    (2.0, 0.0, 4.6, -135.0, 42.0),
    (2.0, 0.0, 4.6, 0.0, 12.0),
    (-10.0, 3.5, 7.0, 0.0, 12.0),
    (2.0, 0.0, 4.6, 135.0, 12.0),
    (2.0, 3.5, 4.6, -135.0, 12.0),
    (14.0, 0.0, 4.6, 180.0, 12.0),
    (2.0, -3.5, 7.0, 90.0, 42.0),
    (-4.0, 3.5, 4.6, -90.0, 12.0),
    (8.0, 0.0, 4.6, 0.0, 12.0),
)
"""camera1 to camera15: x, y, z in metres, to which side (0 ahead, 90 left) and how far down they look, degrees.

Picked one after the other from 720 candidates: the first nine as those that see most of what the path from the forward
to the top-down pose sees and no camera before them does, the others likewise for views around the car. Over six drives
the rig sees 99.9 % of what the path sees within 150 m, and 98 % of what is seen around the car.
"""


def vehicle_from_camera() -> dict[str, NDArray[np.float64]]:
    """Pose [4, 4] of every camera in the vehicle's frame (x ahead, y left, z up; the ground is z = 0), metres.

    camera0 to camera15 stand around and above the car, camera0 where the paper's path ends; yaw-0 looks ahead from
    where that path begins, yaw-60 and yaw-neg-60 stand beside it and look to the left and to the right.
    """
    poses = {"camera0": _looking(DRIVING_GOAL_POSITION, DRIVING_GOAL_TARGET)}
    for number, (x, y, z, azimuth_deg, down_deg) in enumerate(_SURROUND, start=1):
        poses[f"camera{number}"] = _turned((x, y, z), azimuth_deg, down_deg)
    poses["yaw-0"] = _looking(DRIVING_SOURCE_POSITION, DRIVING_SOURCE_TARGET)
    for name, side in (("yaw-60", 1.0), ("yaw-neg-60", -1.0)):
        x, y, z = DRIVING_SOURCE_POSITION
        poses[name] = _turned((x, y + side * _SIDE_M, z), side * _SIDE_YAW_DEG, 0.0)
    return poses


def on_vehicle(rows: Floats) -> dict[str, NDArray[np.float64]]:
    """world_from_camera [T, 4, 4] of every camera, where the vehicle is at x, y, z, yaw [T, 4]."""
    world_from_vehicle = rigid(rows)
    return {name: world_from_vehicle @ pose for name, pose in vehicle_from_camera().items()}


def rigid(rows: NDArray[Any]) -> NDArray[np.float64]:
    """x, y, z, yaw [T, 4] as rigid transforms [T, 4, 4]."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = upright(rows)
    return poses


def _turned(position: Point, azimuth_deg: float, down_deg: float) -> NDArray[np.float64]:
    azimuth, down = np.radians(azimuth_deg), np.radians(down_deg)
    ahead = (np.cos(azimuth) * np.cos(down), np.sin(azimuth) * np.cos(down), -np.sin(down))
    x, y, z = (float(at + step) for at, step in zip(position, ahead, strict=True))
    return _looking(position, (x, y, z))


def _looking(position: Point, target: Point) -> NDArray[np.float64]:
    return look_at(torch.tensor(position, dtype=torch.float64), torch.tensor(target, dtype=torch.float64)).numpy()
